// SPDX-License-Identifier: GPL-3.0-or-later
//! The way of an axis: its last steps, each with its instant, for parts that feel a motion and not
//! only a position.
//!
//! The core writes, without a lock; readers on any thread follow at their own pace, each with a place
//! of its own. A reader that falls behind by more than the track holds notices, and goes on from
//! where the axis is.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use super::physics::Axis;
use pinion_firmware::time::Clock;

/// Steps that are kept: half a second at 32,000 a second.
const KEPT: usize = 1 << 14;

/// The last steps, in a ring.
///
/// Before the writer changes a place it says so in `begun`, and when it is done in `written`. A
/// reader looks at `written` first and at `begun` last: if the writer has not begun to change the
/// place again, what was read is whole.
#[derive(Debug)]
pub(crate) struct Track {
    begun: AtomicU64,
    written: AtomicU64,
    /// The instant in ticks, and the position in steps after the step.
    steps: Box<[[AtomicU64; 2]]>,
}

impl Track {
    pub(crate) fn new() -> Track {
        let steps = (0..KEPT).map(|_| [AtomicU64::new(0), AtomicU64::new(0)]).collect();
        Track { begun: AtomicU64::new(0), written: AtomicU64::new(0), steps }
    }

    fn place(&self, step: u64) -> &[AtomicU64; 2] {
        // The remainder is below `KEPT`.
        &self.steps[(step % KEPT as u64) as usize]
    }

    /// Adds a step. Only one thread may.
    pub(crate) fn push(&self, at: Clock, position: i64) {
        let step = self.written.load(Ordering::Relaxed);
        self.begun.store(step + 1, Ordering::Relaxed);
        fence(Ordering::Release);
        let [instant, steps] = self.place(step);
        instant.store(at.ticks(), Ordering::Relaxed);
        steps.store(position as u64, Ordering::Relaxed);
        self.written.store(step + 1, Ordering::Release);
    }

    /// The step with this number.
    fn get(&self, step: u64) -> Recorded {
        let written = self.written.load(Ordering::Acquire);
        if step >= written {
            return Recorded::NotYet;
        }
        let [instant, steps] = self.place(step);
        let (at, position) = (instant.load(Ordering::Relaxed), steps.load(Ordering::Relaxed));
        fence(Ordering::Acquire);
        if self.begun.load(Ordering::Relaxed) - step > KEPT as u64 {
            return Recorded::Overwritten;
        }
        Recorded::Step(Clock::from_ticks(at), position as i64)
    }
}

/// What a track has of a step.
enum Recorded {
    Step(Clock, i64),
    NotYet,
    Overwritten,
}

/// One who follows an axis.
#[derive(Debug)]
pub(crate) struct Follower {
    axis: Arc<Axis>,
    next: u64,
}

/// What an axis did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Motion {
    /// A step at this instant, to this place in mm.
    Step(Clock, f64),
    /// More than the track holds; at this instant it stepped to here, in mm.
    Lost(Clock, f64),
}

impl Follower {
    /// Follows from the first step that the axis makes.
    pub(crate) fn new(axis: Arc<Axis>) -> Follower {
        Follower { axis, next: 0 }
    }

    /// What came next, if it was no later than this.
    pub(crate) fn next(&mut self, until: Clock) -> Option<Motion> {
        let mut lost = false;
        loop {
            match self.axis.track().get(self.next) {
                Recorded::Step(at, position) if at <= until => {
                    self.next += 1;
                    let mm = self.axis.mm(position);
                    return Some(if lost { Motion::Lost(at, mm) } else { Motion::Step(at, mm) });
                }
                Recorded::Step(..) | Recorded::NotYet => return None,
                // Half of the track is left to go on from, while the writer overwrites the other half.
                Recorded::Overwritten => {
                    self.next = self.axis.track().written.load(Ordering::Acquire).saturating_sub(KEPT as u64 / 2);
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
    use std::sync::atomic::AtomicBool;

    #[test]
    fn a_reader_never_sees_a_step_that_is_half_another() {
        let track = Arc::new(Track::new());
        let done = Arc::new(AtomicBool::new(false));
        let reader = std::thread::spawn({
            let (track, done) = (track.clone(), done.clone());
            move || {
                let (mut next, mut read, mut lost) = (0, 0, 0);
                loop {
                    let over = done.load(Ordering::Acquire);
                    match track.get(next) {
                        Recorded::Step(at, position) => {
                            assert_eq!((at.ticks(), position), (next, -(next as i64)));
                            (next, read) = (next + 1, read + 1);
                        }
                        // As far behind as can be, where the writer is at work.
                        Recorded::Overwritten => {
                            next = track.written.load(Ordering::Acquire).saturating_sub(KEPT as u64);
                            lost += 1;
                        }
                        Recorded::NotYet if over => return (next, read, lost),
                        Recorded::NotYet => {}
                    }
                }
            }
        });
        let steps = 40 * KEPT as u64;
        for step in 0..steps {
            track.push(Clock::from_ticks(step), -(step as i64));
        }
        done.store(true, Ordering::Release);
        let Ok((next, read, lost)) = reader.join() else { panic!("the reader failed") };
        assert_eq!(next, steps);
        assert!(read >= KEPT as u64, "{read} read, lost {lost} times");
    }

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
        // No further than asked for.
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
