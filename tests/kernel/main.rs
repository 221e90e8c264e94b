// SPDX-License-Identifier: GPL-3.0-or-later
//! The suite on kernel drivers. It runs the tests of `tests/kernel/guest` against real kernel drivers in a VM, on each
//! kernel flavor. docs/develop/test-kernel.md explains its use.
//!
//! This is the computer's side, a separate test harness. It builds the VMs' boot files and lists the tests of the guest
//! binary. It distributes each flavor's tests to a few VMs, and prints each test by name as libtest does.

mod cache_lines;
mod emulator;
mod guest_program;
mod klippy;
mod options;
mod programs;
mod report;
mod snapshot;
mod table;
mod vm;

use std::process::ExitCode;
use std::sync::Mutex;
use std::thread;

use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::unistd::Pid;

use guest_program::GuestProgram;
use options::Options;
use pinion_testkit::cache::Cache;
use pinion_testkit::kernel::{Flavour, Kernel, Offers};
use programs::Programs;
use report::Report;
use snapshot::Snapshot;
use vm::Run;

/// A failed run exits with libtest's code.
const FAILED: u8 = 101;

/// Highest number of tests in one VM.
const TESTS_IN_A_VM: usize = 64;

/// Tests with figures that are compared with another run or another program. They have their own VM, so that their
/// figures do not depend on earlier tests. They take long, and run only if a filter asks for them.
const FIGURES: &str = "figures::";

/// Tests with a chip that has the number 0. Linux 6.1 never gives the number of a chip again that went away while a line
/// was held, as in other tests. So they have their own VM.
const NUMBERED: &str = "renumbered::";

/// Figures of a print with klippy.
const PRINT: &str = "figures::print::";

fn main() -> ExitCode {
    match run(&Options::from_args()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(FAILED),
        Err(cause) => {
            eprintln!("kernel: {cause}");
            ExitCode::from(FAILED)
        }
    }
}

