// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections of the documentation's examples.

use super::*;
use crate::config::tests::example;

/// The printer.cfg of an example.
fn printed(heading: &str) -> String {
    let config = SimConfig::parse(&example(heading), heading).unwrap_or_else(|error| panic!("{error}"));
    printer_cfg(&config, "/tmp/pty")
}

/// The keys of a section in use.
#[track_caller]
fn section<'a>(cfg: &'a str, name: &str) -> Vec<&'a str> {
    let Some((_, section)) = cfg.split_once(&format!("\n[{name}]\n")) else { panic!("no [{name}] in\n{cfg}") };
    let lines = section.split("\n\n").next().unwrap_or_default().lines();
    lines.filter(|line| !line.starts_with('#')).collect()
}

#[track_caller]
fn assert_has(cfg: &str, name: &str, keys: &[&str]) {
    let section = section(cfg, name);
    keys.iter().for_each(|key| assert!(section.contains(key), "no {key} in [{name}]:\n{section:#?}"));
}

#[test]
fn several_motors_of_the_z_axis_are_leveled() {
    let cfg = printed("Four Z motors");
    assert_has(&cfg, "stepper_z", &["endstop_pin: z_endstop", "position_endstop: 0", "position_min: -2"]);
    assert_eq!(
        section(&cfg, "stepper_z2"),
        ["step_pin: z2_step", "dir_pin: z2_dir", "enable_pin: !z2_enable", "microsteps: 16", "rotation_distance: 8"]
    );
    let level = section(&cfg, "quad_gantry_level");
    let corners = ["gantry_corners:", "  -30, -10", "  250, 230"];
    let points = ["points:", "  44, 44", "  44, 176", "  176, 176", "  176, 44"];
    assert_eq!(level[..8], [&corners[..], &points[..]].concat());
    // Three motors, and their drivers.
    let three = example("Four Z motors").split("\n[[axis]]\nname = \"z3\"").next().unwrap().to_owned();
    let driver = "\n[[part]]\nkind = \"tmc2209\"\naxis = \"z2\"\nuart_pin = \"z2_uart\"\naddress = 1\n";
    let cfg = printer_cfg(&SimConfig::parse(&(three + driver), "three").unwrap(), "/tmp/pty");
    assert_eq!(section(&cfg, "z_tilt")[..4], ["z_positions:", "  -30, -10", "  -30, 230", "  250, 230"]);
    assert!(!cfg.contains("quad_gantry_level"));
    section(&cfg, "tmc2209 stepper_z2");
}

#[test]
fn a_delta_has_its_towers() {
    let cfg = printed("A delta printer");
    assert_has(&cfg, "printer", &["kinematics: delta", "delta_radius: 105", "print_radius: 90"]);
    let endstop_mm = 420.0 - (215.0f64 * 215.0 - 105.0 * 105.0).sqrt();
    let endstop = format!("position_endstop: {endstop_mm:.6}");
    for (tower, angle) in [("a", "angle: 210"), ("b", "angle: 330"), ("c", "angle: 90")] {
        assert_has(&cfg, &format!("stepper_{tower}"), &[&endstop, "arm_length: 215", angle]);
    }
    assert_has(&cfg, "delta_calibrate", &["radius: 72"]);
    assert_has(&cfg, "bed_mesh", &["mesh_radius: 72", "round_probe_count: 5"]);
    section(&cfg, "probe");
}

#[test]
fn a_second_extruder_and_a_second_carriage_have_sections_of_their_own() {
    let cfg = printed("A second extruder");
    assert_has(&cfg, "extruder1", &["step_pin: e1_step", "heater_pin: hotend1_heater", "nozzle_diameter: 0.4"]);
    assert_has(&cfg, "dual_carriage", &["axis: x", "endstop_pin: u_endstop", "position_endstop: 220"]);
    // Without its heater it is not a hot end's axis, and without its endstop it is not a carriage.
    let text = example("A second extruder").replace("name = \"extruder1\"\npin", "name = \"oven\"\npin");
    let text = text.replace("endstop_pin = \"u_endstop\"\n", "");
    let cfg = printer_cfg(&SimConfig::parse(&text, "other").unwrap(), "/tmp/pty");
    section(&cfg, "manual_stepper extruder1");
    section(&cfg, "heater_generic oven");
    section(&cfg, "manual_stepper dual_carriage");
}

#[test]
fn a_fan_goes_with_what_it_cools() {
    let cfg = printed("A chamber with a fan");
    assert_has(&cfg, "temperature_fan exhaust", &["sensor_pin: chamber_sensor", "control: watermark", "max_temp: 90"]);
    assert_has(&cfg, "heater_fan heat_sink", &["heater: extruder", "pin: heat_sink_fan"]);
    assert!(!cfg.contains("[temperature_sensor chamber]"));
    let text = example("A chamber with a fan").replace("cools = \"chamber\"\ncooling_w_per_k = 4.0\n", "");
    let cfg = printer_cfg(&SimConfig::parse(&text, "other").unwrap(), "/tmp/pty");
    assert_has(&cfg, "temperature_sensor chamber", &["sensor_pin: chamber_sensor"]);
    section(&cfg, "fan_generic exhaust");
}

#[test]
fn a_light_has_its_colours() {
    let pins = ["red_pin: shelf_red", "green_pin: shelf_green", "blue_pin: shelf_blue", "white_pin: shelf_white"];
    assert_eq!(section(&printed("An RGBW strip"), "led shelf"), pins);
}

#[test]
fn a_corexy_printer_has_klippys_kinematics_and_the_sections_of_a_cartesian_one() {
    let cfg = printed("A CoreXY printer");
    assert_has(&cfg, "printer", &["kinematics: corexy", "max_z_velocity: 15"]);
    assert_has(&cfg, "stepper_y", &["rotation_distance: 40", "endstop_pin: y_endstop", "position_max: 220"]);
}
