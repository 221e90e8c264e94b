// SPDX-License-Identifier: GPL-3.0-or-later
//! Filament that runs out or gets stuck during a print.

use std::path::Path;

use super::checkout;
use super::klippy::{UNHOMED, WHERE_IT_STANDS, rest};
use super::printer::Printer;

/// A print of `moves` moves of 5 mm of filament each, with a cold hot end.
fn start_print(checkout: &Path, moves: usize, spool: &str) -> Printer {
    let describe = |board: String| {
        let changed = board.replace("length_mm = 330000.0\n", spool);
        assert_ne!(changed, board, "the built-in printer has another spool");
        changed
    };
    let change = |config: String| {
        let cold = config.replace("min_extrude_temp: 170", "min_extrude_temp: 0");
        assert_ne!(cold, config);
        format!("{cold}\n[pause_resume]\n\n[virtual_sdcard]\npath: .\n{UNHOMED}")
    };
    let mut printer = Printer::start_on(checkout, describe, change);
    let part: String = (0..moves).map(|n| format!("G1 X{} E5 F1500\n", 30 + 25 * (n % 2))).collect();
    printer.write("part.gcode", &format!("{WHERE_IT_STANDS}\nM83\nG1 X30 Y30 Z5 F6000\n{part}"));
    printer.until_object(SWITCH, "filament_detected", true);
    assert_eq!(
        rest(&printer.gcode("QUERY_FILAMENT_SENSOR SENSOR=filament"), "Filament Sensor filament: "),
        "filament detected"
    );
    printer.gcode("SDCARD_PRINT_FILE FILENAME=part.gcode");
    printer
}

fn detects(printer: &mut Printer, sensor: &str) -> bool {
    printer.object(sensor)["filament_detected"].as_bool().unwrap()
}

const SWITCH: &str = "filament_switch_sensor filament";
const MOTION: &str = "filament_motion_sensor filament_motion";

#[test]
fn a_print_pauses_as_the_filament_runs_out() {
    let Some(checkout) = checkout("a_print_pauses_as_the_filament_runs_out") else { return };
    let mut printer = start_print(&checkout, 40, "length_mm = 42.0\n");
    printer.until_object("pause_resume", "is_paused", true);
    printer.gcode("M400");
    assert!(!detects(&mut printer, SWITCH));
    assert_eq!(
        rest(&printer.gcode("QUERY_FILAMENT_SENSOR SENSOR=filament"), "Filament Sensor filament: "),
        "filament not detected"
    );
    assert_eq!(printer.object("print_stats")["state"], "paused");
    // klippy still prints the moves that it has read, but not the rest of 200 mm.
    let extruder = printer.probe().axis("extruder").unwrap().position_mm;
    assert!((42.0..150.0).contains(&extruder), "{extruder}");
    printer.gcode("CANCEL_PRINT");
}

#[test]
fn a_print_pauses_as_the_filament_is_stuck() {
    let Some(checkout) = checkout("a_print_pauses_as_the_filament_is_stuck") else { return };
    let mut printer = start_print(&checkout, 40, "length_mm = 330000.0\nstuck_after_mm = 42.0\n");
    printer.until_object("pause_resume", "is_paused", true);
    printer.gcode("M400");
    assert!(!detects(&mut printer, MOTION));
    assert!(detects(&mut printer, SWITCH));
    // Not before the length that klippy waits for an edge of the encoder.
    let extruder = printer.probe().axis("extruder").unwrap().position_mm;
    assert!((42.0 + 7.0 - 1.44..150.0).contains(&extruder), "{extruder}");
    printer.gcode("CANCEL_PRINT");
}

#[test]
fn a_print_with_enough_filament_goes_on_to_its_end() {
    let Some(checkout) = checkout("a_print_with_enough_filament_goes_on_to_its_end") else { return };
    let mut printer = start_print(&checkout, 12, "length_mm = 60.005\n");
    printer.until_object("print_stats", "state", "complete");
    printer.gcode("M400");
    assert_eq!(printer.object("pause_resume")["is_paused"], false);
    assert!(detects(&mut printer, SWITCH) && detects(&mut printer, MOTION));
    assert_eq!(printer.probe().axis("extruder").unwrap().position_mm, 60.0);
    // After one step more the filament has run out.
    printer.gcode("G1 E0.01 F60\nM400");
    printer.until_object(SWITCH, "filament_detected", false);
}

#[test]
fn a_new_spool_is_put_in() {
    let Some(checkout) = checkout("a_new_spool_is_put_in") else { return };
    let mut printer = start_print(&checkout, 40, "length_mm = 42.0\n");
    printer.until_object("pause_resume", "is_paused", true);
    printer.gcode("M400");
    assert!(!detects(&mut printer, SWITCH));
    printer.gcode("CANCEL_PRINT\nSET_PIN PIN=filament_refill VALUE=1\nSET_PIN PIN=filament_refill VALUE=0");
    printer.until_object(SWITCH, "filament_detected", true);
    printer.gcode("M83\nG1 E41 F1500\nM400");
    assert!(detects(&mut printer, SWITCH));
    printer.gcode("G1 E2 F1500\nM400");
    printer.until_object(SWITCH, "filament_detected", false);
}
