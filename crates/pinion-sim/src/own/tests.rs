// SPDX-License-Identifier: GPL-3.0-or-later
//! The meaning of each section of a printer.cfg.

use std::fs;

use pinion_printer_config::Config;
use toml::{Table, Value};

use super::{Pace, Translated, translate};

const PRINTER: &str = "\
[mcu]
serial: /dev/ttyUSB0
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
[stepper_x]
step_pin: PB9
dir_pin: !PC2
enable_pin: !PC3
microsteps: 16
rotation_distance: 40
endstop_pin: ^!PA5
position_endstop: -5
position_min: -5
position_max: 235
[stepper_y]
step_pin: EXP_Y
dir_pin: PB7
enable_pin: !PC3
microsteps: 16
rotation_distance: 40
gear_ratio: 3:1, 2:1
endstop_pin: tmc2209_stepper_y:virtual_endstop
position_endstop: 235
position_max: 235
[stepper_z]
step_pin: z:gpio1
dir_pin: z:gpio2
microsteps: 16
rotation_distance: 8
endstop_pin: probe:z_virtual_endstop
position_max: 250
[tmc2209 stepper_y]
uart_pin: PC11
uart_address: 1
diag_pin: ^PC12
driver_SGTHRS: 130
[mcu z]
canbus_uuid: 11aabb
[board_pins]
aliases: EXP_Y=PB8
[extruder]
step_pin: PB4
dir_pin: PB3
enable_pin: !PC4
microsteps: 16
rotation_distance: 33
heater_pin: PC8
sensor_type: EPCOS 100K B57560G104F
sensor_pin: PA0
control: pid
pid_Kp: 22
pid_Ki: 1
pid_Kd: 114
min_temp: 0
max_temp: 250
nozzle_diameter: 0.4
filament_diameter: 1.75
[probe]
pin: ^z:gpio9
z_offset: 1.5
[output_pin beeper]
pin: PA9
[beacon]
probe_pin: PD1
";

fn translated(text: &str) -> Result<Translated, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("printer.cfg");
    fs::write(&path, text).unwrap();
    let config = Config::read(&path).unwrap();
    let folder = format!("{}/", folder.path().display());
    translate(&config, Pace::Fast).map_err(|trouble| trouble.to_string().replace(&folder, ""))
}

fn tables<'a>(description: &'a Table, kind: &str) -> Vec<&'a Table> {
    description[kind].as_array().unwrap().iter().map(|table| table.as_table().unwrap()).collect()
}

fn named<'a>(description: &'a Table, kind: &str, key: &str, name: &str) -> &'a Table {
    tables(description, kind).into_iter().find(|table| table.get(key).and_then(Value::as_str) == Some(name)).unwrap()
}

#[test]
fn motors_have_their_pins_their_steps_and_their_endstops() {
    let Translated { description, mcus, .. } = translated(PRINTER).unwrap();
    assert_eq!(mcus, ["mcu", "z"]);
    let [x, y, z] = ["x", "y", "z"].map(|name| named(&description, "axis", "name", name));
    assert_eq!(x["dir_pin"].as_str(), Some("!PC2"));
    assert_eq!(x["endstop_pin"].as_str(), Some("!PA5"));
    assert_eq!((x["endstop_mm"].as_float(), x["endstop_at"].as_str()), (Some(-5.0), Some("min")));
    assert_eq!((x["min_mm"].as_float(), x["travel_mm"].as_float()), (Some(-5.0), Some(235.0)));
    assert_eq!(x["steps_per_mm"].as_float(), Some(80.0));
    assert_eq!(y["step_pin"].as_str(), Some("PB8"), "by its alias");
    assert_eq!(y["steps_per_mm"].as_float(), Some(480.0));
    assert_eq!((y["enable_pin"].as_str(), x["enable_pin"].as_str()), (Some("!PC3"), Some("!PC3")));
    // The motor stalls where klippy believes the end to be.
    assert!(y.get("endstop_pin").is_none());
    assert_eq!((y["travel_mm"].as_float(), y["overtravel_mm"].as_float()), (Some(235.0), Some(0.0)));
    assert_eq!((z["step_pin"].as_str(), z.get("endstop_pin")), (Some("z:gpio1"), None));
}

#[test]
fn everything_else_becomes_what_it_is_and_each_pin_exists() {
    let Translated { description, notes, .. } = translated(PRINTER).unwrap();
    let driver = named(&description, "part", "kind", "tmc2209");
    assert_eq!((driver["axis"].as_str(), driver["address"].as_integer()), (Some("y"), Some(1)));
    assert_eq!((driver["diag_pin"].as_str(), driver["sg_free"].as_integer()), (Some("PC12"), Some(360)));
    let probe = named(&description, "part", "kind", "probe");
    assert_eq!((probe["pin"].as_str(), probe["z_offset_mm"].as_float()), (Some("z:gpio9"), Some(1.5)));
    let hot = named(&description, "heater", "name", "extruder");
    assert_eq!(hot["points_celsius_ohm"].as_array().unwrap().len(), 3);
    let rate = hot["heater_watts"].as_float().unwrap() / hot["heat_capacity_j_per_k"].as_float().unwrap();
    assert!((4.0..5.0).contains(&rate), "{rate}: as fast as 114 for pid_Kd permits");
    let boards = tables(&description, "mcu");
    assert_eq!((boards[0]["chip"].as_str(), boards[1]["chip"].as_str()), (Some("stm32f103xe"), Some("rp2040")));
    assert_eq!(boards[0]["pins"].as_array().unwrap(), &["PD1".into()]);
    assert_eq!(notes.len(), 1);
    assert!(notes[0].to_string().ends_with(
        "printer.cfg:65: [beacon] is no section of Klipper or Kalico: klippy needs its module; its pins exist, and nothing is at them"
    ), "{}", notes[0]);
}

#[test]
fn a_mistake_is_said_with_its_line_in_klippys_words() {
    for (from, to, error) in [
        (
            "rotation_distance: 8\n",
            "",
            "printer.cfg:27: Option 'rotation_distance' in section 'stepper_z' must be specified: add it",
        ),
        (
            "position_endstop: -5",
            "position_endstop: 100",
            "printer.cfg:14: Unable to infer homing_positive_dir in section 'stepper_x': add homing_positive_dir",
        ),
        (
            "position_endstop: -5",
            "position_endstop: -6",
            "printer.cfg:14: position_endstop in section 'stepper_x' must be between position_min and position_max: correct one of them",
        ),
        (
            "dir_pin: PB7",
            "dir_pin: PB9",
            "printer.cfg:19: pin PB9 used multiple times in config: name a pin of its own",
        ),
        (
            "microsteps: 16\nrotation_distance: 40\nendstop",
            "microsteps: x\nrotation_distance: 40\nendstop",
            "printer.cfg:11: Unable to parse option 'microsteps' in section 'stepper_x': correct its value",
        ),
        (
            "[tmc2209 stepper_y]",
            "[tmc2209 stepper_q]",
            "printer.cfg:34: Could not find config section '[stepper_q]' required by TMC driver: add it, or remove the driver",
        ),
        (
            "kinematics: cartesian",
            "kinematics: cube",
            "printer.cfg:4: Error loading kinematics 'cube': name one of Klipper's kinematics",
        ),
    ] {
        let text = PRINTER.replacen(from, to, 1);
        assert_ne!(text, PRINTER);
        assert_eq!(translated(&text).unwrap_err(), error);
    }
}
