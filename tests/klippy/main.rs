// SPDX-License-Identifier: GPL-3.0-or-later
//! A real klippy on the simulated printer: what a user's host does with the program.
//!
//! Needs a checkout of Klipper in `KLIPPER_DIR` and, in `KLIPPER_PYTHON` (python3 if unset), a
//! Python with klippy's requirements (scripts/klippy-requirements.txt there). Without the
//! former every test here is skipped, and says so.

mod klippy;

use std::io::Write;
use std::path::PathBuf;
use std::process::Command;

use klippy::{Printer, python};

/// The checkout, or a loud skip: written past the test harness, which keeps what a test prints.
fn checkout(test: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("KLIPPER_DIR").map(PathBuf::from);
    if folder.is_none() {
        let _ = writeln!(
            std::io::stderr(),
            "\nSKIPPED {test}: KLIPPER_DIR is not set; set it to a checkout of Klipper to test with a real klippy"
        );
    }
    folder
}

#[test]
fn klippy_homes_heats_and_moves() {
    let Some(checkout) = checkout("klippy_homes_heats_and_moves") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("G28");
    printer.gcode("G1 X50 Y40 Z10 F6000\nM400");
    let toolhead = printer.object("toolhead");
    assert_eq!(toolhead["homed_axes"], "xyz");
    assert_eq!(toolhead["position"][0], 50.0);
    // The bed in the background, the hot end to its target: verify_heater watches both.
    printer.gcode("M140 S45\nM109 S180");
    let extruder = printer.object("extruder")["temperature"].as_f64().unwrap();
    assert!((extruder - 180.0).abs() < 5.0, "{extruder}");
    printer.gcode("G92 E0\nG1 X100 E5 F1200\nG1 X20 Y20 E10\nM400\nM190 S45");
    let bed = printer.object("heater_bed")["temperature"].as_f64().unwrap();
    assert!((bed - 45.0).abs() < 3.0, "{bed}");
    printer.gcode("M106 S128\nSET_LED LED=light RED=0.5 WHITE=0.5\nM400\nTURN_OFF_HEATERS");
    assert_eq!(printer.state(), "ready");
}

#[test]
fn klippy_stops_in_an_emergency_and_restarts() {
    let Some(checkout) = checkout("klippy_stops_in_an_emergency_and_restarts") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("G28");
    printer.stop("M112");
    // klippy stops itself first, then asks the machine to.
    printer.until_logged("shutdown: Command request");
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28");
    printer.restart("RESTART");
    printer.gcode("G28\nG1 X30 F6000\nM400");
    assert_eq!(printer.object("toolhead")["position"][0], 30.0);
}

#[test]
fn a_klippy_that_is_killed_comes_back() {
    let Some(checkout) = checkout("a_klippy_that_is_killed_comes_back") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("M104 S200");
    printer.until_heating("extruder");
    printer.kill_host();
    // The heater is not refreshed any more.
    printer.until_logged("Missed scheduling of next digital out event");
    printer.start_host();
    // A machine that is shut down wants its FIRMWARE_RESTART, as any micro-controller; klippy
    // gives it by itself where it may.
    if printer.settled() != "ready" {
        printer.restart("FIRMWARE_RESTART");
    }
    printer.gcode("G28");
}

#[test]
fn klippy_tells_a_wrong_pin_and_goes_on_after_it_was_mended() {
    let Some(checkout) = checkout("klippy_tells_a_wrong_pin_and_goes_on_after_it_was_mended") else { return };
    let mut printer =
        Printer::start_with(&checkout, |config| config.replace("sensor_pin: bed_sensor", "sensor_pin: fan_tachometer"));
    printer.until_logged("fan_tachometer");
    assert_ne!(printer.settled(), "ready");
    printer.configure(|config| config);
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28");
}

#[test]
fn klippy_translates_g_code_with_our_dictionary() {
    let Some(checkout) = checkout("klippy_translates_g_code_with_our_dictionary") else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let pinion = |args: &[&str]| Command::new(env!("CARGO_BIN_EXE_pinion")).args(args).output().unwrap().stdout;
    std::fs::write(path("printer.cfg"), pinion(&["sim", "--print-config"])).unwrap();
    std::fs::write(path("dict"), pinion(&["dict", "--board", "sim"])).unwrap();
    std::fs::write(path("g.gcode"), "G28\nG1 X10 Y20 Z5 F3000\nG1 X100 Y100\nM106 S100\n").unwrap();
    let batch = Command::new(python())
        .arg(checkout.join("klippy/klippy.py"))
        .arg(path("printer.cfg"))
        .arg("-i")
        .arg(path("g.gcode"))
        .arg("-o")
        .arg(path("out"))
        .arg("-d")
        .arg(path("dict"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&batch.stderr);
    assert!(batch.status.success(), "{said}\n{}", String::from_utf8_lossy(&batch.stdout));
    let out = std::fs::metadata(path("out")).unwrap();
    assert!(out.len() > 1000, "only {} bytes", out.len());
}
