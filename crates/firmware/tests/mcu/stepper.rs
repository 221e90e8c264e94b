// SPDX-License-Identifier: GPL-3.0-or-later
//! Moves, checked tick by tick.

use pinion_firmware::mcu::SPIN_MAX;
use pinion_firmware::time::Ticks;

use pinion_testbench::board::{Edge, SleepyLink};
use pinion_testbench::rig::Rig;

const STEP: u32 = 1;
const DIR: u32 = 2;

// Direction 0 is the initial one and counts down. klippy uses 1 to go forwards.
const PULSED: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100";
const BOTH_EDGES: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=100";

fn position(rig: &mut Rig) -> String {
    rig.ask("stepper_get_position oid=0")
}

/// The times of the edges, whatever their levels.
fn instants(edges: &[Edge]) -> Vec<u64> {
    edges.iter().map(|(at, _)| *at).collect()
}

fn rising(edges: &[Edge]) -> Vec<u64> {
    edges.iter().filter(|(_, level)| *level == 1).map(|(at, _)| *at).collect()
}

#[test]
fn a_step_is_a_pulse_of_the_configured_width() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=5000 count=3 add=0"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(STEP), [(5000, 1), (5100, 0), (10_000, 1), (10_100, 0), (15_000, 1), (15_100, 0)]);
    assert_eq!(rig.edges(DIR), []);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-3");
}

#[test]
fn an_inverted_step_pin_idles_high_and_pulses_low() {
    let mut rig = Rig::configured(&["config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=1 step_pulse_ticks=100"]);
    assert!(rig.bench.level(STEP));
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=5000 count=2 add=0"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(STEP), [(5000, 0), (5100, 1), (10_000, 0), (10_100, 1)]);
}

#[test]
fn stepping_on_both_edges_needs_one_edge_a_step() {
    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=5000 count=3 add=0"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(STEP), [(5000, 1), (10_000, 0), (15_000, 1)]);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-3");
}

#[test]
fn intervals_grow_and_shrink_by_add() {
    for config in [PULSED, BOTH_EDGES] {
        let mut rig = Rig::configured(&[config]);
        rig.send_all(&[
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=5000 count=4 add=-500",
            "queue_step oid=0 interval=4000 count=3 add=300",
        ]);
        rig.run_until(100_000);
        let edges = rig.edges(STEP);
        let steps = if config == PULSED { rising(&edges) } else { instants(&edges) };
        assert_eq!(steps, [5000, 9500, 13_500, 17_000, 21_000, 25_300, 29_900]);
    }
}

#[test]
fn a_move_of_one_step_ignores_add() {
    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=5000 count=1 add=-32768",
        "queue_step oid=0 interval=5000 count=1 add=32767",
    ]);
    rig.run_until(100_000);
    assert_eq!(instants(&rig.edges(STEP)), [5000, 10_000]);
}

#[test]
fn steps_closer_than_the_pulse_are_pushed_back_and_none_is_lost() {
    // A pulse takes 100 ticks, and so does the pause after it.
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=150 count=4 add=0"]);
    rig.run_until(100_000);
    let expected: Vec<Edge> = (0..4).flat_map(|n| [(150 + 200 * n, 1), (250 + 200 * n, 0)]).collect();
    assert_eq!(rig.edges(STEP), expected);

    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=1 add=0",
        "queue_step oid=0 interval=30 count=3 add=0",
        "queue_step oid=0 interval=1000 count=1 add=0",
    ]);
    rig.run_until(100_000);
    // The last step is on time again: steps that were pushed back do not shift later ones.
    assert_eq!(instants(&rig.edges(STEP)), [1000, 1100, 1200, 1300, 2090]);
}

#[test]
fn a_pulse_is_measured_from_when_the_pin_was_written() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.bench.state().write_ticks = 70;
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=5000 count=1 add=0"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(STEP), [(5000, 1), (5170, 0)]);
}

