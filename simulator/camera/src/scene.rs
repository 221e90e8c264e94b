// SPDX-License-Identifier: GPL-3.0-or-later
//! The scene that a picture shows.

/// Red, green and blue.
pub type Rgb = [u8; 3];

/// The parts of a printer that never change.
#[derive(Clone, Debug, PartialEq)]
pub struct Printer {
    /// The bed.
    pub bed: Bed,
    /// The highest position of the nozzle.
    pub height_mm: f64,
    /// How the nozzle is held.
    pub gantry: Gantry,
}

/// The outline of the bed, in the coordinates of the nozzle. It lies at a height of 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bed {
    /// The lowest and the highest x, and the lowest and the highest y.
    Rectangle {
        /// Along x.
        x_mm: [f64; 2],
        /// Along y.
        y_mm: [f64; 2],
    },
    /// A disc around 0.
    Disc {
        /// From the middle to the edge.
        radius_mm: f64,
    },
}

/// How the nozzle is held.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gantry {
    /// A beam along x on two rails along y, each with a motor of its own.
    Cartesian,
    /// The same beam and rails, with two belts that move together.
    CoreXy,
    /// Three arms.
    Delta {
        /// The places of the arms' upper ends, x and y, as if their lower ends were all at the nozzle.
        towers_mm: [[f64; 2]; 3],
        /// The length of the arms.
        arm_mm: f64,
    },
}

/// A printer at one instant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// The time, from any instant.
    pub seconds: f64,
    /// Whether the MCU is shut down.
    pub is_shut_down: bool,
    /// The position of the nozzle: x, y and z.
    pub nozzle_mm: [f64; 3],
    /// The positions of the nozzles of other carriages, which do not print.
    pub parked_mm: Vec<[f64; 3]>,
    /// The motors.
    pub axes: Vec<Axis>,
    /// The heaters.
    pub heaters: Vec<Heater>,
    /// The fans.
    pub fans: Vec<Fan>,
    /// Lights, and other outputs that are on or off.
    pub lamps: Vec<Lamp>,
    /// Strips of lights.
    pub strips: Vec<Strip>,
    /// Displays.
    pub displays: Vec<Display>,
    /// Servos.
    pub servos: Vec<Servo>,
    /// Probes beside the nozzle.
    pub probes: Vec<Probe>,
    /// The filament laid since the last scene.
    pub laid: Vec<Laid>,
}

/// A motor with what it moves.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// For example `x`.
    pub name: String,
    /// Its position.
    pub position_mm: f64,
    /// Steps that it could not make, and should have made.
    pub lost_steps: u64,
}

/// A heater.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Heater {
    /// For example `heater_bed`.
    pub name: String,
    /// Its temperature.
    pub celsius: f64,
    /// The temperature that the host wants; `None` if that is unknown or none.
    pub target_celsius: Option<f64>,
    /// Whether it has power.
    pub on: bool,
}

/// A fan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fan {
    /// For example `fan`.
    pub name: String,
    /// Revolutions per minute.
    pub rpm: f64,
}

/// A light, or another output that is on or off.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lamp {
    /// For example `light`.
    pub name: String,
    /// 0 to 1.
    pub brightness: f64,
    /// Its color at full brightness.
    pub color: Rgb,
}

/// A strip of lights.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Strip {
    /// For example `strip`.
    pub name: String,
    /// Its lights, from the left.
    pub lights: Vec<Rgb>,
}

/// A display.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Display {
    /// For example `display`.
    pub name: String,
    /// Pixels in a row.
    pub width: usize,
    /// Whether each pixel is bright: rows from the top, each from the left.
    pub pixels: Vec<bool>,
}

/// A servo.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Servo {
    /// For example `arm`.
    pub name: String,
    /// Its angle.
    pub degrees: f64,
}

/// A probe beside the nozzle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Probe {
    /// For example `probe`.
    pub name: String,
    /// Its tip, from the nozzle: x, y and z.
    pub offset_mm: [f64; 3],
    /// Its push-pin; `None` without one.
    pub pin: Option<Pin>,
}

/// A push-pin of a probe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pin {
    /// It is up in its probe.
    In,
    /// It is down, and feels the bed.
    Out,
    /// It is stuck or blocked, and the probe blinks.
    Alarm,
}

/// A straight piece of filament that was laid.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Laid {
    /// Where it begins: x, y and z.
    pub from_mm: [f32; 3],
    /// Where it ends.
    pub to_mm: [f32; 3],
    /// The speed of the nozzle.
    pub mm_per_s: f32,
    /// Whether it is the first of a new print: what lies on the bed is taken off.
    pub begins: bool,
}
