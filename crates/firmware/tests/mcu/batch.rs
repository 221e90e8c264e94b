// SPDX-License-Identifier: GPL-3.0-or-later
//! Edges of several steppers at one instant, on lines of one bank.

use pinion_testbench::board::{Edge, SleepyLink};
use pinion_testbench::rig::Rig;
use proptest::prelude::*;

const STEPPERS: u32 = 3;
const PULSE: u64 = 100;

fn step_pin(stepper: u32) -> u32 {
    2 * stepper + 1
}

fn dir_pin(stepper: u32) -> u32 {
    2 * stepper + 2
}

/// Three steppers. Their lines are in a bank, or not.
fn rig(has_bank: bool, invert_step: i8) -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().has_bank = has_bank;
    let config = |n: u32| {
        let (step, dir) = (step_pin(n), dir_pin(n));
        format!(
            "config_stepper oid={n} step_pin={step} dir_pin={dir} invert_step={invert_step} step_pulse_ticks={PULSE}"
        )
    };
    let configs: Vec<String> = (0..STEPPERS).map(config).collect();
    rig.configure(&configs.iter().map(String::as_str).collect::<Vec<_>>());
    rig
}

fn step(rig: &mut Rig, stepper: u32, interval: u32, count: u16) {
    rig.send(&format!("queue_step oid={stepper} interval={interval} count={count} add=0"));
}

fn start(rig: &mut Rig) {
    (0..STEPPERS).for_each(|n| rig.send(&format!("reset_step_clock oid={n} clock=@0")));
}

#[test]
fn edges_of_one_instant_are_one_store() {
    let mut rig = rig(true, 0);
    start(&mut rig);
    (0..STEPPERS).for_each(|n| step(&mut rig, n, 5000, 2));
    rig.run_until(20_000);
    let all = 1 << step_pin(0) | 1 << step_pin(1) | 1 << step_pin(2);
    assert_eq!(rig.bench.state().stores, [(all, 0), (0, all), (all, 0), (0, all)]);
    for n in 0..STEPPERS {
        assert_eq!(rig.edges(step_pin(n)), [(5000, 1), (5100, 0), (10_000, 1), (10_100, 0)]);
    }
}

/// Each store waits until it has reached the pins, before the pulses are measured.
#[test]
fn pulses_behind_a_bus_that_holds_stores_back_are_as_long_as_they_are_measured() {
    let mut rig = rig(true, 0);
    rig.bench.state().link = Some(SleepyLink::new(90, 1000));
    start(&mut rig);
    (0..STEPPERS).for_each(|n| step(&mut rig, n, 5000, 2));
    rig.run_until(20_000);
    for n in 0..STEPPERS {
        assert_eq!(rig.edges(step_pin(n)), [(5090, 1), (5190, 0), (10_090, 1), (10_190, 0)]);
    }
}

#[test]
fn an_edge_alone_is_written_as_ever() {
    let mut rig = rig(true, 0);
    start(&mut rig);
    (0..STEPPERS).for_each(|n| step(&mut rig, n, 5000 + 200 * n, 2));
    rig.run_until(20_000);
    assert_eq!(rig.bench.state().stores, []);
    assert_eq!(rig.edges(step_pin(2)), [(5400, 1), (5500, 0), (10_800, 1), (10_900, 0)]);
}

/// One goes high and two go low.
#[test]
fn high_and_low_edges_share_a_batch() {
    let mut rig = rig(true, -1);
    start(&mut rig);
    step(&mut rig, 1, 3000, 1);
    step(&mut rig, 2, 3000, 1);
    rig.run_until(4000);
    step(&mut rig, 0, 6000, 1);
    step(&mut rig, 1, 3000, 1);
    step(&mut rig, 2, 3000, 1);
    rig.run_until(20_000);
    assert_eq!(
        rig.bench.state().stores,
        [(1 << step_pin(1) | 1 << step_pin(2), 0), (1 << step_pin(0), 1 << step_pin(1) | 1 << step_pin(2))]
    );
}

