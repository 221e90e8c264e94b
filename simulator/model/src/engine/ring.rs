// SPDX-License-Identifier: GPL-3.0-or-later
//! A mass that rings on an axis, for parts that feel it, and for people who want to see it.

use std::f64::consts::TAU;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::follower::RailFollower;
use super::rail::Rail;
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    follower: RailFollower,
    /// Angular frequency in rad/s; the next field is the decay rate in 1/s.
    omega: f64,
    fade: f64,
    /// The time up to which the motion is solved.
    now: Clock,
    /// The axis's position, how far the mass is ahead of it, and the speed of the mass.
    axis_mm: f64,
    ahead_mm: f64,
    mm_per_s: f64,
    /// The instant of the last step.
    stepped: Clock,
}

impl Ring {
    /// Rings from the first step of the axis on.
    pub(crate) fn new(rail: Arc<Rail>, config: &RingConfig, now: Clock) -> Ring {
        Ring::of(RailFollower::new(rail.clone()), &rail, config, now)
    }

    /// Rings from the next step of the axis on.
    fn from_here(rail: Arc<Rail>, config: &RingConfig, now: Clock) -> Ring {
        Ring::of(RailFollower::from_here(rail.clone()), &rail, config, now)
    }

    fn of(follower: RailFollower, rail: &Rail, config: &RingConfig, now: Clock) -> Ring {
        let omega = TAU * config.hz;
        Ring {
            axis_mm: rail.position_mm(),
            follower,
            omega,
            fade: config.damping_ratio * omega,
            now,
            ahead_mm: 0.0,
            mm_per_s: 0.0,
            stepped: now,
        }
    }

    /// Continues to an instant, and returns the speed there.
    pub(crate) fn speed_at(&mut self, until: Clock) -> f64 {
        self.go(until);
        self.mm_per_s
    }

    /// Continues to an instant, step by step.
    fn go(&mut self, until: Clock) {
        while let Some((at, mm, lost)) = self.follower.next(until) {
            self.swing(at);
            self.ahead_mm -= mm - self.axis_mm;
            self.axis_mm = mm;
            self.stepped = at;
            if lost {
                // The motion between is unknown, so the mass starts from rest.
                (self.ahead_mm, self.mm_per_s) = (0.0, 0.0);
            }
        }
        self.swing(until);
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

/// How far the ringing head was off its axis, while the axis stood behind a move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ringing {
    /// At most.
    pub greatest_mm: f64,
    /// On average, in the tenth of a second behind a move.
    pub mean_mm: f64,
}

/// Watches how the head rings on an axis. An accelerometer's description says how.
pub struct RingWatch {
    axis: String,
    hz: f64,
    ring: Ring,
    at: Clock,
    greatest_mm: f64,
    sum_mm: f64,
    looks: u64,
}

impl RingWatch {
    /// Time between two samples. A head that rings with 200 Hz is sampled ten times in a period.
    const EACH: Ticks = Ticks::from_us(500);
    /// The axis stands if its last step was this long ago. It accelerates no longer, so the head only rings.
    const STANDS: Ticks = Ticks::from_ms(3);
    /// How long the ringing behind a move counts.
    const RINGS: Ticks = Ticks::from_ms(100);

    pub(crate) fn new(rail: Arc<Rail>, config: &RingConfig, now: Clock) -> RingWatch {
        let name = rail.name.clone();
        let ring = Ring::from_here(rail, config, now);
        RingWatch { axis: name, hz: config.hz, ring, at: now, greatest_mm: 0.0, sum_mm: 0.0, looks: 0 }
    }

    /// The axis, for example `x`.
    pub fn axis(&self) -> &str {
        &self.axis
    }

    /// Its resonance.
    pub fn hz(&self) -> f64 {
        self.hz
    }

    /// Continues to an instant. Call it every 0.1 s or so. A step may come late, so stay 0.1 s behind the present while
    /// the printer runs.
    pub fn read(&mut self, until: Clock) {
        while until.since(self.at) >= i64::from(RingWatch::EACH.0) {
            self.at = Clock::from_ticks(self.at.ticks() + u64::from(RingWatch::EACH.0));
            self.ring.go(self.at);
            let stands = i64::from(RingWatch::STANDS.0)..i64::from(RingWatch::RINGS.0);
            if !stands.contains(&self.at.since(self.ring.stepped)) || self.ring.ahead_mm == 0.0 {
                continue;
            }
            let off_mm = self.ring.ahead_mm.abs();
            self.greatest_mm = self.greatest_mm.max(off_mm);
            self.sum_mm += off_mm;
            self.looks += 1;
        }
    }

    /// Forgets what was seen so far.
    pub fn forget(&mut self) {
        (self.greatest_mm, self.sum_mm, self.looks) = (0.0, 0.0, 0);
    }

    /// The ringing so far; `None` if the axis has not moved.
    pub fn seen(&self) -> Option<Ringing> {
        let mean_mm = self.sum_mm / self.looks as f64;
        (self.greatest_mm > 0.0).then_some(Ringing { greatest_mm: self.greatest_mm, mean_mm })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;

    /// How far the head is off after a move of 11 mm that begins and ends at once, or with half of its speed for half a
    /// period (the ZV shaper of a head without damping).
    fn seen(shaped: bool) -> Ringing {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
        axis.set_enabled(true);
        axis.set_forward(true);
        let config = RingConfig { axis: "x".into(), hz: 50.0, damping_ratio: 0.01 };
        let mut watch = RingWatch::new(axis.rail().clone(), &config, Clock::EPOCH);
        let at = |seconds: f64| Clock::from_ticks((seconds * f64::from(CLOCK_FREQ)) as u64);
        let steps = 880;
        for n in 0..steps {
            let slow = f64::from(n) / 8000.0;
            let way = if shaped { f64::min(slow * 2.0, slow + 0.005) + (slow - 0.105).max(0.0) } else { slow };
            axis.edge(true, at(0.01 + way));
            axis.edge(false, at(0.01 + way));
            watch.read(at(0.01 + way));
        }
        watch.read(at(0.4));
        watch.seen().unwrap()
    }

    #[test]
    fn a_shaped_start_rings_less() {
        let (hard, shaped) = (seen(false), seen(true));
        // 100 mm/s at once: the amplitude is v / ω. The start's is still there, and adds to it after 5.5 periods.
        let amplitude = 100.0 / (TAU * 50.0);
        assert!((1.4..2.0).contains(&(hard.greatest_mm / amplitude)), "{hard:?}");
        assert!(
            shaped.greatest_mm < 0.2 * hard.greatest_mm && shaped.mean_mm < 0.2 * hard.mean_mm,
            "{hard:?} {shaped:?}"
        );
    }

    #[test]
    fn an_axis_that_stands_was_not_seen_ringing() {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
        let config = RingConfig { axis: "x".into(), hz: 50.0, damping_ratio: 0.01 };
        let mut watch = RingWatch::new(axis.rail().clone(), &config, Clock::EPOCH);
        watch.read(Clock::from_ticks(u64::from(CLOCK_FREQ)));
        assert_eq!(watch.seen(), None);
    }
}
