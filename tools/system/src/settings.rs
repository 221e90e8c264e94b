// SPDX-License-Identifier: GPL-3.0-or-later
//! The settings of `pinion run`: from its command line, its configuration file and the defaults.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::error::ErrorKind;
use clap::{Args, Parser, Subcommand, ValueHint};
use log::LevelFilter;

use pinion_firmware::mcu::{DialectName, Tolerances};
use pinion_linux::gpio::FastGpio;
use pinion_runtime::{Access, LinkName};

use super::complete::{BOARDS, FAST, LEVELS, SPOKEN, offering};

/// The device of the watchdog that -w feeds.
pub const WATCHDOG: &str = "/dev/watchdog";
/// The remedy if the device is missing.
pub const WATCHDOG_REMEDY: &str =
    "sudo modprobe softdog; on a Raspberry Pi dtparam=watchdog=on in config.txt, and reboot";
/// Highest margin that may be asked for.
pub const MARGIN_MAX_US: u32 = 10_000;

/// Options of `pinion run`, and of `pinion` alone.
#[derive(Args, Clone, Debug)]
// An option may stand both in the unit and in PINION_OPTIONS. The last one counts.
#[command(args_override_self = true)]
pub struct RunArgs {
    /// The command line's own settings.
    #[command(flatten)]
    pub given: Given,
    /// Read options from FILE, for example /etc/pinion/pinion.toml. The command line overrides it
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Check the configuration on this computer, and end. The exit status is 0 if Pinion can serve it
    #[arg(long)]
    pub check: bool,
}

/// The level of the log (stderr).
#[derive(Args, Debug, Clone)]
pub struct LogArgs {
    /// How much to log: error, warn, info, debug, trace or off [default: info]
    #[arg(long, value_name = "LEVEL", global = true, value_parser = offering::<LevelFilter>(LEVELS),
        hide_possible_values = true)]
    pub log_level: Option<LevelFilter>,
}

impl LogArgs {
    /// The level, or the default one.
    pub fn level(&self) -> LevelFilter {
        self.log_level.unwrap_or(LevelFilter::Info)
    }
}

/// The subcommands of `pinion` that serve no host.
pub const OTHERS: [&str; 13] = [
    "add",
    "attach",
    "completions",
    "console",
    "dict",
    "doctor",
    "help",
    "latency",
    "link",
    "pins",
    "sim",
    "status",
    "trace",
];

/// The command line of `pinion`, as far as a process that serves a host has it.
#[derive(Parser)]
#[command(name = "pinion", args_conflicts_with_subcommands = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    log: LogArgs,
}

#[derive(Subcommand)]
enum Command {
    Run(Box<RunArgs>),
    #[command(external_subcommand)]
    Other(Vec<OsString>),
}

/// The options of `pinion run` in a command line, such as a running process's, with the level of the log in `given`. `None`
/// if the command line has another subcommand.
///
/// # Errors
///
/// The command line is not one of this version of Pinion.
pub fn run_args(arguments: impl IntoIterator<Item = OsString>) -> Result<Option<RunArgs>, clap::Error> {
    let line = CommandLine::try_parse_from(arguments)?;
    let with_level = |args: RunArgs| RunArgs { given: Given { log_level: line.log.log_level, ..args.given }, ..args };
    Ok(match line.command {
        None => Some(with_level(line.run)),
        Some(Command::Run(args)) => Some(with_level(*args)),
        Some(Command::Other(words)) if OTHERS.iter().any(|other| *other == words[0]) => None,
        Some(Command::Other(_)) => return Err(clap::Error::new(ErrorKind::InvalidSubcommand)),
    })
}

/// The settings that the command line or the configuration file gives.
#[derive(Args, Clone, Debug, Default, PartialEq)]
pub struct Given {
    /// Path of the symbolic link that the host opens; it leads to the pty [default: /tmp/klipper_host_mcu]
    #[arg(short = 'I', value_name = "PATH")]
    pub symlink: Option<PathBuf>,
    /// The way to the host: pty:PATH, or for a host on another computer serial:/dev/PORT, serial:/dev/PORT,BAUD,
    /// can:INTERFACE, can:INTERFACE,UUID or stdio. The status and the traces are still named after -I [default: pty, at the path of -I]
    #[arg(long, value_name = "LINK", value_hint = ValueHint::Other, value_parser = clap::value_parser!(LinkName))]
    pub link: Option<LinkName>,
    /// Run in real time: SCHED_FIFO and locked memory
    #[arg(short = 'r', num_args = 0, default_missing_value = "true")]
    pub realtime: Option<bool>,
    /// Run the core on this processor only
    #[arg(long, value_name = "N", value_hint = ValueHint::Other)]
    pub cpu: Option<usize>,
    /// Longest time that the core wakes early for a timer and then spins, in microseconds. It learns the
    /// time it needs. 0 saves power and makes steps late [default: 200]
    #[arg(long, value_name = "US", value_hint = ValueHint::Other, value_parser = clap::value_parser!(u32).range(0..=i64::from(MARGIN_MAX_US)))]
    pub margin: Option<u32>,
    /// Feed the hardware watchdog /dev/watchdog
    #[arg(short = 'w', num_args = 0, default_missing_value = "true")]
    pub watchdog: Option<bool>,
    /// Permission bits of the pty, octal [default: 0660]
    #[arg(short = 'm', value_name = "MODE", value_hint = ValueHint::Other, value_parser = mode)]
    pub mode: Option<u32>,
    /// Group of the pty, by name or number [default: tty, if permitted]
    #[arg(short = 'g', value_name = "GROUP", value_hint = ValueHint::Other)]
    pub group: Option<String>,
    /// The board: linux (this computer's pins), sim (a simulated printer) or sim:FILE.toml [default: linux]
    #[arg(long, value_name = "BOARD", value_parser = offering::<BoardName>(BOARDS), hide_possible_values = true)]
    pub board: Option<BoardName>,
    /// The hosts to serve: auto (recognizes the host), v0.11, v0.12, v0.13 or master of Klipper, kalico, or
    /// union (what v0.13, master and kalico agree on) [default: auto]
    #[arg(long, value_name = "NAME", value_parser = offering::<Spoken>(SPOKEN), hide_possible_values = true)]
    pub dialect: Option<Spoken>,
    /// Write and read GPIO lines through the chip's registers: off, auto (where tests cover the chip), on, or
    /// /dev/mem (as root, through this file) [default: auto]
    #[arg(long, value_name = "HOW", value_parser = offering::<FastGpio>(FAST), hide_possible_values = true)]
    pub fast_gpio: Option<FastGpio>,
    /// Let the flight recorder note each edge of each output, for `pinion trace --vcd`. It costs time
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub trace_edges: Option<bool>,
    /// Only the configuration file has this.
    #[arg(skip)]
    pub tolerances: Option<Tolerances>,
    /// Path of the socket for `pinion status` [default: named after the link, in /run/pinion or beside the link]
    #[arg(long, value_name = "PATH")]
    pub socket: Option<PathBuf>,
    /// The command line's level is an option of all subcommands.
    #[arg(skip)]
    pub log_level: Option<LevelFilter>,
}

