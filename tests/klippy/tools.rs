// SPDX-License-Identifier: GPL-3.0-or-later
//! A second extruder on a second carriage, fans that follow a temperature, a light of four colors.

use super::checkout;
use super::klippy::example;
use super::printer::Printer;

#[test]
fn klippy_uses_a_second_extruder_and_a_second_carriage() {
    let Some(checkout) = checkout("klippy_uses_a_second_extruder_and_a_second_carriage") else { return };
    let describe = |board: String| example(&board, "A second extruder");
    let mut printer =
        Printer::start_on(&checkout, describe, |config| config.replace("min_extrude_temp: 170", "min_extrude_temp: 0"));
    printer.gcode("G28");
    let at = |printer: &Printer, axis: &str| printer.probe().axis(axis).unwrap().position_mm;
    assert_eq!((at(&printer, "x"), at(&printer, "dual_carriage")), (0.0, 220.0));
    printer.gcode("SET_DUAL_CARRIAGE CARRIAGE=dual_carriage\nACTIVATE_EXTRUDER EXTRUDER=extruder1\nM83");
    printer.gcode("G1 X150 Y30 Z5 F9000\nG1 E4 F300\nM400");
    assert_eq!((at(&printer, "x"), at(&printer, "dual_carriage")), (0.0, 150.0));
    assert_eq!((at(&printer, "extruder"), at(&printer, "extruder1")), (0.0, 4.0));
    printer.gcode("M104 T1 S60");
    printer.gcode("TEMPERATURE_WAIT SENSOR=extruder1 MINIMUM=30");
    let first = printer.object("extruder")["temperature"].as_f64().unwrap();
    assert!(first < 26.0, "{first}");
    printer.gcode("TURN_OFF_HEATERS\nSET_DUAL_CARRIAGE CARRIAGE=x\nACTIVATE_EXTRUDER EXTRUDER=extruder");
    printer.gcode("G1 X40 F9000\nG1 E2 F300\nM400");
    assert_eq!((at(&printer, "x"), at(&printer, "dual_carriage")), (40.0, 150.0));
    assert_eq!((at(&printer, "extruder"), at(&printer, "extruder1")), (2.0, 4.0));
    assert!(printer.probe().axes().all(|axis| axis.lost_steps == 0));
}

#[test]
fn klippy_cools_a_chamber_by_its_fan() {
    let Some(checkout) = checkout("klippy_cools_a_chamber_by_its_fan") else { return };
    let describe = |board: String| example(&board, "A chamber with a fan");
    let mut printer = Printer::start_on(&checkout, describe, |config| config);
    let rpm = |printer: &Printer, fan: &str| printer.probe().fan(fan).unwrap().rpm;
    let celsius = |printer: &Printer| printer.probe().heater("chamber").unwrap().celsius;
    printer.gcode("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=exhaust TARGET=80\nG4 P3000");
    let warm = celsius(&printer);
    assert!(warm > 44.0 && rpm(&printer, "exhaust") < 300.0, "{warm} {}", rpm(&printer, "exhaust"));
    printer.gcode("G4 P3000");
    let warmer = celsius(&printer);
    assert!(warmer > warm, "{warmer} {warm}");
    printer.gcode("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=exhaust TARGET=30\nG4 P8000");
    assert!(rpm(&printer, "exhaust") > 2900.0, "{}", rpm(&printer, "exhaust"));
    assert!(celsius(&printer) < warmer, "{} {warmer}", celsius(&printer));
    let read = printer.object("temperature_fan exhaust")["temperature"].as_f64().unwrap();
    assert!((read - celsius(&printer)).abs() < 1.0, "{read}");
    // The heat sink's fan follows the hot end.
    assert_eq!(rpm(&printer, "heat_sink"), 0.0);
    printer.gcode("M104 S60");
    printer.until_object("heater_fan heat_sink", "speed", 1.0);
    printer.gcode("G4 P3000");
    assert!(rpm(&printer, "heat_sink") > 5000.0);
    // No command was given to the fan yet, but klippy reads its tachometer.
    assert!(printer.object("fan")["rpm"].is_number());
    printer.gcode("M106 S255\nG4 P5000");
    let read = printer.object("fan")["rpm"].as_f64().unwrap();
    assert!((read - 4500.0).abs() < 50.0, "{read}");
}

#[test]
fn klippy_mixes_the_colours_of_a_light() {
    let Some(checkout) = checkout("klippy_mixes_the_colours_of_a_light") else { return };
    let describe = |board: String| example(&board, "An RGBW strip");
    let mut printer = Printer::start_on(&checkout, describe, |config| config);
    assert!(!printer.log().contains("WARN"), "{}", printer.log());
    assert_eq!(printer.sight("shelf").to_string(), "off");
    printer.gcode("SET_LED LED=shelf RED=1 GREEN=0.2 WHITE=0.6");
    assert_eq!(printer.sight("shelf").to_string(), "#ff3300+99");
    printer.gcode("SET_LED LED=shelf BLUE=1");
    assert_eq!(printer.sight("shelf").to_string(), "#0000ff");
}
