// SPDX-License-Identifier: GPL-3.0-or-later
//! The lab: the tests of `tests/lab/guest`, run against real kernel drivers in a
//! virtual machine, on each kernel flavour. docs/lab.md tells how to use it.
//!
//! This is the host's side, a test harness of its own. It builds what the
//! machines boot, lists the tests that the guest binary holds, boots one machine
//! per flavour and kind of clock, and prints each test by name as libtest does.

mod lab {
    pub mod cache;
    pub mod guest_program;
    pub mod initramfs;
    pub mod kernel;
    pub mod options;
    pub mod process;
    pub mod report;
    pub mod tools;
    pub mod vm;
}

use std::collections::VecDeque;
use std::process::ExitCode;
use std::sync::Mutex;
use std::thread;

use lab::cache::Cache;
use lab::guest_program::GuestProgram;
use lab::kernel::{Flavour, Kernel, Offers};
use lab::options::Options;
use lab::report::Report;
use lab::vm::{Clock, Run};

/// A failed run exits as libtest's do.
const FAILED: u8 = 101;

/// Each machine emulates two processors; more than two machines at once would
/// only wait for each other and run into their timeouts.
const MACHINES_AT_ONCE: usize = 2;

fn main() -> ExitCode {
    match run(&Options::from_args()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(FAILED),
        Err(cause) => {
            eprintln!("lab: {cause}");
            ExitCode::from(FAILED)
        }
    }
}

/// Whether every selected test passed; an error is the lab's own failure.
fn run(options: &Options) -> Result<bool, String> {
    let program = GuestProgram::build()?;
    if options.shell {
        return shell(options, &program);
    }
    let tests = program.tests()?;
    if tests.is_empty() {
        return Err("the guest program holds no tests".into());
    }
    let mut runs = Vec::new();
    let mut filtered_out = 0;
    for flavour in Flavour::ALL {
        for clock in [Clock::Host, Clock::Instructions] {
            let of_clock = tests.iter().filter(|test| Clock::of_test(test) == clock);
            let (selected, others): (Vec<_>, Vec<_>) =
                of_clock.cloned().partition(|test| options.selects(flavour, test));
            filtered_out += others.len();
            if !selected.is_empty() {
                runs.push(Run { flavour, clock, tests: selected });
            }
        }
    }
    if options.list {
        for run in &runs {
            for test in &run.tests {
                println!("{}: test", run.flavour.name_of(test));
            }
        }
        return Ok(true);
    }

    let mut report = Report::new(&runs, filtered_out, options.show_output);
    if !runs.is_empty() {
        boot_all(&runs, &program, &mut report)?;
    }
    Ok(report.finish())
}

fn boot_all(runs: &[Run], program: &GuestProgram, report: &mut Report) -> Result<(), String> {
    lab::tools::ensure()?;
    let cache = Cache::open()?;
    let offers = Offers::ask()?;
    let mut kernels = Vec::new();
    for flavour in Flavour::ALL {
        if runs.iter().any(|run| run.flavour == flavour) {
            let kernel = Kernel::prepare(flavour, &offers, &cache)?;
            println!("{} is Linux {}", flavour.name(), kernel.release);
            kernels.push((flavour, kernel));
        }
    }
    let payload = program.payload()?;
    // The longest first.
    let mut order: Vec<&Run> = runs.iter().collect();
    order.sort_by_key(|run| std::cmp::Reverse(run.tests.len()));
    let queue = Mutex::new(VecDeque::from(order));
    let report = Mutex::new(report);
    thread::scope(|scope| {
        let machines: Vec<_> = (0..MACHINES_AT_ONCE)
            .map(|_| {
                scope.spawn(|| -> Result<(), String> {
                    loop {
                        let next = queue.lock().expect("no machine panics").pop_front();
                        let Some(run) = next else { return Ok(()) };
                        let (_, kernel) = kernels
                            .iter()
                            .find(|(flavour, _)| *flavour == run.flavour)
                            .expect("a kernel was prepared for every run");
                        run.boot(kernel, &payload, &cache, &report)?;
                    }
                })
            })
            .collect();
        machines.into_iter().try_for_each(|machine| machine.join().expect("no machine panics"))
    })
}

fn shell(options: &Options, program: &GuestProgram) -> Result<bool, String> {
    lab::tools::ensure()?;
    let cache = Cache::open()?;
    let flavour = options.flavour.unwrap_or(Flavour::Stock);
    let kernel = Kernel::prepare(flavour, &Offers::ask()?, &cache)?;
    lab::vm::shell(&kernel, &program.payload()?, &cache)?;
    Ok(true)
}
