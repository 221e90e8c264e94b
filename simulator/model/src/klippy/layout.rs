// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's sections in klippy, and the place of its bed for klippy.

use std::fmt::{self, Display};

use crate::description::heater::HeaterConfig;
use crate::description::printer::{Kinematics, Printer};

/// Full steps per turn of the usual stepper motor.
pub(crate) const FULL_STEPS: f64 = 200.0;

/// The second carriage of the x axis.
pub(crate) const DUAL_CARRIAGE: &str = "dual_carriage";

/// Maps the axes to klippy's sections.
pub(crate) struct Layout<'a> {
    pub(crate) printer: Printer<'a>,
    pub(crate) kinematics: Kinematics<'a>,
}

impl<'a> Layout<'a> {
    pub(crate) fn of(printer: Printer<'a>) -> Layout<'a> {
        Layout { kinematics: printer.kinematics(), printer }
    }

    /// Whether klippy moves a head over the bed.
    pub(crate) fn has_head(&self) -> bool {
        self.has_rails() || matches!(self.kinematics, Kinematics::Delta(_))
    }

    /// Whether klippy's sections for x, y and z are printed.
    pub(crate) fn has_rails(&self) -> bool {
        self.kinematics.has_gantry() && self.kinematics != Kinematics::Generic
    }

    /// Whether an axis has klippy's keys for a homed axis.
    pub(crate) fn is_homed(&self, axis: &str) -> bool {
        self.has_rails() && (self.kinematics.rails().contains(&axis) || self.is_dual_carriage(axis))
    }

    pub(crate) fn is_dual_carriage(&self, axis: &str) -> bool {
        let config = self.printer.axis(axis).filter(|_| axis == DUAL_CARRIAGE);
        self.kinematics == Kinematics::Cartesian && config.is_some_and(|axis| axis.endstop_pin.is_some())
    }

    /// Whether there is a hot end with this name. klippy has its heater and its stepper in one section.
    pub(crate) fn is_hot_end(&self, name: &str) -> bool {
        self.printer.hot_ends().any(|heater| heater.name == name)
    }

    /// The section of an axis's stepper.
    pub(crate) fn stepper(&self, axis: &str) -> String {
        let is_of = |rail: &&str| self.printer.motors(rail).any(|motor| motor.name == axis);
        if self.has_head() && self.kinematics.rails().iter().any(is_of) {
            format!("stepper_{axis}")
        } else if self.is_hot_end(axis) || self.is_dual_carriage(axis) {
            axis.to_owned()
        } else {
            format!("manual_stepper {axis}")
        }
    }

    /// The section of a heater. For a heater without a pin it is the section of a sensor.
    pub(crate) fn heater(&self, heater: &HeaterConfig) -> String {
        match heater.name.as_str() {
            "heater_bed" => "heater_bed".to_owned(),
            name if self.is_hot_end(name) => name.to_owned(),
            name if heater.pin.is_some() => format!("heater_generic {name}"),
            name => format!("temperature_sensor {name}"),
        }
    }

    /// A place on the bed: 0 is the start of x and y, 1 is the end.
    pub(crate) fn place_mm(&self, x: f64, y: f64) -> [f64; 2] {
        let travel_mm = |name| self.printer.axis(name).and_then(|axis| axis.travel_mm).unwrap_or(0.0);
        match self.kinematics {
            // The inscribed square of the circle.
            Kinematics::Delta(delta) => [x, y].map(|share| (2.0 * share - 1.0) * delta.bed_radius_mm / 2f64.sqrt()),
            _ => [x * travel_mm("x"), y * travel_mm("y")],
        }
    }

    /// The highest position of the nozzle.
    pub(crate) fn height_mm(&self) -> f64 {
        let travel_mm = |name| self.printer.axis(name).and_then(|axis| axis.travel_mm).unwrap_or(0.0);
        match self.kinematics {
            Kinematics::Delta(delta) => travel_mm("a") - delta.lowest_mm(),
            _ => travel_mm("z"),
        }
    }
}

/// The reach of a probe beside the nozzle: up to this share of the bed, and from the remaining share on.
pub(crate) const WITHIN_REACH: f64 = 0.8;
/// A height above the bed at which no probe touches it.
pub(crate) const CLEAR_MM: f64 = 5.0;

/// Rounds to a micrometer, without the rest of a binary fraction.
pub(crate) fn rounded(mm: f64) -> f64 {
    (mm * 1000.0).round() / 1000.0 + 0.0
}

/// A place on the bed, in klippy's format.
pub(crate) struct Place(pub(crate) [f64; 2]);

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x_mm, y_mm] = self.0.map(rounded);
        write!(f, "{x_mm}, {y_mm}")
    }
}
