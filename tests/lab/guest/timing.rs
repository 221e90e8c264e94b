// SPDX-License-Identifier: GPL-3.0-or-later
//! Costs and lateness where time counts instructions: 2 ns for each, on every
//! host. The thresholds leave room for another kernel, not for another machine.

use std::hint::black_box;
use std::thread;
use std::time::{Duration, Instant};

use gpio_cdev::{Chip, LineRequestFlags};
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, ClockNanosleepFlags, clock_gettime, clock_nanosleep};
use pinion::host::Client;
use pinion::host::config::Config;
use pinion::host::motion::Stepper;

use super::gpio_sim::GpioSim;
use super::program::Program;
use super::trace::{Trace, Write};

fn spin(rounds: u32) -> Duration {
    let started = Instant::now();
    for round in 0..rounds {
        black_box(round);
    }
    started.elapsed()
}

#[test]
fn the_clock_counts_instructions() {
    spin(1000);
    let (once, tenfold) = (spin(100_000), spin(1_000_000));
    println!("100,000 rounds {once:?}, 1,000,000 rounds {tenfold:?}");
    let ratio = tenfold.as_secs_f64() / once.as_secs_f64();
    assert!((9.5..10.5).contains(&ratio), "time is not that of instructions: {ratio}");
}

#[test]
fn a_line_is_written_within_20_us() {
    const WRITES: u32 = 1000;
    let sim = GpioSim::new("lab", 8);
    let line = Chip::new(sim.path()).and_then(|mut chip| chip.get_line(0)).expect("the line");
    let handle = line.request(LineRequestFlags::OUTPUT, 0, "lab test").expect("a free line");
    let started = Instant::now();
    for write in 0..WRITES {
        handle.set_value(u8::from(write % 2 == 0)).expect("a held line");
    }
    let each = started.elapsed() / WRITES;
    println!("a write takes {each:?}");
    assert!(each < Duration::from_micros(20), "{each:?}");
}

#[test]
fn a_sleeper_wakes_within_200_us() {
    let mut latest = Duration::ZERO;
    for _ in 0..100 {
        let now = Duration::from(clock_gettime(ClockId::CLOCK_MONOTONIC).expect("the clock"));
        let deadline = now + Duration::from_millis(1);
        clock_nanosleep(
            ClockId::CLOCK_MONOTONIC,
            ClockNanosleepFlags::TIMER_ABSTIME,
            &TimeSpec::from_duration(deadline),
        )
        .expect("a sleep");
        let woken = Duration::from(clock_gettime(ClockId::CLOCK_MONOTONIC).expect("the clock"));
        latest = latest.max(woken - deadline);
    }
    println!("the latest of 100 wakes {latest:?} late");
    assert!(latest < Duration::from_micros(200), "{latest:?}");
}

/// What was seen of a train of steps.
struct Train {
    /// Microseconds, in order.
    late_us: Vec<i64>,
    /// System calls of the core for each edge: writes to the line, waits, others.
    writes: f64,
    waits: f64,
    others: f64,
    /// Those that ask for its running time, in each millisecond.
    looks: f64,
}

/// Has the program make steps so many ticks apart, one on each edge: an edge's time is the plan's.
fn train(program: &Program, client: &mut Client, line: u32, interval_ticks: u64) -> Train {
    const STEPS: u64 = 1000;
    let trace = Trace::with_calls_of(program.core());
    let start = client.clock_in(0.2).expect("the clock");
    client.send_line(&format!("reset_step_clock oid=0 clock={}", start.wire())).expect("a session");
    client.send_line(&format!("queue_step oid=0 interval={interval_ticks} count={STEPS} add=0")).expect("a session");
    thread::sleep(Duration::from_millis(300 + STEPS * interval_ticks / 50_000));
    let edges = trace.writes_to(line);
    assert_eq!(edges.len() as u64, STEPS);

    // Tick 0 is a whole second of CLOCK_MONOTONIC.
    let late = |(step, edge): (u64, &Write)| {
        let due_us = (start.ticks() + step * interval_ticks) / 50;
        (edge.at_us as i64 - due_us as i64 + 500_000).rem_euclid(1_000_000) - 500_000
    };
    let mut late_us: Vec<i64> = (1..).zip(&edges).map(late).collect();
    late_us.sort_unstable();
    let mut calls = trace.calls();
    let (first, last) = (edges[0].at_us, edges[edges.len() - 1].at_us);
    calls.retain(|call| (first..last).contains(&call.at_us));
    let mut take = |number, parts: u64| {
        let before = calls.len();
        calls.retain(|call| call.number != number);
        (before - calls.len()) as f64 / parts as f64
    };
    let writes = take(libc::SYS_ioctl, STEPS - 1);
    let waits = take(libc::SYS_futex, STEPS - 1);
    // The clock itself is read without a call.
    let looks = take(libc::SYS_clock_gettime, (last - first) / 1000);
    Train { late_us, writes, waits, others: calls.len() as f64 / (STEPS - 1) as f64, looks }
}

/// The wire, the core and the kernel's GPIO together.
#[test]
fn a_step_is_in_time_and_costs_a_write_and_a_wait() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    let mut config = Config::default();
    Stepper::configure(&mut config, "lab/gpio0", -1, "lab/gpio1", false, 100).expect("few objects");
    config.apply(client).expect("a configuration that it takes");
    for interval_ticks in [50_000, 5_000] {
        let Train { late_us, writes, waits, others, looks } =
            train(&program, client, sim.kernel_number(0), interval_ticks);
        let late = |share: f64| late_us[((late_us.len() - 1) as f64 * share) as usize];
        let [earliest, p50, p99, latest] = [0.0, 0.5, 0.99, 1.0].map(late);
        println!(
            "figures: {} steps a second: late by p50 {p50} us, p99 {p99} us, at most {latest} us; \
             {writes:.3} ioctl, {waits:.3} futex and {others:.3} other system calls an edge, {looks:.3} looks at the \
             running time a millisecond",
            50_000_000 / interval_ticks
        );
        assert!(earliest >= -1, "an edge came {} us early", -earliest);
        assert!(p50 <= 15 && p99 <= 30 && latest <= 100, "late by {p50}, {p99}, {latest} us");
        assert!(writes <= 1.001 && waits <= 1.02 && others <= 0.01, "{writes}, {waits}, {others} system calls an edge");
        assert!(looks <= 1.01, "{looks} looks at the running time a millisecond");
    }
    client.emergency_stop().expect("a session");
    let line = program.wait_for_line(&["timers: "]);
    println!("figures: of the program itself, {}", line.split_once("timers: ").expect("what was waited for").1);
}
