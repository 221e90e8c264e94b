// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing: the MCU samples an endstop and triggers a trsync, and steppers stop.

use pinion_firmware::board::{Bias, Direction};

use pinion_testbench::rig::Rig;

const SWITCH: u32 = 10;

const OBJECTS: &[&str] = &[
    "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100",
    "config_stepper oid=1 step_pin=3 dir_pin=4 invert_step=-1 step_pulse_ticks=100",
    "config_endstop oid=2 pin=10 pull_up=1",
    "config_trsync oid=3",
    "config_trsync oid=4",
];

/// Two steppers step every 1000 ticks. The switch stops them. It needs four samples 50 ticks apart, every 700 ticks.
fn homing() -> Rig {
    let mut rig = Rig::configured(OBJECTS);
    rig.send_all(&[
        "trsync_start oid=3 report_clock=@3000 report_ticks=5000 expire_reason=4",
        "trsync_set_timeout oid=3 clock=@20000",
        "stepper_stop_on_trigger oid=0 trsync_oid=3",
        "stepper_stop_on_trigger oid=1 trsync_oid=3",
        "endstop_home oid=2 clock=@1000 sample_ticks=50 sample_count=4 rest_ticks=700 pin_value=1 trsync_oid=3 trigger_reason=1",
        "reset_step_clock oid=0 clock=@0",
        "reset_step_clock oid=1 clock=@0",
        "queue_step oid=0 interval=1000 count=100 add=0",
        "queue_step oid=1 interval=1000 count=100 add=0",
    ]);
    rig
}

fn steps(rig: &mut Rig) -> (String, String) {
    (rig.ask("stepper_get_position oid=0"), rig.ask("stepper_get_position oid=1"))
}

#[test]
fn every_stepper_stops_on_the_tick_of_the_last_sample() {
    let mut rig = homing();
    // Samples at 1000, 1700, ..., 5900. The switch closes before 5900. The samples at 5900, 5950, 6000 and 6050 are
    // closed.
    rig.bench.script_input(SWITCH, &[(5500, 1)]);
    rig.sends_until(6049, &["trsync_state oid=3 can_trigger=1 trigger_reason=0 clock=@3000"]);
    rig.sends_until(6050, &["trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@6050"]);
    let query = rig.ask("endstop_query_state oid=2");
    assert_eq!(query, "endstop_state oid=2 homing=1 next_clock=@6600 pin_value=1");
    rig.run_until(100_000);
    // The step at 6000 was made, and its pulse of 100 ticks was cut short.
    assert_eq!(rig.edges(1).last(), Some(&(6050, 0)));
    assert_eq!(rig.edges(3).last(), Some(&(6000, 0)));
    assert_eq!(steps(&mut rig), ("stepper_position oid=0 pos=-6".into(), "stepper_position oid=1 pos=-6".into()));
}

/// The MCU stands still while 30 steps are due. During these steps the axis meets its switch.
#[test]
fn an_mcu_that_stood_still_takes_steps_and_samples_in_their_order() {
    const STEP_TICKS: u64 = 25_000;
    const REST_TICKS: u64 = 25_000;
    const SWITCH_AT: u64 = 40;
    // A step is a pulse or an edge.
    for (oid, step, both_edges) in [(0, 1, false), (1, 3, true)] {
        let mut rig = Rig::configured(OBJECTS);
        let mut steps = 0;
        rig.bench.plug_line(SWITCH, move |_, edge| {
            steps += u64::from(edge.is_some_and(|(pin, level)| pin == step && (level || both_edges)));
            steps >= SWITCH_AT
        });
        rig.send_all(&[
            "trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=4",
            &format!("stepper_stop_on_trigger oid={oid} trsync_oid=3"),
            &format!("endstop_home oid=2 clock=@10000 sample_ticks=750 sample_count=4 rest_ticks={REST_TICKS} pin_value=1 trsync_oid=3 trigger_reason=1"),
            &format!("reset_step_clock oid={oid} clock=@0"),
            &format!("queue_step oid={oid} interval={STEP_TICKS} count=100 add=0"),
        ]);
        rig.run_until(30 * STEP_TICKS);
        rig.stall_until(60 * STEP_TICKS);
        rig.run_until(120 * STEP_TICKS);
        // From the sample's clock, klippy computes the number of steps made by then.
        let state = rig.ask("endstop_query_state oid=2");
        let next_clock: u64 = state.split(['@', ' ']).find_map(|word| word.parse().ok()).unwrap();
        assert_eq!((next_clock - REST_TICKS) / STEP_TICKS, SWITCH_AT, "{state}");
        let stands = rig.ask(&format!("stepper_get_position oid={oid}"));
        assert_eq!(stands, format!("stepper_position oid={oid} pos=-{SWITCH_AT}"));
    }
}

