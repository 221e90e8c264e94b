// SPDX-License-Identifier: GPL-3.0-or-later
//! The macros that begin and end a print.

use std::collections::BTreeSet;

use super::heaters::heat_extruder;
use super::{Seen, skipped};
use crate::attempt::report::Outcome;
use crate::attempt::trial::{LEVELING, LONG, Trial, travel};

/// Usual names of theirs.
const STARTS: [&str; 4] = ["START_PRINT", "PRINT_START", "START_GCODE", "BEGIN_PRINT"];
const ENDS: [&str; 3] = ["END_PRINT", "PRINT_END", "END_GCODE"];
/// The usual names of the temperatures.
const PARAMETERS: [&str; 6] = ["BED_TEMP", "EXTRUDER_TEMP", "BED", "EXTRUDER", "HOTEND", "TOOL_TEMP"];
/// Words of an error of a macro that lacks what another macro, a plugin or the slicer gives it.
const LACKS: [&str; 3] = ["has no attribute", "is undefined", "is not valid for"];

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
    let (low, high) = travel(&trial.toolhead()?);
    let [x, y] = [0, 1].map(|axis: usize| (low[axis] + high[axis]) / 2.0);
    for name in &found {
        let script = format!("{name} {}", parameters(trial, name));
        let result = match trial.gcode(&script, LEVELING) {
            // Some expect that the slicer has heated before.
            Err(Outcome::Failed { cause, .. }) if cause.contains("Extrude below minimum temp") => {
                heat_extruder(trial)?;
                trial.gcode(&script, LEVELING)
            }
            result => result,
        };
        match result {
            Err(Outcome::Failed { cause, .. })
                if trial.own.is_partial() && LACKS.iter().any(|words| cause.contains(words)) =>
            {
                return skipped(format!("{cause}: klippy's copy may be without what it needs"));
            }
            Err(Outcome::Failed { cause, .. }) if cause.contains("'dict object' has no attribute") => {
                return skipped(format!("{cause}: your slicer may give it, so try a file of yours with --gcode"));
            }
            result => result?,
        }
        // A print ends somewhere on the bed. If this fails, the next macro says why.
        let _ = trial.host.gcode(&format!("G90\nG1 X{x:.2} Y{y:.2} F6000"), LONG);
    }
    trial.lost_none_since(&before)?;
    Ok(found.join(", "))
}

/// The parameters of a macro with temperatures: those that its text asks for, and the usual ones.
fn parameters(trial: &Trial<'_>, name: &str) -> String {
    let text = trial.macro_named(name).and_then(|section| section.text("gcode"));
    let asked = text.unwrap_or_default().split("params.").skip(1);
    let asked =
        asked.map(|rest| rest.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').next().unwrap_or_default());
    let names: BTreeSet<String> = asked.chain(PARAMETERS).map(str::to_uppercase).collect();
    let given = names.iter().filter_map(|name| Some(format!("{name}={}", celsius(name)?)));
    given.collect::<Vec<String>>().join(" ")
}

/// The temperature that a parameter with this name asks for.
fn celsius(name: &str) -> Option<u32> {
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    match name {
        _ if has(&["CHAMBER", "SOAK", "TIME", "MESH", "PROFILE", "DIAMETER", "SIZE"]) => None,
        _ if has(&["BED"]) => Some(60),
        _ if has(&["EXTR", "HOTEND", "NOZZLE", "TEMP", "TOOL_T"]) => Some(200),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::celsius;

    #[test]
    fn a_parameter_s_name_says_its_temperature() {
        let names =
            ["T_BED", "BEDTEMP", "T_EXTRUDER", "EXTRUDER_TEMP", "NOZZLE", "CHAMBER_TEMP", "BED_MESH", "MATERIAL"];
        let celsius = names.map(celsius);
        assert_eq!(celsius, [Some(60), Some(60), Some(200), Some(200), Some(200), None, None, None]);
    }
}
