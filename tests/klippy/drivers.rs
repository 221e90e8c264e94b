// SPDX-License-Identifier: GPL-3.0-or-later
//! Trinamic's drivers on their UART and on SPI: registers, currents, homing by the load.

use std::collections::HashMap;
use std::f64::consts::TAU;

use crate::checkout;
use crate::klippy::without;
use crate::printer::Printer;

/// The registers of a driver by name, from klippy's dump.
pub fn dump(printer: &mut Printer, stepper: &str) -> HashMap<String, u32> {
    let said = printer.gcode(&format!("DUMP_TMC STEPPER={stepper}"));
    let registers = said.lines().filter_map(|line| {
        let (name, value) = line.trim_start_matches("// ").split_once(':')?;
        let value = u32::from_str_radix(value.split_whitespace().next()?, 16).ok()?;
        Some((name.to_owned(), value))
    });
    registers.collect()
}

/// The steps of a stepper, by klippy's own count.
fn steps(printer: &mut Printer, stepper: &str) -> i64 {
    let said = printer.gcode("GET_POSITION");
    let (_, counts) = said.split_once("mcu: ").unwrap();
    let mut words = counts.lines().next().unwrap().split([':', ' ']);
    words.find(|word| *word == stepper).unwrap();
    words.next().unwrap().parse().unwrap()
}

/// The registers that klippy reads from a configured TMC2209 at standstill, with the default values of
/// klippy/extras/tmc2209.py.
const TMC2209: [(&str, u32); 12] = [
    // PDN_DISABLE, MSTEP_REG_SELECT, MULTISTEP_FILT, and SpreadCycle.
    ("GCONF", 0x0000_01c4),
    ("OTP_READ", 0x0000_000f),
    ("FACTORY_CONF", 0x0000_000f),
    ("TSTEP", 0x000f_ffff),
    // 16 microsteps, both edges, interpolation.
    ("CHOPCONF", 0x3403_0053),
    ("DRV_STATUS", 0x8019_0000),
    ("MSCNT", 0),
    ("MSCURACT", 0x00f7_0000),
    ("PWMCONF", 0xc80d_0e24),
    ("PWM_SCALE", 0),
    ("PWM_AUTO", 0x000e_0024),
    ("SG_RESULT", 0),
];

#[test]
fn klippy_sets_up_a_driver_on_a_uart_of_one_wire_or_two() {
    let Some(checkout) = checkout("klippy_sets_up_a_driver_on_a_uart_of_one_wire_or_two") else { return };
    for two in [false, true] {
        let second = |board: String| match two {
            true => board.replace("uart_pin = \"y_uart\"", "uart_pin = \"y_uart\"\ntx_pin = \"y_tx\"\naddress = 3"),
            false => board,
        };
        let mut printer = Printer::start_on(&checkout, second, |config| config);
        let dumped = dump(&mut printer, "stepper_y");
        for (name, value) in TMC2209 {
            assert_eq!(dumped[name], value, "{name}: {:08x}", dumped[name]);
        }
        // The power stage is off. MS1 and MS2 are the address.
        assert_eq!(dumped["IOIN"] & 0xff00_005d, 0x2100_0041 | if two { 3 << 2 } else { 0 });
        assert_eq!(dumped["GSTAT"], 1, "it was switched on");
        assert_eq!(dumped["IHOLD_IRUN"], 0x0008_1919);
        let count = dumped["IFCNT"];

        printer.gcode("SET_TMC_CURRENT STEPPER=stepper_y CURRENT=0.4 HOLDCURRENT=0.2");
        let current = |printer: &mut Printer, key: &str| printer.object("tmc2209 stepper_y")[key].as_f64().unwrap();
        assert!((current(&mut printer, "run_current") - 0.4).abs() < 0.02);
        let dumped = dump(&mut printer, "stepper_y");
        assert_eq!(dumped["IHOLD_IRUN"] & 0x1f1f, 0x0c06);
        assert_eq!(dumped["DRV_STATUS"] >> 16 & 0x1f, 0x06, "the chip holds by it");
        assert_eq!(dumped["IFCNT"], (count + 1) & 0xff);
        printer.gcode("INIT_TMC STEPPER=stepper_y");

        // At the first enable klippy reports the reset, and clears it.
        printer.gcode("G28 Y\nG1 Y50 F6000\nM400");
        let log = printer.host_log();
        assert!(log.contains("TMC 'stepper_y' reports GSTAT:      00000001 reset=1(Reset)"), "{log}");
        assert!(!log.contains("phase change") && !log.contains("Unable to"), "{log}");
        let dumped = dump(&mut printer, "stepper_y");
        assert_eq!(dumped["GSTAT"], 0);
        // 16 microsteps per full step. klippy knows the position of the driver's wave from its own count.
        let status = printer.object("tmc2209 stepper_y");
        let offset = status["mcu_phase_offset"].as_i64().unwrap();
        let position = steps(&mut printer, "stepper_y");
        let mscnt = i64::from(dumped["MSCNT"]);
        let phase = if status["mcu_phase_offset"].is_null() { -1 } else { (position + offset).rem_euclid(64) };
        let phases = [mscnt, 1023 - mscnt].map(|count| (count as f64 / 16.0).round() as i64 % 64);
        assert!(phases.contains(&phase), "{phase} {phases:?}");
    }
}

