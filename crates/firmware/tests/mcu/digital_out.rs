// SPDX-License-Identifier: GPL-3.0-or-later
//! Digital outputs, checked tick by tick.

use pinion_testbench::rig::Rig;

const PIN: u32 = 20;

/// A heater: off by default, with a refresh at least every 100000 ticks.
const HEATER: &str = "config_digital_out oid=0 pin=20 value=0 default_value=0 max_duration=100000";
/// A fan: it needs no refresh.
const FAN: &str = "config_digital_out oid=0 pin=20 value=0 default_value=0 max_duration=0";
/// An enable pin that is high when the motor is off.
const ENABLE: &str = "config_digital_out oid=0 pin=20 value=0 default_value=1 max_duration=0";
const CYCLE: &str = "set_digital_out_pwm_cycle oid=0 cycle_ticks=10000";

fn expect_shutdown(rig: &Rig, text: &str) {
    assert_eq!(rig.shutdown().as_deref(), Some(text));
}

#[test]
fn changes_come_on_their_ticks() {
    let mut rig = Rig::configured(&[FAN]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@1000 on_ticks=1",
        "queue_digital_out oid=0 clock=@1001 on_ticks=0",
        "queue_digital_out oid=0 clock=@5000 on_ticks=77",
    ]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(PIN), [(1000, 1), (1001, 0), (5000, 1)]);
}

#[test]
fn software_pwm_pulses_to_the_tick_and_changes_its_duty_between() {
    let mut rig = Rig::configured(&[FAN, CYCLE]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@1000 on_ticks=2500",
        "queue_digital_out oid=0 clock=@31000 on_ticks=9999",
        "queue_digital_out oid=0 clock=@51000 on_ticks=10000",
        "queue_digital_out oid=0 clock=@71000 on_ticks=1",
        "queue_digital_out oid=0 clock=@91000 on_ticks=0",
    ]);
    rig.run_until(200_000);
    assert_eq!(
        rig.edges(PIN),
        [
            (1000, 1),
            (3500, 0),
            (11_000, 1),
            (13_500, 0),
            (21_000, 1),
            (23_500, 0),
            // 99.99 %
            (31_000, 1),
            (40_999, 0),
            (41_000, 1),
            (50_999, 0),
            // Full on, without a gap.
            (51_000, 1),
            // 0.01 %
            (71_001, 0),
            (81_000, 1),
            (81_001, 0),
        ]
    );
    assert!(!rig.bench.level(PIN));
}

