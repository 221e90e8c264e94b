// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run`: serve a host.

use std::fs;
use std::path::Path;
use std::process::ExitCode;

use log::LevelFilter;
use nix::unistd::{Pid, getpid, getppid};

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::Monotonic;
use pinion_linux::gpio::FastGpio;
use pinion_linux::sys;
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Guardian, Helpers, Options, Recording};
use pinion_trace::folder::folders;

use super::board::linux;
use super::simulator::Open;
use super::{check, end_by_panic, failed, logging};
use pinion_system::config;
use pinion_system::settings::{BoardName, Given, RunArgs, Settings, WATCHDOG};

/// The command line's settings, then the configuration file's. `log_level` is the command line's.
///
/// # Errors
///
/// One line about the file.
fn settings(args: &RunArgs, log_level: Option<LevelFilter>) -> Result<Settings, Trouble> {
    let file = args.config.as_deref().map(config::load).transpose()?.unwrap_or_default();
    let given = Given { log_level, ..args.given.clone() };
    Ok(given.or(file).settings())
}

/// The options of the runtime.
fn options(settings: &Settings) -> Options {
    let Settings { symlink, socket, .. } = settings;
    Options {
        link: settings.link.clone(),
        dialect: settings.dialect,
        access: settings.access.clone(),
        realtime: settings.realtime,
        cpu: settings.cpu,
        margin: MarginLimits::up_to_us(settings.margin_us),
        watchdog: settings.watchdog.then(|| WATCHDOG.into()),
        tolerances: settings.tolerances.clone(),
        trace_edges: settings.trace_edges,
        sockets: socket.clone().map_or_else(|| pinion_runtime::socket_paths(symlink), |path| vec![path]),
    }
}

/// Serves until SIGTERM, SIGINT or SIGHUP. With `--check` it only reports whether that is possible. A simulated board
/// is made by `simulated`. `log_level` is the command line's.
pub fn run(args: &RunArgs, log_level: Option<LevelFilter>, simulated: Open) -> ExitCode {
    let settings = match settings(args, log_level) {
        Ok(settings) => settings,
        Err(error) => return failed(error),
    };
    log::set_max_level(settings.log_level);
    if args.check {
        return check::run(&settings, args.config.as_deref(), simulated);
    }
    end_by_panic();
    let clock = Monotonic::start();
    // A simulated printer needs no guardian. It comes first, because another program may take over for it.
    let simulation = match &settings.board {
        BoardName::Linux => None,
        BoardName::Sim(file) => match simulated(file.as_deref(), clock.shared()) {
            Ok(opened) => Some(opened),
            Err(error) => return failed(error),
        },
    };
    let guarded = simulation.is_none();
    let recording = Recording::new(clock, &settings.symlink, settings.realtime, folders())
        .map(|recording| recording.over(&settings.link));
    // /dev/mem is opened later, when a line of its chip is claimed.
    let rights = sys::SERVE | if settings.fast_gpio == FastGpio::DevMem { sys::RAW_MEMORY } else { 0 };
    let helpers = recording.and_then(|recording| {
        Ok((
            Helpers::start(&recording, guarded, settings.dialect.is_none() && settings.link.is_local(), rights)?,
            recording,
        ))
    });
    let (helpers, recording) = match helpers {
        Ok(started) => started,
        Err(error) => return failed(error),
    };
    logging::detach();
    if let Some(file) = &args.config {
        log::info!("configuration {}", file.display());
    }
    if helpers.guardian.is_some() && dies_with_its_guardian() {
        log::warn!(
            "this container has process numbers of its own: if Pinion dies, the kernel kills its guardian, too, and outputs \
             keep their levels: start the container with --pid=host"
        );
    }
    let guard = helpers.guardian.as_ref().map(Guardian::guard);
    let (board, timing) = simulation.unwrap_or_else(|| linux(clock.shared(), guard, settings.fast_gpio));
    match pinion_runtime::run(&options(&settings), board, timing, recording, helpers, None) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(error),
    }
}

/// Whether the kernel kills the guardian when this process ends. It kills all processes of a PID namespace with the first
/// one. That is this process, or the small init of a container, which ends with this process.
fn dies_with_its_guardian() -> bool {
    // The namespace of the computer itself (PROC_PID_INIT_INO of include/linux/proc_ns.h).
    const OUTSIDE: &str = "pid:[4026531836]";
    let first = Pid::from_raw(1);
    let has_own_numbers = fs::read_link("/proc/self/ns/pid").is_ok_and(|namespace| namespace.as_os_str() != OUTSIDE);
    has_own_numbers && (getpid() == first || getppid() == first && !Path::new("/run/systemd/system").exists())
}
