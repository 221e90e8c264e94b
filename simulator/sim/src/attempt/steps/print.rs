// SPDX-License-Identifier: GPL-3.0-or-later
//! A print, and the path of the nozzle against the file.

use std::io::BufReader;
use std::time::Duration;

use pinion_model::{AskedPath, PathPoint, Recorder, compare};
use pinion_system::files;

use super::heaters::heat_extruder;
use super::homing::said_mm;
use super::square::{LAYER_MM, square};
use super::{Seen, skipped};
use crate::attempt::report::Outcome;
use crate::attempt::trial::{LONG, Trial, travel};
use pinion_host::Refused;

/// How long a print may take.
const PRINT: Duration = Duration::from_secs(4 * 3600);
/// Longest G-code file.
const GCODE_MIB: u64 = 256;
/// How far apart two layers may be beside what the square asks for.
const LAYER_OFF_MM: f64 = 0.05;
/// Distance above which a print is wrong.
const WITHIN_MM: f64 = 0.1;

pub(super) fn printed(trial: &mut Trial<'_>) -> Seen {
    if !trial.has("extruder") {
        return skipped("there is no extruder");
    }
    let (low, high) = travel(&trial.toolhead()?);
    let (name, text) = match &trial.attempt.gcode {
        Some(path) => match files::read(path, GCODE_MIB) {
            Ok(bytes) => (path.display().to_string(), String::from_utf8_lossy(&bytes).into_owned()),
            Err(error) => return Err(trial.failed(format!("{}: {error}", path.display()), None)),
        },
        None => ("a small square".to_owned(), square(low, high)),
    };
    let asked = AskedPath::read(BufReader::new(text.as_bytes()), &name);
    let asked = asked.map_err(|trouble| trial.failed(trouble.to_string(), None))?;
    prepare(trial)?;
    // Moves that were sent before are not in the print's path.
    trial.gcode("M400", LONG)?;
    let said = said_mm(trial)?;
    let before = trial.lost();
    let (sent, recorder) = recorded(trial, |trial| {
        let lines: Vec<&str> = text.lines().collect();
        for block in lines.chunks(200) {
            send(trial, &block.join("\n"))?;
        }
        trial.gcode("M400", PRINT)
    })?;
    let place = |point: &PathPoint| {
        let nozzle_mm = [0, 1, 2].map(|axis| point.nozzle_mm[axis] + said[axis]);
        PathPoint { nozzle_mm, ..*point }
    };
    let points: Vec<PathPoint> = recorder.points().iter().map(place).collect();
    let compared = compare(&points, &asked);
    trial.path = Some(recorder);
    sent?;
    trial.lost_none_since(&before)?;
    let found = compared.map_err(|trouble| trial.failed(trouble.to_string(), None))?;
    let (mm, line) = (found.all.greatest_mm, found.all.line);
    if mm > WITHIN_MM {
        return Err(trial.failed(format!("{name}, line {line}: the nozzle was {mm:.3} mm off"), None));
    }
    if let Some(line) = found.ends_at_line {
        return Err(trial.failed(format!("{name}: the path ends at line {line}"), None));
    }
    if trial.attempt.gcode.is_none() {
        layers_are_apart(trial, &points)?;
    }
    Ok(format!("{name}: {:.0} mm, at most {mm:.3} mm off", found.all.length_mm))
}

/// Fails if the two layers of the small square are not as far apart as it asks for. A mesh moves both alike.
fn layers_are_apart(trial: &Trial<'_>, points: &[PathPoint]) -> Result<(), Outcome> {
    let laid: f64 = points.iter().map(|point| f64::from(point.laid_mm)).sum();
    // Of both layers: the sum of the heights by the filament that was laid there, and that filament.
    let mut layers = [(0.0, 0.0); 2];
    let mut so_far = 0.0;
    for point in points {
        let here = f64::from(point.laid_mm);
        let (sum, filament) = &mut layers[usize::from(so_far + here / 2.0 > laid / 2.0)];
        *sum += point.nozzle_mm[2] * here;
        *filament += here;
        so_far += here;
    }
    let [low, high] = layers.map(|(sum, filament)| sum / filament);
    let apart = high - low;
    if (apart - LAYER_MM).abs() > LAYER_OFF_MM {
        let cause = format!("the layers of the square are {apart:.3} mm apart, not {LAYER_MM:.3} mm");
        let section = trial.config().section("stepper_z");
        return Err(trial.failed(cause, section.map(|section| section.place_of("rotation_distance").clone())));
    }
    Ok(())
}

/// Homes and heats for the small square. A file of the user does that itself.
fn prepare(trial: &mut Trial<'_>) -> Result<(), Outcome> {
    if trial.has("pause_resume") {
        trial.gcode("CLEAR_PAUSE", LONG)?;
    }
    if trial.config().section("input_shaper").is_some() {
        // A shaper rounds corners, as it should.
        trial.gcode("SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0", LONG)?;
    }
    if trial.attempt.gcode.is_some() {
        return Ok(());
    }
    // The macros have begun and ended a print, or stopped somewhere in it.
    trial.gcode("SET_GCODE_OFFSET X=0 Y=0 Z=0\nM220 S100\nM221 S100", LONG)?;
    if trial.has("skew_correction") {
        trial.gcode("SET_SKEW CLEAR=1", LONG)?;
    }
    trial.gcode("G28", LONG)?;
    if trial.has("dual_carriage") {
        trial.gcode("SET_DUAL_CARRIAGE CARRIAGE=0\nACTIVATE_EXTRUDER EXTRUDER=extruder", LONG)?;
    }
    heat_extruder(trial)
}

/// Records the path of the nozzle while a print runs. Returns the print's result, too.
fn recorded<T>(trial: &mut Trial<'_>, print: impl FnOnce(&mut Trial<'_>) -> T) -> Result<(T, Recorder), Outcome> {
    trial.host.watch.recorder = Some(trial.probe.recorder());
    let printed = print(trial);
    trial.sleep(Duration::from_millis(600));
    let Some(mut recorder) = trial.host.watch.recorder.take() else {
        return Err(trial.failed("the path was not recorded", None));
    };
    recorder.end(trial.probe.now());
    Ok((printed, recorder))
}

/// Sends a block of a file.
fn send(trial: &mut Trial<'_>, block: &str) -> Result<(), Outcome> {
    match trial.host.gcode(block, PRINT) {
        Ok(()) => Ok(()),
        Err(Refused::Error(words)) => {
            let words = trial.why(words);
            Err(trial.failed(words, None))
        }
        Err(refused) => Err(trial.failed(format!("the print stopped: {refused}"), None)),
    }
}
