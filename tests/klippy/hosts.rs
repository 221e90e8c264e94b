// SPDX-License-Identifier: GPL-3.0-or-later
//! Hosts of every dialect on the whole simulated printer. Each has its own checkout: `KLIPPER_DIR_V0_11`, `_V0_12`,
//! `_V0_13`, `_MASTER` and `_KALICO`. Kalico's branch `bleeding-edge-v2` has `KLIPPER_DIR_KALICO_BLEEDING_EDGE`.

use std::io::Write;
use std::path::PathBuf;

use pinion_firmware::mcu::DialectName;

use super::drivers::{dump, on_a_port};
use super::klippy::{rest, without};
use super::printer::Printer;
use super::probes::on_spi;

/// The checkout of a dialect; `None` if there is none.
pub fn checkout(dialect: DialectName) -> Option<PathBuf> {
    folder_of(&dialect.name().to_uppercase().replace('.', "_"))
}

/// The checkout in the variable `KLIPPER_DIR_` with this end; `None` if there is none.
fn folder_of(host: &str) -> Option<PathBuf> {
    let variable = format!("KLIPPER_DIR_{host}");
    let folder = std::env::var_os(&variable).map(PathBuf::from);
    if folder.is_none() {
        let skipped =
            format!("\nSKIPPED the host {host}: {variable} is not set; set it to a checkout of that version\n");
        let _ = std::io::stderr().write_all(skipped.as_bytes());
    }
    folder
}

/// Adds a pressed button to the built-in printer.
fn with_button(board: String) -> String {
    board + "\n[[input]]\nname = \"knob\"\npin = \"knob\"\nlevel = true\n"
}

fn with_sections(config: String, dialect: DialectName) -> String {
    // Load cells came with v0.13, and this form of the ADS1220 with master.
    let is_known = |section: &&str| dialect == DialectName::Master || !section.starts_with("[load_cell");
    let sections = config.split_inclusive("\n\n").filter(is_known);
    sections.collect::<String>() + "\n[gcode_button knob]\npin: knob\npress_gcode:\n"
}

#[test]
fn hosts_of_all_dialects_use_the_whole_printer() {
    for dialect in DialectName::OF_HOSTS {
        let Some(checkout) = checkout(dialect) else { continue };
        eprintln!("{dialect}");
        let mut printer = Printer::start_on(&checkout, with_button, |config| with_sections(config, dialect));
        for restart in ["FIRMWARE_RESTART", "RESTART"] {
            use_everything(&mut printer);
            let answer = printer.gcode("ACCELEROMETER_QUERY");
            assert_is_gravity(z_mm_per_s2(rest(&answer, "accelerometer values (x, y, z): ")));
            printer.restart(restart);
        }
        printer.gcode("G28 X");
        assert!(!printer.log().lines().any(|line| line.starts_with("ERROR ")), "{dialect}: {}", printer.log());
    }
}

/// Names of pins that stand for a serial port and for the data lines of an SPI bus. Kalico has its own code for load
/// cells.
#[test]
fn kalico_uses_a_serial_port_and_an_spi_bus_as_pins() {
    let Some(checkout) = checkout(DialectName::Kalico) else { return };
    let describe = |board: String| on_spi(on_a_port(board));
    let mut printer = Printer::start_on(&checkout, describe, |config| {
        let config = without(&without(&config, "angle y"), "load_cell ads1220");
        assert_eq!(config.matches("\nuart_pin: ttyAMA1\n").count(), 2, "{config}");
        assert!(config.contains("\ndout_pin: spidev4.0/miso\nsclk_pin: spidev4.0\n"), "{config}");
        config
    });
    for (stepper, address) in [("stepper_y", 3), ("stepper_x", 1)] {
        assert_eq!(dump(&mut printer, stepper)["IOIN"] >> 2 & 3, address);
    }
    let said = printer.gcode("LOAD_CELL_DIAGNOSTIC");
    let rate: f64 = rest(&said, "Measured samples per second: ").split(',').next().unwrap().parse().unwrap();
    assert!((79.0..81.0).contains(&rate), "{said}");
    printer.gcode("G28 X Y\nG1 X50 Y40 F6000\nM400");
    assert!(!printer.log().contains("TMC UART ttyAMA1") && !printer.log().contains("HX71x sclk"), "{}", printer.log());
}

