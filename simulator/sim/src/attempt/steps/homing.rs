// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing, and the second carriage of a printer with two.

use super::{Seen, skipped};
use crate::attempt::report::Outcome;
use crate::attempt::trial::{LONG, Trial, coordinates, travel};

/// The nozzle's axes, as klippy names them.
const AXES: [&str; 3] = ["x", "y", "z"];
/// How near the nozzle has to be to klippy's position.
const NEAR_MM: f64 = 0.15;

pub(super) fn homed(trial: &mut Trial<'_>) -> Seen {
    if trial.kinematics() == Some("none") {
        return skipped("kinematics: none");
    }
    let before = trial.lost();
    let start = trial.probe.nozzle_mm();
    trial.gcode("G28", LONG)?;
    trial.gcode("M400", LONG)?;
    trial.lost_none_since(&before)?;
    let toolhead = trial.toolhead()?;
    let homed = toolhead["homed_axes"].as_str().unwrap_or_default();
    if !AXES.iter().all(|axis| homed.contains(axis)) {
        return Err(trial.failed(format!("G28 homed only \"{homed}\""), None));
    }
    let nozzle = trial.probe.nozzle_mm();
    // A belt as z axis has no end: [homing_override] says where it is, and does not move it.
    let is_said = |axis: usize| start[axis] == nozzle[axis] && has_said_place(trial, axis);
    // A probe that homes z finds the bed within its own distance of a step, and a mesh may be in force.
    let off = coordinates(&toolhead["position"]).into_iter().zip(nozzle).map(|(klippys, real)| (klippys - real).abs());
    let mut far = off.enumerate().filter(|(axis, off)| *off > NEAR_MM && !is_said(*axis));
    if let Some((axis, off)) = far.find(|(axis, _)| is_plain(trial, *axis)) {
        let axis = AXES[axis];
        let section = trial.config().section(&format!("stepper_{axis}"));
        let place = section.map(|section| section.place_of("position_endstop").clone());
        return Err(trial.failed(format!("after G28 the nozzle is {off:.3} mm from klippy's {axis} position"), place));
    }
    let [x, y, z] = nozzle;
    Ok(format!("G28: the nozzle is at {x:.2} {y:.2} {z:.2}"))
}

/// How far klippy's position is from the nozzle's along the axes whose position `[homing_override]` only sets: a belt.
/// `homed` has checked that the others agree.
pub(super) fn said_mm(trial: &mut Trial<'_>) -> Result<[f64; 3], Outcome> {
    let klippys = coordinates(&trial.toolhead()?["position"]);
    let nozzle = trial.probe.nozzle_mm();
    Ok([0, 1, 2].map(|axis| {
        let off = klippys[axis] - nozzle[axis];
        if has_said_place(trial, axis) && off.abs() > NEAR_MM { off } else { 0.0 }
    }))
}

/// Whether `[homing_override]` says where an axis is.
fn has_said_place(trial: &Trial<'_>, axis: usize) -> bool {
    let over = trial.config().section("homing_override");
    over.is_some_and(|over| over.text(&format!("set_position_{}", AXES[axis])).is_some())
}

/// Whether klippy's position along an axis is the nozzle's: nothing is between them, and the bed does not change it.
fn is_plain(trial: &Trial<'_>, axis: usize) -> bool {
    let of_z = ["bed_tilt", "axis_twist_compensation", "z_tilt", "z_tilt_ng", "quad_gantry_level"];
    let has = |name: &&str| trial.config().section(name).is_some();
    let simple = ["cartesian", "corexy", "corexz", "delta", "hybrid_corexy", "hybrid_corexz"];
    let is_bent = has(&"skew_correction") || axis == 2 && of_z.iter().any(has);
    !is_bent && trial.kinematics().is_some_and(|kinematics| simple.contains(&kinematics))
}

/// Moves the second carriage, and checks where its motor is.
pub(super) fn second_carriage(trial: &mut Trial<'_>) -> Seen {
    let Some(section) = trial.config().section("dual_carriage") else {
        return skipped("there is no [dual_carriage]");
    };
    let gcode =
        |trial: &mut Trial<'_>, script: &str| trial.gcode(script, LONG).map_err(|outcome| outcome.at(&section.place));
    let before = trial.lost();
    gcode(trial, "G28")?;
    gcode(trial, "SET_DUAL_CARRIAGE CARRIAGE=1")?;
    let (low, high) = travel(&trial.toolhead()?);
    let axis = usize::from(section.text("axis") == Some("y"));
    let (middle, letter) = ((low[axis] + high[axis]) / 2.0, ["X", "Y"][axis]);
    gcode(trial, &format!("G90\nG1 {letter}{middle:.2} F6000\nM400"))?;
    let off = trial.probe.axis("dual_carriage").map(|axis| (axis.position_mm - middle).abs());
    if let Some(off) = off.filter(|off| *off > NEAR_MM) {
        let cause = format!("the second carriage is {off:.3} mm from klippy's {letter} position");
        return Err(trial.failed(cause, Some(section.place_of("position_endstop").clone())));
    }
    gcode(trial, "SET_DUAL_CARRIAGE CARRIAGE=0")?;
    trial.lost_none_since(&before)?;
    Ok(format!("the second carriage is at {middle:.2}"))
}
