// SPDX-License-Identifier: GPL-3.0-or-later
//! A stepper's pulses counted from outside, and one homing.

use pinion_client::Client;
use pinion_client::config::Config;
use pinion_client::motion::{Endstop, HomingEnd, MoveQueue, Profile, Stepper};

use super::outside::Outside;
use super::program::{Pinion, Way, both_ways};

pub const STEP: u32 = 17;
const DIR: u32 = 18;
const ENDSTOP: u32 = 24;

/// Slow enough that the outside can close the endstop between two steps.
const STEPS_PER_S: f64 = 100.0;
/// Puts the steps in the middle between the endstop's samples, which begin with the move. The n-th step comes after n +
/// 12.5 of their intervals.
const STEPS_PER_S2: f64 = 400.0;
/// Highest number of steps by which the outside may be late when other programs use the processor.
const LATE_MAX: i64 = 10;
const PULSE_S: f64 = 0.000_002;

both_ways!(every_step_is_a_pulse, homing_ends_where_the_outside_closes_the_endstop);

pub fn axis(client: &mut Client) -> (Stepper, Endstop, MoveQueue) {
    let mut config = Config::default();
    let (step, dir) = (format!("gpio{STEP}"), format!("gpio{DIR}"));
    let stepper = Stepper::configure(&mut config, &step, 0, &dir, false, client.ticks(PULSE_S)).unwrap();
    let endstop = Endstop::configure(&mut config, &format!("gpio{ENDSTOP}"), 1, false).unwrap();
    let status = config.apply(client).expect("a configuration");
    (stepper, endstop, MoveQueue::new(status.move_count))
}

pub fn profile(client: &Client, steps: u32) -> Profile {
    Profile::trapezoid(steps, STEPS_PER_S, STEPS_PER_S2, client.frequency_hz()).unwrap()
}

fn every_step_is_a_pulse(way: Way) {
    let mut outside = Outside::new();
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let (stepper, _, mut queue) = axis(&mut client);
    let there = profile(&client, 40);
    let back = profile(&client, 15);
    queue.run(&mut client, stepper, true, &there, None).expect("a move");
    assert_eq!(outside.edges(STEP), "10".repeat(40));
    assert_eq!(outside.edges(DIR), "1");
    queue.run(&mut client, stepper, false, &back, None).expect("a move");
    assert_eq!(outside.edges(STEP), "10".repeat(55));
    assert_eq!(outside.edges(DIR), "10");
    assert_eq!(stepper.position(&mut client).unwrap(), 25);
}

fn homing_ends_where_the_outside_closes_the_endstop(way: Way) {
    const CLOSES_AFTER: usize = 137;
    let mut outside = Outside::new();
    outside.drive(ENDSTOP, false);
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let (stepper, endstop, mut queue) = axis(&mut client);
    let far = profile(&client, 1000);
    outside.drive_after(ENDSTOP, true, CLOSES_AFTER, STEP);
    let homed = queue.home(&mut client, stepper, endstop, true, &far, &mut |_| ()).expect("homing");

    let edges = outside.edges(STEP);
    let pulses = edges.len() as i64 / 2;
    println!("homed at {} after {pulses} pulses; the endstop closed after {CLOSES_AFTER}", homed.position);
    assert_eq!(homed.reason, HomingEnd::Endstop);
    assert_eq!(edges, "10".repeat(pulses as usize), "pulses are complete");
    assert_eq!(homed.position, pulses, "every step was seen");
    let late = homed.position - CLOSES_AFTER as i64;
    assert!((0..=LATE_MAX).contains(&late), "it went on for {late} steps");
    assert!(endstop.triggered(&mut client).unwrap());
}