/// The x axis gets a driver, too, with another address at the same port.
pub fn on_a_port(board: String) -> String {
    let board = board.replace("uart_pin = \"y_uart\"", "uart_port = \"ttyAMA1\"\naddress = 3");
    board + "\n[[part]]\nkind = \"tmc2209\"\naxis = \"x\"\nuart_port = \"ttyAMA1\"\naddress = 1\n"
}

#[test]
fn klippy_sets_up_two_drivers_on_one_serial_port() {
    let Some(checkout) = checkout("klippy_sets_up_two_drivers_on_one_serial_port") else { return };
    let mut printer = Printer::start_on(&checkout, on_a_port, |config| {
        assert_eq!(config.matches("\nuart_pin: ttyAMA1\n").count(), 2, "{config}");
        // As in many configurations from elsewhere.
        config.replace("uart_pin: ttyAMA1", "uart_pin: ^ttyAMA1")
    });
    for (stepper, address) in [("stepper_y", 3), ("stepper_x", 1)] {
        let dumped = dump(&mut printer, stepper);
        for (name, value) in TMC2209 {
            assert_eq!(dumped[name], value, "{stepper} {name}: {:08x}", dumped[name]);
        }
        assert_eq!(dumped["IOIN"] >> 2 & 3, address);
        let count = dumped["IFCNT"];
        printer.gcode(&format!("SET_TMC_CURRENT STEPPER={stepper} CURRENT=0.4 HOLDCURRENT=0.2"));
        let dumped = dump(&mut printer, stepper);
        assert_eq!(dumped["IHOLD_IRUN"] & 0x1f1f, 0x0c06);
        assert_eq!(dumped["IFCNT"], (count + 1) & 0xff, "one message for one write");
    }
    // Hundreds of registers, while the steppers move. No message is repeated, so nothing waited for an answer.
    printer.gcode("G28 X Y\nG1 X100 Y100 F6000\nG1 X20 Y20");
    for _ in 0..10 {
        dump(&mut printer, "stepper_x");
        dump(&mut printer, "stepper_y");
    }
    let log = printer.log();
    assert!(!log.contains("TMC UART ttyAMA1"), "{log}");
    assert!(!printer.host_log().contains("Unable to"));
}

#[test]
fn klippy_tells_of_a_driver_that_is_not_on_the_serial_port() {
    let Some(checkout) = checkout("klippy_tells_of_a_driver_that_is_not_on_the_serial_port") else { return };
    let mut printer =
        Printer::start_on(&checkout, on_a_port, |config| config.replace("uart_address: 1", "uart_address: 2"));
    assert!(
        printer.host_log().contains("TMC stepper_x failed to init: Unable to read tmc uart 'stepper_x' register IFCNT")
    );
    dump(&mut printer, "stepper_y");
    let advice = "TMC UART ttyAMA1: no driver answers at address 2: check uart_address";
    assert_eq!(printer.log().matches(advice).count(), 1, "said once: {}", printer.log());
}

#[test]
fn klippy_tells_of_a_driver_that_is_not_there() {
    let Some(checkout) = checkout("klippy_tells_of_a_driver_that_is_not_there") else { return };
    let mut printer = Printer::start_with(&checkout, |config| config.replace("uart_address: 0", "uart_address: 1"));
    assert!(
        printer.host_log().contains("TMC stepper_y failed to init: Unable to read tmc uart 'stepper_y' register IFCNT")
    );
    let error = printer.refused("DUMP_TMC STEPPER=stepper_y");
    assert!(error.contains("Unable to read tmc uart 'stepper_y' register"), "{error}");
    // The other drivers still work.
    printer.gcode("G28 X");
    printer.stop("G28 Y");
}

