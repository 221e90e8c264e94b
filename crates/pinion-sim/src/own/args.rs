// SPDX-License-Identifier: GPL-3.0-or-later
//! The options for a printer.cfg of one's own.

use std::path::PathBuf;

use clap::Args;

use super::Pace;
use crate::attempt::{self, Attempt, Form, Running};
use pinion_printer_config::Trouble;

/// Options for a printer.cfg.
#[derive(Args, Clone, Debug)]
pub(crate) struct OwnArgs {
    /// With a printer.cfg: start a klippy on a copy of it, and try everything: ready, homed, heated, leveled, printed.
    /// The exit status is 0 if nothing failed
    #[arg(long = "try", conflicts_with_all = ["demo", "show", "print_config", "print_board"])]
    pub(crate) attempt: bool,
    /// The checkout of Klipper or Kalico for --try; KLIPPER_DIR by default
    #[arg(long, value_name = "DIR")]
    klipper: Option<PathBuf>,
    /// The Python for that klippy; KLIPPER_PYTHON, or ~/klippy-env, by default
    #[arg(long, value_name = "PROGRAM", requires = "attempt")]
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
    /// Write the report of --try as JSON
    #[arg(long, requires = "attempt")]
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
    /// Leave the sections out of klippy's copy for which it has no module, for example of shaketune. Without --klipper:
    /// which neither Klipper nor Kalico has
    #[arg(long, conflicts_with = "in_place_pty")]
    pub(crate) without_plugins: bool,
    /// Make no copy: put each pty where `serial` of printer.cfg expects it
    #[arg(long, conflicts_with = "attempt")]
    pub(crate) in_place_pty: bool,
}

impl OwnArgs {
    /// Whether an option needs a printer.cfg.
    pub(crate) fn is_used(&self) -> bool {
        self.attempt
            || self.built_like.is_some()
            || self.with.is_some()
            || self.folder.is_some()
            || self.in_place_pty
            || self.without_plugins
    }

    pub(crate) fn pace(&self) -> Pace {
        if self.real_heat { Pace::Real } else { Pace::Fast }
    }

    /// The form of the report of `--try`.
    pub(crate) fn form(&self) -> Form {
        if self.json { Form::Json } else { Form::Lines }
    }

    /// The klippy that is named, or the one of KLIPPER_DIR.
    pub(crate) fn klipper(&self) -> Option<PathBuf> {
        self.klipper.clone().or_else(|| std::env::var_os("KLIPPER_DIR").map(PathBuf::from))
    }

    /// The options of `--try`, if it is given.
    ///
    /// # Errors
    ///
    /// There is no klippy.
    pub(crate) fn attempt(&self) -> Result<Option<Attempt>, Trouble> {
        if !self.attempt {
            return Ok(None);
        }
        let klipper = attempt::klipper(self.klipper())?;
        let python = attempt::python(self.python.as_deref(), &klipper);
        Ok(Some(Attempt {
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
