// SPDX-License-Identifier: GPL-3.0-or-later
//! The axes of a description, and how they move the head.

#![forbid(unsafe_code)]

use serde::Deserialize;

use super::{HeaterConfig, PinName, SimConfig};

/// The end of an axis at which its endstop sits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum End {
    /// At 0 mm.
    Min,
    /// At `travel_mm`.
    Max,
}

/// A stepper motor and what it moves.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisConfig {
    /// Such as `x`.
    pub name: String,
    /// The step pin. Each rising edge is a step.
    pub step_pin: PinName,
    /// The direction pin. While it is high, steps count up.
    pub dir_pin: PinName,
    /// The motor is held, and steps, only while this is high. Without this pin it always is.
    pub enable_pin: Option<PinName>,
    /// Whether the falling edge of the step pin is a step too.
    #[serde(default)]
    pub step_both_edges: bool,
    /// Steps in a millimetre.
    pub steps_per_mm: f64,
    /// Microsteps in a full step, for printer.cfg. The motor has 200 full steps in a turn.
    #[serde(default = "default_microsteps")]
    pub microsteps: u32,
    /// The axis goes from 0 to here. Without this it has no end.
    pub travel_mm: Option<f64>,
    /// How far beyond either end of its travel the axis goes before it hits something and loses steps.
    #[serde(default = "default_overtravel_mm")]
    pub overtravel_mm: f64,
    /// The position of the axis at first.
    #[serde(default)]
    pub start_mm: f64,
    /// The endstop's pin. It is high while the axis is at that end of its travel or beyond.
    pub endstop_pin: Option<PinName>,
    /// The end of the travel at which the endstop sits.
    #[serde(default = "default_end")]
    pub endstop_at: End,
    /// Speed of homing, for printer.cfg.
    #[serde(default = "default_homing_mm_per_s")]
    pub homing_mm_per_s: f64,
    /// Where on the bed a motor of the z axis holds the gantry, or the bed: x and y.
    pub at_mm: Option<[f64; 2]>,
}

fn default_microsteps() -> u32 {
    16
}

fn default_overtravel_mm() -> f64 {
    2.0
}

fn default_end() -> End {
    End::Min
}

fn default_homing_mm_per_s() -> f64 {
    5.0
}

/// A delta printer: three towers around the bed, whose carriages hold the nozzle by arms. The carriages
/// are the axes `a`, `b` and `c`, at 0 where the arms would lie flat on the bed.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeltaConfig {
    /// What the arms span, seen from above, while the nozzle is in the middle of the bed.
    pub radius_mm: f64,
    /// The length of the arms.
    pub arm_mm: f64,
    /// From the middle of the bed to its edge.
    pub bed_radius_mm: f64,
    /// The directions in which the towers a, b and c stand, counted from the x axis towards the y axis.
    #[serde(default = "default_angles_degrees")]
    pub angles_degrees: [f64; 3],
}

fn default_angles_degrees() -> [f64; 3] {
    [210.0, 330.0, 90.0]
}

/// How the axes move the head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Kinematics<'a> {
    /// `x`, `y` and `z` with endstops, each for itself.
    Cartesian,
    /// `a`, `b` and `c` together.
    Delta(&'a DeltaConfig),
    /// Each is a motor, and no more.
    None,
}

impl Kinematics<'_> {
    /// The axes of klippy's kinematics. Each may have more than one motor.
    pub(crate) fn rails(&self) -> &'static [&'static str] {
        match self {
            Kinematics::Cartesian => &["x", "y", "z"],
            Kinematics::Delta(_) => &DeltaConfig::TOWERS,
            Kinematics::None => &[],
        }
    }
}

impl DeltaConfig {
    /// The axes of the carriages.
    pub(crate) const TOWERS: [&'static str; 3] = ["a", "b", "c"];

    /// How high the carriages are while the nozzle is on the bed's middle.
    pub(crate) fn lowest_mm(&self) -> f64 {
        (self.arm_mm * self.arm_mm - self.radius_mm * self.radius_mm).max(0.0).sqrt()
    }

    /// Where the towers stand: x and y.
    pub(crate) fn towers_mm(&self) -> [[f64; 2]; 3] {
        self.angles_degrees.map(|degrees| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            [self.radius_mm * cosine, self.radius_mm * sine]
        })
    }
}

impl SimConfig {
    /// An axis by its name.
    pub(crate) fn axis(&self, name: &str) -> Option<&AxisConfig> {
        self.axes.iter().find(|axis| axis.name == name)
    }

    pub(crate) fn kinematics(&self) -> Kinematics<'_> {
        let can_home = |name| self.axis(name).is_some_and(|axis| axis.endstop_pin.is_some());
        match &self.delta {
            Some(delta) => Kinematics::Delta(delta),
            None if ["x", "y", "z"].into_iter().all(can_home) => Kinematics::Cartesian,
            None => Kinematics::None,
        }
    }

    /// The motors of a rail, such as `z`, `z1` and `z2`.
    pub(crate) fn motors(&self, rail: &str) -> impl Iterator<Item = &AxisConfig> {
        in_a_row(rail, |name| self.axis(name))
    }

    /// The heaters of the hot ends: `extruder`, `extruder1` and so on.
    pub(crate) fn hot_ends(&self) -> impl Iterator<Item = &HeaterConfig> {
        in_a_row("extruder", |name| self.heaters.iter().find(|heater| heater.name == name))
    }
}

/// What is called `first`, and the same with 1, 2 and so on behind it until one is missing, as klippy looks for it.
fn in_a_row<T>(first: &str, find: impl Fn(&str) -> Option<T>) -> impl Iterator<Item = T> {
    let name = move |n| if n == 0 { first.to_owned() } else { format!("{first}{n}") };
    (0..).map_while(move |n| find(&name(n)))
}