/// Whether every selected test passed. An error is the suite's own failure.
fn run(options: &Options) -> Result<bool, String> {
    let program = GuestProgram::build(&options.programs)?;
    if options.shell {
        return shell(options, &program);
    }
    let mut tests = program.tests()?;
    if tests.is_empty() {
        return Err("the guest program holds no tests".into());
    }
    if !program.has_klippy() {
        eprintln!("SKIPPED: the tests of {PRINT} need a checkout of Klipper. Name it with KLIPPER_DIR.");
        tests.retain(|test| !test.starts_with(PRINT));
    }
    let (runs, filtered_out) = plan(options, tests);
    if options.list {
        for run in &runs {
            for test in &run.tests {
                println!("{}: test", run.name_of(test));
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

/// The VMs' runs, and the number of tests that were not selected.
fn plan(options: &Options, tests: Vec<String>) -> (Vec<Run<'_>>, usize) {
    let (figures, others): (Vec<_>, Vec<_>) = tests.into_iter().partition(|test| test.starts_with(FIGURES));
    let (counted, figures): (Vec<_>, Vec<_>) =
        figures.into_iter().partition(|test| test.starts_with(cache_lines::TESTS));
    let (numbered, others): (Vec<_>, Vec<_>) = others.into_iter().partition(|test| test.contains(NUMBERED));
    let mut runs = Vec::new();
    let mut filtered_out = 0;
    for flavour in Flavour::ALL {
        let mut add = |program, tests: &[String], vms: &dyn Fn(usize) -> usize| {
            let print_seconds = options.print_seconds;
            let whole = Run { flavour, program, print_seconds, tests: tests.to_vec() };
            let (selected, left_out): (Vec<_>, Vec<_>) =
                tests.iter().partition(|test| options.selects(flavour, &whole.name_of(test)));
            filtered_out += left_out.len();
            let vms = vms(selected.len());
            // In turn: the tests of one file take about the same time, and may be the longest.
            runs.extend((0..vms).map(|vm| {
                let tests = selected.iter().skip(vm).step_by(vms).map(|test| (*test).clone()).collect();
                Run { flavour, program, print_seconds, tests }
            }));
        };
        // No processor is idle while another one has a whole VM left.
        add(None, &others, &|tests| tests.div_ceil(TESTS_IN_A_VM).next_multiple_of(processors()).min(tests));
        let one_vm = |tests: usize| tests.min(1);
        add(None, &numbered, &one_vm);
        for program in [None].into_iter().chain(options.programs.iter().map(Some)) {
            add(program, &figures, &one_vm);
            add(program, &counted, &|tests| tests);
        }
    }
    (runs, filtered_out)
}

fn boot_all(runs: &[Run<'_>], program: &GuestProgram<'_>, report: &mut Report) -> Result<(), String> {
    pinion_testkit::tools::ensure()?;
    let cache = Cache::open()?;
    let flavours: Vec<Flavour> =
        Flavour::ALL.into_iter().filter(|flavour| runs.iter().any(|run| run.flavour == *flavour)).collect();
    let (programs, snapshots) = {
        let _lock = cache.lock()?;
        let offers = Offers::ask(&cache)?;
        let mut kernels = Vec::new();
        for &flavour in &flavours {
            let kernel = Kernel::prepare(flavour, &offers, &cache)?;
            println!("{} is Linux {}", flavour.name(), kernel.release);
            kernels.push(kernel);
        }
        let programs = Programs::prepare(program, &cache)?;
        (programs, at_once(&kernels, kernels.len(), |kernel| Snapshot::prepare(kernel, program, &cache))?)
    };
    // The slower kernel first.
    let order: Vec<&Run<'_>> = runs.iter().rev().collect();
    let report = Mutex::new(report);
    // A VM emulates one processor.
    at_once(&order, processors(), |run| {
        let index = flavours.iter().position(|flavour| *flavour == run.flavour).expect("that of a run");
        run.perform(&snapshots[index], &programs, &cache, &report)
    })
    .map(drop)
}

fn processors() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// Applies the function to the items, and returns the results in their order. This many threads each take the next item
/// when they are done. Each thread stays on one processor, and so do the threads of its emulators. `Emulator` explains
/// the reason.
fn at_once<T: Sync, R: Send>(
    items: &[T],
    threads: usize,
    function: impl Fn(&T) -> Result<R, String> + Sync,
) -> Result<Vec<R>, String> {
    let queue = Mutex::new(items.iter().enumerate());
    let done = Mutex::new(Vec::new());
    thread::scope(|scope| {
        let threads: Vec<_> = (0..threads)
            .map(|number| {
                let (queue, done, function) = (&queue, &done, &function);
                scope.spawn(move || -> Result<(), String> {
                    stay_on_processor(number)?;
                    loop {
                        let next = queue.lock().expect("it is not held in a panic").next();
                        let Some((index, item)) = next else { return Ok(()) };
                        let result = function(item)?;
                        done.lock().expect("it is not held in a panic").push((index, result));
                    }
                })
            })
            .collect();
        threads.into_iter().try_for_each(|thread| thread.join().expect("no thread panics"))
    })?;
    let mut done = done.into_inner().expect("it is not held in a panic");
    done.sort_by_key(|(index, _)| *index);
    Ok(done.into_iter().map(|(_, result)| result).collect())
}

/// Keeps this thread on the n-th of its allowed processors, or on one of them if there are fewer.
fn stay_on_processor(number: usize) -> Result<(), String> {
    let me = Pid::from_raw(0);
    let choose = |allowed: CpuSet| {
        let processors: Vec<usize> = (0..CpuSet::count()).filter(|cpu| allowed.is_set(*cpu) == Ok(true)).collect();
        let mut one = CpuSet::new();
        one.set(processors[number % processors.len()])?;
        sched_setaffinity(me, &one)
    };
    sched_getaffinity(me).and_then(choose).map_err(|error| format!("cannot choose a processor: {error}"))
}

fn shell(options: &Options, program: &GuestProgram<'_>) -> Result<bool, String> {
    pinion_testkit::tools::ensure()?;
    let cache = Cache::open()?;
    let flavour = options.flavour.unwrap_or(Flavour::Stock);
    let (programs, kernel) = {
        let _lock = cache.lock()?;
        (Programs::prepare(program, &cache)?, Kernel::prepare(flavour, &Offers::ask(&cache)?, &cache)?)
    };
    vm::shell(&kernel, &program.base()?, &programs, &cache)?;
    Ok(true)
}
