// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters with edges that the kernel counts.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::thread;
use std::time::{Duration, Instant};

use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, refusal, run};
use crate::sysfs;

const TACHO: u32 = 3;
const COUNTER: &str = "config_counter oid=0 pin=lab/gpio3 pull_up=0";

/// A polled pin is read every 50 ms.
const SLOW: u32 = 2_500_000;
/// klippy's default, 1.5 ms.
const USUAL: u32 = 75_000;
/// The shortest level counts.
const FAST: u32 = 1;

/// A pin that is counted.
fn counting(poll_ticks: u32) -> (GpioSim, Program, Client) {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let mut client = program.connect();
    configure(&mut client, 1, &[COUNTER]);
    query(&mut client, poll_ticks);
    (sim, program, client)
}

/// Requests a report of the count every 0.1 s.
fn query(client: &mut Client, poll_ticks: u32) {
    let at = client.clock_in(0.02).expect("the clock").wire();
    run(client, &format!("query_counter oid=0 clock={at} poll_ticks={poll_ticks} sample_ticks=5000000"));
}

/// The next reported count, and the clock of its last edge.
fn next(client: &mut Client) -> (u32, u32) {
    let until = Instant::now() + Duration::from_secs(10);
    let state = client.wait("counter_state", Some(0), until).expect("a session").expect("a state");
    (state.u32("count").expect("a count"), state.u32("count_clock").expect("a clock"))
}

/// Waits for a count that was reported after now. It includes all edges so far.
fn settled(client: &mut Client) -> (u32, u32) {
    client.drain();
    next(client);
    next(client)
}

/// Makes this number of edges as fast as possible. Returns the times before and after the last one in CLOCK_MONOTONIC.
fn edges(sim: &GpioSim, count: u32) -> (Duration, Duration) {
    let mut pull = sim.pull_file(TACHO);
    let mut last = (Duration::ZERO, Duration::ZERO);
    for edge in 0..count {
        let before = sysfs::monotonic();
        set(&mut pull, edge % 2 == 0);
        last = (before, sysfs::monotonic());
    }
    last
}

fn set(pull: &mut File, up: bool) {
    pull.seek(SeekFrom::Start(0)).expect("a file of sysfs");
    pull.write_all(if up { b"pull-up" } else { b"pull-down" }).expect("a pull");
}

#[test]
fn all_edges_are_counted_and_the_last_one_dated() {
    let (sim, program, mut client) = counting(FAST);
    let client = &mut client;
    assert_eq!(settled(client).0, 0);
    let mut expected = 0;
    // An even number, so the line ends low each time.
    for count in [2, 16, 18, 400] {
        let (before, after) = edges(&sim, count);
        expected += count;
        let (reported, clock) = settled(client);
        assert_eq!(reported, expected);
        // Tick 0 is a whole second of CLOCK_MONOTONIC.
        let ns = u64::from(clock) * 20 % 1_000_000_000;
        let since = (ns + 1_000_000_000 - u64::from(before.subsec_nanos())) % 1_000_000_000;
        let took = (after - before).as_nanos() as u64;
        assert!(since <= took, "dated {since} ns after the beginning of an edge of {took} ns");
    }
    assert!(!program.log().contains("polled"), "{}", program.log());
}

#[test]
fn a_fan_of_20_000_rpm_is_measured() {
    let (sim, _program, mut client) = counting(USUAL);
    let client = &mut client;
    settled(client);
    let reported: Vec<(u32, u32)> = thread::scope(|scope| {
        // Two pulses per turn give 1333 edges per second.
        scope.spawn(|| {
            let began = Instant::now();
            for edge in 1..1000 {
                sim.pull(TACHO, edge % 2 == 1);
                thread::sleep((Duration::from_micros(750) * edge).saturating_sub(began.elapsed()));
            }
        });
        (0..6).map(|_| next(client)).collect()
    });
    for pair in reported[1..].windows(2) {
        let (count, ticks) = (pair[1].0 - pair[0].0, pair[1].1 - pair[0].1);
        let rpm = f64::from(count) / 4.0 * 60.0 * 50e6 / f64::from(ticks);
        println!("{rpm:.0} rpm");
        // As exact as the test's own sleep.
        assert!((rpm - 20_000.0).abs() < 400.0, "{rpm}: {reported:?}");
    }
}

