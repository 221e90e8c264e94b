// SPDX-License-Identifier: GPL-3.0-or-later
//! The package, installed in a Debian 12 that was booted with systemd in the emulator. It runs the scripts of
//! `tests/package/checks`: those of the folders `service` and `installation` in order, each folder in a VM of its own, and
//! those of `pages`, which try the commands of the pages. docs/develop/test-package.md explains its use.
//!
//! This is the computer's side, a separate test harness.

mod commands;
mod packages;
mod vm;

use std::collections::VecDeque;
use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use pinion_testkit::arguments::Arguments;
use pinion_testkit::cache::Cache;
use vm::{Root, Vm};

const USAGE: &str = "\
Usage: cargo test --test package -- [OPTIONS] [FILTERS...]

Installs the package in a booted Debian 12 and runs the checks whose name contains any of the filters,
as in reboot or service/. The first check of service/ and of installation/ installs the package for the
others of its folder, so it runs before each of them. It takes root, installs the emulator if it is missing,
and downloads a Debian the first time.

Options:
  --exact            A filter is a whole name
  --skip FILTER      Leave out the checks whose name contains this
  --nocapture        Show the output of checks that pass, too
  --run FILE         Run this script in the VM after the checks, and print its output
  --list             Name the checks";

/// Exit status of a check that cannot run. The check prints the reason.
const NOT_RUN: i32 = 78;
/// The folder of the checks of the installed service: they run in order, and the first one installs the package.
const SERVICE: &str = "service";
/// The folder of the checks that install, upgrade and remove the package, and boot: as the former.
const INSTALLATION: &str = "installation";
/// The folder of the checks that try pages. Each makes everything that its page needs.
const PAGES: &str = "pages";
/// How long the prints of the checks last, in minutes. Without this they are short.
const MINUTES: &str = "PINION_PRINT_MINUTES";
const SHORT_PRINT: Duration = Duration::from_secs(10);
/// A failed run exits with libtest's code.
const FAILED: u8 = 101;

struct Options {
    arguments: Arguments,
    list: bool,
    run: Option<PathBuf>,
}

impl Options {
    /// Exits after an error, and for `--help`.
    fn from_args() -> Options {
        let (mut list, mut run) = (false, None);
        let arguments = Arguments::read(USAGE, |option, value| {
            match option {
                "--list" => list = true,
                "--run" => run = Some(value()?.into()),
                _ => return Ok(false),
            }
            Ok(true)
        });
        Options { arguments, list, run }
    }

    fn chosen(&self, check: &Check) -> bool {
        self.arguments.selects(&check.name)
    }
}

/// A script, with the things that earlier scripts prepare for it.
struct Check {
    name: String,
    script: String,
}

/// How long a long print lasts, if one is asked for.
fn long_print() -> Result<Option<Duration>, String> {
    let Some(minutes) = env::var_os(MINUTES) else { return Ok(None) };
    let minutes = minutes.to_str().and_then(|minutes| minutes.parse::<u64>().ok());
    minutes.map(|minutes| Some(Duration::from_secs(60 * minutes))).ok_or_else(|| format!("{MINUTES} is no number"))
}

/// The scripts of a folder in the order of their numbers, each after the common script.
fn checks(folder: &str, long_print: Option<Duration>) -> Result<Vec<Check>, String> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/package");
    let read = |path: &Path| fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()));
    let print_s = long_print.unwrap_or(SHORT_PRINT).as_secs();
    let shared = read(&here.join("guest/words.sh"))?;
    let path = here.join("checks").join(folder);
    let entries = fs::read_dir(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.sort();
    let check = |path: &PathBuf| {
        let name = format!("{folder}/{}", path.file_stem().unwrap_or_default().to_string_lossy());
        Ok(Check { name, script: format!("PRINT_S={print_s}\n{shared}\n{}", read(path)?) })
    };
    paths.iter().map(check).collect()
}

