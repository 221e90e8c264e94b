// SPDX-License-Identifier: GPL-3.0-or-later
//! A follower feels a motion: every step of an axis, with its instant.

#![forbid(unsafe_code)]

use std::sync::Arc;

use super::physics::Axis;
use super::track::{KEPT, Recorded};
use pinion_firmware::time::Clock;

/// Reads the steps of an axis in order.
#[derive(Debug)]
pub(crate) struct Follower {
    axis: Arc<Axis>,
    next: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Motion {
    /// A step at this instant, to this position in mm.
    Step(Clock, f64),
    /// The track no longer holds the steps before. At this instant the axis stepped to this position, in mm.
    Lost(Clock, f64),
}

impl Motion {
    pub(crate) fn at(self) -> Clock {
        let (Motion::Step(at, _) | Motion::Lost(at, _)) = self;
        at
    }

    pub(crate) fn mm(self) -> f64 {
        let (Motion::Step(_, mm) | Motion::Lost(_, mm)) = self;
        mm
    }
}

impl Follower {
    /// Follows from the first step that the axis makes.
    pub(crate) fn new(axis: Arc<Axis>) -> Follower {
        Follower { axis, next: 0 }
    }

    /// Follows from the next step that the axis makes.
    pub(crate) fn from_here(axis: Arc<Axis>) -> Follower {
        Follower { next: axis.track().next(), axis }
    }

    /// The next motion, if it was not later than `until`.
    pub(crate) fn next(&mut self, until: Clock) -> Option<Motion> {
        let mut lost = false;
        loop {
            match self.axis.track().get(self.next) {
                Recorded::Step(at, position) if at <= until => {
                    self.next += 1;
                    let mm = self.axis.place_mm(position);
                    return Some(if lost { Motion::Lost(at, mm) } else { Motion::Step(at, mm) });
                }
                Recorded::Step(..) | Recorded::NotYet => return None,
                // Continue at half of the track, while the writer overwrites the other half.
                Recorded::Overwritten => {
                    self.next = self.axis.track().next().saturating_sub(KEPT as u64 / 2);
                    lost = true;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;

    #[test]
    fn who_falls_behind_goes_on_from_where_the_axis_is() {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[3]));
        axis.set_enabled(true);
        axis.set_forward(true);
        let mut follower = Follower::new(axis.clone());
        let steps = |from: u64, to: u64| {
            for step in from..=to {
                axis.edge(true, Clock::from_ticks(step));
                axis.edge(false, Clock::from_ticks(step));
            }
        };
        let at = Clock::from_ticks;
        steps(1, 10);
        // No step later than the given instant.
        for step in 1..=4 {
            assert_eq!(follower.next(at(4)), Some(Motion::Step(at(step), step as f64 / 100.0)));
        }
        assert_eq!(follower.next(at(4)), None);
        let end = 2 * KEPT as u64;
        steps(11, end);
        let from = end - KEPT as u64 / 2 + 1;
        assert_eq!(follower.next(at(end)), Some(Motion::Lost(at(from), from as f64 / 100.0)));
        for step in from + 1..=end {
            assert_eq!(follower.next(at(end)), Some(Motion::Step(at(step), step as f64 / 100.0)));
        }
        assert_eq!(follower.next(at(end)), None);
    }
}
