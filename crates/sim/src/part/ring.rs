// SPDX-License-Identifier: GPL-3.0-or-later
//! A mass that rings on an axis, for parts that feel it.

#![forbid(unsafe_code)]

use std::f64::consts::TAU;
use std::sync::Arc;

use serde::Deserialize;

use crate::engine::follower::{Follower, Motion};
use crate::engine::physics::Axis;
use pinion_firmware::time::{CLOCK_FREQ, Clock};

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RingConfig {
    /// The axis.
    pub axis: String,
    /// Its resonance, without damping.
    pub hz: f64,
    /// At 0 it would ring forever, and at 1 not at all.
    pub damping_ratio: f64,
}

/// A mass on a spring. An axis moves the other end of the spring.
pub(crate) struct Ring {
    follower: Follower,
    /// Angular frequency in rad/s; the next field is the decay rate in 1/s.
    omega: f64,
    fade: f64,
    /// The time up to which the motion is solved.
    now: Clock,
    /// The axis's position, how far the mass is ahead of it, and the speed of the mass.
    axis_mm: f64,
    ahead_mm: f64,
    mm_per_s: f64,
}

impl Ring {
    pub(crate) fn new(axis: Arc<Axis>, config: &RingConfig, now: Clock) -> Ring {
        let omega = TAU * config.hz;
        Ring {
            axis_mm: axis.position_mm(),
            follower: Follower::new(axis),
            omega,
            fade: config.damping_ratio * omega,
            now,
            ahead_mm: 0.0,
            mm_per_s: 0.0,
        }
    }

    /// Continues to an instant, step by step, and returns the speed there.
    pub(crate) fn speed_at(&mut self, until: Clock) -> f64 {
        while let Some(motion) = self.follower.next(until) {
            let (Motion::Step(at, mm) | Motion::Lost(at, mm)) = motion;
            self.swing(at);
            self.ahead_mm -= mm - self.axis_mm;
            self.axis_mm = mm;
            if matches!(motion, Motion::Lost(..)) {
                // The motion between is unknown, so the mass starts from rest.
                (self.ahead_mm, self.mm_per_s) = (0.0, 0.0);
            }
        }
        self.swing(until);
        self.mm_per_s
    }

    /// The damped oscillation while the axis stands still. With the damped frequency `n` it is
    /// `y = e^-ft (y0 cos nt + (v0 + f y0)/n sin nt)`, `v = e^-ft (v0 cos nt - (w^2 y0 + f v0)/n sin nt)`.
    /// A step that comes out of order counts as happening now.
    fn swing(&mut self, until: Clock) {
        let ticks = until.since(self.now).max(0);
        self.now = self.now.max(until);
        let (omega, fade) = (self.omega, self.fade);
        let (y, v) = (self.ahead_mm, self.mm_per_s);
        let seconds = ticks as f64 / f64::from(CLOCK_FREQ);
        let damped = (omega * omega - fade * fade).sqrt();
        let (sin, cos) = (damped * seconds).sin_cos();
        let decay = (-fade * seconds).exp();
        self.ahead_mm = decay * (y * cos + (v + fade * y) / damped * sin);
        self.mm_per_s = decay * (v * cos - (omega * omega * y + fade * v) / damped * sin);
    }
}