/// Behind PCIe a write returns before its edge is at the pin. Without a read back, the edges of a pulse come together.
#[test]
fn a_pulse_is_measured_from_when_its_edge_has_reached_the_pin() {
    for (config, idle_ticks) in [(PULSED, 40), (PULSED, 1000), (BOTH_EDGES, 40), (BOTH_EDGES, 1000)] {
        for interval in [1, 100, 150, 230, 300, 2000] {
            let mut rig = Rig::new();
            rig.bench.state().link = Some(SleepyLink::new(90, idle_ticks));
            rig.configure(&[config]);
            rig.send_all(&[
                "reset_step_clock oid=0 clock=@0",
                "queue_step oid=0 interval=5000 count=1 add=0",
                &format!("queue_step oid=0 interval={interval} count=3 add=0"),
                "set_next_step_dir oid=0 dir=1",
                &format!("queue_step oid=0 interval={interval} count=2 add=0"),
            ]);
            rig.run_until(100_000);
            let (steps, dirs) = (instants(&rig.edges(STEP)), instants(&rig.edges(DIR)));
            assert_eq!((steps.len(), dirs.len()), (if config == PULSED { 12 } else { 6 }, 1));
            let spans = steps.windows(2).map(|two| two[1] - two[0]);
            assert!(spans.min().unwrap() >= 100, "{interval}: {steps:?}");
            let [dir] = dirs[..] else { panic!("{dirs:?}") };
            let (before, after) = steps.split_at(if config == PULSED { 8 } else { 4 });
            assert!(dir >= before[before.len() - 1] && after[0] >= dir + 100, "{interval}: {steps:?} {dir}");
        }
    }
}

/// Steps on both edges, with klippy's pulse for such a driver: 100 ns.
const SHORT: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=5";

#[test]
fn a_call_of_the_kernel_holds_a_short_pulse_and_a_register_does_not() {
    for (is_fast, expected) in [(false, [1000, 1001, 1002, 1003]), (true, [1000, 1005, 1010, 1015])] {
        let mut rig = Rig::new();
        if is_fast {
            rig.bench.state().fast.insert(STEP);
        }
        rig.configure(&[SHORT]);
        rig.send_all(&[
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=1000 count=1 add=0",
            "queue_step oid=0 interval=1 count=3 add=0",
        ]);
        rig.run_until(100_000);
        assert_eq!(instants(&rig.edges(STEP)), expected);
    }
}

#[test]
fn the_time_is_read_after_four_late_edges() {
    let mut rig = Rig::configured(&[SHORT, "config_digital_out oid=1 pin=3 value=0 default_value=0 max_duration=0"]);
    rig.bench.state().write_ticks = 70;
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=1 add=0",
        "queue_step oid=0 interval=1 count=60 add=0",
        "queue_digital_out oid=1 clock=@1100 on_ticks=1",
    ]);
    rig.run_until(100_000);
    let [(at, 1)] = rig.edges(3)[..] else { panic!("{:?}", rig.edges(3)) };
    assert!((1100..1100 + 4 * 70).contains(&at), "{at}");
    assert_eq!(rig.edges(STEP).len(), 61);
}

#[test]
fn a_step_more_than_a_millisecond_late_stops_the_mcu() {
    for (interval, ends) in [(50_000, false), (0, true)] {
        let mut rig =
            Rig::configured(&["config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=51000"]);
        rig.send_all(&[
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=1000 count=1 add=0",
            &format!("queue_step oid=0 interval={interval} count=1 add=0"),
        ]);
        rig.run_until(200_000);
        assert_eq!(rig.shutdown().as_deref(), ends.then_some("Stepper too far in past"), "{interval}");
    }
}

#[test]
fn a_reversal_with_pulses_changes_the_direction_after_the_pulse_and_leaves_it_time() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=5000 count=2 add=0",
        "set_next_step_dir oid=0 dir=1",
        "queue_step oid=0 interval=120 count=2 add=5000",
        "set_next_step_dir oid=0 dir=0",
        "queue_step oid=0 interval=5000 count=1 add=0",
    ]);
    rig.run_until(100_000);
    // The direction changes with the falling edge of the last pulse. The next step was due 20 ticks later. It waits for
    // the rest of the 100.
    assert_eq!(rig.edges(DIR), [(10_100, 1), (15_340, 0)]);
    assert_eq!(rising(&rig.edges(STEP)), [5000, 10_000, 10_200, 15_240, 20_240]);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-1");
}

#[test]
fn a_reversal_on_both_edges_waits_for_the_pulse_and_leaves_the_direction_time() {
    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=5000 count=2 add=0",
        "set_next_step_dir oid=0 dir=1",
        "queue_step oid=0 interval=120 count=1 add=0",
        "queue_step oid=0 interval=5000 count=1 add=0",
    ]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(DIR), [(10_100, 1)]);
    assert_eq!(instants(&rig.edges(STEP)), [5000, 10_000, 10_200, 15_120]);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=0");
}

