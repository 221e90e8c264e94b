// SPDX-License-Identifier: GPL-3.0-or-later
//! A motor's shaft with a magnet, and the parity in several sensors' frames.

use std::f64::consts::TAU;
use std::sync::Arc;

use crate::engine::motion::Axis;

/// The shaft that a sensor measures.
pub(super) struct Shaft {
    pub(super) axis: Arc<Axis>,
    pub(super) steps_per_turn: f64,
    /// In turns.
    pub(super) offset: f64,
    pub(super) eccentricity: f64,
}

impl Shaft {
    /// The turns of the motor.
    pub(super) fn turns(&self) -> f64 {
        self.axis.position_steps() as f64 / self.steps_per_turn
    }

    /// The angle that the sensor measures, with this number of bits.
    pub(super) fn angle(&self, bits: u32) -> u16 {
        let angle = (self.turns() + self.offset).rem_euclid(1.0);
        let measured = angle + self.eccentricity * (TAU * angle).sin();
        let steps = f64::from(1u32 << bits);
        // A full turn wraps to zero.
        (measured.rem_euclid(1.0) * steps) as u16 & ((1u32 << bits) - 1) as u16
    }
}

/// The bit that makes the number of ones even.
pub(super) fn even_parity(word: u16) -> u16 {
    (word.count_ones() & 1) as u16
}
