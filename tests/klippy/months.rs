// SPDX-License-Identifier: GPL-3.0-or-later
//! Hosts of any month on the whole simulated printer, with checkouts in the folder `KLIPPER_MONTHS`; and a host that
//! comes back.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use super::hosts;
use super::klippy::without;
use super::printer::Printer;

/// The checkouts of other months; none if the variable is not set.
fn months() -> Vec<PathBuf> {
    let Some(folder) = std::env::var_os("KLIPPER_MONTHS") else {
        let skipped = "\nSKIPPED hosts by month: KLIPPER_MONTHS is not set; set it to a folder of checkouts\n";
        let _ = std::io::stderr().write_all(skipped.as_bytes());
        return Vec::new();
    };
    let mut months: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    months.retain(|month| month.join("klippy/klippy.py").exists());
    months.sort();
    assert!(!months.is_empty(), "there are no checkouts in KLIPPER_MONTHS");
    months
}

fn has_extra(checkout: &Path, name: &str) -> bool {
    let extras = checkout.join("klippy/extras");
    extras.join(format!("{name}.py")).exists() || extras.join(name).is_dir()
}

/// Adds sensors to the built-in printer: a thermometer on I2C, and an accelerometer on each kind of bus.
fn with_sensors(board: String) -> String {
    board
        + r#"
[[input]]
name = "knob"
pin = "knob"
level = true

[[part]]
kind = "i2c_sensor"
chip = "bme280"
name = "room"
bus = "i2c.1"
address = 118
heater = "heater_bed"

[[part]]
kind = "accelerometer"
chip = "lis2dw"
name = "by_spi"
bus = "spidev1.0"
select_pin = "lis2dw_cs"
z = { axis = "z", hz = 90.0, damping_ratio = 0.1 }

[[part]]
kind = "accelerometer"
chip = "lis2dw"
name = "by_i2c"
bus = "i2c.1"
address = 25
"#
}

/// The sections that this host knows.
fn with_sections(config: &str, checkout: &Path) -> String {
    let mut config = config.to_owned();
    // Kalico has its own code for load cells. This form of the ADS1220 is newer than its chip.
    if !has_extra(checkout, "trigger_analog") {
        config = without(&without(&config, "load_cell ads1220"), "load_cell");
    }
    let lis2dw = fs::read_to_string(checkout.join("klippy/extras/lis2dw.py")).unwrap_or_default();
    if !lis2dw.contains("i2c") {
        config = without(&config, "lis2dw by_i2c");
    }
    let sections: Vec<String> =
        config.lines().filter_map(|line| Some(line.strip_prefix('[')?.strip_suffix(']')?.to_owned())).collect();
    for section in sections {
        let module = section.split(' ').next().unwrap();
        let is_klippy_s = ["mcu", "printer", "extruder"].contains(&module) || module.starts_with("stepper_");
        if !is_klippy_s && !has_extra(checkout, module) {
            config = without(&config, &section);
        }
    }
    config += "\n[gcode_button knob]\npin: knob\npress_gcode:\n";
    config
}

#[test]
fn hosts_of_any_month_use_the_whole_printer() {
    let mut failed = Vec::new();
    for month in months() {
        eprintln!("{}", month.display());
        let tried = std::panic::catch_unwind(|| use_everything(&month));
        if tried.is_err() {
            failed.push(month);
        }
    }
    assert!(failed.is_empty(), "{failed:?}");
}

/// Also BME280 (I2C), accelerometers (SPI and I2C), angle sensor, load cells.
fn use_everything(checkout: &Path) {
    let mut printer = Printer::start_on(checkout, with_sensors, |config| with_sections(&config, checkout));
    hosts::use_everything(&mut printer);
    hosts::assert_celsius(&mut printer, "temperature_sensor room", 20.0, 60.0);
    let config = fs::read_to_string(printer.path("printer.cfg")).unwrap();
    let felt_mm_per_s2 = |printer: &mut Printer, query: &str| {
        let answer = printer.gcode(query);
        // Before v0.11 the sentence begins with the chip.
        let (_, values) = answer.split_once(" values (x, y, z): ").unwrap();
        hosts::z_mm_per_s2(values)
    };
    if config.contains("\n[adxl345]\n") {
        hosts::assert_is_gravity(felt_mm_per_s2(&mut printer, "ACCELEROMETER_QUERY"));
    }
    for chip in ["by_spi", "by_i2c"].iter().filter(|chip| config.contains(&format!("\n[lis2dw {chip}]\n"))) {
        let felt = felt_mm_per_s2(&mut printer, &format!("ACCELEROMETER_QUERY CHIP={chip}"));
        // Older hosts set a LIS2DW's range and read its samples with the scale of another.
        assert!(felt > 9000.0, "{chip}: {felt}");
    }
    if config.contains("\n[angle y]\n") {
        printer.gcode("ANGLE_CALIBRATE CHIP=y");
    }
    if config.contains("\n[load_cell]\n") {
        let said = printer.gcode("LOAD_CELL_DIAGNOSTIC LOAD_CELL=load_cell");
        assert!(said.contains("Measured samples per second: "), "{said}");
    }
    assert_eq!(printer.state(), "ready");
    printer.restart("FIRMWARE_RESTART");
    printer.restart("RESTART");
    printer.gcode("M105");
    assert!(!printer.log().lines().any(|line| line.starts_with("ERROR ")), "{}", printer.log());
}
