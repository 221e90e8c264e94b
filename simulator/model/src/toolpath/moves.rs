// SPDX-License-Identifier: GPL-3.0-or-later
//! The path as G-code.

use std::io::{self, Write};

use super::lines;
use crate::engine::recorder::PathPoint;

/// Rests that are shorter than this are left out.
const REST_S: f64 = 0.05;

/// Writes G-code that makes the path again: absolute moves with the speed of each line. It has about 40 bytes for each
/// point of the path.
///
/// # Errors
///
/// The file cannot be written.
pub fn write_gcode(points: &[PathPoint], out: &mut dyn Write) -> io::Result<()> {
    writeln!(out, "; The path of a simulated printer, from its step pulses (pinion sim --toolpath)")?;
    writeln!(out, "G90\nM82\nG92 E0")?;
    let Some(start) = points.first() else { return Ok(()) };
    let [x, y, z] = start.nozzle_mm;
    writeln!(out, "G0 X{x:.4} Y{y:.4} Z{z:.4} F6000")?;
    let mut layer = 0;
    for line in lines(points) {
        let (mm, seconds) = (line.mm(), line.seconds());
        let filament_mm = line.to.filament_mm - line.from.filament_mm;
        if line.to.layer != layer {
            layer = line.to.layer;
            writeln!(out, ";LAYER:{layer}")?;
        }
        if mm == 0.0 && filament_mm == 0.0 {
            if seconds >= REST_S {
                writeln!(out, "G4 P{:.0}", seconds * 1000.0)?;
            }
            continue;
        }
        // klippy takes the speed of a move without the nozzle from the filament.
        let way_mm = if mm > 0.0 { mm } else { filament_mm.abs() };
        let [x, y, z] = line.to.nozzle_mm;
        let e = line.to.filament_mm - start.filament_mm;
        let mm_per_min = (way_mm / seconds * 60.0).max(0.1);
        writeln!(out, "G1 X{x:.4} Y{y:.4} Z{z:.4} E{e:.4} F{mm_per_min:.1}")?;
    }
    Ok(())
}