#[test]
fn the_first_move_sets_its_direction_at_once() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "set_next_step_dir oid=0 dir=1",
        "queue_step oid=0 interval=5000 count=1 add=0",
    ]);
    assert_eq!(rig.edges(DIR), [(0, 1)]);
    rig.run_until(100_000);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=1");
}

#[test]
fn the_position_is_right_in_the_middle_of_a_move() {
    for config in [PULSED, BOTH_EDGES] {
        let mut rig = Rig::configured(&[config]);
        rig.send_all(&[
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=1000 count=10 add=0",
            "set_next_step_dir oid=0 dir=1",
            "queue_step oid=0 interval=1000 count=15 add=0",
        ]);
        for (at, expected) in [
            (999, 0),
            (4000, -4),
            (4050, -4),
            (4150, -4),
            (10_050, -10),
            (10_150, -10),
            (11_000, -9),
            (20_000, 0),
            (22_500, 2),
            (30_000, 5),
        ] {
            rig.run_until(at);
            assert_eq!(position(&mut rig), format!("stepper_position oid=0 pos={expected}"), "at {at}, {config}");
        }
    }
}

#[test]
fn a_trigger_keeps_the_position_in_the_middle_of_a_reverse_move() {
    for config in [PULSED, BOTH_EDGES] {
        let mut rig = Rig::configured(&[config, "config_trsync oid=1"]);
        rig.send_all(&[
            "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=4",
            "stepper_stop_on_trigger oid=0 trsync_oid=1",
            "set_next_step_dir oid=0 dir=1",
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=1000 count=10 add=0",
        ]);
        // In the middle of a pulse.
        rig.run_until(7050);
        rig.send("trsync_trigger oid=1 reason=3");
        assert_eq!(position(&mut rig), "stepper_position oid=0 pos=7");
        assert!(!rig.bench.level(DIR), "a stop leaves the direction pin low");
        assert_eq!(rig.bench.level(STEP), config == BOTH_EDGES, "a stop ends the pulse");
        rig.edges(STEP);
        rig.run_until(50_000);
        assert_eq!(rig.edges(STEP), []);

        // Backwards and forwards from there. The direction is set again.
        rig.send_all(&[
            "reset_step_clock oid=0 clock=@50000",
            "set_next_step_dir oid=0 dir=1",
            "queue_step oid=0 interval=1000 count=2 add=0",
            "set_next_step_dir oid=0 dir=0",
            "queue_step oid=0 interval=1000 count=5 add=0",
        ]);
        rig.run_until(52_000);
        assert_eq!(position(&mut rig), "stepper_position oid=0 pos=9");
        rig.run_until(60_000);
        assert_eq!(position(&mut rig), "stepper_position oid=0 pos=4");
    }
}

#[test]
fn a_trigger_while_the_direction_waits_to_change_forgets_the_change() {
    let mut rig = Rig::configured(&[BOTH_EDGES, "config_trsync oid=1"]);
    rig.send_all(&[
        "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=4",
        "stepper_stop_on_trigger oid=0 trsync_oid=1",
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=2 add=0",
        "set_next_step_dir oid=0 dir=1",
        "queue_step oid=0 interval=1000 count=2 add=0",
    ]);
    rig.run_until(2050);
    rig.send("trsync_trigger oid=1 reason=3");
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-2");
    rig.send_all(&["reset_step_clock oid=0 clock=@5000", "queue_step oid=0 interval=1000 count=2 add=0"]);
    rig.edges(STEP);
    rig.run_until(20_000);
    assert_eq!(instants(&rig.edges(STEP)), [6000, 7000]);
    assert_eq!(rig.edges(DIR), []);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-4");
}

#[test]
fn moves_after_a_stop_are_dropped_until_the_clock_is_reset() {
    let mut rig = Rig::configured(&[PULSED, "config_trsync oid=1"]);
    rig.send_all(&[
        "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=4",
        "stepper_stop_on_trigger oid=0 trsync_oid=1",
        "trsync_trigger oid=1 reason=3",
    ]);
    // More moves than the queue has room for: dropped moves take no place in it.
    for _ in 0..2000 {
        rig.send("queue_step oid=0 interval=1000 count=10 add=0");
    }
    rig.send("set_next_step_dir oid=0 dir=1");
    rig.send("queue_step oid=0 interval=1000 count=10 add=0");
    rig.run_until(50_000);
    assert_eq!((rig.edges(STEP), rig.edges(DIR)), (vec![], vec![]));
    rig.send_all(&["reset_step_clock oid=0 clock=@50000", "queue_step oid=0 interval=1000 count=1 add=0"]);
    rig.run_until(60_000);
    assert_eq!(rig.edges(STEP), [(51_000, 1), (51_100, 0)]);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=1");
}

