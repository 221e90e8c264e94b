// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines of chips that may sleep: expanders. A worker calls them (the bench panics if the core does), and everything
//! else continues.

use pinion_testbench::rig::Rig;

const PIN: u32 = 50;
const FAN: &str = "config_digital_out oid=0 pin=50 value=0 default_value=0 max_duration=0";
const STEPPER: &str = "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0";

/// An MCU with pins 50 and 51 on an expander. A call to the expander takes 20000 ticks (0.4 ms).
fn rig(objects: &[&str]) -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.extend([PIN, PIN + 1]);
    rig.bench.state().answer_ticks = 20_000;
    rig.configure(objects);
    rig
}

#[test]
fn an_output_is_written_by_its_worker_and_steps_are_in_time() {
    let mut rig = rig(&[FAN, STEPPER]);
    rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=1000 count=200 add=0"]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@10000 on_ticks=1",
        "queue_digital_out oid=0 clock=@90000 on_ticks=0",
    ]);
    rig.run_until(200_000);
    assert_eq!(rig.edges(PIN), [(30_000, 1), (110_000, 0)]);
    assert!(rig.edges(1).iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
}

#[test]
fn a_command_that_sets_it_is_over_when_it_is_set() {
    let mut rig = rig(&[FAN]);
    rig.begin("update_digital_out oid=0 value=1");
    assert!(rig.mcu.is_held());
    rig.run_until(20_000);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.edges(PIN), [(20_000, 1)]);
}

#[test]
fn a_command_waits_for_its_own_value_where_a_write_is_under_way() {
    let mut rig = rig(&[FAN]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.run_until(2000);
    rig.send("update_digital_out oid=0 value=0");
    assert_eq!(rig.now(), 41_000);
    assert_eq!(rig.edges(PIN), [(21_000, 1), (41_000, 0)]);
}

#[test]
fn a_shutdown_reaches_it_through_what_is_under_way() {
    let mut rig = rig(&[FAN, "config_digital_out oid=2 pin=51 value=1 default_value=0 max_duration=0"]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.run_until(2000);
    rig.send("emergency_stop");
    assert!(rig.mcu.has_pending_values());
    rig.run_until(100_000);
    assert_eq!(rig.edges(PIN), [(21_000, 1), (61_000, 0)]);
    assert_eq!(rig.edges(PIN + 1), [(41_000, 0)]);
    assert!(!rig.mcu.has_pending_values());
}

#[test]
fn a_step_pin_is_refused_with_the_reason() {
    for (step, dir) in [(50, 1), (1, 50)] {
        let mut rig = Rig::new();
        rig.bench.state().sleeping.insert(PIN);
        rig.send("allocate_oids count=1");
        rig.stops_on(
            &format!("config_stepper oid=0 step_pin={step} dir_pin={dir} invert_step=0 step_pulse_ticks=100"),
            "Unable to open out GPIO chip line",
        );
        let notes = rig.notes();
        let named = |note: &String| ["gpio50", "behind a bus", "choose"].iter().all(|word| note.contains(word));
        assert!(notes.iter().any(named), "{notes:?}");
    }
}

const HOMING: &[&str] = &["config_endstop oid=2 pin=51 pull_up=0", "config_trsync oid=3"];

fn home(rig: &mut Rig, at: u64) {
    rig.send("trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=4");
    rig.send(&format!(
        "endstop_home oid=2 clock=@{at} sample_ticks=100 sample_count=2 rest_ticks=50000 pin_value=1 trsync_oid=3 trigger_reason=1"
    ));
}

#[test]
fn an_endstop_is_sampled_by_the_worker() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(115_000, 1)]);
    home(&mut rig, 10_000);
    rig.run_until(1_000_000);
    // Reads begin at 10000, 60000 and 110000. The last one ends at 130000, after the change. The read that confirms it
    // ends at 150000.
    assert_eq!(rig.responses(), ["trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@150050"]);
}

#[test]
fn a_read_that_began_before_a_sample_is_due_is_not_taken_for_it() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(0, 1), (25_000, 0)]);
    home(&mut rig, 1000);
    rig.run_until(5000);
    // Homing begins again during the read.
    home(&mut rig, 10_000);
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [""; 0], "the switch was open at 41000, when the second read ended");
}