/// The direction of a stepper changes after its last step of the move before.
#[test]
fn a_direction_changes_after_the_step_before_it() {
    let mut rig = rig(true, 0);
    start(&mut rig);
    for n in 0..STEPPERS {
        step(&mut rig, n, 5000, 1);
        rig.send(&format!("set_next_step_dir oid={n} dir=1"));
        step(&mut rig, n, 5000, 1);
    }
    rig.run_until(20_000);
    let edges = rig.bench.state().edges.clone();
    for n in 0..STEPPERS {
        let place = |wanted: (u32, Edge)| edges.iter().position(|edge| *edge == wanted).expect("an edge");
        assert_eq!(rig.edges(dir_pin(n)), [(5100, 1)]);
        assert!(place((step_pin(n), (5100, 0))) < place((dir_pin(n), (5100, 1))));
    }
}

/// A pulse begins with the store, not with the event before it.
#[test]
fn no_pulse_of_a_batch_is_shorter_than_asked_for() {
    let mut rig = rig(true, 0);
    rig.bench.state().write_ticks = 70;
    start(&mut rig);
    (0..STEPPERS).for_each(|n| step(&mut rig, n, 5000, 20));
    rig.run_until(200_000);
    for n in 0..STEPPERS {
        let edges = rig.edges(step_pin(n));
        assert_eq!(edges.len(), 40);
        assert!(edges.windows(2).all(|pair| pair[1].0 - pair[0].0 >= PULSE), "{edges:?}");
    }
}

/// The first stepper stops the MCU. The edges of the others are made already, and count.
#[test]
fn a_stop_in_a_batch_loses_no_step() {
    for invert_step in -1..2 {
        let mut rig = rig(true, invert_step);
        start(&mut rig);
        (0..STEPPERS).for_each(|n| step(&mut rig, n, 5000, 3));
        step(&mut rig, 0, 100_000u32.wrapping_neg(), 1);
        rig.stops_by(100_000, "Stepper too far in past");
        rig.send("clear_shutdown");
        for n in 0..STEPPERS {
            assert_eq!(rig.ask(&format!("stepper_get_position oid={n}")), format!("stepper_position oid={n} pos=-3"));
        }
    }
}

proptest! {
    /// With a bank and without one, the same edges of a stepper come at the same times and in the same order. Each store
    /// of the bank has several edges.
    #[test]
    fn a_bank_changes_no_edge_of_a_stepper(
        invert_step in -1i8..2,
        moves in prop::collection::vec((0..STEPPERS, 1u32..6, 1u16..6, any::<bool>()), 1..40),
    ) {
        let edges = [false, true].map(|has_bank| {
            let mut rig = rig(has_bank, invert_step);
            start(&mut rig);
            for n in 0..STEPPERS {
                // Late enough for all commands.
                step(&mut rig, n, 50_000, 1);
            }
            for (n, interval, count, dir) in &moves {
                rig.send(&format!("set_next_step_dir oid={n} dir={}", u8::from(*dir)));
                step(&mut rig, *n, interval * 500, *count);
            }
            rig.run_until(1_000_000);
            assert_eq!(rig.shutdown(), None);
            assert!(rig.bench.state().stores.iter().all(|(high, low)| (high | low).count_ones() > 1 && high & low == 0));
            let positions: Vec<String> =
                (0..STEPPERS).map(|n| rig.ask(&format!("stepper_get_position oid={n}"))).collect();
            let edges = rig.bench.state().edges.clone();
            let of_stepper = |n| edges.iter().filter(|(pin, _)| [step_pin(n), dir_pin(n)].contains(pin)).copied().collect();
            let edges: Vec<Vec<(u32, Edge)>> = (0..STEPPERS).map(of_stepper).collect();
            (positions, edges)
        });
        prop_assert_eq!(&edges[0], &edges[1]);
    }
}
