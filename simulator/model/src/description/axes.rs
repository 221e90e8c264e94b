// SPDX-License-Identifier: GPL-3.0-or-later
//! The axes of a description, the bed, and the limits of the motion.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::pin::PinName;
use super::whole;

/// The end of an axis with its endstop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum End {
    /// At the lowest place.
    Min,
    /// At the highest place.
    Max,
}

/// A stepper motor and its axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisConfig {
    /// For example `x`.
    pub name: String,
    /// The step pin. Each rising edge is a step.
    pub step_pin: PinName,
    /// The direction pin. While it is high, steps count up.
    pub dir_pin: PinName,
    /// The motor is held, and steps, only while this pin is high. Without this pin it is always held.
    pub enable_pin: Option<PinName>,
    /// Whether the falling edge of the step pin is also a step.
    #[serde(default)]
    pub step_both_edges: bool,
    /// Steps per millimeter.
    pub steps_per_mm: f64,
    /// Microsteps per full step, for printer.cfg. The motor has 200 full steps per turn.
    #[serde(default = "whole::<16, _>")]
    pub microsteps: u32,
    /// The lowest place of the axis.
    #[serde(default)]
    pub min_mm: f64,
    /// The axis moves from `min_mm` to this position. Without this key it has no end.
    pub travel_mm: Option<f64>,
    /// How far beyond either end of its travel the axis moves before it hits something and loses steps.
    #[serde(default = "whole::<2, _>")]
    pub overtravel_mm: f64,
    /// The initial position of the axis.
    #[serde(default)]
    pub start_mm: f64,
    /// The endstop's pin. It is high while the axis is at that end of its travel or beyond.
    pub endstop_pin: Option<PinName>,
    /// The end of the travel with the endstop.
    #[serde(default = "default_end")]
    pub endstop_at: End,
    /// Where the endstop closes. Without this key it closes at that end.
    pub endstop_mm: Option<f64>,
    /// Speed of homing, for printer.cfg.
    #[serde(default = "whole::<5, _>")]
    pub homing_mm_per_s: f64,
    /// The place on the bed where a motor of the z axis holds the gantry, or the bed: x and y.
    pub at_mm: Option<[f64; 2]>,
    /// The carriages that the motor moves together, and which way: `{ x = 1.0, y = -1.0 }`. Without this key the axis has
    /// a rail of its own.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub carriages: BTreeMap<String, f64>,
}

/// A rail without a motor of its own. An axis says with `carriages` which of them it moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarriageConfig {
    /// `x`, `y`, `z`, or another name.
    pub name: String,
    /// The lowest place.
    #[serde(default)]
    pub min_mm: f64,
    /// The highest place.
    pub travel_mm: f64,
    /// How far beyond either end of its travel it moves before it hits something.
    #[serde(default = "whole::<2, _>")]
    pub overtravel_mm: f64,
    /// The initial place.
    #[serde(default)]
    pub start_mm: f64,
    /// The endstop's pin. It is high while the carriage is at that end of its travel or beyond.
    pub endstop_pin: Option<PinName>,
    /// The end of the travel with the endstop.
    #[serde(default = "default_end")]
    pub endstop_at: End,
    /// Where the endstop closes. Without this key it closes at that end.
    pub endstop_mm: Option<f64>,
}

fn default_end() -> End {
    End::Min
}

/// A delta printer: three towers around the bed. Their carriages hold the nozzle by arms. The carriages are the axes
/// `a`, `b` and `c`. A carriage is at 0 where the arms would lie flat on the bed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeltaConfig {
    /// Horizontal length of the arms while the nozzle is in the middle of the bed.
    pub radius_mm: f64,
    /// The length of the arms.
    pub arm_mm: f64,
    /// The length of each arm, if they differ.
    pub arms_mm: Option<[f64; 3]>,
    /// From the middle of the bed to its edge.
    pub bed_radius_mm: f64,
    /// The directions of the towers a, b and c, counted from the x axis toward the y axis.
    #[serde(default = "default_angles_degrees")]
    pub angles_degrees: [f64; 3],
}

fn default_angles_degrees() -> [f64; 3] {
    [210.0, 330.0, 90.0]
}

impl DeltaConfig {
    /// The axes of the carriages.
    pub(crate) const TOWERS: [&'static str; 3] = ["a", "b", "c"];

    /// The lengths of the arms.
    pub(crate) fn arms_mm(&self) -> [f64; 3] {
        self.arms_mm.unwrap_or([self.arm_mm; 3])
    }

    /// The height of the carriages while the nozzle is on the middle of the bed.
    pub(crate) fn lowest_mm(&self) -> f64 {
        (self.arm_mm * self.arm_mm - self.radius_mm * self.radius_mm).max(0.0).sqrt()
    }

    /// The positions of the towers: x and y.
    pub fn towers_mm(&self) -> [[f64; 2]; 3] {
        self.angles_degrees.map(|degrees| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            [self.radius_mm * cosine, self.radius_mm * sine]
        })
    }
}

/// The limits of the motion in printer.cfg. The simulated axes themselves follow at any speed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Highest speed of the head.
    pub velocity_mm_per_s: f64,
    /// Highest acceleration of the head.
    pub accel_mm_per_s2: f64,
    /// Highest speed of the z axis.
    pub z_velocity_mm_per_s: f64,
    /// Highest acceleration of the z axis.
    pub z_accel_mm_per_s2: f64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            velocity_mm_per_s: 300.0,
            accel_mm_per_s2: 3000.0,
            z_velocity_mm_per_s: 15.0,
            z_accel_mm_per_s2: 100.0,
        }
    }
}

/// The shape of the bed. Its middle is at 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BedConfig {
    /// How much higher the bed is at the end of the x axis than at its start.
    pub x_slope_mm: f64,
    /// How much higher the bed is at the end of the y axis than at its start.
    pub y_slope_mm: f64,
    /// How much lower the bed is at the corners than in the middle.
    pub bow_mm: f64,
    /// The corner of the bed in front, on the left: x and y. Without this key it is where the axes begin.
    pub min_mm: Option<[f64; 2]>,
    /// The corner behind, on the right. Without this key it is where the axes end.
    pub max_mm: Option<[f64; 2]>,
}