#[test]
fn the_step_clock_can_not_be_reset_while_steps_are_queued() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=1 add=0"]);
    rig.run_until(1050);
    rig.stops_on("reset_step_clock oid=0 clock=@5000", "Can't reset time when stepper active");

    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=1 add=0"]);
    rig.run_until(1100);
    rig.send("reset_step_clock oid=0 clock=@5000");
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_move_without_steps_stops_the_mcu() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.stops_on("queue_step oid=0 interval=1000 count=0 add=0", "Invalid count parameter");
}

#[test]
fn a_first_step_in_the_past_is_too_close() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.run_until(10_000);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=9999 count=1 add=0"]);
    assert_eq!(rig.shutdown().as_deref(), Some("Timer too close"));
    assert_eq!(rig.edges(STEP), []);
}

#[test]
fn steppers_do_not_disturb_each_other() {
    let mut rig = Rig::configured(&[
        PULSED,
        "config_stepper oid=1 step_pin=3 dir_pin=4 invert_step=-1 step_pulse_ticks=0",
        "config_stepper oid=2 step_pin=5 dir_pin=6 invert_step=1 step_pulse_ticks=250",
    ]);
    for (oid, interval, count, add) in [(0, 1000, 50, 3), (1, 333, 200, 0), (2, 1500, 30, -20)] {
        rig.send_all(&[
            &format!("reset_step_clock oid={oid} clock=@0"),
            &format!("queue_step oid={oid} interval={interval} count={count} add={add}"),
        ]);
    }
    rig.run_until(1_000_000);
    let steps = |interval: u64, count: u64, add: i64| -> Vec<u64> {
        let gaps = (0..count as i64).map(|n| (interval as i64 + n * add) as u64);
        gaps.scan(0, |at, gap| {
            *at += gap;
            Some(*at)
        })
        .collect()
    };
    assert_eq!(rising(&rig.edges(1)), steps(1000, 50, 3));
    assert_eq!(instants(&rig.edges(3)), steps(333, 200, 0));
    let edges = rig.edges(5);
    let falling: Vec<u64> = edges.iter().filter(|(_, level)| *level == 0).map(|(at, _)| *at).collect();
    assert_eq!(falling, steps(1500, 30, -20));
    assert!(edges.chunks(2).all(|pulse| pulse[1].0 - pulse[0].0 == 250));
}

/// klippy's stepcompress sends a step after a long pause with the interval modulo 2^32.
#[test]
fn a_move_after_a_long_pause_starts_on_its_tick() {
    for pause in
        [1u64 << 30, (1 << 31) - 1000, 1 << 31, (1 << 31) + 1000, (1 << 32) - 1, 1 << 32, 3 << 32, (9 << 32) + 5]
    {
        let mut rig = Rig::configured(&[PULSED]);
        rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=1 add=0"]);
        // The host sends the next move about 100 ms ahead of it.
        rig.run_until(pause - 5_000_000);
        rig.edges(STEP);
        rig.send(&format!("queue_step oid=0 interval={} count=1 add=0", pause as u32));
        rig.send("queue_step oid=0 interval=700 count=1 add=0");
        rig.run_until(pause + 10_000_000);
        assert_eq!(rig.shutdown(), None, "pause of {pause}");
        assert_eq!(rising(&rig.edges(STEP)), [1000 + pause, 1700 + pause], "pause of {pause}");
    }
}