fn run(options: &Options) -> Result<bool, String> {
    let long_print = long_print()?;
    let chosen = |folder, is_needed: bool| {
        let checks = checks(folder, long_print)?;
        let is_needed = is_needed || checks.iter().any(|check| options.chosen(check));
        let runs = |(n, check): &(usize, Check)| options.chosen(check) || is_needed && *n == 0;
        Ok::<_, String>(checks.into_iter().enumerate().filter(runs).map(|(_, check)| check).collect::<Vec<Check>>())
    };
    // A script of `--run` finds the installed package.
    let (service, installation) = (chosen(SERVICE, options.run.is_some())?, chosen(INSTALLATION, false)?);
    let mut of_pages = commands::each_page(checks(PAGES, long_print)?)?;
    of_pages.retain(|check| options.chosen(check));
    if options.list {
        service.iter().chain(&installation).chain(&of_pages).for_each(|check| println!("{}: test", check.name));
        return Ok(true);
    }
    if !nix::unistd::geteuid().is_root() {
        return Err("to make a root folder takes root: sudo -E env PATH=$PATH make test-package".into());
    }
    let began = Instant::now();
    let cache = Cache::open()?;
    let root = Root::prepare(&cache)?;
    let folder = cache.run_folder()?;
    let share = folder.path().join("share");
    packages::share(&share)?;
    packages::share_klippy(&share)?;
    if installation.iter().any(|check| check.script.contains("/share/apt")) {
        packages::share_repositories(&share)?;
    }
    commands::share(&share)?;
    println!("prepared in {:.1} s", began.elapsed().as_secs_f64());

    of_pages.retain(|check| {
        let has_nothing = commands::has_nothing_to_try(check);
        if has_nothing {
            commands::not_tried(check).iter().for_each(|line| println!("{line}"));
        }
        !has_nothing
    });
    // Both VMs help with the pages when their own checks are done.
    let of_pages = Mutex::new(VecDeque::from(of_pages));
    let run = |(name, checks, then): (&str, Vec<Check>, _)| {
        let folder = folder.path().join(name);
        fs::create_dir(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        in_a_vm(|| Vm::boot(&root, &folder, &share, long_print), checks, &of_pages, options, then)
    };
    let vms = [(SERVICE, service, options.run.as_deref()), (INSTALLATION, installation, None)];
    let tallies: Vec<Result<Tally, String>> = thread::scope(|scope| {
        let started = vms.map(|vm| scope.spawn(|| run(vm)));
        started.into_iter().map(|thread| thread.join().unwrap_or_else(|_| Err("a VM's thread died".into()))).collect()
    });
    let mut all = Tally::default();
    for tally in tallies {
        let tally = tally?;
        all.passed += tally.passed;
        all.failed.extend(tally.failed);
        all.not_run.extend(tally.not_run);
    }
    let Tally { passed, failed, not_run } = all;
    println!(
        "\n{passed} passed, {} failed {failed:?}, {} not run {not_run:?} in {:.1} s",
        failed.len(),
        not_run.len(),
        began.elapsed().as_secs_f64()
    );
    Ok(failed.is_empty())
}

#[derive(Default)]
struct Tally {
    passed: usize,
    failed: Vec<String>,
    not_run: Vec<String>,
}

/// Runs the checks in a VM, if there are any, and `then` the script at this path. It also runs the shared checks that
/// the other VM leaves.
fn in_a_vm(
    boot: impl FnOnce() -> Result<Vm, String>,
    checks: Vec<Check>,
    shared: &Mutex<VecDeque<Check>>,
    options: &Options,
    then: Option<&Path>,
) -> Result<Tally, String> {
    let mut tally = Tally::default();
    let next_shared = || shared.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
    let mut own = VecDeque::from(checks);
    let installs = own.front().map(|check| check.name.clone());
    if own.is_empty() && then.is_none() {
        own.extend(next_shared());
    }
    if own.is_empty() && then.is_none() {
        return Ok(tally);
    }
    let mut vm = boot()?;
    println!("booted in {:.1} s", vm.boot_took.as_secs_f64());
    while let Some(check) = own.pop_front().or_else(next_shared) {
        let began = Instant::now();
        let (status, output) = vm.run(&check.script)?;
        if status == NOT_RUN {
            println!("check {} ... NOT RUN: {}", check.name, output.trim());
            tally.not_run.push(check.name.clone());
            continue;
        }
        let verdict = if status == 0 { "ok" } else { "FAILED" };
        let mut said = format!("check {} ... {verdict} ({:.1} s)\n", check.name, began.elapsed().as_secs_f64());
        said.extend(commands::not_tried(&check).iter().map(|line| format!("{line}\n")));
        if status != 0 || options.arguments.show_output {
            said.push_str(&output);
        }
        // Print at once, because another VM's lines may come between.
        print!("{said}");
        match status {
            0 => tally.passed += 1,
            _ => tally.failed.push(check.name.clone()),
        }
        if status != 0 && installs.as_ref() == Some(&check.name) {
            break;
        }
    }
    if let Some(file) = then {
        let script = fs::read_to_string(file).map_err(|error| format!("{}: {error}", file.display()))?;
        let (status, output) = vm.run(&script)?;
        println!("{output}\nstatus {status}");
    }
    Ok(tally)
}

fn main() -> ExitCode {
    match run(&Options::from_args()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(FAILED),
        Err(error) => {
            eprintln!("package: {error}");
            ExitCode::from(FAILED)
        }
    }
}
