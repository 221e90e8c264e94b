// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion lets Klipper use this computer's GPIO pins and buses. It is a drop-in replacement for klipper_mcu.
//!
//! This crate is the program's command line: one file, or file and folder, for each subcommand. docs/develop/architecture.md
//! describes the other crates.

#![forbid(unsafe_code)]
// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

use std::ffi::OsString;
use std::fs::Metadata;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{CommandFactory as _, Parser, Subcommand, ValueHint};
use log::LevelFilter;
use nix::sys::signal::{Signal, kill};
use nix::unistd::getpid;

use pinion_linux::gpio::Opener;
use pinion_linux::uart::is_pseudo_terminal;
pub use pinion_runtime::logging;
use pinion_system::Computer;
use pinion_system::klippy::klippys;
use pinion_system::settings::{LogArgs, RunArgs, run_args};

mod add;
mod attach;
mod board;
mod check;
pub mod console;
pub mod dict;
mod doctor;
pub mod latency;
mod link;
pub mod page;
mod pins;
mod report;
pub mod run;
pub mod simulator;
pub mod status;
pub mod terminal;
mod trace;

#[cfg(test)]
#[path = "../tools/system/tests/support/boards.rs"]
mod boards;
#[cfg(test)]
#[path = "../tools/system/tests/support/tree.rs"]
mod tree;

use page::{Page, print};
use simulator::take_over;

/// Lets Klipper use this computer's GPIO pins and buses. A drop-in replacement for klipper_mcu.
///
/// Without a subcommand it does the same as `pinion run`. It has the command line of klipper_mcu: -r -w -I PATH.
#[derive(Parser, Debug)]
#[command(name = "pinion", version = pinion_runtime::VERSION, max_term_width = 100, args_conflicts_with_subcommands = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    log: LogArgs,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Serve a Klipper host on a pty (the default)
    Run(RunArgs),
    /// Connect a device to the header, from its wires to a first measured value
    Add(add::AddArgs),
    /// List this computer's GPIO lines, ADCs, PWM channels and buses by name
    Pins(pins::PinsArgs),
    /// Print the data dictionary for klippy's batch mode (-d)
    Dict(dict::DictArgs),
    /// Measure how late this computer wakes up, and say which uses that allows
    Latency(latency::LatencyArgs),
    /// Check this computer, and print the command that fixes each problem
    Doctor(doctor::DoctorArgs),
    /// Ask a running Pinion for its state, host, pins, queues and lateness
    Status(status::StatusArgs),
    /// Say why the MCU stopped and who was late, from the recording of its last seconds
    Trace(trace::TraceArgs),
    /// Send commands to a running or simulated MCU by hand, without klippy
    Console(console::ConsoleArgs),
    /// Make a pty here for the Pinion on another computer, over ssh
    Link(link::LinkArgs),
    /// The far end of `pinion link`: carry standard input and output to the running Pinion
    Attach(attach::AttachArgs),
    /// Show the simulated printer at work, or print its printer.cfg
    #[command(disable_help_flag = true)]
    Sim {
        /// Options and files of pinion-sim: see `pinion sim --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT", value_hint = ValueHint::FilePath)]
        arguments: Vec<OsString>,
    },
    /// Print a script with which a shell completes pinion's command lines
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    // A program that serves a host keeps its memory. So it does not make the options of the other subcommands.
    if let Ok(Some(args)) = run_args(std::env::args_os()) {
        logging::start(args.given.log_level.unwrap_or(LevelFilter::Info));
        let status = run::run(&args, args.given.log_level, take_over);
        logging::finish();
        return status;
    }
    other_command()
}

/// Runs a subcommand that serves no host, or reports an error of the command line.
#[inline(never)]
fn other_command() -> ExitCode {
    let cli = Cli::parse();
    match cli.command {
        None | Some(Command::Run(_) | Command::Link(_) | Command::Attach(_)) => logging::start(cli.log.level()),
        Some(_) => logging::start_command(cli.log.level()),
    }
    let status = match cli.command {
        None => run::run(&cli.run, cli.log.log_level, take_over),
        Some(Command::Run(args)) => run::run(&args, cli.log.log_level, take_over),
        Some(Command::Add(args)) => add::run(&args),
        Some(Command::Pins(args)) => pins::run(&args),
        Some(Command::Dict(args)) => dict::run(&args, take_over),
        Some(Command::Latency(args)) => latency::run(&args),
        Some(Command::Doctor(args)) => doctor::run(&args),
        Some(Command::Status(args)) => status::run(&args),
        Some(Command::Trace(args)) => trace::run(&args),
        Some(Command::Console(args)) => console::run(&args, take_over),
        Some(Command::Link(args)) => link::run(&args),
        Some(Command::Attach(args)) => attach::run(&args),
        Some(Command::Sim { arguments }) => sim(&arguments, &cli.log),
        Some(Command::Completions { shell }) => {
            // pinion-sim knows the options behind `pinion sim`. Without it, a shell offers files there.
            let _ = simulator::start(&["completions".into(), "--all".into(), shell.to_string().into()]);
            completions(&mut Cli::command(), shell)
        }
    };
    logging::finish();
    status
}

/// Does the work of `pinion sim` in another program.
fn sim(arguments: &[OsString], log: &LogArgs) -> ExitCode {
    let level = log.log_level.map(|level| format!("--log-level={level}").into());
    failed(simulator::start(&level.into_iter().chain(arguments.iter().cloned()).collect::<Vec<_>>()))
}

/// The command line of `pinion`, with that of `pinion-sim` behind `pinion sim`.
pub fn with_simulator(simulator: clap::Command) -> clap::Command {
    Cli::command().mut_subcommand("sim", |own| {
        let about = own.get_about().cloned().unwrap_or_default();
        simulator.name("sim").about(about)
    })
}

