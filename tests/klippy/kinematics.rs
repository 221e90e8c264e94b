// SPDX-License-Identifier: GPL-3.0-or-later
//! Printers of several boards, and kinematics that the built-in printer does not have. klippy homes them and moves their
//! heads, and the motors have to be where klippy believes.

use std::path::Path;

use super::checkout;
use super::printer::Printer;

/// A motor of the description, with its pins.
fn axis(name: &str, keys: &str) -> String {
    format!("\n[[axis]]\nname = \"{name}\"\nstep_pin = \"{name}_step\"\ndir_pin = \"{name}_dir\"\n{keys}\n")
}

/// Its section of printer.cfg. 200 full steps and 16 microsteps in a turn.
fn stepper(section: &str, pins: &str, keys: &str) -> String {
    format!("\n[{section}]\nstep_pin: {pins}_step\ndir_pin: {pins}_dir\nmicrosteps: 16\n{keys}\n")
}

/// Starts klippy on this board with these sections behind those for the MCUs.
fn start(checkout: &Path, board: String, sections: String) -> Printer {
    let mcus = |printed: String| {
        let end = printed.find("\n[virtual_sdcard]").unwrap();
        let mcus = &printed[..end];
        format!("{mcus}\n[force_move]\nenable_force_move: True\n{sections}")
    };
    Printer::start_on(checkout, |_| board, mcus)
}

#[track_caller]
fn assert_at(printer: &Printer, expected_mm: [f64; 3], off_mm: f64) {
    let nozzle_mm = printer.probe().nozzle_mm();
    for i in 0..3 {
        assert!(
            (nozzle_mm[i] - expected_mm[i]).abs() < off_mm,
            "{nozzle_mm:?}, not {expected_mm:?}\n{}",
            printer.log()
        );
    }
    let lost: u64 = printer.probe().axes().map(|axis| axis.lost_steps).sum();
    assert_eq!(lost, 0, "lost steps");
}

/// 16 microsteps of 200 steps in 40 mm.
const STEPS: &str = "steps_per_mm = 80.0\n";

/// A rail along a direction of the head: its description and its section.
fn rail(name: &str, endstop: &str) -> [String; 2] {
    let keys = format!("{STEPS}travel_mm = 200.0\nstart_mm = 20.0\nendstop_pin = \"{endstop}\"");
    let limits = "rotation_distance: 40\nposition_endstop: 0\nposition_max: 200\nhoming_speed: 20";
    let section = format!("endstop_pin: {endstop}\n{limits}");
    [axis(name, &keys), stepper(&format!("stepper_{name}"), name, &section)]
}

const LIMITS: &str = "max_velocity: 200\nmax_accel: 3000\nmax_z_velocity: 20\nmax_z_accel: 500\n";

#[test]
fn an_endstop_of_the_toolhead_stops_the_motors_of_the_main_board() {
    let Some(checkout) = checkout("an_endstop_of_the_toolhead_stops_the_motors_of_the_main_board") else { return };
    let boards = "[[mcu]]\nname = \"mcu\"\nchip = \"stm32f103xe\"\n\
                  [[mcu]]\nname = \"toolhead\"\nchip = \"rp2040\"\ndrift_ppm = 30.0\n\
                  [kinematics]\nkind = \"corexy\"\n";
    let [x, y, z] = [("x", "toolhead:gpio3"), ("y", "PC1"), ("z", "PC2")].map(|(name, pin)| rail(name, pin));
    let sections = format!("[printer]\nkinematics: corexy\n{LIMITS}{}{}{}", x[1], y[1], z[1]);
    let mut printer = start(&checkout, format!("{boards}{}{}{}", x[0], y[0], z[0]), sections);
    printer.gcode("G28");
    printer.gcode("G1 X100 Y50 Z10 F6000\nM400");
    // klippy stops the motors some milliseconds after the endstop of another board, and calculates the difference from
    // the time. The two clocks agree within some 10 us.
    assert_at(&printer, [100.0, 50.0, 10.0], 0.1);
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28\nG1 X30 Y120 Z5 F6000\nM400");
    assert_at(&printer, [30.0, 120.0, 5.0], 0.1);
}