/// Enables the sections that printer.cfg offers for homing by the load.
fn without_endstops(config: String) -> String {
    let mut offered = false;
    let mut changed = String::new();
    for line in config.lines() {
        let use_it = offered && line.starts_with('#') && !line.starts_with("# ");
        offered = line.starts_with("# To home without the endstop") || offered && (use_it || line.is_empty());
        changed += if use_it { &line[1..] } else { line };
        changed += "\n";
    }
    assert_eq!(changed.matches("\nendstop_pin: tmc").count(), 2, "{changed}");
    changed
}

#[test]
fn klippy_homes_by_the_load_at_the_end_of_an_axis() {
    let Some(checkout) = checkout("klippy_homes_by_the_load_at_the_end_of_an_axis") else { return };
    let mut printer = Printer::start_on(&checkout, |board| board, without_endstops);
    for _ in 0..2 {
        printer.gcode("G28");
        let position =
            |printer: &mut Printer, axis: usize| printer.object("toolhead")["position"][axis].as_f64().unwrap();
        // (axis, its number, mm of a step)
        for (axis, number, step_mm) in [("y", 1, 1.0 / 80.0), ("z", 2, 1.0 / 400.0)] {
            let stands_mm = printer.probe().axis(axis).unwrap().position_mm;
            assert_eq!(stands_mm, -2.0, "{axis} stands at its hard end");
            let thinks_mm = position(&mut printer, number);
            // It stalls a step or two after the lost steps that make the load: 4 steps (y) or 11 (z).
            let off = (thinks_mm - stands_mm) / step_mm;
            assert!((-1.0..=2.0).contains(&off), "{axis}: klippy is off by {off} steps");
        }
        printer.gcode("G1 Y100 Z20 F3000\nM400");
        for (axis, step_mm, wanted_mm) in [("y", 1.0 / 80.0, 100.0), ("z", 1.0 / 400.0, 20.0)] {
            let off = (printer.probe().axis(axis).unwrap().position_mm - wanted_mm) / step_mm;
            assert!((-20.0..=20.0).contains(&off), "{axis} is off by {off} steps");
        }
    }
    // The registers that homing changes have their former values.
    let dumped = dump(&mut printer, "stepper_y");
    assert_eq!((dumped["GCONF"], dumped["TCOOLTHRS"], dumped["SGTHRS"]), (0x1c4, 0, 100));
    let dumped = dump(&mut printer, "stepper_z");
    assert_eq!((dumped["GCONF"] & 0x100, dumped["TCOOLTHRS"]), (0, 0));
}

/// Puts another sensor on the built-in printer's shaft.
fn with_sensor(chip: &'static str) -> impl Fn(String) -> String {
    move |board| {
        let changed = board.replace("chip = \"tle5012b\"", &format!("chip = \"{chip}\""));
        assert!(changed.contains(&format!("chip = \"{chip}\"")), "the built-in printer has another angle sensor");
        changed
    }
}

/// Makes klippy calibrate the sensor against its stepper.
fn with_stepper(config: String) -> String {
    let changed = config.replace("#stepper: stepper_y", "stepper: stepper_y");
    assert_ne!(config, changed);
    changed
}

#[test]
fn klippy_calibrates_an_angle_sensor_on_a_motor_s_shaft() {
    let Some(checkout) = checkout("klippy_calibrates_an_angle_sensor_on_a_motor_s_shaft") else { return };
    let mut printer = Printer::start_on(&checkout, with_sensor("tle5012b"), with_stepper);
    let read = printer.gcode("ANGLE_DEBUG_READ CHIP=y REG=0x06");
    assert!(read.contains("ANGLE REG[0x06] = 0x4001"), "{read}");
    printer.gcode("G28 Y\nG1 Y110 F6000\nANGLE_CALIBRATE CHIP=y");
    let pending = printer.object("configfile")["save_config_pending_items"]["angle y"]["calibrate"].clone();
    let table = pending.as_str().unwrap().replace('\n', "");
    let angles: Vec<f64> = table.split(',').map(|angle| angle.trim().parse().unwrap()).collect();
    // One angle for each full step, with the error of the magnet: 0.6 degrees of 65536.
    assert_eq!(angles.len(), 200);
    let even = |n: usize| (angles[n] - angles[0] - n as f64 * 65536.0 / 200.0 + 32768.0).rem_euclid(65536.0) - 32768.0;
    let even: Vec<f64> = (0..200).map(even).collect();
    let spread = even.iter().copied().fold(f64::MIN, f64::max) - even.iter().copied().fold(f64::MAX, f64::min);
    assert!((200.0..240.0).contains(&spread), "{spread}");

    printer.configure(|config| config.replace("[angle y]", &format!("[angle y]\ncalibrate: {table}")));
    printer.restart("RESTART");
    printer.gcode("G28 Y\nG1 Y100 F6000\nM400");
    // Each batch has the angle, and klippy's position of the axis from it.
    let mut errors_mm = Vec::new();
    for place_mm in [100, 103, 107, 112, 120, 131, 150] {
        printer.gcode(&format!("G1 Y{place_mm}\nM400\nG4 P300"));
        let batch = printer.angles("y");
        let offset_mm = batch["position_offset"].as_f64().unwrap();
        let (_, angle) = batch["data"].as_array().unwrap().last().map(|sample| (&sample[0], &sample[1])).unwrap();
        // 40 mm are one turn, in either direction.
        let turn_mm = angle.as_f64().unwrap() * 40.0 / 65536.0;
        errors_mm.push(turn_mm + offset_mm - f64::from(place_mm));
    }
    // Without the calibration they would differ by 0.13 mm.
    let (least, most) = errors_mm.iter().fold((f64::MAX, f64::MIN), |(l, m), error| (l.min(*error), m.max(*error)));
    assert!(most - least < 0.005, "{errors_mm:?}");
}