/// The settings that the program runs by.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The instance's name: the path of the symbolic link, even if the link to the host is another one.
    pub symlink: PathBuf,
    /// The way to the host.
    pub link: LinkName,
    /// Whether it runs in real time.
    pub realtime: bool,
    /// The processor of the core.
    pub cpu: Option<usize>,
    /// The longest time that the core wakes early, in microseconds.
    pub margin_us: u32,
    /// Whether it feeds the hardware watchdog.
    pub watchdog: bool,
    /// The permission bits and the group of the pty.
    pub access: Access,
    /// The board.
    pub board: BoardName,
    /// The dialect. `None`: that of the host that comes.
    pub dialect: Option<DialectName>,
    /// Whether lines are written through the chip's registers.
    pub fast_gpio: FastGpio,
    /// How long each device may fail.
    pub tolerances: Tolerances,
    /// Whether the recorder notes each edge.
    pub trace_edges: bool,
    /// The path of the socket, if it is given.
    pub socket: Option<PathBuf>,
    /// The level of the log.
    pub log_level: LevelFilter,
}

impl Given {
    /// The values given here. Where one is missing, it is `other`'s.
    pub fn or(self, other: Given) -> Given {
        Given {
            symlink: self.symlink.or(other.symlink),
            link: self.link.or(other.link),
            realtime: self.realtime.or(other.realtime),
            cpu: self.cpu.or(other.cpu),
            margin: self.margin.or(other.margin),
            watchdog: self.watchdog.or(other.watchdog),
            mode: self.mode.or(other.mode),
            group: self.group.or(other.group),
            board: self.board.or(other.board),
            dialect: self.dialect.or(other.dialect),
            fast_gpio: self.fast_gpio.or(other.fast_gpio),
            tolerances: self.tolerances.or(other.tolerances),
            trace_edges: self.trace_edges.or(other.trace_edges),
            socket: self.socket.or(other.socket),
            log_level: self.log_level.or(other.log_level),
        }
    }

    /// The same, with the defaults for missing values.
    pub fn settings(self) -> Settings {
        let symlink = match &self.link {
            Some(LinkName::Pty(path)) => path.clone(),
            _ => self.symlink.unwrap_or_else(|| "/tmp/klipper_host_mcu".into()),
        };
        Settings {
            link: self.link.unwrap_or_else(|| LinkName::Pty(symlink.clone())),
            symlink,
            realtime: self.realtime.unwrap_or(false),
            cpu: self.cpu,
            margin_us: self.margin.unwrap_or(200),
            watchdog: self.watchdog.unwrap_or(false),
            access: Access { mode: self.mode.unwrap_or(0o660), group: self.group },
            board: self.board.unwrap_or(BoardName::Linux),
            dialect: self.dialect.and_then(|Spoken(name)| name),
            fast_gpio: self.fast_gpio.unwrap_or_default(),
            tolerances: self.tolerances.unwrap_or_default(),
            trace_edges: self.trace_edges.unwrap_or(false),
            socket: self.socket,
            log_level: self.log_level.unwrap_or(LevelFilter::Info),
        }
    }
}

/// Permission bits, as the command line writes them.
pub fn mode(text: &str) -> Result<u32, String> {
    match u32::from_str_radix(text, 8) {
        Ok(mode) if mode <= 0o777 => Ok(mode),
        _ => Err("this is not an octal number up to 0777".into()),
    }
}

/// A board, as the command line names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BoardName {
    /// This computer's pins.
    Linux,
    /// The simulated printer: the default one, or the one in a TOML file.
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

/// The dialect to speak. `None`: the dialect of the host that comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spoken(Option<DialectName>);

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
    /// The files that it is read from.
    pub fn files(&self) -> Vec<&Path> {
        match self {
            BoardName::Sim(Some(file)) => vec![file],
            BoardName::Linux | BoardName::Sim(None) => Vec::new(),
        }
    }
}
