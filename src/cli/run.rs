// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run`: serve a host.

#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::Arc;

use clap::Args;

use crate::board::Board;
use crate::board::linux::{Guard, LinuxBoard};
use crate::board::sim::{SimBoard, SimConfig, SimError};
use crate::mcu::DialectName;
use crate::runtime::wakeup::MarginLimits;
use crate::runtime::{self, Access, Guardian, Options};
use crate::time::{Monotonic, TimeSource};

use super::{end_by_panic, failed, logging};

/// The device of the watchdog that -w feeds.
const WATCHDOG: &str = "/dev/watchdog";

/// Options of `pinion run`, and of `pinion` alone.
#[derive(Args, Clone, Debug)]
pub(super) struct RunArgs {
    /// Where to put the symbolic link to the pty that the host opens
    #[arg(short = 'I', value_name = "PATH", default_value = "/tmp/klipper_host_mcu")]
    symlink: PathBuf,
    /// Run in real time: SCHED_FIFO and locked memory
    #[arg(short = 'r')]
    realtime: bool,
    /// Run the core on this processor only
    #[arg(long, value_name = "N")]
    cpu: Option<usize>,
    /// How early, at most, the core may wake for a timer and spin the rest: it learns how early
    /// it has to. 0 saves power and makes steps late
    #[arg(long, value_name = "US", default_value_t = 200, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    margin: u32,
    /// Feed the hardware watchdog /dev/watchdog
    #[arg(short = 'w')]
    watchdog: bool,
    /// Permission bits of the pty, octal
    #[arg(short = 'm', value_name = "MODE", default_value = "0660", value_parser = mode)]
    mode: u32,
    /// Group of the pty, by name or number [default: tty, where that is permitted]
    #[arg(short = 'g', value_name = "GROUP")]
    group: Option<String>,
    /// The board: linux (this machine's pins), sim (a simulated printer) or sim:FILE.toml
    #[arg(long, value_name = "BOARD", default_value = "linux")]
    board: BoardName,
    /// The hosts to serve: auto (whichever comes), v0.11, v0.12, v0.13 or master (of Klipper), kalico,
    /// or union (of the last three, as far as they agree)
    #[arg(long, value_name = "NAME", default_value = "auto")]
    dialect: Spoken,
    /// Where to put the socket for `pinion status` [default: named for the link, in /run/pinion or beside it]
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

fn mode(text: &str) -> Result<u32, String> {
    match u32::from_str_radix(text, 8) {
        Ok(mode) if mode <= 0o777 => Ok(mode),
        _ => Err("an octal number up to 0777 is wanted, such as 0660".into()),
    }
}

/// Which board, as the command line names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum BoardName {
    /// This machine's pins.
    Linux,
    /// The simulated printer: the default one, or that of a TOML file.
    Sim(Option<PathBuf>),
}

impl FromStr for BoardName {
    type Err = String;

    fn from_str(text: &str) -> Result<BoardName, String> {
        match text.split_once(':') {
            None if text == "linux" => Ok(BoardName::Linux),
            None if text == "sim" => Ok(BoardName::Sim(None)),
            Some(("sim", file)) if !file.is_empty() => Ok(BoardName::Sim(Some(file.into()))),
            _ => Err("there are the boards linux, sim and sim:FILE.toml".into()),
        }
    }
}

/// The dialect that is spoken; none: that of the host that comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Spoken(Option<DialectName>);

impl FromStr for Spoken {
    type Err = String;

    fn from_str(text: &str) -> Result<Spoken, String> {
        match text {
            "auto" => Ok(Spoken(None)),
            name => name.parse().map(|name| Spoken(Some(name))),
        }
    }
}

impl BoardName {
    /// Opens the board. Its outputs are given to `guard`.
    pub(super) fn open(
        &self,
        clock: Arc<dyn TimeSource>,
        guard: Option<Box<dyn Guard>>,
    ) -> Result<Box<dyn Board>, String> {
        match self {
            BoardName::Linux => Ok(Box::new(LinuxBoard::new(guard))),
            BoardName::Sim(file) => {
                let board = sim_config(file.as_deref()).and_then(|config| SimBoard::new(config, clock));
                Ok(Box::new(board.map_err(|error| error.to_string())?))
            }
        }
    }
}

/// The description of a simulated printer: that of a file, or the default one.
pub(super) fn sim_config(file: Option<&Path>) -> Result<SimConfig, SimError> {
    file.map_or_else(|| Ok(SimConfig::default_printer()), SimConfig::load)
}

impl RunArgs {
    /// What the runtime needs to know.
    pub(super) fn options(&self) -> Options {
        Options {
            symlink: self.symlink.clone(),
            dialect: self.dialect.0,
            access: Access { mode: self.mode, group: self.group.clone() },
            realtime: self.realtime,
            cpu: self.cpu,
            margin: MarginLimits::up_to_us(self.margin),
            watchdog: self.watchdog.then(|| WATCHDOG.into()),
            sockets: self.socket.clone().map_or_else(|| runtime::socket_paths(&self.symlink), |path| vec![path]),
        }
    }
}

/// Serves until SIGTERM, SIGINT or SIGHUP.
pub(super) fn run(args: &RunArgs) -> ExitCode {
    end_by_panic();
    let clock = Monotonic::start();
    // The guardian must be forked before any thread is started. A simulated printer needs none.
    let guardian = match args.board {
        BoardName::Linux => Some(Guardian::start(clock, args.realtime)),
        BoardName::Sim(_) => None,
    };
    let guardian = match guardian.transpose() {
        Ok(guardian) => guardian,
        Err(error) => return failed(error),
    };
    logging::detach();
    let board = match args.board.open(Arc::new(clock), guardian.as_ref().map(Guardian::guard)) {
        Ok(board) => board,
        Err(error) => return failed(error),
    };
    match runtime::run(&args.options(), board, clock, guardian, || ()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(error),
    }
}
