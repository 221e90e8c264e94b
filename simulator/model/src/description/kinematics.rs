// SPDX-License-Identifier: GPL-3.0-or-later
//! The kinematics of a description.

use serde::{Deserialize, Serialize};

use super::axes::DeltaConfig;
use super::whole;

/// How the motors move the head.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum KinematicsConfig {
    /// Each axis is only a motor.
    None(NoKeys),
    /// A motor for each of x, y and z.
    Cartesian(NoKeys),
    /// Two belts move the head along x and y.
    #[serde(rename = "corexy")]
    CoreXy(NoKeys),
    /// Two belts move the head along x and z.
    #[serde(rename = "corexz")]
    CoreXz(NoKeys),
    /// The belt of x runs along y too.
    #[serde(rename = "hybrid_corexy")]
    HybridCoreXy(NoKeys),
    /// The belt of x runs along z too.
    #[serde(rename = "hybrid_corexz")]
    HybridCoreXz(NoKeys),
    /// Each motor says which carriages it moves.
    GenericCartesian(NoKeys),
    /// Three towers with carriages.
    Delta(DeltaConfig),
    /// Two towers with carriages, and a bed that moves along y.
    Deltesian(DeltesianConfig),
    /// A bed that turns, and an arm along its radius.
    Polar(NoKeys),
    /// Three arms that turn.
    RotaryDelta(RotaryDeltaConfig),
    /// Cables that hold the head.
    Winch(WinchConfig),
}

/// A kinematics without keys.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoKeys {}

/// A deltesian printer: the carriages `left` and `right` on two towers hold the head by arms. `y` moves the bed. A
/// carriage is at 0 where its arm would lie flat with the nozzle in the middle of the bed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeltesianConfig {
    /// The lengths of the arms, left and right.
    pub arms_mm: [f64; 2],
    /// Horizontal lengths of the arms while the nozzle is in the middle.
    pub arm_x_mm: [f64; 2],
}

/// A rotary delta printer: the arms `a`, `b` and `c` turn at shoulders around the bed, and hold the head by a second arm.
/// Their places are angles in radians, 0 where the upper arm is level, and higher up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RotaryDeltaConfig {
    /// From the middle to the shoulders, less the radius of the head's joints.
    pub shoulder_radius_mm: f64,
    /// How high the shoulders are above the bed, less the height of the head's joints.
    pub shoulder_height_mm: f64,
    /// The lengths of the arms that turn.
    pub upper_arms_mm: [f64; 3],
    /// The lengths of the arms from there to the head.
    pub lower_arms_mm: [f64; 3],
    /// The directions of the shoulders, counted from the x axis toward the y axis.
    #[serde(default = "default_shoulders_degrees")]
    pub angles_degrees: [f64; 3],
    /// From the middle of the bed to its edge.
    pub bed_radius_mm: f64,
}

fn default_shoulders_degrees() -> [f64; 3] {
    [30.0, 150.0, 270.0]
}

/// A printer whose head hangs on cables. Their lengths are the axes `a`, `b`, `c` and so on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WinchConfig {
    /// The places where the cables begin. The first three determine the head's place.
    pub anchors_mm: Vec<[f64; 3]>,
    /// From the middle of the bed to its edge.
    #[serde(default = "whole::<200, _>")]
    pub bed_radius_mm: f64,
}

impl WinchConfig {
    /// The axes of the cables.
    pub(crate) const CABLES: [&'static str; 8] = ["a", "b", "c", "d", "e", "f", "g", "h"];
}
