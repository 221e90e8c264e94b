// SPDX-License-Identifier: GPL-3.0-or-later
//! The input shaper of a printer with an accelerometer.

use super::{Seen, skipped};
use crate::attempt::trial::{LONG, Trial};
use crate::own::{Kind, kind_of};

pub(super) fn shaped(trial: &mut Trial<'_>) -> Seen {
    let Some(section) = trial.config().section("resonance_tester") else {
        return skipped("there is no [resonance_tester]");
    };
    let chips = ["accel_chip", "accel_chip_x", "accel_chip_y"].into_iter().filter_map(|key| section.text(key));
    let mut kinds = chips.filter_map(|chip| chip.split_whitespace().next());
    if let Some(kind) = kinds.find(|kind| kind_of(kind) != Kind::Known) {
        return skipped(format!("[{kind}] is not simulated"));
    }
    // The whole range would take four minutes.
    for command in ["G28", "SHAPER_CALIBRATE FREQ_START=25 FREQ_END=85 HZ_PER_SEC=2"] {
        trial.gcode(command, LONG).map_err(|outcome| outcome.at(&section.place))?;
    }
    Ok("SHAPER_CALIBRATE".into())
}
