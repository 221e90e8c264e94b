// SPDX-License-Identifier: GPL-3.0-or-later
//! Leveling with a probe, and the calibration of the probe.

use pinion_printer_config::Limit;

use super::{Seen, skipped};
use crate::attempt::trial::{LEVELING, LONG, Trial, travel};

/// How level a gantry or bed has to be.
const LEVEL_MM: f64 = 0.1;

/// Whether a leveling moves the motors of z apart, or only measures.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Moves {
    Motors,
    Nothing,
}

/// The sections that level something with a probe, in the order in which an owner uses them, and their commands.
const LEVELS: [(&str, &str, Moves); 7] = [
    ("bed_tilt", "BED_TILT_CALIBRATE", Moves::Nothing),
    ("z_tilt", "Z_TILT_ADJUST", Moves::Motors),
    ("z_tilt_ng", "Z_TILT_ADJUST", Moves::Motors),
    ("quad_gantry_level", "QUAD_GANTRY_LEVEL", Moves::Motors),
    ("delta_calibrate", "DELTA_CALIBRATE", Moves::Nothing),
    ("screws_tilt_adjust", "SCREWS_TILT_CALCULATE", Moves::Nothing),
    ("bed_mesh", "BED_MESH_CALIBRATE", Moves::Nothing),
];

pub(super) fn leveled(trial: &mut Trial<'_>) -> Seen {
    let found = LEVELS.map(|(name, command, moves)| Some((trial.place(name)?, command, moves)));
    let found: Vec<_> = found.into_iter().flatten().collect();
    if found.is_empty() {
        return skipped("nothing of [z_tilt], [quad_gantry_level], [bed_mesh] is there");
    }
    if !trial.has("probe") {
        return skipped("there is no probe");
    }
    let before = trial.lost();
    for (place, command, moves) in &found {
        trial.gcode("G28", LONG).map_err(|outcome| outcome.at(place))?;
        for script in with_probe(trial, &[command, "M400"]) {
            trial.gcode(script, LEVELING).map_err(|outcome| outcome.at(place))?;
        }
        if let Some((apart, name)) =
            apart(trial).filter(|(apart, _)| *apart > level_mm(trial) && *moves == Moves::Motors)
        {
            let cause = format!("after {command} the motor {name} holds its side {apart:.3} mm too high or low");
            return Err(trial.failed(cause, Some(place.clone())));
        }
    }
    trial.lost_none_since(&before)?;
    let commands: Vec<&str> = found.iter().map(|(_, command, _)| *command).collect();
    Ok(commands.join(", "))
}

/// These commands, between the macros that take a probe from its dock and put it back, if the printer has such a probe.
/// A command whose own macro does that leaves a probe that is locked at the nozzle.
fn with_probe<'a>(trial: &Trial<'_>, commands: &[&'a str]) -> Vec<&'a str> {
    const TAKE_UP: &str = "ATTACH_PROBE_LOCK";
    const PUT_BACK: &str = "DOCK_PROBE_UNLOCK";
    let needs = [TAKE_UP, PUT_BACK].into_iter().all(|name| trial.macro_named(name).is_some());
    let [before, behind] = [TAKE_UP, PUT_BACK].map(|name| needs.then_some(name));
    before.into_iter().chain(commands.iter().copied()).chain(behind).collect()
}

/// How far apart they may be: as far as the user tolerates. The motors are farther apart than the points.
fn level_mm(trial: &Trial<'_>) -> f64 {
    let sections = ["z_tilt", "z_tilt_ng", "quad_gantry_level"].map(|name| trial.config().section(name));
    let tolerances = sections.into_iter().flatten();
    let tolerances = tolerances.filter_map(|section| section.number("retry_tolerance", Limit::Any).ok().flatten());
    tolerances.map(|tolerance| 2.0 * tolerance).fold(LEVEL_MM, f64::max)
}

/// The largest distance of a z motor from the first one, and its name. The simulated bed is flat.
fn apart(trial: &Trial<'_>) -> Option<(f64, String)> {
    let first = trial.probe.axis("z")?.position_mm;
    let others = (1..).map_while(|n| trial.probe.axis(&format!("z{n}")));
    let apart = others.map(|axis| ((axis.position_mm - first).abs(), axis.name.to_owned()));
    apart.max_by(|(a, _), (b, _)| a.total_cmp(b))
}

/// How far the probe reaches below the nozzle.
fn z_offset_mm(trial: &Trial<'_>) -> f64 {
    let probe = trial.config().section("probe");
    probe.and_then(|probe| probe.number("z_offset", Limit::Any).ok().flatten()).unwrap_or(0.0)
}

pub(super) fn probed(trial: &mut Trial<'_>) -> Seen {
    if !trial.has("probe") {
        return skipped("there is no probe");
    }
    let before = trial.lost();
    // G28 may end where the probe has triggered, or where it is beside the bed.
    let (low, high) = travel(&trial.toolhead()?);
    let [x, y] = [0, 1].map(|n: usize| (low[n] + high[n]) / 2.0);
    // A probe that is put below the nozzle by hand needs more room.
    let z = 10.0 + z_offset_mm(trial).max(0.0);
    let middle = format!("G90\nG1 Z{z:.2} F600\nG1 X{x:.2} Y{y:.2} F6000");
    trial.gcode("G28", LONG)?;
    for command in with_probe(trial, &[&middle, "PROBE_CALIBRATE", "ABORT"]) {
        trial.gcode(command, LONG)?;
    }
    if trial.macro_named("STOW_PROBE").is_some() {
        // A macro with the name of PROBE_CALIBRATE may have taken the probe up.
        let _ = trial.host.gcode("STOW_PROBE", LONG);
    }
    trial.lost_none_since(&before)?;
    Ok("PROBE_CALIBRATE".into())
}
