// SPDX-License-Identifier: GPL-3.0-or-later
//! Steps as seen on the lines.

use pinion_client::config::Config;
use pinion_client::motion::{MoveQueue, Profile, Stepper};

use crate::gpio_sim::GpioSim;
use crate::program::{Program, run};
use crate::sysfs;
use crate::trace::Trace;

#[test]
fn a_train_forwards_and_backwards_is_seen_step_by_step() {
    let sim = GpioSim::builder("lab", 8).name(3, "STEP").name(5, "DIR").build();
    let program = Program::start();
    let client = &mut program.connect();
    let mut config = Config::default();
    let stepper = Stepper::configure(&mut config, "STEP", 0, "DIR", false, 100).expect("few objects");
    let status = config.apply(client).expect("a configuration that it takes");
    let mut queue = MoveQueue::new(status.move_count);
    let profile = |steps| Profile::trapezoid(steps, 4000.0, 40_000.0, 50e6).expect("a profile");

    let trace = Trace::start();
    queue.run(client, stepper, true, &profile(700), None).expect("a move");
    queue.run(client, stepper, false, &profile(250), None).expect("a move");
    assert_eq!(stepper.position(client).expect("a position"), 450);
    let [step, dir] = [3, 5].map(|offset| sim.kernel_number(offset));
    let seen: Vec<(u32, bool)> = trace.writes().iter().map(|write| (write.line, write.level)).collect();
    let steps = |count| std::iter::repeat_n([(step, true), (step, false)], count).flatten();
    let expected: Vec<(u32, bool)> =
        [(dir, true)].into_iter().chain(steps(700)).chain([(dir, false)]).chain(steps(250)).collect();
    assert_eq!(seen, expected);
}

#[test]
fn steppers_of_every_kind_step_at_once_on_several_chips() {
    const STEPS: usize = 300;
    let sims = ["x", "y", "z"].map(|label| GpioSim::new(label, 64));
    let program = Program::start();
    let client = &mut program.connect();
    let mut config = Config::default();
    // Plain, inverted, and with steps on both edges; the rates meet and part.
    let steppers = [(0, 10_000), (1, 15_000), (-1, 20_000)];
    for (sim, (invert, _)) in sims.iter().zip(steppers) {
        let [step, dir] = [62, 63].map(|offset| format!("{}/gpio{offset}", sim.label()));
        Stepper::configure(&mut config, &step, invert, &dir, false, 100).expect("few objects");
    }
    config.apply(client).expect("a configuration that it takes");
    assert_eq!(sims.each_ref().map(|sim| sim.level(62)), [false, true, false], "idle levels");

    let trace = Trace::start();
    let start = client.clock_in(0.2).expect("the clock").wire();
    for (oid, (_, interval)) in steppers.into_iter().enumerate() {
        for line in [
            format!("reset_step_clock oid={oid} clock={start}"),
            format!("set_next_step_dir oid={oid} dir=1"),
            format!("queue_step oid={oid} interval={interval} count={STEPS} add=0"),
        ] {
            run(client, &line);
        }
    }
    let edges_of = |sim: &GpioSim| trace.writes_to(sim.kernel_number(62));
    let edges = [2 * STEPS, 2 * STEPS, STEPS];
    sysfs::wait_until("all steps are made", || sims.each_ref().map(|sim| edges_of(sim).len()) == edges);
    for (oid, sim) in sims.iter().enumerate() {
        assert!(sim.level(63), "its direction");
        let edges = edges_of(sim);
        assert!(edges.windows(2).all(|pair| pair[0].level != pair[1].level), "every edge is one");
        assert_eq!(edges[0].level, oid != 1, "an inverted step begins with a falling edge");
        let args = [("oid", oid.to_string().parse::<u8>().expect("a small number").into())];
        let position = client.query("stepper_get_position", &args, "stepper_position", None).expect("a session");
        assert_eq!(position.int("pos").expect("a position"), STEPS as i64);
    }
}
