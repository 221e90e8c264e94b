// SPDX-License-Identifier: GPL-3.0-or-later
//! The options for a printer.cfg of one's own.

use std::path::{Path, PathBuf};

use clap::Args;

use super::Pace;
use crate::attempt::print::PrintOptions;
use crate::attempt::{self, Attempt, Form, Task};
use pinion_host::Running;
use pinion_printer_config::Trouble;

/// Options for a printer.cfg.
#[derive(Args, Clone, Debug)]
pub(crate) struct OwnArgs {
    /// With a printer.cfg: start a klippy on a copy of it, and try everything: ready, homed, heated, leveled, printed.
    /// The exit status is 0 if nothing failed
    #[arg(long = "try", group = "with_klippy", conflicts_with_all = ["demo", "show", "print_config", "print_board"])]
    pub(crate) attempt: bool,
    /// With a printer.cfg: start a klippy on a copy of it, and let it print this file, in the printer's own time. It says
    /// how long the print takes, and what the motors and heaters did
    #[arg(long, value_name = "FILE.gcode", group = "with_klippy",
          conflicts_with_all = ["attempt", "demo", "show", "print_config", "print_board"])]
    print: Option<PathBuf>,
    /// With a printer.cfg: start a klippy on a copy of it at this many times the pace of real time, for Mainsail, Fluidd and
    /// --camera. On a slow computer it is slower, and never late
    #[arg(long, value_name = "N", group = "with_klippy", value_parser = speed,
          conflicts_with_all = ["attempt", "print", "demo", "show", "print_config", "print_board"])]
    speed: Option<f64>,
    /// List each layer of --print
    #[arg(long, requires = "print")]
    layers: bool,
    /// Draw speed, temperatures and flow of --print into this file
    #[arg(long, value_name = "FILE.svg", requires = "print")]
    plot: Option<PathBuf>,
    /// Say whether the computer with these figures can make the steps of --print. The file is an output of "pinion latency
    /// --json", and a second one of "pinion latency --pin NAME --json"
    #[arg(long, value_name = "FILE.json", requires = "print")]
    latency: Vec<PathBuf>,
    /// The checkout of Klipper or Kalico that judges printer.cfg, and for --try and --print; KLIPPER_DIR by default, or
    /// the one of this computer's klippy
    #[arg(long, value_name = "DIR")]
    klipper: Option<PathBuf>,
    /// The Python for that klippy; KLIPPER_PYTHON, or ~/klippy-env, by default
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// Print this file in --try, in place of a small square
    #[arg(long, value_name = "FILE", requires = "attempt")]
    gcode: Option<PathBuf>,
    /// Try only these steps, and that klippy is ready: for example homed,heated
    #[arg(long, value_name = "STEP", requires = "attempt", value_delimiter = ',', value_parser = attempt::steps(),
        hide_possible_values = true)]
    only: Vec<String>,
    /// Let klippy and the printer run by this computer's clock in --try. It takes minutes, and needs a computer that is
    /// fast enough
    #[arg(long, requires = "attempt")]
    real_time: bool,
    /// Write the report of --try or --print as JSON
    #[arg(long, requires = "with_klippy")]
    json: bool,
    /// Heat as slowly as a real printer does
    #[arg(long)]
    real_heat: bool,
    /// The printer.cfg of the printer itself, for example the one before your change. klippy gets the other one, so
    /// everything shows that does not fit the printer: a direction, an endstop, a thermistor
    #[arg(long, value_name = "PRINTER.cfg")]
    pub(crate) built_like: Option<PathBuf>,
    /// A description that lies over the one that comes out of printer.cfg
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) with: Option<PathBuf>,
    /// The folder for klippy's copy and its logs; a new one in /tmp by default
    #[arg(long, value_name = "DIR", conflicts_with = "in_place_pty")]
    pub(crate) folder: Option<PathBuf>,
    /// Leave the sections out of klippy's copy for which it has no module, for example of shaketune, and the included
    /// files that are not there. Without --klipper: the sections that neither Klipper nor Kalico has
    #[arg(long, conflicts_with = "in_place_pty")]
    pub(crate) without_plugins: bool,
    /// Make no copy: put each pty where `serial` of printer.cfg expects it
    #[arg(long, conflicts_with = "with_klippy")]
    pub(crate) in_place_pty: bool,
}

/// A pace. A very slow one would look like a printer that hangs.
fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse().ok().filter(|speed| (0.01..=1000.0).contains(speed));
    speed.ok_or_else(|| "a number from 0.01 to 1000".to_owned())
}

impl OwnArgs {
    /// Whether an option needs a printer.cfg.
    pub(crate) fn is_used(&self) -> bool {
        self.has_klippy()
            || self.built_like.is_some()
            || self.with.is_some()
            || self.folder.is_some()
            || self.in_place_pty
            || self.without_plugins
    }

    /// Whether this program starts a klippy, which runs the programs in a printer.cfg.
    pub(crate) fn has_klippy(&self) -> bool {
        self.attempt || self.print.is_some() || self.speed.is_some()
    }

    pub(crate) fn pace(&self) -> Pace {
        if self.real_heat { Pace::Real } else { Pace::Fast }
    }

    /// The form of the report of `--try`.
    pub(crate) fn form(&self) -> Form {
        if self.json { Form::Json } else { Form::Lines }
    }

    /// The klippy that is named, the one of KLIPPER_DIR, or the only one that this computer has.
    pub(crate) fn klipper(&self) -> Option<PathBuf> {
        let named = || self.klipper.clone().or_else(|| std::env::var_os("KLIPPER_DIR").map(PathBuf::from));
        named().or_else(pinion::klipper_here)
    }

    /// Whether the command line names the checkout.
    pub(super) fn names_klipper(&self) -> bool {
        self.klipper.is_some()
    }

    pub(super) fn python(&self) -> Option<&Path> {
        self.python.as_deref()
    }

    /// The options of `--try` or `--print`, if one is given.
    ///
    /// # Errors
    ///
    /// There is no klippy.
    pub(crate) fn attempt(&self) -> Result<Option<Attempt>, Trouble> {
        if !self.has_klippy() {
            return Ok(None);
        }
        let klipper = attempt::klipper(self.klipper())?;
        let python = attempt::python(self.python.as_deref(), &klipper);
        let print = |file: &PathBuf| {
            Task::Print(PrintOptions {
                file: file.clone(),
                layers: self.layers,
                plot: self.plot.clone(),
                latency: self.latency.clone(),
            })
        };
        let task = self.print.as_ref().map(print).or(self.speed.map(Task::Serve)).unwrap_or(Task::Try);
        Ok(Some(Attempt {
            task,
            klipper,
            python,
            gcode: self.gcode.clone(),
            real_time: self.real_time,
            only: self.only.clone(),
            form: self.form(),
            running: Running::default(),
        }))
    }
}
