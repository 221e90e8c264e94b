// SPDX-License-Identifier: GPL-3.0-or-later
//! Parts that move independent of the head: a servo, and a stepper of its own.

use std::time::Duration;

use super::checkout;
use super::printer::Printer;
use pinion_model::Look;

/// The servo's angle, after it has stopped turning.
fn servo_degrees(printer: &mut Printer) -> f64 {
    printer.sleep(Duration::from_secs(1));
    let Look::Angle { degrees } = printer.sight("servo arm") else { panic!("it has another look") };
    degrees
}

#[test]
fn a_servo_turns_to_its_angle() {
    let Some(checkout) = checkout("a_servo_turns_to_its_angle") else { return };
    let mut printer = Printer::start_on(&checkout, |board| board, |config| config);
    assert_eq!(servo_degrees(&mut printer), 0.0);
    for (command, degrees) in [
        ("ANGLE=30", 30.0),
        ("ANGLE=120", 120.0),
        ("WIDTH=0.0015", 90.0),
        ("WIDTH=0.002", 180.0),
        // Without a pulse it stays.
        ("WIDTH=0", 180.0),
        ("ANGLE=0", 0.0),
    ] {
        printer.gcode(&format!("SET_SERVO SERVO=arm {command}\nM400"));
        let found = servo_degrees(&mut printer);
        // A pulse of a millisecond is 50,000 ticks, so the angle is exact to the last digit.
        assert!((found - degrees).abs() < 0.11, "{command}: {found}");
    }
}

#[test]
fn a_manual_stepper_homes_and_moves() {
    let Some(checkout) = checkout("a_manual_stepper_homes_and_moves") else { return };
    let lift = "[[axis]]\nname = \"lift\"\nstep_pin = \"lift_step\"\ndir_pin = \"lift_dir\"\n\
                enable_pin = \"!lift_enable\"\nsteps_per_mm = 50.0\ntravel_mm = 40.0\nstart_mm = 17.0\n\
                endstop_pin = \"lift_endstop\"\nhoming_mm_per_s = 8.0\n\n[[heater]]";
    let describe = |board: String| board.replacen("[[heater]]", lift, 1);
    let mut printer = Printer::start_on(&checkout, describe, |config| config);
    let position = |printer: &Printer| printer.probe().axis("lift").unwrap().position_mm;
    printer.gcode("MANUAL_STEPPER STEPPER=lift ENABLE=1 SET_POSITION=30 MOVE=33.5 SPEED=20 SYNC=1\nM400");
    assert_eq!(position(&printer), 20.5);
    // To its endstop. It stops a few steps after the endstop closed.
    printer.gcode("MANUAL_STEPPER STEPPER=lift MOVE=-10 STOP_ON_ENDSTOP=home\nM400");
    let stopped = position(&printer);
    assert!((-0.5..=0.0).contains(&stopped), "{stopped}");
    assert_eq!(printer.probe().axis("lift").unwrap().endstop, Some(true));
    // klippy counts from the place of the endstop.
    printer.gcode("MANUAL_STEPPER STEPPER=lift SET_POSITION=0 MOVE=25 SPEED=20\nM400");
    let moved = position(&printer) - stopped;
    assert_eq!((moved * 50.0).round(), 1250.0);
    printer.gcode("MANUAL_STEPPER STEPPER=lift ENABLE=0\nM400");
    let lift = printer.probe().axis("lift").unwrap();
    assert!(!lift.enabled && lift.lost_steps == 0);
}