/// Klipper's C compares 32-bit clocks. A step that seems to lie in the past comes as soon as the pulse before it
/// allows. The step after it is counted from the time when it should have come.
#[test]
fn an_interval_that_grows_past_half_the_clocks_range_looks_past() {
    const HALF: u64 = 1 << 31;
    const FIRST: u64 = HALF - 32_000;
    // The earliest time of a step is a pulse of 100 ticks after the step before.
    for (second, expected) in [(HALF + 99, [FIRST, FIRST + HALF + 99]), (HALF + 100, [FIRST, FIRST + 100])] {
        let mut rig = Rig::configured(&[BOTH_EDGES]);
        rig.send("reset_step_clock oid=0 clock=@0");
        rig.send(&format!("queue_step oid=0 interval={FIRST} count=2 add={}", second - FIRST));
        rig.run_until(3 * HALF);
        assert_eq!(instants(&rig.edges(STEP)), expected, "interval {second}");
        assert_eq!(rig.shutdown(), None);
    }
}

#[test]
fn intervals_past_half_the_clocks_range_do_not_stall_a_move() {
    const FIRST: u64 = (1 << 31) - 100;
    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send("reset_step_clock oid=0 clock=@0");
    rig.send(&format!("queue_step oid=0 interval={FIRST} count=7 add=1000"));
    rig.run_until(20 << 31);
    // Two of the long intervals are a whole turn of the clock and a little more. So every other step is on time again.
    let (third, fifth, seventh) = (FIRST + 2800, FIRST + 9600, FIRST + 20_400);
    assert_eq!(instants(&rig.edges(STEP)), [FIRST, FIRST + 100, third, third + 100, fifth, fifth + 100, seventh]);
    assert_eq!(position(&mut rig), "stepper_position oid=0 pos=-7");

    // A move that begins this late is refused.
    let mut rig = Rig::configured(&[BOTH_EDGES]);
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=1 add=0",
        &format!("queue_step oid=0 interval={} count=1 add=0", (1u64 << 31) + 100),
    ]);
    rig.stops_by(5000, "Stepper too far in past");
}

#[test]
fn steps_that_are_far_behind_are_caught_up_with_a_pulse_apart_and_then_come_on_time() {
    let mut rig =
        Rig::configured(&[PULSED, "config_stepper oid=1 step_pin=3 dir_pin=4 invert_step=-1 step_pulse_ticks=100"]);
    for oid in [0, 1] {
        rig.send(&format!("reset_step_clock oid={oid} clock=@0"));
        rig.send(&format!("queue_step oid={oid} interval=5000 count=8 add=0"));
        rig.send(&format!("set_next_step_dir oid={oid} dir=1"));
        rig.send(&format!("queue_step oid={oid} interval=5000 count=4 add=0"));
    }
    rig.run_until(10_000);
    rig.stall_until(47_000);
    rig.run_until(100_000);
    assert_eq!(rig.shutdown(), None);
    let (pulsed, both) = (rig.edges(STEP), instants(&rig.edges(3)));
    let gap = |edges: &[u64]| edges.windows(2).map(|pair| pair[1] - pair[0]).min();
    assert_eq!((rising(&pulsed).len(), both.len()), (12, 12));
    assert_eq!((gap(&instants(&pulsed)), gap(&both)), (Some(100), Some(100)), "{pulsed:?} {both:?}");
    let late: Vec<u64> = rising(&pulsed).into_iter().filter(|at| at % 5000 != 0).collect();
    assert_eq!(late.len(), 7, "{late:?}");
    // For both steppers, the reversal comes after the eighth step and before the ninth.
    for (dir, steps) in [(DIR, rising(&pulsed)), (4, both.clone())] {
        let [(reversed, 1)] = rig.edges(dir)[..] else { panic!("{:?}", rig.edges(dir)) };
        assert!(steps[7] < reversed && reversed + 100 <= steps[8], "{steps:?} {reversed}");
    }
    assert_eq!(rising(&pulsed)[9..], [50_000, 55_000, 60_000]);
    assert_eq!(both[9..], [50_000, 55_000, 60_000]);
}

