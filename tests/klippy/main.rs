// SPDX-License-Identifier: GPL-3.0-or-later
//! A real klippy on the simulated printer: the program with a user's host.
//!
//! Needs a checkout of Klipper in `KLIPPER_DIR`. Also needs, in `KLIPPER_PYTHON` (python3 if unset), a Python with
//! klippy's requirements (scripts/klippy-requirements.txt there). Without the checkout every test here is skipped, and
//! says so.

mod add;
mod drivers;
mod filament;
mod hosts;
mod kinematics;
mod klippy;
mod leveling;
mod links;
mod mainsail;
mod months;
mod non_critical;
mod own_printer;
mod print;
mod printer_cfg;
mod probes;
mod regression;
mod rings;
mod sections;
mod seeds;
mod servo;
mod shown;
mod ssh;
mod toolpath;
mod tools;

use std::io::Write;
use std::path::PathBuf;

use klippy::{Printer, without};

/// The checkout, or a visible skip. It bypasses the test harness, which captures the output of tests.
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
    // The bed heats in the background, and the hot end to its target. verify_heater watches both.
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

/// The registers of a TMC5160 that DUMP_TMC reads (klippy/extras/tmc5160.py). The values are those that klippy does not
/// write, for a motor that has never moved. DRV_STATUS is standstill at klippy's holding current. IOIN is the version,
/// step and direction mode, and a power stage that is off.
const DUMPED: [(&str, u8, Option<u32>); 13] = [
    ("GCONF", 0x00, None),
    ("CHOPCONF", 0x6c, None),
    ("GSTAT", 0x01, Some(1)),
    ("DRV_STATUS", 0x6f, Some(0x801f_0000)),
    ("FACTORY_CONF", 0x08, Some(0x0f)),
    ("IOIN", 0x04, Some(0x3000_0050)),
    ("LOST_STEPS", 0x73, Some(0)),
    ("MSCNT", 0x6a, Some(0)),
    ("MSCURACT", 0x6b, Some(0x00f7_0000)),
    ("OTP_READ", 0x07, Some(0x0f)),
    ("PWM_SCALE", 0x71, Some(0)),
    ("PWM_AUTO", 0x72, Some(0x0000_001e)),
    ("TSTEP", 0x12, Some(0x000f_ffff)),
];

/// The last value that the host wrote to a register of the chip.
fn written(sent: &[u64], register: u8) -> Option<u32> {
    let is_it = |datagram: &&u64| (**datagram >> 32) as u8 == register | 0x80;
    sent.iter().rfind(is_it).map(|datagram| *datagram as u32)
}

#[test]
fn klippy_reads_the_registers_of_a_driver_on_a_slow_bus_each_once() {
    const DUMPS: usize = 100;
    let Some(checkout) = checkout("klippy_reads_the_registers_of_a_driver_on_a_slow_bus_each_once") else { return };
    let slow = |board: String, _: &std::path::Path| {
        let slow = board.replace("name = \"spidev1.0\"\n", "name = \"spidev1.0\"\ndelay_us = 4000\n");
        assert_ne!(slow, board, "the built-in printer's bus has another name");
        slow
    };
    let mut printer = Printer::start_sim(&checkout, &["--spi-trace", "trace"], slow, |config| config);
    printer.until_state("ready");
    let sent = |printer: &Printer| -> Vec<u64> {
        let trace = printer.trace();
        // Another chip is also on this bus.
        let driver = trace.lines().filter(|line| line.starts_with("bus=spidev1.0 chips=tmc5160 z "));
        let sent = driver.map(|line| line.split_once(" sent=").unwrap().1.split_once(' ').unwrap().0);
        sent.map(|sent| u64::from_str_radix(sent, 16).unwrap()).collect()
    };
    // klippy writes each register, with a datagram that reads the value back. Then it queries the motor's position.
    let before = sent(&printer);
    let (set_up, position) = before.split_at(before.len() - 2);
    assert_eq!(position, [0x6a << 32; 2]);
    assert!(set_up.len() > 20 && set_up.chunks(2).all(|pair| pair[0] >> 39 == 1 && pair[1] == 0), "{set_up:x?}");
    let mut registers: Vec<u64> = set_up.iter().step_by(2).map(|datagram| datagram >> 32).collect();
    registers.sort_unstable();
    registers.dedup();
    assert_eq!(2 * registers.len(), set_up.len(), "klippy wrote one twice: {set_up:x?}");

    for _ in 0..DUMPS {
        printer.gcode("DUMP_TMC STEPPER=stepper_z");
    }
    let dumped = printer.host_log("\nTSTEP:", DUMPS);
    let read = sent(&printer).split_off(before.len());
    let asked = DUMPED.iter().flat_map(|(_, register, _)| [u64::from(*register) << 32; 2]);
    let asked: Vec<u64> = asked.cycle().take(DUMPS * 2 * DUMPED.len()).collect();
    assert_eq!(read, asked);
    for (name, register, known) in DUMPED {
        let value = written(set_up, register).or(known).unwrap();
        let lines = dumped.lines().filter_map(|line| line.strip_prefix(&format!("{name}:")));
        let values: Vec<&str> = lines.map(|line| line.split_whitespace().next().unwrap()).collect();
        assert_eq!(values, vec![format!("{value:08x}"); DUMPS], "{name}");
    }
}

#[test]
fn klippy_homes_and_moves_an_axis_with_and_without_its_driver() {
    let Some(checkout) = checkout("klippy_homes_and_moves_an_axis_with_and_without_its_driver") else { return };
    for with_driver in [true, false] {
        let mut printer =
            Printer::start_with(
                &checkout,
                |config| {
                    if with_driver { config } else { without(&config, "tmc5160 stepper_z") }
                },
            );
        printer.until_state("ready");
        printer.gcode("G28\nG1 Z7 F600\nM400\nG28 Z\nGET_POSITION");
        let log = printer.host_log("\nmcu: stepper_x:", 1);
        // The axis was at 12 mm, with 400 steps per mm.
        let (_, position) = log.split_once("\nmcu: stepper_x:").unwrap();
        let steps = position.lines().next().unwrap().rsplit_once(" stepper_z:").unwrap().1.parse::<i32>().unwrap();
        assert!((-4900..=-4790).contains(&steps), "{steps}");
        // klippy compares the driver's microstep counter with its own at each homing.
        assert_eq!(log.contains("TMC 'stepper_z' reports GSTAT: "), with_driver, "{log}");
        assert!(!log.contains("phase change"), "{log}");
    }
}
