// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion on a Raspberry Pi 3 and 4. It runs the tests of `tests/raspberry_pi/guest` against the real driver of the GPIO
//! chip on an emulated Pi. docs/develop/test-raspberry-pi.md explains its use.
//!
//! This is the computer's side, a separate test harness. It builds for arm64 and armhf. It simulates the world outside
//! the pins, as the tests request over the console.

mod board;
mod cross;
mod debian;
mod gpio;
mod vm;

use std::env;
use std::process::{Command, ExitCode};
use std::time::Instant;

use board::{BOARDS, Board};
use cross::{ARCHITECTURES, Architecture, Programs};
use debian::{Emulator, Kernel};
use pinion_testkit::arguments::Arguments;
use pinion_testkit::cache::Cache;
use vm::{News, Parts, Vm};

const USAGE: &str = "\
Usage: cargo test --test raspberry_pi -- [OPTIONS] [FILTERS...]

Runs the tests whose name, as in gpio::an_output_is_seen_from_outside, contains any
of the filters, on each emulated board with the programs of each architecture.
Without filters and options it first runs pinion's own tests of boards, with the
device trees of Debian 13's kernel. It installs compilers if they are missing and you
are root, and downloads 300 MB the first time.

Options:
  --exact            A filter is a whole name
  --skip FILTER      Leave out the tests whose name contains this
  --nocapture        Show the output of tests that pass, too
  --board BOARD      Only this board: raspi3b or raspi4b
  --arch ARCH        Only programs of this architecture: arm64 or armhf
  --device-trees     Only the tests of boards with device trees
  --shell            A shell on the board instead of tests; Ctrl-A X ends it";

/// A failed run exits with libtest's code.
const FAILED: u8 = 101;

fn main() -> ExitCode {
    let (mut shell, mut only_device_trees) = (false, false);
    let (mut machine, mut debian) = (None, None);
    let arguments = Arguments::read(USAGE, |option, value| {
        match option {
            "--shell" => shell = true,
            "--device-trees" => only_device_trees = true,
            "--board" => machine = Some(value()?),
            "--arch" => debian = Some(value()?),
            _ => return Ok(false),
        }
        Ok(true)
    });
    let everything = !shell && machine.is_none() && debian.is_none() && arguments.for_libtest().is_empty();
    let device_trees = match everything || only_device_trees {
        true => Cache::open().and_then(|cache| boards_are_as_in_device_trees(&cache)),
        false => Ok(true),
    };
    let ok = device_trees.and_then(|ok| match only_device_trees {
        true => Ok(ok),
        false => Ok(run(&arguments, &chosen(machine.as_deref(), debian.as_deref())?, shell)? && ok),
    });
    match ok {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(FAILED),
        Err(cause) => {
            eprintln!("raspberry_pi: {cause}");
            ExitCode::from(FAILED)
        }
    }
}

/// A board with programs of an architecture.
type System = (&'static Board, &'static Architecture);

/// The systems that the options ask for.
fn chosen(machine: Option<&str>, debian: Option<&str>) -> Result<Vec<System>, String> {
    let boards = BOARDS.iter().filter(|board| machine.is_none_or(|machine| machine == board.machine));
    let architectures = ARCHITECTURES.iter().filter(|one| debian.is_none_or(|debian| debian == one.debian));
    let systems: Vec<System> = architectures.flat_map(|one| boards.clone().map(move |board| (board, one))).collect();
    match systems.is_empty() {
        true => Err("there is no such board, or no such architecture: see --help".to_owned()),
        false => Ok(systems),
    }
}

/// Whether every test passed on each system. An error is the suite's own failure.
fn run(arguments: &Arguments, systems: &[System], shell: bool) -> Result<bool, String> {
    let cache = Cache::open()?;
    let kernel = Kernel::prepare(&cache)?;
    let emulator = Emulator::prepare(&cache)?;
    let filters: String = arguments.for_libtest().iter().map(|word| format!("{word}\n")).collect();
    let mut ok = true;
    // One after the other: each keeps a processor busy.
    for &(board, architecture) in systems {
        let programs = Programs::build(architecture, &cache)?;
        let mut archive = programs.initramfs(&kernel)?;
        archive.file("/tests/filters", filters.as_bytes());
        let parts = Parts { board, emulator: &emulator, kernel: &kernel, initramfs: &archive.finish() };
        if shell {
            vm::shell(&parts, &cache)?;
            continue;
        }
        println!("a {} with Linux {} and programs of {}", board.name, kernel.release, architecture.debian);
        let mut vm = Vm::boot(&parts, &cache)?;
        let mut report = Report { started: Instant::now(), planned: Vec::new(), failures: Vec::new(), passed: 0 };
        let outcome = follow(&mut vm, &mut report, arguments.show_output);
        ok &= report.finish(outcome, &vm);
    }
    Ok(ok)
}

