// SPDX-License-Identifier: GPL-3.0-or-later
//! Costs and lateness with a time that counts instructions: 1 ns for each, on every computer. The thresholds leave room
//! for another kernel, not for another computer.

use std::hint::black_box;
use std::time::{Duration, Instant};

use gpio_cdev::{Chip, LineRequestFlags};
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, ClockNanosleepFlags, clock_gettime, clock_nanosleep};

use crate::gpio_sim::GpioSim;

fn spin(rounds: u32) -> Duration {
    let started = Instant::now();
    for round in 0..rounds {
        black_box(round);
    }
    started.elapsed()
}

#[test]
fn the_clock_counts_instructions() {
    // The least of several: an interruption lengthens a measurement.
    let least = |rounds| (0..5).map(|_| spin(rounds)).min().expect("five measurements");
    let (once, tenfold) = (least(100_000), least(1_000_000));
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

/// How late the latest of 100 sleeps ends.
fn latest_wake() -> Duration {
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
    latest
}

#[test]
fn a_sleeper_wakes_within_200_us() {
    // The least of several: a wake-up may meet other work of the kernel.
    let latest = (0..5).map(|_| latest_wake()).min().expect("five measurements");
    println!("the latest of 100 wakes {latest:?} late");
    assert!(latest < Duration::from_micros(200), "{latest:?}");
}