#[test]
fn reports_go_on_after_a_trigger_until_the_host_ends_them() {
    let mut rig = homing();
    rig.bench.script_input(SWITCH, &[(5500, 1)]);
    rig.sends_until(
        14_000,
        &[
            "trsync_state oid=3 can_trigger=1 trigger_reason=0 clock=@3000",
            "trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@6050",
            "trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@8000",
            "trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@13000",
        ],
    );
    // The first reason stays, also after another trigger.
    assert!(rig.ask("trsync_trigger oid=3 reason=2").starts_with("trsync_state oid=3 can_trigger=0 trigger_reason=1 "));
    rig.sends_until(100_000, &[]);
}

#[test]
fn a_bounce_at_any_sample_starts_the_search_anew_a_rest_after_the_first_match() {
    // Closed at 1700, and open again before the sample that the bounce affects.
    for (sample, open) in [(2, 1740), (3, 1790), (4, 1840)] {
        let mut rig = homing();
        rig.bench.script_input(SWITCH, &[(1700, 1), (open, 0), (open + 100, 1)]);
        rig.run_until(2400 + 149);
        assert_eq!(rig.responses(), [""; 0], "bounce at sample {sample}");
        rig.run_until(2400 + 150);
        assert_eq!(rig.responses(), ["trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@2550"], "{sample}");
        assert!(rig.ask("endstop_query_state oid=2").contains("next_clock=@3100"));
    }
}

#[test]
fn one_sample_may_do() {
    let mut rig = Rig::configured(OBJECTS);
    rig.bench.script_input(SWITCH, &[(0, 1), (2500, 0)]);
    rig.send_all(&[
        "trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=4",
        "endstop_home oid=2 clock=@1000 sample_ticks=50 sample_count=1 rest_ticks=700 pin_value=0 trsync_oid=3 trigger_reason=9",
    ]);
    rig.sends_until(50_000, &["trsync_state oid=3 can_trigger=0 trigger_reason=9 clock=@3100"]);
}

#[test]
fn homing_ends_when_the_host_says_so() {
    let mut rig = homing();
    rig.bench.script_input(SWITCH, &[(5500, 1)]);
    rig.run_until(5000);
    rig.send("endstop_home oid=2 clock=@0 sample_ticks=0 sample_count=0 rest_ticks=0 pin_value=0 trsync_oid=0 trigger_reason=0");
    rig.responses();
    rig.sends_until(10_000, &["trsync_state oid=3 can_trigger=1 trigger_reason=0 clock=@8000"]);
    assert!(rig.ask("endstop_query_state oid=2").starts_with("endstop_state oid=2 homing=0 "));
}

#[test]
fn a_trsync_expires_for_its_own_reason() {
    let mut rig = homing();
    rig.run_until(19_999);
    rig.responses();
    rig.sends_until(20_000, &["trsync_state oid=3 can_trigger=0 trigger_reason=4 clock=@20000"]);
    rig.run_until(22_000);
    // The step of tick 20000 came before the trigger or not at all. Both steppers agree.
    let (a, b) = steps(&mut rig);
    assert_eq!(a.strip_prefix("stepper_position oid=0"), b.strip_prefix("stepper_position oid=1"));
}

#[test]
fn a_timeout_that_is_set_anew_in_time_does_not_expire() {
    let mut rig = homing();
    for at in [15_000, 30_000, 45_000] {
        rig.run_until(at);
        rig.send(&format!("trsync_set_timeout oid=3 clock=@{}", at + 20_000));
    }
    rig.run_until(64_999);
    assert!(rig.responses().iter().all(|report| report.contains("can_trigger=1")));
    rig.sends_until(65_000, &["trsync_state oid=3 can_trigger=0 trigger_reason=4 clock=@65000"]);
    // After the trigger, nothing expires.
    rig.send("trsync_set_timeout oid=3 clock=@66000");
    rig.sends_until(67_999, &[]);
}

#[test]
fn the_host_pulls_the_trigger_and_gets_no_report_of_it() {
    let mut rig = homing();
    rig.run_until(4500);
    rig.responses();
    let answer = rig.ask("trsync_trigger oid=3 reason=2");
    // Clock 0, as in Klipper's C.
    assert_eq!(answer, "trsync_state oid=3 can_trigger=0 trigger_reason=2 clock=@-10000000");
    rig.run_until(100_000);
    assert_eq!(steps(&mut rig), ("stepper_position oid=0 pos=-4".into(), "stepper_position oid=1 pos=-4".into()));
    assert_eq!(rig.responses(), [""; 0]);
}