/// Whether the tests of `tools/system/tests/support/boards.rs` pass with the device trees of Debian's kernel.
fn boards_are_as_in_device_trees(cache: &Cache) -> Result<bool, String> {
    let folder = debian::device_trees(cache)?;
    println!("the boards of tools/system/tests/support/boards.rs with {}", folder.display());
    let mut cargo = Command::new(env::var_os("CARGO").unwrap_or("cargo".into()));
    cargo
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["test", "--locked", "--lib", "--", "board", "header", "config_txt"])
        .env("PINION_DEVICE_TREES", folder);
    cargo.status().map(|status| status.success()).map_err(|error| format!("cannot start cargo: {error}"))
}

/// Runs until the last test has ended. An error describes the end of the VM.
fn follow(vm: &mut Vm, report: &mut Report, show_output: bool) -> Result<(), String> {
    loop {
        match vm.next()? {
            News::Planned(tests) => report.plan(tests),
            News::Ended { test, status, output } => {
                // libtest reports success for a name that the program does not know.
                let passed = status == "0" && output.contains("test result: ok. 1 passed;");
                report.test(test, passed, &output, show_output)?;
            }
            News::Done => return Ok(()),
        }
    }
}

/// The output of the run, in libtest's form.
struct Report {
    started: Instant,
    planned: Vec<String>,
    passed: usize,
    /// Name and output.
    failures: Vec<(String, String)>,
}

impl Report {
    fn plan(&mut self, tests: Vec<String>) {
        println!("\nrunning {} test{}", tests.len(), if tests.len() == 1 { "" } else { "s" });
        self.planned = tests;
    }

    fn test(&mut self, test: String, passed: bool, output: &str, show_output: bool) -> Result<(), String> {
        let ended = self.passed + self.failures.len();
        if self.planned.get(ended) != Some(&test) {
            return Err(format!("the guest reported {test}, which was not its next test"));
        }
        if show_output {
            println!("---- {test} ----\n{}", output.trim_end());
        }
        println!("test {test} ... {}", if passed { "ok" } else { "FAILED" });
        match passed {
            true => self.passed += 1,
            false => self.failures.push((test, output.to_owned())),
        }
        Ok(())
    }

    /// Prints the rest. Returns whether there were tests and all have passed.
    fn finish(mut self, outcome: Result<(), String>, vm: &Vm) -> bool {
        let ended = self.passed + self.failures.len();
        let cause = match outcome {
            Err(cause) => Some(cause),
            Ok(()) if self.planned.is_empty() => Some("no test ran: none has such a name".to_owned()),
            Ok(()) if ended < self.planned.len() => Some("the guest left tests out".to_owned()),
            Ok(()) => None,
        };
        let left_out = self.planned.get(ended..).unwrap_or_default().iter();
        let not_run: Vec<_> = left_out.map(|test| (test.clone(), "it has no result: see below".to_owned())).collect();
        for (test, _) in &not_run {
            println!("test {test} ... FAILED");
        }
        self.failures.extend(not_run);
        if !self.failures.is_empty() {
            println!("\nfailures:\n");
            for (test, output) in &self.failures {
                println!("---- {test} ----\n{}\n", output.trim_end());
            }
        }
        let ok = cause.is_none() && self.failures.is_empty();
        if let Some(cause) = cause {
            println!("{cause}\n{}", vm.console());
        }
        if !self.failures.is_empty() {
            println!("\nfailures:");
            self.failures.iter().for_each(|(test, _)| println!("    {test}"));
        }
        println!(
            "\ntest result: {}. {} passed; {} failed; 0 ignored; 0 measured; finished in {:.2}s\n",
            if ok { "ok" } else { "FAILED" },
            self.passed,
            self.failures.len(),
            self.started.elapsed().as_secs_f64()
        );
        ok
    }
}