/// The checkout of the only klippy that this computer has.
pub fn klipper_here() -> Option<PathBuf> {
    let klippys = klippys(&Computer::at(Path::new("/"))).into_iter();
    // A process with another root sees other files.
    let folders = klippys.filter_map(|klippy| klippy.folder).filter(|folder| !folder.starts_with("/proc"));
    let mut folders: Vec<PathBuf> = folders.filter_map(|folder| Some(folder.parent()?.to_owned())).collect();
    folders.dedup();
    if folders.len() == 1 { folders.pop() } else { None }
}

/// Prints the script for a shell.
pub fn completions(program: &mut clap::Command, shell: clap_complete::Shell) -> ExitCode {
    let mut script = Vec::new();
    let name = program.get_name().to_owned();
    clap_complete::generate(shell, program, name, &mut script);
    match print(&Page::text(&String::from_utf8_lossy(&script))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(error),
    }
}

/// Makes a panic in any thread log a line and end the process. Otherwise only that thread would end. Without its core,
/// for example, the MCU would still answer its host, with the outputs as they are.
fn end_by_panic() {
    std::panic::set_hook(Box::new(|panic| {
        // This comes first: the lines in the log's queue are lost when the process has ended.
        logging::finish();
        pinion_runtime::give_back();
        let panic = panic.to_string().replace('\n', " ");
        log::error!("this is a bug in Pinion, which ends here: please report it with this line: {panic}");
        std::process::abort();
    }));
}

/// Does `work` with only errors logged, because its findings are printed.
fn quietly<T>(work: impl FnOnce() -> T) -> T {
    let level = log::max_level();
    log::set_max_level(level.min(LevelFilter::Error));
    let done = work();
    log::set_max_level(level);
    done
}

/// Why a user may not ask a running Pinion by its link, which leads to this file.
fn not_permitted(link: &Path, file: &Path) -> String {
    // Any user can make a link in /tmp to any file, and the groups of other files open more than a terminal. Pinion's
    // own socket is no link.
    let is_socket = file.symlink_metadata().is_ok_and(|about| about.file_type().is_socket());
    let is_other = |about: Metadata| !is_socket && !is_pseudo_terminal(&about);
    let remedy = match Opener::of(file).command() {
        _ if file.metadata().is_ok_and(is_other) => "name the link of a Pinion".to_owned(),
        Some(command) => format!("\"{command}\" and log in again, or use sudo"),
        None => "use sudo".to_owned(),
    };
    format!("{} may not be opened by this user: {remedy}", link.display())
}

/// Ends this program in order, as by Ctrl-C: SIGTERM to ourselves.
pub fn end() {
    if let Err(error) = kill(getpid(), Signal::SIGTERM) {
        log::error!("Pinion cannot end itself: {error}: press Ctrl-C");
    }
}

/// Logs why a subcommand failed, and returns its exit status.
pub fn failed(error: impl std::fmt::Display) -> ExitCode {
    log::error!("{error}");
    ExitCode::FAILURE
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_system::settings::OTHERS;
    use std::os::unix::process::ExitStatusExt;

    #[test]
    #[ignore = "started by the other test"]
    fn panicking_thread() {
        if std::env::var_os("PINION_TEST_PANIC").is_none() {
            return;
        }
        logging::start(LevelFilter::Info);
        logging::detach();
        end_by_panic();
        let _ = std::thread::Builder::new().name("core".into()).spawn(|| panic!("in the core"));
        std::thread::sleep(std::time::Duration::from_secs(20));
    }

    #[test]
    fn subcommands_that_serve_no_host_are_known_to_those_that_look_for_hosts() {
        let mut program = Cli::command();
        program.build();
        let mut names: Vec<&str> = program.get_subcommands().map(clap::Command::get_name).collect();
        names.retain(|name| *name != "run");
        names.sort_unstable();
        assert_eq!(names, OTHERS);
        let options = |words: &[&str]| run_args(words.iter().map(Into::into));
        assert!(options(&["pinion", "-r", "--log-level=warn"]).is_ok_and(|args| args.is_some()));
        assert!(options(&["pinion", "run", "-r"]).is_ok_and(|args| args.is_some()));
        assert!(options(&["pinion", "doctor", "--json"]).is_ok_and(|args| args.is_none()));
        assert!(options(&["pinion", "3600"]).is_err(), "another version may have this");
    }

    #[test]
    fn a_link_to_another_kind_of_file_makes_nobody_a_member_of_its_group() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let (file, socket) = (folder.path().join("shadow"), folder.path().join("socket"));
        std::fs::write(&file, "").unwrap();
        let _socket = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        for path in [&file, &socket] {
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o660)).unwrap();
        }
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&socket, &link).unwrap();
        for other in [&file, &link] {
            let refusal = not_permitted(Path::new("/tmp/klipper_host_mcu"), other);
            assert!(refusal.ends_with("may not be opened by this user: name the link of a Pinion"), "{refusal}");
        }
        assert!(not_permitted(&socket, &socket).contains("use sudo"));
    }

    #[test]
    fn a_panic_in_any_thread_ends_the_process_and_is_logged() {
        let output = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "--nocapture", "tests::panicking_thread"])
            .env("PINION_TEST_PANIC", "1")
            .output()
            .unwrap();
        let log = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.signal(), Some(libc::SIGABRT), "{log}");
        assert!(log.contains("ERROR this is a bug in Pinion"), "{log}");
        assert!(log.contains("src/lib.rs") && log.contains("in the core"), "{log}");
    }
}
