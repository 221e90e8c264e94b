// SPDX-License-Identifier: GPL-3.0-or-later
//! Gantries on several motors, and a delta printer. klippy levels and calibrates them with the probe.

use std::path::Path;

use super::checkout;
use super::klippy::example;
use super::printer::Printer;
use super::probes::{STEP_MM, probed};

/// The positions of the motors of the z axis.
fn motors(printer: &Printer) -> Vec<f64> {
    let axes = printer.probe().axes().filter(|axis| axis.name.starts_with('z'));
    axes.map(|axis| axis.position_mm).collect()
}

/// The bed's heights by the probe, with the nozzle at these places.
fn heights<const N: usize>(printer: &mut Printer, places: [[f64; 2]; N]) -> [f64; N] {
    places.map(|[x, y]| {
        printer.gcode(&format!("G1 Z5 F600\nG1 X{x} Y{y} F9000"));
        probed(printer, "PROBE")[2]
    })
}

fn range(values: &[f64]) -> f64 {
    let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(low, high), mm| (low.min(*mm), high.max(*mm)));
    high - low
}

/// Homes a gantry that hangs askew, and levels it.
fn level(checkout: &Path, change: fn(String) -> String, command: &str, corners: &[[f64; 2]; 4]) {
    let describe = |board: String| change(example(&board, "Four Z motors"));
    let mut printer = Printer::start_on(checkout, describe, |config| config);
    printer.gcode("G28");
    assert!(range(&heights(&mut printer, *corners)) > 0.2, "it is level from the start");
    let said = printer.gcode(&format!("G1 Z5 F600\n{command}"));
    let after = heights(&mut printer, *corners);
    assert!(range(&after) < 4.0 * STEP_MM, "{after:?}\n{said}");
    let motors = motors(&printer);
    assert!(range(&motors) < 1.0, "{motors:?}");
    assert!(printer.probe().axes().all(|axis| axis.lost_steps == 0));
}

const CORNERS: [[f64; 2]; 4] = [[44.0, 44.0], [44.0, 176.0], [176.0, 176.0], [176.0, 44.0]];

#[test]
fn klippy_levels_a_gantry_on_four_motors() {
    let Some(checkout) = checkout("klippy_levels_a_gantry_on_four_motors") else { return };
    level(&checkout, |board| board, "QUAD_GANTRY_LEVEL", &CORNERS);
}

#[test]
fn klippy_levels_a_bed_on_three_motors() {
    let Some(checkout) = checkout("klippy_levels_a_bed_on_three_motors") else { return };
    let three = |board: String| board.split("\n[[axis]]\nname = \"z3\"").next().unwrap().to_owned();
    level(&checkout, three, "Z_TILT_ADJUST RETRIES=4", &[CORNERS[0], CORNERS[1], CORNERS[2], CORNERS[0]]);
}

#[test]
fn klippy_levels_a_gantry_on_two_motors() {
    let Some(checkout) = checkout("klippy_levels_a_gantry_on_two_motors") else { return };
    // In the middle of the left and the right side.
    let two = |board: String| {
        let board = board.split("\n[[axis]]\nname = \"z2\"").next().unwrap().to_owned();
        board.replace("[-30.0, -10.0]", "[-30.0, 110.0]").replace("[-30.0, 230.0]", "[250.0, 110.0]")
    };
    let [left, right] = [[44.0, 110.0], [176.0, 110.0]];
    level(&checkout, two, "Z_TILT_ADJUST RETRIES=4", &[left, right, left, right]);
}

/// The bed of the example's delta. By `[bed]` it rises 0.1 mm along x. It is 0.05 mm lower at the ends of both
/// directions than in the middle.
fn bed_mm(x_mm: f64, y_mm: f64) -> f64 {
    let (u, v) = (x_mm / 90.0, y_mm / 90.0);
    0.05 * u - 0.025 * (u * u + v * v)
}

#[test]
fn klippy_probes_the_bed_of_a_delta_printer() {
    let Some(checkout) = checkout("klippy_probes_the_bed_of_a_delta_printer") else { return };
    let describe = |board: String| example(&board, "A delta printer");
    let mut printer = Printer::start_on(&checkout, describe, |config| config);
    printer.gcode("G28");
    for [x, y] in [[0.0, 0.0], [60.0, 10.0], [-40.0, 50.0]] {
        let [z] = heights(&mut printer, [[x, y]]);
        assert!((z - bed_mm(x, y)).abs() < 0.02, "{x} {y}: {z} {}", bed_mm(x, y));
    }
    assert!(printer.probe().axes().all(|axis| axis.lost_steps == 0));
}

#[test]
fn klippy_homes_and_moves_a_corexy_printer() {
    let Some(checkout) = checkout("klippy_homes_and_moves_a_corexy_printer") else { return };
    let describe = |board: String| example(&board, "A CoreXY printer");
    let mut printer = Printer::start_on(&checkout, describe, |config| config);
    printer.gcode("G28");
    for place in [[30.0, 20.0, 5.0], [200.0, 20.0, 5.0], [200.0, 190.0, 1.0], [17.5, 33.25, 60.0]] {
        let [x, y, z] = place;
        printer.gcode(&format!("G1 X{x} Y{y} Z{z} F9000\nM400"));
        let nozzle = printer.probe().nozzle_mm();
        let off = (0..2).map(|i: usize| (nozzle[i] - place[i]).abs()).fold(0.0, f64::max);
        // A step of homing, and one of rounding.
        assert!(off < 2.0 / 80.0, "{place:?} {nozzle:?}");
    }
    assert!(printer.probe().axes().all(|axis| axis.lost_steps == 0));
}

#[test]
fn klippy_calibrates_a_delta_printer() {
    let Some(checkout) = checkout("klippy_calibrates_a_delta_printer") else { return };
    // A flat bed, and a printer.cfg with a wrong radius and wrong ends of the towers.
    let describe =
        |board: String| example(&board, "A delta printer").replace("[bed]\nx_slope_mm = 0.1\nbow_mm = 0.05\n", "");
    let mut true_endstop = 0.0;
    let mut printer = Printer::start_on(&checkout, describe, |config| {
        let (_, endstop) = config.split_once("position_endstop: ").unwrap();
        let endstop = endstop.lines().next().unwrap();
        true_endstop = endstop.parse().unwrap();
        let config = config.replace("delta_radius: 105\n", "delta_radius: 105.4\n");
        let of_a = format!("position_endstop: {endstop}");
        config.replacen(&of_a, &format!("position_endstop: {}", true_endstop + 0.3), 1)
    });
    printer.gcode("G28");
    let places = [[0.0, 0.0], [60.0, 0.0], [-30.0, 50.0], [-30.0, -50.0]];
    let before = heights(&mut printer, places);
    assert!(range(&before) > 0.15, "{before:?}");
    printer.gcode("G1 Z5 F600\nDELTA_CALIBRATE");
    let saved = printer.object("configfile")["save_config_pending_items"].clone();
    let number = |section: &str, key: &str| saved[section][key].as_str().unwrap().parse::<f64>().unwrap();
    let radius = number("printer", "delta_radius");
    assert!((radius - 105.0).abs() < 0.05, "{radius}");
    // The arms' height depends on the radius that was found.
    let arms = |radius: f64| (215.0f64 * 215.0 - radius * radius).sqrt();
    for tower in ["a", "b", "c"] {
        let endstop = number(&format!("stepper_{tower}"), "position_endstop") + arms(radius);
        assert!((endstop - true_endstop - arms(105.0)).abs() < 0.05, "{tower}: {endstop}");
    }
}