#[test]
fn a_long_pulse_keeps_nothing_else_waiting() {
    // Edges are at least 1 ms apart, and a step is due every 1.5 ms.
    let mut rig = Rig::configured(&[
        "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=50000",
        "config_digital_out oid=1 pin=5 value=0 default_value=0 max_duration=0",
    ]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=75000 count=20 add=0"]);
    for n in 1..20 {
        rig.send(&format!("queue_digital_out oid=1 clock=@{} on_ticks={}", 75_000 * n + 60_000, n % 2));
    }
    rig.run_until(4_000_000);
    assert_eq!(rising(&rig.edges(STEP)).len(), 20);
    assert_eq!(instants(&rig.edges(5)), (1..20).map(|n| 75_000 * n + 60_000).collect::<Vec<_>>());
}

#[test]
fn a_move_goes_on_after_a_stall_of_150_ms() {
    let mut rig = Rig::configured(&[PULSED]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=50000 count=400 add=0"]);
    rig.run_until(1_000_000);
    rig.stall_until(8_500_000);
    rig.run_until(30_000_000);
    assert_eq!((rig.shutdown(), rising(&rig.edges(STEP)).len()), (None, 400));
}

/// Three steppers make 100,000 steps per second each, with pulses of 3 us. If each waits for the others' pulses, all
/// pulses take 90 % of the time. Edges that overlap catch up.
#[test]
fn a_print_catches_up_after_a_short_stall() {
    const STEPPERS: u32 = 3;
    const INTERVAL: u64 = 500;
    const STEPS: u64 = 3000;
    let config = |n: u32| {
        format!(
            "config_stepper oid={n} step_pin={} dir_pin={} invert_step=0 step_pulse_ticks=150",
            2 * n + 1,
            2 * n + 2
        )
    };
    let configs: Vec<String> = (0..STEPPERS).map(config).collect();
    let mut rig = Rig::configured(&configs.iter().map(String::as_str).collect::<Vec<_>>());
    // A call takes half a microsecond.
    rig.bench.state().write_ticks = 25;
    for n in 0..STEPPERS {
        rig.send(&format!("reset_step_clock oid={n} clock=@{}", u64::from(n) * INTERVAL / 3));
        for _ in 0..STEPS / 10 {
            rig.send(&format!("queue_step oid={n} interval={INTERVAL} count=10 add=0"));
        }
    }
    rig.run_until(10_000);
    rig.stall_until(10_000 + 30_000);
    rig.run_until(2 * STEPS * INTERVAL);
    assert_eq!(rig.shutdown(), None);
    for n in 0..STEPPERS {
        let steps = rising(&rig.edges(2 * n + 1));
        assert_eq!(steps.len() as u64, STEPS, "stepper {n}");
        let due = |step: u64| u64::from(n) * INTERVAL / 3 + (step + 1) * INTERVAL;
        // All steps are on time again within 3 ms, give or take the calls for the other steppers.
        let late = steps.iter().zip(0..).filter(|(at, step)| **at > due(*step) + 150 && due(*step) > 190_000);
        assert_eq!(late.count(), 0, "stepper {n}");
    }
}

/// A pulse takes five seconds. After one edge of it and a stop, the next edge does not wait for the pulse.
#[test]
fn no_wait_is_longer_than_a_short_pulse() {
    for (invert_step, edges) in [(0, &[(1000, 1), (2000, 0), (6000, 1)][..]), (-1, &[(1000, 1), (6000, 0)])] {
        let config =
            format!("config_stepper oid=0 step_pin=1 dir_pin=2 invert_step={invert_step} step_pulse_ticks=250000000");
        let mut rig = Rig::configured(&[
            &config,
            "config_trsync oid=1",
            "config_digital_out oid=2 pin=5 value=0 default_value=0 max_duration=0",
        ]);
        rig.send_all(&[
            "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=4",
            "stepper_stop_on_trigger oid=0 trsync_oid=1",
            "reset_step_clock oid=0 clock=@0",
            "queue_step oid=0 interval=1000 count=2 add=0",
        ]);
        rig.run_until(2000);
        rig.send_all(&[
            "trsync_trigger oid=1 reason=3",
            "reset_step_clock oid=0 clock=@5000",
            "queue_step oid=0 interval=1000 count=1 add=0",
            "queue_digital_out oid=2 clock=@7000 on_ticks=1",
        ]);
        rig.run_until(10_000);
        assert_eq!(rig.edges(STEP), edges, "{invert_step}");
        assert_eq!(rig.edges(5), [(7000, 1)]);
        assert_eq!(rig.now(), 10_000);
    }
}

/// The core itself never waits longer than this.
#[test]
fn the_core_waits_for_50_us_at_most() {
    let mut rig = Rig::configured(&[]);
    let now = rig.mcu.now();
    rig.mcu.context().spin_until(now + Ticks(1000));
    assert_eq!(rig.mcu.now(), now + Ticks(1000));
    rig.mcu.context().spin_until(now + Ticks(u32::MAX));
    assert_eq!(rig.mcu.now(), now + Ticks(1000) + SPIN_MAX);
}