#[test]
fn a_query_is_answered_with_a_fresh_read_before_the_next_command() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(10_000, 1)]);
    assert_eq!(rig.ask("endstop_query_state oid=2"), "endstop_state oid=2 homing=0 next_clock=@-10000000 pin_value=1");
    assert_eq!(rig.now(), 20_000);
    // The same during a sample of a homing.
    rig.bench.script_input(PIN + 1, &[(20_000, 0)]);
    home(&mut rig, 30_000);
    rig.run_until(31_000);
    rig.begin("endstop_query_state oid=2");
    assert!(rig.mcu.is_held());
    rig.run_until(60_000);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.responses(), ["endstop_state oid=2 homing=1 next_clock=@-10000000 pin_value=0"]);
}

#[test]
fn a_chip_that_fails_stops_the_mcu_and_is_tried_until_it_answers() {
    let mut rig = rig(&[FAN]);
    rig.send("update_digital_out oid=0 value=1");
    rig.bench.state().broken.insert(PIN);
    rig.stops_on("update_digital_out oid=0 value=0", "GPIO line write failed");
    rig.run_until(40_000_000);
    assert_eq!(rig.mcu.pending_value(), Some("digital output oid 0 (gpio50)"));
    rig.bench.state().broken.clear();
    rig.run_until(50_000_000);
    assert_eq!(rig.mcu.pending_value(), None);
    assert!(!rig.bench.level(PIN));
    let notes = rig.notes();
    assert_eq!(notes.iter().filter(|note| note.starts_with("trouble: GPIO line write failed")).count(), 1, "{notes:?}");
    assert_eq!(notes.last().unwrap(), "safe: digital output oid 0 (gpio50)");
}

/// The last setup decides: nothing drives an input. A value that stays pending would keep a config_reset waiting.
#[test]
fn a_line_that_becomes_an_input_has_no_pending_value() {
    for hangs in [false, true] {
        let mut rig = rig(&[FAN, "config_buttons oid=3 button_count=1"]);
        if hangs {
            rig.bench.state().answer_ticks = 600_000_000;
        } else {
            rig.bench.state().broken.insert(PIN);
        }
        rig.send("emergency_stop");
        rig.run_until(1_000_000);
        assert_eq!(rig.mcu.pending_value(), Some("digital output oid 0 (gpio50)"), "hangs: {hangs}");
        rig.bench.state().broken.clear();
        rig.send_all(&["clear_shutdown", "buttons_add oid=3 pos=0 pin=50 pull_up=0"]);
        assert_eq!(rig.mcu.pending_value(), None, "hangs: {hangs}");
    }
}

/// 100 ms in ticks.
const UNREAD_LIMIT: u64 = 5_000_000;

/// The time of the sample that closed the switch, as klippy computes it.
fn trigger(rig: &mut Rig) -> i64 {
    let state = rig.ask("endstop_query_state oid=2");
    let next_clock = state.split(['@', ' ']).filter_map(|word| word.parse::<i64>().ok()).next().unwrap();
    next_clock - 50_000
}

#[test]
fn an_endstop_is_dated_by_the_end_of_the_read_that_saw_it() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(115_000, 1)]);
    home(&mut rig, 10_000);
    rig.run_until(1_000_000);
    // The read that saw it began at 110000.
    assert_eq!(trigger(&mut rig), 130_000);
}

#[test]
fn an_endstop_is_dated_by_its_read_after_a_stall_too() {
    // The core stands still for 15 ms before the read is requested.
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(800_000, 1)]);
    home(&mut rig, 10_000);
    rig.run_until(80_000);
    rig.stall_until(850_000);
    rig.run_until(2_000_000);
    assert_eq!(trigger(&mut rig), 870_000);
    // The core stands still while the worker reads. The level that the read saw counts from the read's end.
    let mut rig = self::rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(75_000, 1)]);
    home(&mut rig, 10_000);
    rig.run_until(70_000);
    rig.stall_until(820_000);
    rig.run_until(2_000_000);
    assert_eq!(trigger(&mut rig), 80_000);
}