#[test]
fn software_pwm_changes_in_the_middle_of_a_cycle() {
    let mut rig = Rig::configured(&[FAN, CYCLE]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=5000");
    rig.run_until(12_000);
    // On since 11000. The change at 14000 comes before the end of the pulse.
    rig.send("queue_digital_out oid=0 clock=@14000 on_ticks=2000");
    rig.run_until(30_000);
    assert_eq!(rig.edges(PIN), [(1000, 1), (6000, 0), (11_000, 1), (16_000, 0), (24_000, 1), (26_000, 0)]);
}

#[test]
fn software_pwm_pulses_on_until_its_next_change() {
    let mut rig = Rig::configured(&[FAN, CYCLE]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=5000");
    rig.run_until(12_000);
    rig.send("queue_digital_out oid=0 clock=@33000 on_ticks=1000");
    rig.run_until(40_000);
    assert_eq!(
        rig.edges(PIN),
        [(1000, 1), (6000, 0), (11_000, 1), (16_000, 0), (21_000, 1), (26_000, 0), (31_000, 1), (34_000, 0)]
    );
}

#[test]
fn a_change_before_the_pulses_first_end_is_loaded_in_its_place() {
    let mut rig = Rig::configured(&[FAN, CYCLE]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@1000 on_ticks=9000",
        "queue_digital_out oid=0 clock=@3000 on_ticks=0",
    ]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(PIN), [(1000, 1), (3000, 0)]);
}

#[test]
fn a_heater_that_is_not_refreshed_is_switched_off() {
    for (cycle, on_ticks) in [(0, 1), (10_000, 4000)] {
        let mut rig = Rig::configured(&[HEATER]);
        rig.send(&format!("set_digital_out_pwm_cycle oid=0 cycle_ticks={cycle}"));
        rig.send(&format!("queue_digital_out oid=0 clock=@1000 on_ticks={on_ticks}"));
        rig.run_until(100_999);
        assert_eq!(rig.shutdown(), None);
        rig.run_until(101_000);
        expect_shutdown(&rig, "Missed scheduling of next digital out event");
        assert!(!rig.bench.level(PIN));
        rig.edges(PIN);
        rig.run_until(500_000);
        assert_eq!(rig.edges(PIN), []);
    }
}

#[test]
fn a_heater_that_is_refreshed_in_time_pulses_on() {
    let mut rig = Rig::configured(&[HEATER, CYCLE]);
    for n in 0..20 {
        rig.send(&format!("queue_digital_out oid=0 clock=@{} on_ticks=4000", 1000 + 100_000 * n));
        rig.run_until(500 + 100_000 * (n + 1));
    }
    assert_eq!(rig.shutdown(), None);
    let edges = rig.edges(PIN);
    assert_eq!(edges.len(), 400);
    assert!(edges.chunks(2).zip(0..).all(|(pulse, n)| pulse == [(1000 + 10_000 * n, 1), (5000 + 10_000 * n, 0)]));
}

#[test]
fn a_heater_that_is_off_need_not_be_refreshed() {
    let mut rig = Rig::configured(&[HEATER, CYCLE]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@1000 on_ticks=4000",
        "queue_digital_out oid=0 clock=@50000 on_ticks=0",
    ]);
    rig.run_until(10_000_000);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn an_output_that_is_on_by_default_is_refreshed_while_it_is_off() {
    let mut rig = Rig::configured(&["config_digital_out oid=0 pin=20 value=1 default_value=1 max_duration=100000"]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.run_until(500_000);
    assert_eq!(rig.shutdown(), None);
    rig.send("queue_digital_out oid=0 clock=@501000 on_ticks=0");
    rig.run_until(601_000);
    expect_shutdown(&rig, "Missed scheduling of next digital out event");
    assert_eq!(rig.edges(PIN), [(501_000, 0), (601_000, 1)]);
}

#[test]
fn a_change_past_max_duration_is_refused_at_once() {
    // While the output is on, and while a change to on is queued.
    let mut rig = Rig::configured(&[HEATER]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.run_until(2000);
    rig.send("queue_digital_out oid=0 clock=@101001 on_ticks=0");
    expect_shutdown(&rig, "Scheduled digital out event will exceed max_duration");

    let mut rig = Rig::configured(&[HEATER]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.send("queue_digital_out oid=0 clock=@101001 on_ticks=0");
    rig.run_until(999);
    assert_eq!(rig.shutdown(), None);
    rig.run_until(1000);
    expect_shutdown(&rig, "Scheduled digital out event will exceed max_duration");

    let mut rig = Rig::configured(&[HEATER]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.run_until(2000);
    rig.send("queue_digital_out oid=0 clock=@101000 on_ticks=0");
    rig.run_until(200_000);
    assert_eq!(rig.shutdown(), None);
    assert_eq!(rig.edges(PIN), [(1000, 1), (101_000, 0)]);
}

#[test]
fn an_output_is_changed_at_once() {
    let mut rig = Rig::configured(&[HEATER]);
    rig.run_until(500);
    rig.send("update_digital_out oid=0 value=1");
    rig.run_until(50_000);
    rig.send("update_digital_out oid=0 value=1");
    rig.run_until(149_999);
    assert_eq!(rig.shutdown(), None);
    assert_eq!(rig.edges(PIN), [(500, 1)]);
    rig.run_until(150_000);
    expect_shutdown(&rig, "Missed scheduling of next digital out event");
    assert_eq!(rig.edges(PIN), [(150_000, 0)]);
}

#[test]
fn an_output_that_is_changed_at_once_stops_pulsing() {
    let mut rig = Rig::configured(&[FAN, CYCLE]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=4000");
    rig.run_until(12_000);
    rig.send("update_digital_out oid=0 value=0");
    rig.run_until(100_000);
    assert_eq!(rig.edges(PIN), [(1000, 1), (5000, 0), (11_000, 1), (12_000, 0)]);
    rig.send("queue_digital_out oid=0 clock=@110000 on_ticks=4000");
    rig.run_until(115_000);
    assert_eq!(rig.edges(PIN), [(110_000, 1), (114_000, 0)]);
}

#[test]
fn an_output_with_a_queue_is_not_changed_at_once() {
    let mut rig = Rig::configured(&[FAN]);
    rig.send_all(&["queue_digital_out oid=0 clock=@1000 on_ticks=1", "update_digital_out oid=0 value=1"]);
    expect_shutdown(&rig, "update_digital_out not valid with active queue");
}

#[test]
fn the_cycle_does_not_change_under_a_queue() {
    let mut rig = Rig::configured(&[FAN]);
    rig.send_all(&["queue_digital_out oid=0 clock=@1000 on_ticks=1", CYCLE]);
    expect_shutdown(&rig, "Can not set soft pwm cycle ticks while updates pending");
}

#[test]
fn a_shutdown_drives_every_output_to_its_default() {
    let mut rig = Rig::configured(&[
        ENABLE,
        "config_digital_out oid=1 pin=21 value=1 default_value=0 max_duration=0",
        "config_digital_out oid=2 pin=22 value=1 default_value=1 max_duration=0",
    ]);
    rig.send_all(&[
        "set_digital_out_pwm_cycle oid=2 cycle_ticks=1000",
        "queue_digital_out oid=2 clock=@100 on_ticks=500",
    ]);
    rig.run_until(700);
    assert!(!rig.bench.level(22));
    rig.send("emergency_stop");
    assert_eq!([20, 21, 22].map(|pin| rig.bench.level(pin)), [true, false, true]);
    rig.run_until(100_000);
    assert_eq!([20, 21, 22].map(|pin| rig.bench.level(pin)), [true, false, true]);
    // The guardian has the same values.
    assert_eq!([20, 21, 22].map(|pin| rig.bench.shutdown_value(pin)), [true, false, true]);
}

#[test]
fn pulses_go_on_across_the_clocks_wrap() {
    let mut rig = Rig::at((1 << 32) - 20_000);
    rig.configure(&[HEATER, CYCLE]);
    for n in 0..4 {
        rig.send(&format!("queue_digital_out oid=0 clock=@{} on_ticks=4000", 1000 + 10_000 * n));
    }
    rig.run_until(39_999);
    let expected: Vec<_> = (0..4).flat_map(|n| [(1000 + 10_000 * n, 1), (5000 + 10_000 * n, 0)]).collect();
    assert_eq!(rig.edges(PIN), expected);
}

#[test]
fn a_line_that_fails_stops_the_mcu_and_the_other_outputs_are_safe() {
    let mut rig = Rig::configured(&[FAN, "config_digital_out oid=1 pin=21 value=1 default_value=0 max_duration=0"]);
    rig.send("queue_digital_out oid=0 clock=@1000 on_ticks=1");
    rig.bench.state().broken.insert(PIN);
    rig.run_until(2000);
    expect_shutdown(&rig, "GPIO line write failed");
    assert!(!rig.bench.level(21));
}

#[test]
fn a_pin_that_is_set_once_stays_and_may_be_set_again() {
    let mut rig = Rig::new();
    rig.send_all(&[
        "set_digital_out pin=30 value=1",
        "set_digital_out pin=31 value=0",
        "set_digital_out pin=31 value=1",
    ]);
    assert_eq!(rig.shutdown(), None);
    assert!(rig.bench.level(30) && rig.bench.level(31));
    // An output takes over the line without a gap.
    rig.edges(30);
    rig.configure(&["config_digital_out oid=0 pin=30 value=1 default_value=1 max_duration=0"]);
    assert_eq!(rig.edges(30), []);
    rig.send("update_digital_out oid=0 value=0");
    assert!(!rig.bench.level(30));
    // The line can also be set while the MCU runs, because it is claimed already.
    rig.send("set_digital_out pin=31 value=0");
    assert_eq!(rig.shutdown(), None);
    assert!(!rig.bench.level(31));
    rig.bench.state().broken.insert(31);
    rig.send("set_digital_out pin=31 value=1");
    expect_shutdown(&rig, "GPIO line write failed");
    let note = rig.notes().pop().unwrap();
    assert!(note.contains("set_digital_out"), "{note}");
}

#[test]
fn as_many_pins_may_be_set_once_as_the_mcu_promises() {
    let mut rig = Rig::new();
    (0..256).for_each(|pin| rig.send(&format!("set_digital_out pin={pin} value=1")));
    assert_eq!(rig.shutdown(), None);
    rig.send("set_digital_out pin=256 value=1");
    expect_shutdown(&rig, "Unable to open out GPIO chip line");
}

#[test]
fn a_pin_that_is_set_once_belongs_where_the_output_that_takes_it_does() {
    let mut rig = Rig::new();
    rig.send("set_digital_out pin=30 value=1");
    rig.configure(&["config_digital_out oid=0 pin=30 value=1 default_value=0 max_duration=0"]);
    assert!(!rig.bench.shutdown_value(30));
    rig.send("emergency_stop");
    assert!(!rig.bench.level(30));
}

/// klippy's `[duplicate_pin_override]`: two users of one line.
/// The MCU and the guardian drive a heater off, whatever else was set on its line.
#[test]
fn a_line_that_is_set_beside_its_object_keeps_the_shutdown_value_of_the_object() {
    let mut rig = Rig::configured(&[HEATER, "set_digital_out pin=20 value=1"]);
    assert!(rig.bench.level(PIN) && !rig.bench.shutdown_value(PIN));
    rig.send("emergency_stop");
    assert!(!rig.bench.level(PIN));
}

#[test]
fn two_outputs_may_share_a_line() {
    let mut rig = Rig::configured(&[FAN, "config_digital_out oid=1 pin=20 value=0 default_value=0 max_duration=0"]);
    rig.send_all(&[
        "update_digital_out oid=0 value=1",
        "update_digital_out oid=1 value=0",
        "update_digital_out oid=0 value=1",
    ]);
    assert_eq!(rig.edges(PIN), [(0, 1), (0, 0), (0, 1)]);
    rig.send("emergency_stop");
    assert!(!rig.bench.level(PIN));
}

#[test]
fn an_output_without_its_object_is_not_driven() {
    const ON: &str = "config_digital_out oid=0 pin=21 value=1 default_value=0 max_duration=0";
    let mut rig = Rig::new();
    rig.send_all(&["allocate_oids count=1", FAN, ON]);
    expect_shutdown(&rig, "Can't assign oid");
    assert_eq!(rig.bench.state().levels.get(&21), None);
    let mut rig = Rig::configured(&[]);
    rig.send(ON);
    expect_shutdown(&rig, "Can't assign oid");
    assert_eq!(rig.bench.state().levels.get(&21), None);
}
