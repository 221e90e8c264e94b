// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian: whatever becomes of the program, its outputs go to their shutdown values, and
//! a restart claims them.

use std::os::unix::process::ExitStatusExt;

use nix::sys::signal::{Signal, kill};
use pinion::time::monotonic;

use super::outputs::Outputs;
use crate::program::{Program, exists, shutdown_of};
use crate::sysfs;
use crate::trace::Trace;

/// What the guardian promises.
const WITHIN_US: u64 = 600_000;

/// Starts a program whose outputs are on, ends it by a signal, and returns its log.
fn end_by(outputs: &Outputs, signal: Signal) -> String {
    let mut program = Program::with(&["-r"], &[("PINION_TEST_HANG", "1")]);
    let mut client = program.connect();
    outputs.switch_on(&mut client, 0);
    let guardian = program.guardian();
    let trace = Trace::start();
    outputs.wait_until_on();
    let began_us = monotonic().as_micros() as u64;
    program.signal(signal);
    if signal == Signal::SIGSEGV {
        // Rust's handler takes the first for a stack that may have overflown, and waits for
        // the access to fail again.
        program.signal(signal);
    }
    let safe_us = outputs.assert_safe(&trace);
    assert!(safe_us - began_us < WITHIN_US, "{signal}: it took {} us", safe_us - began_us);
    sysfs::wait_until("the guardian is gone", || !exists(guardian));
    // SIGUSR2 makes the core hang, for which the guardian kills the program.
    let death = if signal == Signal::SIGUSR2 { Signal::SIGKILL } else { signal };
    assert_eq!(program.wait().signal(), Some(death as i32));
    println!("{signal}: safe after {} us", safe_us - began_us);
    program.log()
}

#[test]
fn killed_crashed_or_aborted_the_outputs_are_safe_and_free() {
    let outputs = Outputs::new();
    for signal in [Signal::SIGKILL, Signal::SIGSEGV, Signal::SIGABRT] {
        let log = end_by(&outputs, signal);
        assert!(log.contains("guardian: "), "{signal}: {log}");
        assert!(log.contains("outputs are driven to their shutdown values"), "{signal}: {log}");
    }
    // Each program after the first one had to claim what the one before had held.
}

#[test]
fn a_core_that_hangs_is_noticed() {
    let outputs = Outputs::new();
    let log = end_by(&outputs, Signal::SIGUSR2);
    assert!(log.contains("outputs are driven to their shutdown values"), "{log}");
    let program = Program::start();
    outputs.switch_on(&mut program.connect(), 0);
}

#[test]
fn a_program_without_its_guardian_stops_and_says_so() {
    let outputs = Outputs::new();
    let mut program = Program::start();
    let mut client = program.connect();
    outputs.switch_on(&mut client, 0);
    let trace = Trace::start();
    outputs.wait_until_on();
    kill(program.guardian(), Signal::SIGKILL).expect("a guardian");
    assert_eq!(shutdown_of(&mut client), "Guardian process lost");
    outputs.assert_safe(&trace);
    assert_eq!(program.wait().code(), Some(1));
    program.wait_for_line(&["shutdown: Guardian process lost", "somebody killed the guardian"]);
    let program = Program::start();
    outputs.switch_on(&mut program.connect(), 0);
}
