// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing against an endstop that the test closes.

use std::time::Duration;

use pinion_client::config::Config;
use pinion_client::motion::{Endstop, HomingEnd, MoveQueue, Profile, Stepper};

use crate::gpio_sim::GpioSim;
use crate::program::Program;
use crate::sysfs;
use crate::trace::Trace;

const SWITCH: u32 = 2;
const STEPS_PER_S: f64 = 2000.0;
/// Shortest time at which steps and the switch can be distinguished in the trace.
const JITTER_NS: u64 = 200_000;

#[test]
fn an_axis_homes_backs_off_and_homes_again() {
    let sim = GpioSim::builder("lab", 8).name(0, "STEP").name(1, "DIR").name(SWITCH, "STOP").build();
    let program = Program::start();
    let client = &mut program.connect();
    let mut config = Config::default();
    let stepper = Stepper::configure(&mut config, "STEP", 0, "DIR", true, 100).expect("few objects");
    // A switch to ground and a pull-up resistor.
    let endstop = Endstop::configure(&mut config, "STOP", 1, true).expect("few objects");
    let status = config.apply(client).expect("a configuration that it takes");
    let mut queue = MoveQueue::new(status.move_count);
    let profile = |steps| Profile::trapezoid(steps, STEPS_PER_S, 20_000.0, 50e6).expect("a profile");
    assert!(!endstop.triggered(client).expect("a state"));

    let mut position = 0;
    for switch_at in [-700, -650] {
        let trace = Trace::start();
        let mut closed_ns = None;
        let homed = queue.home(client, stepper, endstop, false, &profile(3000), &mut |sight| {
            if closed_ns.is_none() && sight.position <= switch_at {
                sim.pull(SWITCH, false);
                closed_ns = Some(sysfs::monotonic().as_nanos() as u64);
            }
        });
        let homed = homed.expect("a homing");
        assert_eq!(homed.reason, HomingEnd::Endstop);
        let closed_ns = closed_ns.expect("the switch was closed");
        let steps = trace.writes_to(sim.kernel_number(0));
        let rising: Vec<u64> = steps.iter().filter(|write| write.level).map(|write| write.at_ns).collect();
        assert_eq!(homed.position, position - rising.len() as i64, "it is where the lines say");
        assert!(homed.position <= switch_at);
        let after = rising.iter().filter(|at_ns| **at_ns > closed_ns + JITTER_NS).count();
        println!("{after} of {} steps after the switch closed", homed.slack_steps);
        assert!(after <= homed.slack_steps as usize, "{after} steps after the switch closed");
        assert!(endstop.triggered(client).expect("a state"));
        drop(trace);

        sim.pull(SWITCH, true);
        queue.run(client, stepper, true, &profile(200), None).expect("a move");
        position = homed.position + 200;
        assert!(!sim.level(1), "an inverted direction line is low forwards");
    }

    let homed = queue.home(client, stepper, endstop, false, &profile(300), &mut |_| ()).expect("a homing");
    assert_eq!((homed.reason, homed.position), (HomingEnd::PastEnd, position - 300), "nobody closed the switch");
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_host_that_falls_silent_while_homing_stops_the_axis() {
        let sim = GpioSim::new("lab", 8);
        let program = Program::start();
        let client = &mut program.connect();
        let mut config = Config::default();
        let stepper = Stepper::configure(&mut config, "lab/gpio0", 0, "lab/gpio1", false, 100).expect("few objects");
        let endstop = Endstop::configure(&mut config, "lab/gpio2", 1, true).expect("few objects");
        config.apply(client).expect("a configuration that it takes");
        let (trsync, oid) = (endstop.trsync, stepper.oid);
        let start = client.clock_in(0.2).expect("the clock").wire();
        let expire = start.wrapping_add(client.ticks(0.25));
        // Ten seconds of steps, and news for a quarter of a second.
        for line in [
            format!("trsync_start oid={trsync} report_clock={start} report_ticks=0 expire_reason=4"),
            format!("stepper_stop_on_trigger oid={oid} trsync_oid={trsync}"),
            format!("trsync_set_timeout oid={trsync} clock={expire}"),
            format!("reset_step_clock oid={oid} clock={start}"),
            format!("queue_step oid={oid} interval=50000 count=10000 add=0"),
        ] {
            client.send_line(&line).expect("a session");
        }
        let trace = Trace::start();
        let state = client
            .wait("trsync_state", Some(trsync), std::time::Instant::now() + Duration::from_secs(5))
            .expect("a session")
            .expect("a report");
        assert_eq!(state.int("trigger_reason").expect("a reason"), 4);
        std::thread::sleep(Duration::from_millis(20));
        let rising = trace.writes_to(sim.kernel_number(0)).iter().filter(|write| write.level).count();
        assert!((249..=251).contains(&rising), "{rising} steps in 250 ms");
        assert_eq!(stepper.position(client).expect("a position").unsigned_abs(), rising as u64);
    }
}
