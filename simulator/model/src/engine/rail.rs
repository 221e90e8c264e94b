// SPDX-License-Identifier: GPL-3.0-or-later
//! Motors, and the rails that they move.
//!
//! A rail is what has an endstop and two ends: the carriage of an axis, the tower of a delta, an arm that turns. Most
//! motors move one rail. On CoreXY each of two motors moves two of them. A rail keeps no place of its own: its place
//! follows from its motors, so that motors of several boards may move it.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use super::track::Track;
use crate::description::axes::{AxisConfig, End};
use crate::description::rails::RailConfig;
use pinion_firmware::time::Clock;

/// Places are compared in these units: a picometer, or as small a part of a radian. Sums of fractions would miss the
/// place of an endstop by their rounding.
const PER_MM: f64 = 1e9;

/// The rotor of a motor, and its last steps.
#[derive(Debug)]
pub struct Motor {
    position: AtomicI64,
    track: Track,
}

impl Motor {
    /// The limits of the description keep the position below 2^63.
    pub fn at(start_mm: f64, config: &AxisConfig) -> Arc<Motor> {
        let position = AtomicI64::new((start_mm * config.steps_per_mm).round() as i64);
        Arc::new(Motor { position, track: Track::new() })
    }

    /// Its place in steps.
    pub fn steps(&self) -> i64 {
        self.position.load(Ordering::Relaxed)
    }

    /// Turns it by this many steps. Only the thread of its axis may call this.
    pub(super) fn turn(&self, steps: i64, at: Clock) {
        let position = self.steps().wrapping_add(steps);
        self.position.store(position, Ordering::Relaxed);
        self.track.push(at, position);
    }

    /// Its last steps with their instants.
    pub fn track(&self) -> &Track {
        &self.track
    }
}

/// A part that motors move between two ends.
#[derive(Debug)]
pub struct Rail {
    pub name: String,
    /// Its lowest and its highest place, in mm or radians; `None` for a rail without an end.
    pub travel_mm: Option<(f64, f64)>,
    /// Its motors, each with the way of the rail in one of its steps.
    motors: Vec<(Arc<Motor>, f64)>,
    /// The lowest and the highest place that it reaches without hitting something.
    hard_limits: Option<(i64, i64)>,
    /// The endstop's end, and the place where it closes.
    endstop: Option<(End, i64)>,
}

impl Rail {
    pub fn new(config: &RailConfig, motors: Vec<(Arc<Motor>, f64)>) -> Rail {
        let travel_mm = config.travel_mm;
        Rail {
            name: config.name.to_owned(),
            travel_mm,
            motors,
            hard_limits: travel_mm.map(|(min_mm, max_mm)| {
                let over_mm = config.overtravel_mm;
                (units(min_mm - over_mm), units(max_mm + over_mm))
            }),
            endstop: config.endstop.map(|(end, mm)| (end, units(mm))),
        }
    }

    /// Its motors, each with the way of the rail in one of its steps.
    pub(crate) fn motors(&self) -> &[(Arc<Motor>, f64)] {
        &self.motors
    }

    fn units(&self) -> i64 {
        self.units_at(Motor::steps)
    }

    fn units_at(&self, steps: impl Fn(&Motor) -> i64) -> i64 {
        units(self.motors.iter().map(|(motor, mm)| steps(motor) as f64 * mm).sum())
    }

    /// Its place while its motors are at these steps.
    pub fn mm_at(&self, steps: impl Fn(&Motor) -> i64) -> f64 {
        self.units_at(steps) as f64 / PER_MM
    }

    /// Its place.
    pub fn position_mm(&self) -> f64 {
        self.mm_at(Motor::steps)
    }

    /// The greatest way of a step.
    pub fn step_mm(&self) -> f64 {
        self.motors.iter().map(|(_, mm)| mm.abs()).fold(0.0, f64::max)
    }

    /// Whether the rail can move by this way. A rail beyond its end can come back.
    pub(super) fn moves_by(&self, mm: f64) -> bool {
        let to = self.units() + units(mm);
        self.hard_limits.is_none_or(|(min, max)| if mm < 0.0 { to >= min } else { to <= max })
    }

    /// Whether the endstop is closed; `None` without an endstop.
    pub fn endstop(&self) -> Option<bool> {
        let position = self.units();
        self.endstop.map(|(end, at)| match end {
            End::Min => position <= at,
            End::Max => position >= at,
        })
    }
}

/// The limits of the description keep it below 2^63.
fn units(mm: f64) -> i64 {
    (mm * PER_MM).round() as i64
}