#[test]
fn klippy_reads_each_kind_of_angle_sensor() {
    let Some(checkout) = checkout("klippy_reads_each_kind_of_angle_sensor") else { return };
    for chip in ["a1333", "as5047d", "mt6816", "mt6826s", "tle5012b"] {
        let mut printer = Printer::start_on(&checkout, with_sensor(chip), with_stepper);
        let batch = printer.angles("y");
        let measured = batch["data"].as_array().unwrap().last().unwrap()[1].as_f64().unwrap();
        // It is at 45 mm, with 40 mm per turn. The magnet's error repeats once per turn.
        let angle = 77.0 / 360.0 + 45.0 / 40.0 - 1.0;
        let expected = (angle + 0.6 / 360.0 * (TAU * angle).sin()) * 65536.0;
        assert!((measured - expected + 32768.0).rem_euclid(65536.0) - 32768.0 < 1.0, "{chip}: {measured} {expected}");
        assert!((expected - measured + 32768.0).rem_euclid(65536.0) - 32768.0 < 5.0, "{chip}: {measured} {expected}");
        match chip {
            "mt6816" => assert!(printer.gcode("ANGLE_DEBUG_READ CHIP=y").contains("No Mag: 0")),
            "mt6826s" => {
                let read = printer.gcode("ANGLE_DEBUG_READ CHIP=y REG=0x003");
                let (_, sums) = read.split_once("CRC: ").unwrap();
                let (one, other) = sums.lines().next().unwrap().split_once(" == ").unwrap();
                assert_eq!(one, other.trim());
            }
            _ => {}
        }
    }
}

#[test]
fn klippy_has_an_angle_sensor_calibrate_itself() {
    let Some(checkout) = checkout("klippy_has_an_angle_sensor_calibrate_itself") else { return };
    // 22 turns and more have no room on an axis with an end.
    let long = |board: String| {
        let (before, y) = board.split_once("name = \"y\"\n").unwrap();
        with_sensor("mt6826s")(format!("{before}name = \"y\"\n{}", y.replacen("220.0", "9000.0", 1)))
    };
    let mut printer = Printer::start_on(&checkout, long, with_stepper);
    printer.gcode("G28 Y");
    let said = printer.gcode("ANGLE_CHIP_CALIBRATE CHIP=y");
    assert!(said.contains("Calibration success"), "{said}");
    assert!(printer.gcode("ANGLE_DEBUG_READ CHIP=y REG=0x113").contains("Status: Calibration Successful"));
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
    let slow = |board: String| {
        let slow = board.replace("name = \"spidev1.0\"\n", "name = \"spidev1.0\"\ndelay_us = 4000\n");
        assert_ne!(slow, board, "the built-in printer's bus has another name");
        slow
    };
    let mut printer = Printer::start_on(&checkout, slow, |config| config);
    let sent = |printer: &Printer| -> Vec<u64> {
        let trace = printer.spi();
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
    let dumped = printer.host_log();
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
        printer.gcode("G28\nG1 Z7 F600\nM400\nG28 Z\nGET_POSITION");
        let log = printer.host_log();
        // The axis was at 12 mm, with 400 steps per mm.
        let (_, position) = log.split_once("\nmcu: stepper_x:").unwrap();
        let steps = position.lines().next().unwrap().rsplit_once(" stepper_z:").unwrap().1.parse::<i32>().unwrap();
        assert!((-4900..=-4790).contains(&steps), "{steps}");
        // klippy compares the driver's microstep counter with its own at each homing.
        assert_eq!(log.contains("TMC 'stepper_z' reports GSTAT: "), with_driver, "{log}");
        assert!(!log.contains("phase change"), "{log}");
    }
}
