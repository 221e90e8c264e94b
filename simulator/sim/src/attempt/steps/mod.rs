// SPDX-License-Identifier: GPL-3.0-or-later
//! The steps of `--try`, a file for each thing that an owner checks.
//!
//! A step is one command or a few, and checks the printer, not only klippy: where the motors put the nozzle, how
//! hot the heater is, how fast the fan turns.

mod heaters;
mod homing;
mod leveling;
mod macros;
mod outputs;
mod print;
mod ready;
mod shaper;
mod square;

use super::report::Outcome;
use super::trial::Trial;

/// The observation of a step on a printer that works. The error is any other outcome.
type Seen = Result<String, Outcome>;

/// Something that is tried.
pub(super) struct Step {
    pub(super) name: &'static str,
    pub(super) run: fn(&mut Trial<'_>) -> Seen,
}

/// In the order in which an owner tries them.
pub(super) const STEPS: &[Step] = &[
    Step { name: "ready", run: ready::ready },
    Step { name: "homed", run: homing::homed },
    Step { name: "carriage", run: homing::second_carriage },
    Step { name: "heated", run: heaters::heated },
    Step { name: "fans", run: outputs::fans },
    Step { name: "lights", run: outputs::lights },
    Step { name: "servo", run: outputs::servo },
    Step { name: "leveled", run: leveling::leveled },
    Step { name: "probe", run: leveling::probed },
    Step { name: "shaper", run: shaper::shaped },
    Step { name: "macros", run: macros::macros },
    Step { name: "printed", run: print::printed },
    Step { name: "cooled", run: heaters::cooled },
];

fn skipped<T>(why: impl Into<String>) -> Result<T, Outcome> {
    Err(Outcome::Skipped(why.into()))
}
