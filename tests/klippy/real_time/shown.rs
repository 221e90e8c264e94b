// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --show` while a klippy drives the printer.

use super::Printer;
use crate::checkout;

#[test]
fn a_fan_at_half_speed_is_told_where_it_ends_up_and_not_for_each_ripple() {
    let Some(checkout) = checkout("a_fan_at_half_speed_is_told_where_it_ends_up_and_not_for_each_ripple") else {
        return;
    };
    let mut printer = Printer::start_shown(&checkout);
    printer.until_state("ready");
    // klippy's PWM cycle is 10 ms. The fan needs 0.4 s to follow.
    printer.gcode("M106 S128\nG4 P8000");
    let rpm = |printer: &Printer| printer.shown("fan").trim_end_matches(" rpm").parse::<f64>().unwrap();
    let first = rpm(&printer);
    assert!((first - 4500.0 * 128.0 / 255.0).abs() < 45.0, "{first}");
    let lines = |printer: &Printer| printer.all_shown().matches("] fan: ").count();
    let before = lines(&printer);
    printer.gcode("G4 P8000");
    assert!(lines(&printer) - before <= 3, "{}", printer.all_shown());
    printer.gcode("M107\nG4 P8000");
    assert!(rpm(&printer) < 5.0, "{}", rpm(&printer));
}
