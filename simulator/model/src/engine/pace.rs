// SPDX-License-Identifier: GPL-3.0-or-later
//! How fast each motor was at most.

use std::sync::Arc;

use super::follower::{Follower, Motion};
use super::motion::Axis;
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks};

/// Speeds are means over this span. A shorter one would take the jitter of single steps for acceleration.
const WINDOW: Ticks = Ticks::from_ms(10);

/// The highest figures of a motor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pace {
    /// For example `x`.
    pub name: String,
    /// Steps in a second.
    pub steps_per_s: f64,
    /// Speed. A motor that turns an arm has radians in place of mm.
    pub mm_per_s: f64,
    /// Acceleration.
    pub mm_per_s2: f64,
}

/// Watches the motors. Somebody has to call [`PaceWatch::read`] as often as a recorder's.
pub struct PaceWatch(Vec<Watched>);

struct Watched {
    follower: Follower,
    step_mm: f64,
    most: Pace,
    /// The start of the window, the motor's place then, and its speed in the window before.
    from: Clock,
    from_steps: i64,
    speed: f64,
    steps: i64,
}

impl PaceWatch {
    pub(crate) fn new(axes: &[Arc<Axis>], now: Clock) -> PaceWatch {
        PaceWatch(
            axes.iter()
                .map(|axis| {
                    let steps = axis.position_steps();
                    Watched {
                        follower: Follower::from_here(axis.motor().clone()),
                        step_mm: axis.step_mm(),
                        most: Pace { name: axis.name.clone(), ..Pace::default() },
                        from: now,
                        from_steps: steps,
                        speed: 0.0,
                        steps,
                    }
                })
                .collect(),
        )
    }

    /// Takes in the steps until now.
    pub fn read(&mut self, now: Clock) {
        self.0.iter_mut().for_each(|watched| watched.read(now));
    }

    /// The highest figures of each motor so far.
    pub fn most(&self) -> impl Iterator<Item = &Pace> {
        self.0.iter().map(|watched| &watched.most)
    }
}

impl Watched {
    fn read(&mut self, now: Clock) {
        while let Some(motion) = self.follower.next(now) {
            let (Motion::Step(at, steps) | Motion::Lost(at, steps)) = motion;
            while at.since(self.from) > i64::from(WINDOW.0) {
                // After a rest the windows without steps are like one.
                let idle = (at.since(self.from) / i64::from(WINDOW.0) - 2).max(0);
                self.end_window();
                if idle > 0 && self.speed == 0.0 {
                    self.from = self.from.later(idle as u64 * u64::from(WINDOW.0));
                }
            }
            if let Motion::Lost(..) = motion {
                (self.from, self.from_steps, self.speed) = (at, steps, 0.0);
            }
            self.steps = steps;
        }
    }

    fn end_window(&mut self) {
        let window_s = f64::from(WINDOW.0) / f64::from(CLOCK_FREQ);
        let steps_per_s = (self.steps - self.from_steps) as f64 / window_s;
        let speed = steps_per_s * self.step_mm;
        let most = &mut self.most;
        most.steps_per_s = most.steps_per_s.max(steps_per_s.abs());
        most.mm_per_s = most.mm_per_s.max(speed.abs());
        most.mm_per_s2 = most.mm_per_s2.max((speed - self.speed).abs() / window_s);
        (self.from, self.from_steps, self.speed) = (self.from + WINDOW, self.steps, speed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;

    #[test]
    fn a_motor_that_accelerates_has_its_highest_speed_and_acceleration() {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
        axis.set_enabled(true);
        axis.set_forward(true);
        let begin = Clock::from_ticks(1_000_000);
        let mut watch = PaceWatch::new(std::slice::from_ref(&axis), begin);
        // 0.2 s with 500 mm/s^2, then 0.2 s at 100 mm/s.
        let mm_at = |s: f64| if s < 0.2 { 250.0 * s * s } else { 10.0 + (s - 0.2) * 100.0 };
        let mut made = 0;
        for us in 0..400_000_u64 {
            while mm_at(us as f64 * 1e-6) / axis.step_mm() >= f64::from(made) + 1.0 {
                let at = begin.later(us * 50);
                axis.edge(true, at);
                axis.edge(false, at);
                made += 1;
            }
            if us % 50_000 == 0 {
                watch.read(begin.later(us * 50));
            }
        }
        watch.read(begin.later(50_000_000));
        let most = watch.most().next().unwrap();
        let step_mm = axis.step_mm();
        assert!((most.mm_per_s - 100.0).abs() <= step_mm / 0.01 + 0.1, "{most:?}");
        assert!((most.steps_per_s * step_mm - most.mm_per_s).abs() < 1e-6, "{most:?}");
        // Two windows may each be off by a step.
        assert!((most.mm_per_s2 - 500.0).abs() <= 2.0 * step_mm / 1e-4, "{most:?}");
        assert_eq!(most.name, "x");
    }
}
