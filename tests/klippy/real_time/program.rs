// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion` with a klippy: it prints, stops, and is there again after either of them has ended.

use super::Printer;
use crate::checkout;

#[test]
fn klippy_homes_heats_and_moves() {
    let Some(checkout) = checkout("klippy_homes_heats_and_moves") else { return };
    let mut printer = Printer::start(&checkout);
    printer.until_logged(": it gets each message that it looks up (found in ");
    printer.gcode("G28");
    printer.gcode("G1 X50 Y40 Z10 F6000\nM400");
    let toolhead = printer.object("toolhead");
    assert_eq!(toolhead["homed_axes"], "xyz");
    assert_eq!(toolhead["position"][0], 50.0);
    // verify_heater watches both heaters. That they reach their targets is tested in one clock.
    printer.gcode("M140 S60\nM104 S180");
    printer.until_heating("heater_bed");
    printer.until_heating("extruder");
    printer.gcode(
        "G1 X100 F1200\nG1 X20 Y20\nM400\nM106 S128\nSET_LED LED=light RED=0.5 WHITE=0.5\nM400\nTURN_OFF_HEATERS",
    );
    assert_eq!(printer.state(), "ready");
}

#[test]
fn klippy_stops_in_an_emergency_and_restarts() {
    let Some(checkout) = checkout("klippy_stops_in_an_emergency_and_restarts") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("G28");
    printer.stop("M112");
    // klippy stops itself first, and then the MCU.
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
    // Nobody refreshes the heater any more.
    printer.until_logged("Missed scheduling of next digital out event");
    printer.start_host();
    // An MCU that is shut down needs its FIRMWARE_RESTART, like any MCU. klippy sends it by itself where it may.
    if printer.settled() != "ready" {
        printer.restart("FIRMWARE_RESTART");
    }
    printer.gcode("G28");
}

#[test]
fn klippy_tells_a_wrong_pin_and_goes_on_after_it_was_mended() {
    let Some(checkout) = checkout("klippy_tells_a_wrong_pin_and_goes_on_after_it_was_mended") else { return };
    let mut printer =
        Printer::start_with(&checkout, |config| config.replace("sensor_pin: bed_sensor", "sensor_pin: spidev0.0"));
    printer.until_logged("pin spidev0.0 of the simulated printer is");
    assert_ne!(printer.settled(), "ready");
    printer.configure(|config| config);
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28");
}

#[test]
fn a_new_klippy_process_finds_a_fresh_mcu_after_a_stop() {
    let Some(checkout) = checkout("a_new_klippy_process_finds_a_fresh_mcu_after_a_stop") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("M140 S60");
    printer.until_heating("heater_bed");
    printer.stop("M112");
    printer.kill_host();
    printer.start_host();
    printer.until_state("ready");
    printer.until_logged("the host's process is gone and another has come");
    assert_eq!(printer.object("heater_bed")["target"], 0.0, "nothing is on");
    // Within one process it is as in Klipper's C.
    printer.stop("M112");
    let _ = printer.try_gcode("RESTART");
    printer.until_state("error");
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("SET_PIN PIN=beeper VALUE=1");
}

#[test]
fn a_klippy_that_ended_in_its_configuration_leaves_nothing_to_the_next() {
    let Some(checkout) = checkout("a_klippy_that_ended_in_its_configuration_leaves_nothing_to_the_next") else {
        return;
    };
    let mut printer = Printer::start_on(
        &checkout,
        |board, _| board,
        // The MCU stops at a sensor that does not exist, amid the configuration.
        |config| {
            config + "\n[temperature_sensor gone]\nsensor_type: DS18B20\nserial_no: 28-000000000000\nsensor_mcu: mcu\n"
        },
    );
    printer.until_logged("shutdown: ");
    printer.kill_host();
    printer.configure(|config| config);
    printer.start_host();
    printer.until_state("ready");
    printer.gcode("SET_PIN PIN=beeper VALUE=1");
}