/// At the slowest `poll_ticks`, so that the speed of the emulated computer does not matter.
#[test]
fn glitches_are_not_counted_and_pulses_are_exactly() {
    // A level counts if it lasts 50 ms.
    let (sim, _program, mut client) = counting(4 * SLOW);
    let client = &mut client;
    let (before, _) = settled(client);
    let mut pull = sim.pull_file(TACHO);
    let mut longest = Duration::ZERO;
    for level in [true, false, true, false, true] {
        set(&mut pull, level);
        thread::sleep(Duration::from_millis(80));
        for _ in 0..50 {
            let began = sysfs::monotonic();
            set(&mut pull, !level);
            set(&mut pull, level);
            longest = longest.max(sysfs::monotonic() - began);
        }
    }
    thread::sleep(Duration::from_millis(80));
    println!("the longest glitch takes {longest:?}");
    assert!(longest < Duration::from_millis(50), "{longest:?} is no glitch");
    assert_eq!(settled(client).0 - before, 5);
}

#[test]
fn a_counter_shares_its_pin_with_inputs_and_is_polled_if_it_comes_second() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    let endstop = "config_endstop oid=1 pin=lab/gpio3 pull_up=1";
    let sees = |client: &mut Client| {
        let state = client.query("endstop_query_state", &[("oid", 1.into())], "endstop_state", Some(1));
        state.expect("a state").flag("pin_value").expect("a level")
    };
    for (first, second, polled) in [(COUNTER, endstop, false), (endstop, COUNTER, true)] {
        configure(client, 2, &[first, second]);
        query(client, if polled { SLOW } else { FAST });
        let (before, _) = settled(client);
        // (The pull of the endstop moved the line, in either order.)
        sim.pull(TACHO, false);
        assert!(!sees(client));
        let (low, _) = settled(client);
        edges(&sim, 100);
        let (after, _) = settled(client);
        assert!(if polled { after - low <= 2 } else { after - low == 100 }, "{}", after - low);
        sim.pull(TACHO, true);
        assert!(sees(client));
        assert!(settled(client).0 > before);
        if polled {
            program.wait_for_line(&["so it is polled"]);
        } else {
            assert!(!program.log().contains("so it is polled"), "{}", program.log());
        }
        sim.pull(TACHO, false);
    }
    let output = "config_digital_out oid=1 pin=lab/gpio3 value=0 default_value=0 max_duration=0";
    assert_eq!(refusal(client, 2, &[COUNTER, output]), "Unable to open out GPIO chip line");
    program.wait_for_line(&["line 3 counts pulses and cannot be an output as well"]);
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_pin_that_floats_is_polled_and_can_be_an_output_after_a_restart() {
        let (sim, program, mut client) = counting(SLOW);
        let client = &mut client;
        // The kernel lists the consumers of interrupts.
        let has_interrupt = || sysfs::read("/proc/interrupts").lines().any(|line| line.ends_with("pinion"));
        assert!(has_interrupt());
        let mut pull = sim.pull_file(TACHO);
        let until = Instant::now() + Duration::from_secs(5);
        while !program.log().contains("polled from now on") {
            assert!(Instant::now() < until, "{}", program.log());
            (0..2000).for_each(|edge| set(&mut pull, edge % 2 == 0));
        }
        assert!(!has_interrupt());
        let (before, _) = settled(client);
        // First shorter than the polling interval, so that one read may see the pin high; then longer.
        edges(&sim, 100);
        let (low, _) = settled(client);
        assert!(low - before <= 2, "{}", low - before);
        sim.pull(TACHO, true);
        assert_eq!(settled(client).0, low + 1);
        sim.pull(TACHO, false);
        configure(client, 1, &["config_digital_out oid=0 pin=lab/gpio3 value=1 default_value=1 max_duration=0"]);
        assert!(sim.level(TACHO));
    }
}