#[test]
fn a_trsync_that_was_not_started_does_not_trigger() {
    let mut rig = Rig::configured(OBJECTS);
    rig.send_all(&["stepper_stop_on_trigger oid=0 trsync_oid=3", "reset_step_clock oid=0 clock=@0"]);
    rig.send("queue_step oid=0 interval=1000 count=5 add=0");
    rig.run_until(2500);
    assert!(rig.ask("trsync_trigger oid=3 reason=2").contains("can_trigger=0 trigger_reason=0"));
    rig.run_until(10_000);
    assert_eq!(rig.ask("stepper_get_position oid=0"), "stepper_position oid=0 pos=-5");
}

#[test]
fn a_stepper_waits_for_one_trigger_at_a_time() {
    for trsync in [3, 4] {
        let mut rig = homing();
        rig.send("trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=4");
        rig.stops_on(
            &format!("stepper_stop_on_trigger oid=0 trsync_oid={trsync}"),
            "Can't add signal that is already active",
        );
    }
    // A new start of a trsync removes the steppers that waited for it.
    let mut rig = homing();
    rig.send_all(&[
        "trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=4",
        "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=4",
        "stepper_stop_on_trigger oid=0 trsync_oid=4",
    ]);
    assert_eq!(rig.shutdown(), None);
    // A trigger does the same.
    rig.send_all(&["trsync_trigger oid=4 reason=1", "stepper_stop_on_trigger oid=0 trsync_oid=3"]);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_search_without_rest_stops_the_mcu_once_it_is_behind() {
    let mut rig = Rig::configured(OBJECTS);
    rig.send("endstop_home oid=2 clock=@1000 sample_ticks=50 sample_count=4 rest_ticks=0 pin_value=1 trsync_oid=3 trigger_reason=1");
    rig.run_until(2000);
    rig.stall_until(5_000_000);
    rig.run_until(5_000_500);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(5_001_500, "Rescheduled timer in the past");
}

#[test]
fn the_bias_reaches_the_board() {
    for (pull_up, bias) in [(1, Bias::PullUp), (0, Bias::None), (-1, Bias::PullDown)] {
        let rig = Rig::configured(&[&format!("config_endstop oid=2 pin=10 pull_up={pull_up}")]);
        assert_eq!(rig.bench.state().directions[&SWITCH], Direction::Input(bias));
    }
}

#[test]
fn homing_needs_a_trsync() {
    let mut rig = Rig::configured(OBJECTS);
    rig.stops_on("endstop_home oid=2 clock=@1000 sample_ticks=50 sample_count=4 rest_ticks=0 pin_value=1 trsync_oid=0 trigger_reason=1", "Invalid oid type");
}

#[test]
fn a_switch_that_is_gone_stops_the_mcu() {
    let mut rig = homing();
    rig.bench.state().broken.insert(SWITCH);
    rig.stops_by(2000, "GPIO line read failed");
}

#[test]
fn homing_works_across_the_clocks_wrap() {
    let mut rig = Rig::at((1 << 32) - 3000);
    rig.configure(OBJECTS);
    rig.bench.script_input(SWITCH, &[(5500, 1)]);
    rig.send_all(&[
        "trsync_start oid=3 report_clock=@2500 report_ticks=1000 expire_reason=4",
        "trsync_set_timeout oid=3 clock=@8000",
        "stepper_stop_on_trigger oid=0 trsync_oid=3",
        "endstop_home oid=2 clock=@1000 sample_ticks=50 sample_count=4 rest_ticks=700 pin_value=1 trsync_oid=3 trigger_reason=1",
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=100 add=0",
    ]);
    rig.run_until(6100);
    let reports = rig.responses();
    assert_eq!(reports[0], "trsync_state oid=3 can_trigger=1 trigger_reason=0 clock=@2500");
    assert_eq!(reports[1], "trsync_state oid=3 can_trigger=1 trigger_reason=0 clock=@3500");
    assert_eq!(reports.last().unwrap(), "trsync_state oid=3 can_trigger=0 trigger_reason=1 clock=@6050");
    assert_eq!(rig.ask("endstop_query_state oid=2"), "endstop_state oid=2 homing=1 next_clock=@6600 pin_value=1");
    assert_eq!(rig.ask("stepper_get_position oid=0"), "stepper_position oid=0 pos=-6");
}
