// SPDX-License-Identifier: GPL-3.0-or-later
//! Followers read the steps of motors, each with its instant, in their order.

use std::sync::Arc;

use super::rail::{Motor, Rail};
use super::track::{KEPT, Recorded};
use pinion_firmware::time::Clock;

/// Reads the steps of a motor in order.
#[derive(Debug)]
pub(crate) struct Follower {
    motor: Arc<Motor>,
    /// The number of the next step.
    number: u64,
    /// The position after the last step that was read.
    steps: i64,
    /// A step that was read and not taken yet.
    pending: Option<Motion>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Motion {
    /// A step at this instant, to this position.
    Step(Clock, i64),
    /// The track no longer holds the steps before. At this instant the motor stepped to this position.
    Lost(Clock, i64),
}

impl Motion {
    pub(crate) fn at(self) -> Clock {
        let (Motion::Step(at, _) | Motion::Lost(at, _)) = self;
        at
    }

    fn steps(self) -> i64 {
        let (Motion::Step(_, steps) | Motion::Lost(_, steps)) = self;
        steps
    }

    fn is_lost(self) -> bool {
        matches!(self, Motion::Lost(..))
    }
}

impl Follower {
    /// Follows from the first step that the motor makes.
    fn new(motor: Arc<Motor>) -> Follower {
        Follower { steps: motor.steps(), motor, number: 0, pending: None }
    }

    /// Follows from the next step that the motor makes.
    pub(crate) fn from_here(motor: Arc<Motor>) -> Follower {
        Follower { number: motor.track().next(), steps: motor.steps(), motor, pending: None }
    }

    /// The next motion, if it was not later than `until`.
    fn look(&mut self, until: Clock) -> Option<Motion> {
        let mut lost = false;
        while self.pending.is_none() {
            match self.motor.track().get(self.number) {
                Recorded::Step(at, steps) => {
                    self.number += 1;
                    self.pending = Some(if lost { Motion::Lost(at, steps) } else { Motion::Step(at, steps) });
                }
                Recorded::NotYet => return None,
                // Continue at half of the track, while the writer overwrites the other half.
                Recorded::Overwritten => {
                    self.number = self.motor.track().next().saturating_sub(KEPT as u64 / 2);
                    lost = true;
                }
            }
        }
        self.pending.filter(|motion| motion.at() <= until)
    }

    /// The next motion, if it was not later than `until`. It is taken.
    pub(crate) fn next(&mut self, until: Clock) -> Option<Motion> {
        let motion = self.look(until);
        if motion.is_some() {
            self.take();
        }
        motion
    }

    fn take(&mut self) {
        if let Some(motion) = self.pending.take() {
            self.steps = motion.steps();
        }
    }
}

/// Reads the steps of several motors in the order of their instants.
#[derive(Debug)]
pub(crate) struct Followers(Vec<Follower>);

impl Followers {
    /// Follows the motors of these rails from the next step that they make.
    pub(crate) fn from_here<'a>(rails: impl IntoIterator<Item = &'a Arc<Rail>>) -> Followers {
        Followers::of(rails, Follower::from_here)
    }

    fn of<'a>(rails: impl IntoIterator<Item = &'a Arc<Rail>>, follow: impl Fn(Arc<Motor>) -> Follower) -> Followers {
        let mut all: Vec<Follower> = Vec::new();
        for (motor, _) in rails.into_iter().flat_map(|rail| rail.motors()) {
            if !all.iter().any(|follower| Arc::ptr_eq(&follower.motor, motor)) {
                all.push(follow(motor.clone()));
            }
        }
        Followers(all)
    }

    /// The place of a rail after the steps that were read.
    pub(crate) fn place_mm(&self, rail: &Rail) -> f64 {
        rail.mm_at(|motor| {
            let follower = self.0.iter().find(|follower| std::ptr::eq(&*follower.motor, motor));
            follower.map_or_else(|| motor.steps(), |follower| follower.steps)
        })
    }

    /// Reads the next steps, those of one instant, if they were not later than `until`: their instant, and whether steps
    /// before them were overwritten.
    pub(crate) fn next(&mut self, until: Clock) -> Option<(Clock, bool)> {
        // One thread makes all steps of a board, in the order of their instants. If a step is visible, those before it
        // are too: also on a motor that had none when it was asked before.
        let mut first: Option<Clock> = None;
        loop {
            let seen = self.0.iter_mut().filter_map(|follower| follower.look(until)).map(Motion::at).min();
            if seen == first {
                break;
            }
            first = seen;
        }
        let first = first?;
        let mut lost = false;
        for follower in &mut self.0 {
            if let Some(motion) = follower.pending.filter(|motion| motion.at() == first) {
                lost |= motion.is_lost();
                follower.take();
            }
        }
        Some((first, lost))
    }
}

/// Reads the motion of a rail.
#[derive(Debug)]
pub(crate) struct RailFollower {
    rail: Arc<Rail>,
    followers: Followers,
}

impl RailFollower {
    /// Follows from the first step that its motors make.
    pub(crate) fn new(rail: Arc<Rail>) -> RailFollower {
        RailFollower { followers: Followers::of([&rail], Follower::new), rail }
    }

    /// Follows from the next step that its motors make.
    pub(crate) fn from_here(rail: Arc<Rail>) -> RailFollower {
        RailFollower { followers: Followers::from_here([&rail]), rail }
    }

    /// The next step of its motors, if it was not later than `until`: its instant, the place of the rail after it, and
    /// whether steps before it were overwritten.
    pub(crate) fn next(&mut self, until: Clock) -> Option<(Clock, f64, bool)> {
        let (at, lost) = self.followers.next(until)?;
        Some((at, self.followers.place_mm(&self.rail), lost))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;

    #[test]
    fn who_falls_behind_goes_on_from_where_the_axis_is() {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[3]));
        axis.set_enabled(true);
        axis.set_forward(true);
        let mut follower = RailFollower::new(axis.rail().clone());
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
            assert_eq!(follower.next(at(4)), Some((at(step), step as f64 / 100.0, false)));
        }
        assert_eq!(follower.next(at(4)), None);
        let end = 2 * KEPT as u64;
        steps(11, end);
        let from = end - KEPT as u64 / 2 + 1;
        // It has read this one already.
        assert_eq!(follower.next(at(end)), Some((at(5), 0.05, false)));
        assert_eq!(follower.next(at(end)), Some((at(from), from as f64 / 100.0, true)));
        for step in from + 1..=end {
            assert_eq!(follower.next(at(end)), Some((at(step), step as f64 / 100.0, false)));
        }
        assert_eq!(follower.next(at(end)), None);
    }
}