#[test]
fn klippy_homes_and_moves_a_delta_with_unequal_arms() {
    let Some(checkout) = checkout("klippy_homes_and_moves_a_delta_with_unequal_arms") else { return };
    let board = "[kinematics]\nkind = \"delta\"\nradius_mm = 100.0\narm_mm = 215.0\narms_mm = [215.0, 214.0, 216.0]\n\
                 bed_radius_mm = 90.0\n";
    let towers = [("a", 215.0f64, 210), ("b", 214.0, 330), ("c", 216.0, 90)].map(|(name, arm, angle)| {
        // The nozzle is 150 mm high at the endstops.
        let top_mm = 150.0 + (arm * arm - 100.0 * 100.0).sqrt();
        let start_mm = top_mm - 10.0;
        let keys = format!(
            "{STEPS}travel_mm = {top_mm}\nstart_mm = {start_mm}\nendstop_pin = \"{name}_end\"\nendstop_at = \"max\""
        );
        let section = format!(
            "rotation_distance: 40\nendstop_pin: {name}_end\nposition_endstop: 150\nhoming_speed: 20\n\
             arm_length: {arm}\nangle: {angle}"
        );
        [axis(name, &keys), stepper(&format!("stepper_{name}"), name, &section)]
    });
    let [boards, sections] = [0, 1].map(|n| towers.iter().map(|tower| tower[n].as_str()).collect::<String>());
    let printer_section =
        "[printer]\nkinematics: delta\nmax_velocity: 200\nmax_accel: 3000\ndelta_radius: 100\nprint_radius: 90\n";
    let mut printer = start(&checkout, format!("{board}{boards}"), format!("{printer_section}{sections}"));
    printer.gcode("G28");
    for place in [[0.0, 0.0, 100.0], [50.0, -30.0, 20.0], [-60.0, 40.0, 0.5]] {
        let [x, y, z] = place;
        printer.gcode(&format!("G1 X{x} Y{y} Z{z} F6000\nM400"));
        assert_at(&printer, place, 0.03);
    }
}

#[test]
fn klippy_homes_and_moves_a_polar_printer() {
    let Some(checkout) = checkout("klippy_homes_and_moves_a_polar_printer") else { return };
    // A turn of the bed is 80 turns of its motor.
    let steps_per_radian = 80.0 * 3200.0 / std::f64::consts::TAU;
    let bed = axis("bed", &format!("steps_per_mm = {steps_per_radian}"));
    let z = rail("z", "z_end");
    // The arm homes away from the center, where the bed has no angle.
    let keys = format!("{STEPS}travel_mm = 200.0\nstart_mm = 150.0\nendstop_pin = \"arm_end\"\nendstop_at = \"max\"");
    let section =
        "endstop_pin: arm_end\nrotation_distance: 40\nposition_endstop: 200\nposition_max: 200\nhoming_speed: 20";
    let arm = [axis("arm", &keys), stepper("stepper_arm", "arm", section)];
    let board = format!("[kinematics]\nkind = \"polar\"\n{bed}{}{}", arm[0], z[0]);
    let bed = stepper("stepper_bed", "bed", "gear_ratio: 80:1");
    let sections = format!("[printer]\nkinematics: polar\n{LIMITS}{bed}{}{}", arm[1], z[1]);
    let mut printer = start(&checkout, board, sections);
    printer.gcode("G28");
    for place in [[50.0, 0.0, 10.0], [40.0, 60.0, 10.0], [-30.0, 50.0, 5.0]] {
        let [x, y, z] = place;
        printer.gcode(&format!("G1 X{x} Y{y} Z{z} F3000\nM400"));
        assert_at(&printer, place, 0.05);
    }
}