#[test]
fn one_failed_read_ends_no_homing_and_three_do_at_once() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(115_000, 1)]);
    home(&mut rig, 10_000);
    rig.run_until(100_000);
    rig.bench.state().nacks.insert(PIN + 1, 2);
    rig.sends_until(1_000_000, &["trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@150050"]);
    let mut rig = self::rig(HOMING);
    home(&mut rig, 10_000);
    rig.run_until(100_000);
    rig.bench.state().nacks.insert(PIN + 1, 3);
    rig.stops_by(130_000, "GPIO line read failed");
    let notes = rig.notes();
    assert!(notes.iter().any(|note| note.contains("endstop oid 2 (gpio51): pin 51 is gone: plug")), "{notes:?}");
}

#[test]
fn a_homing_whose_chip_hangs_stops_the_mcu_after_100_ms() {
    let mut rig = rig(HOMING);
    home(&mut rig, 10_000);
    rig.run_until(100_000);
    rig.bench.state().answer_ticks = 500_000_000;
    rig.run_until(110_000 + UNREAD_LIMIT - 1);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(110_000 + UNREAD_LIMIT, "GPIO line read failed");
    let notes = rig.notes();
    let said = "endstop oid 2 (gpio51): gpio51 has not answered for 100 ms: ";
    assert!(notes.iter().any(|note| note.contains(said)), "{notes:?}");
}

#[test]
fn a_query_reads_again_for_100_ms() {
    let mut rig = rig(HOMING);
    rig.bench.script_input(PIN + 1, &[(0, 1)]);
    // 20 reads with three tries each.
    rig.bench.state().nacks.insert(PIN + 1, 60);
    let state = rig.ask("endstop_query_state oid=2");
    assert_eq!(state, "endstop_state oid=2 homing=0 next_clock=@-10000000 pin_value=1");
    assert_eq!(rig.now(), 21 * 20_000);
    rig.bench.state().broken.insert(PIN + 1);
    rig.send("endstop_query_state oid=2");
    assert_eq!(rig.now(), 21 * 20_000 + UNREAD_LIMIT);
    assert_eq!(rig.shutdown().as_deref(), Some("GPIO line read failed"));
}

#[test]
fn an_output_is_written_again_before_that_stops_the_mcu() {
    let mut rig = rig(&[FAN]);
    rig.bench.state().nacks.insert(PIN, 2);
    rig.send("update_digital_out oid=0 value=1");
    assert_eq!(rig.edges(PIN), [(20_000, 1)]);
    rig.bench.state().nacks.insert(PIN, 2);
    rig.send("emergency_stop");
    rig.run_until(40_000);
    assert_eq!((rig.edges(PIN), rig.mcu.has_pending_values()), (vec![(40_000, 0)], false));
    let notes = rig.notes();
    assert!(!notes.iter().any(|note| note.contains("trouble")), "{notes:?}");
}

#[test]
fn a_driver_that_took_its_time_to_give_up_is_not_asked_again() {
    // A call that fails takes 25 ms.
    let mut rig = rig(&[FAN]);
    rig.bench.state().fail_ticks = 1_250_000;
    rig.bench.state().nacks.insert(PIN, 1);
    rig.stops_on("update_digital_out oid=0 value=1", "GPIO line write failed");
}

#[test]
fn a_chip_that_hung_during_a_reset_keeps_no_line_once_it_is_back() {
    let mut rig = rig(HOMING);
    home(&mut rig, 10_000);
    // A call takes 12 s.
    rig.bench.state().answer_ticks = 600_000_000;
    rig.run_until(20_000);
    rig.send_all(&["emergency_stop", "config_reset"]);
    rig.forget_responses();
    rig.refuses(&[HOMING[0]], "Unable to open in GPIO chip line");
    rig.send("config_reset");
    let is_held = |rig: &Rig| rig.bench.state().held.contains(&(PIN + 1));
    rig.run_until(600_000_000);
    assert!(is_held(&rig), "the chip still hangs");
    rig.run_until(600_010_000);
    rig.run_until(600_010_001);
    assert!(!is_held(&rig));
    rig.bench.state().answer_ticks = 20_000;
    rig.forget_responses();
    rig.configure(HOMING);
    rig.bench.script_input(PIN + 1, &[(0, 1)]);
    assert!(rig.ask("endstop_query_state oid=2").ends_with("pin_value=1"));
}