/// Moves with parts of ticks and a changing acceleration (`queue_step_hp`): curves, retractions and pressure advance.
#[test]
fn kalico_prints_with_steps_of_high_precision() {
    let Some(checkout) = folder_of("KALICO_BLEEDING_EDGE") else { return };
    let mut printer = Printer::start_on(
        &checkout,
        |board| board,
        |config| {
            let config = without(&config, "angle y");
            // Kalico names its load cells in another way.
            let config = without(&without(&config, "load_cell ads1220"), "load_cell");
            let config = config.replace("min_extrude_temp: 170", "min_extrude_temp: 0\npressure_advance: 0.05");
            let precise = config.replace("\nstep_pin:", "\nhigh_precision_step_compress: True\nstep_pin:");
            assert_eq!(precise.matches("high_precision").count(), 4, "{precise}");
            precise + "\n[gcode_arcs]\nresolution: 0.1\n"
        },
    );
    printer.gcode("G28\nM83\nG1 X60 Y50 Z5 F6000");
    for radius in [5, 12, 20] {
        printer.gcode(&format!(
            "G1 X{0} F9000\nG2 X{0} Y50 I{radius} J0 E1.5 F6000\nG3 X{0} Y50 I-{radius} J0 E1.5 F3000\nG1 E-0.8 F2400\nG1 E0.8",
            60 + radius
        ));
    }
    printer.gcode("G1 X30 Y70 Z8 F9000\nM400");
    let position = printer.object("toolhead")["position"].clone();
    assert_eq!((position[0].as_f64(), position[1].as_f64(), position[2].as_f64()), (Some(30.0), Some(70.0), Some(8.0)));
    printer.gcode("G28\nM400");
    assert_eq!(printer.state(), "ready");
}

/// Steppers, heaters and fan, hardware PWM, ADCs, thermocouple (SPI), DS18B20, drivers (SPI and UART), display (I2C),
/// lights (MOSI and software SPI), buttons.
#[track_caller]
pub fn use_everything(printer: &mut Printer) {
    printer.gcode("G28\nG1 X50 Y40 Z10 F6000\nM400");
    let toolhead = printer.object("toolhead");
    assert_eq!(toolhead["homed_axes"], "xyz");
    assert_eq!(toolhead["position"][1], 40.0);
    printer.gcode("M140 S40\nM106 S128\nSET_PIN PIN=laser VALUE=0.4\nSET_SERVO SERVO=arm ANGLE=60");
    printer.gcode("SET_LED LED=strip RED=1\nSET_LED LED=dots BLUE=1\nM117 Hello");
    printer.gcode("DUMP_TMC STEPPER=stepper_z\nDUMP_TMC STEPPER=stepper_y");
    printer.gcode("M190 S40\nTURN_OFF_HEATERS");
    for (sensor, from, to) in [
        ("heater_bed", 38.0, 45.0),
        ("temperature_sensor bed_underside", 30.0, 60.0),
        ("temperature_sensor nozzle", 20.0, 30.0),
    ] {
        assert_celsius(printer, sensor, from, to);
    }
    assert_eq!(printer.object("gcode_button knob")["state"], "PRESSED");
    assert_eq!(printer.state(), "ready");
}

#[track_caller]
pub fn assert_celsius(printer: &mut Printer, sensor: &str, from: f64, to: f64) {
    let celsius = printer.object(sensor)["temperature"].as_f64().unwrap();
    assert!((from..to).contains(&celsius), "{sensor} is at {celsius} C");
}

/// The last one of an accelerometer's three values.
#[track_caller]
pub fn z_mm_per_s2(values: &str) -> f64 {
    values.trim().rsplit(", ").next().unwrap().parse().unwrap()
}

#[track_caller]
pub fn assert_is_gravity(z_mm_per_s2: f64) {
    assert!((z_mm_per_s2 - 9806.65).abs() < 500.0, "{z_mm_per_s2}");
}
