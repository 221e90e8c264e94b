// SPDX-License-Identifier: GPL-3.0-or-later
//! The macros that begin and end a print.

use super::heaters::heat_extruder;
use super::{Seen, skipped};
use crate::attempt::report::Outcome;
use crate::attempt::trial::{LONG, Trial};

/// Usual names of theirs.
const STARTS: [&str; 4] = ["START_PRINT", "PRINT_START", "START_GCODE", "BEGIN_PRINT"];
const ENDS: [&str; 3] = ["END_PRINT", "PRINT_END", "END_GCODE"];
/// The usual names of the temperatures.
const PARAMETERS: &str = "BED_TEMP=60 EXTRUDER_TEMP=200 BED=60 EXTRUDER=200 HOTEND=200 TOOL_TEMP=200";

pub(super) fn macros(trial: &mut Trial<'_>) -> Seen {
    let named = |names: &[&str]| {
        let macros = trial.config().of_kind("gcode_macro").filter_map(|section| section.own_name());
        macros.map(str::to_uppercase).find(|name| names.contains(&name.as_str()))
    };
    let found: Vec<String> = [named(&STARTS), named(&ENDS)].into_iter().flatten().collect();
    if found.is_empty() {
        return skipped("there is no START_PRINT and no END_PRINT");
    }
    let before = trial.lost();
    for name in &found {
        let script = format!("{name} {PARAMETERS}");
        match trial.gcode(&script, LONG) {
            // Some expect that the slicer has heated before.
            Err(Outcome::Failed { cause, .. }) if cause.contains("Extrude below minimum temp") => {
                heat_extruder(trial)?;
                trial.gcode(&script, LONG)?;
            }
            result => result?,
        }
    }
    trial.lost_none_since(&before)?;
    Ok(found.join(", "))
}
