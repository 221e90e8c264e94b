// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run`: serve a host.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use clap::Args;
use log::LevelFilter;
use nix::unistd::{Pid, getpid, getppid};

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::Monotonic;
use pinion_linux::gpio::FastGpio;
use pinion_linux::sys;
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Guardian, Helpers, Options, Recording};
use pinion_trace::folder::folders;

use super::settings::{BoardName, Given, Settings, WATCHDOG, linux};
use super::simulator::Open;
use super::{check, config, end_by_panic, failed, logging};

/// Options of `pinion run`, and of `pinion` alone.
#[derive(Args, Clone, Debug)]
// An option may stand both in the unit and in PINION_OPTIONS. The last one counts.
#[command(args_override_self = true)]
pub struct RunArgs {
    #[command(flatten)]
    given: Given,
    /// Read options from FILE, for example /etc/pinion/pinion.toml. The command line overrides it
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Check the configuration on this computer, and end. The exit status is 0 if Pinion can serve it
    #[arg(long)]
    check: bool,
}

impl Settings {
    /// The options of the runtime.
    fn options(&self) -> Options {
        Options {
            link: self.link.clone(),
            dialect: self.dialect,
            access: self.access.clone(),
            realtime: self.realtime,
            cpu: self.cpu,
            margin: MarginLimits::up_to_us(self.margin_us),
            watchdog: self.watchdog.then(|| WATCHDOG.into()),
            tolerances: self.tolerances.clone(),
            trace_edges: self.trace_edges,
            sockets: self.socket.clone().map_or_else(|| pinion_runtime::socket_paths(&self.symlink), |path| vec![path]),
        }
    }
}

impl RunArgs {
    /// The command line's own settings, and the configuration file that it names.
    pub(super) fn into_parts(self) -> (Given, Option<PathBuf>) {
        (self.given, self.config)
    }

    /// The command line's settings, then the configuration file's. `log_level` is the command line's.
    ///
    /// # Errors
    ///
    /// One line about the file.
    fn settings(&self, log_level: Option<LevelFilter>) -> Result<Settings, Trouble> {
        let file = self.config.as_deref().map(config::load).transpose()?.unwrap_or_default();
        let given = Given { log_level, ..self.given.clone() };
        Ok(given.or(file).settings())
    }
}

/// Serves until SIGTERM, SIGINT or SIGHUP. With `--check` it only reports whether that is possible. A simulated board
/// is made by `simulated`. `log_level` is the command line's.
pub fn run(args: &RunArgs, log_level: Option<LevelFilter>, simulated: Open) -> ExitCode {
    let settings = match args.settings(log_level) {
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
        BoardName::Sim(file) => match simulated(file.as_deref(), Arc::new(clock)) {
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
    let (board, timing) = simulation.unwrap_or_else(|| linux(Arc::new(clock), guard, settings.fast_gpio));
    match pinion_runtime::run(&settings.options(), board, timing, recording, helpers, || ()) {
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
