// SPDX-License-Identifier: GPL-3.0-or-later
//! The track of an axis: its last steps, each with its instant, for parts that feel a motion and not only a position.
//!
//! The core writes without a lock. Readers on any thread follow at their own pace, each with its own place. A reader
//! that falls behind by more than the track holds notices it. It then continues where the axis is.

#![forbid(unsafe_code)]

use std::sync::atomic::{AtomicU64, Ordering, fence};

use pinion_firmware::time::Clock;

/// Number of steps kept: half a second at 32,000 steps per second.
pub(crate) const KEPT: usize = 1 << 14;

/// The last steps, in a ring.
///
/// The writer increments `begun` before it changes a place, and `written` afterwards. A reader reads `written` first
/// and `begun` last. If the writer has not begun to change the place again, the reader has a whole step.
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

    /// Adds a step. Only one thread may push.
    pub(crate) fn push(&self, at: Clock, position: i64) {
        let step = self.written.load(Ordering::Relaxed);
        self.begun.store(step + 1, Ordering::Relaxed);
        fence(Ordering::Release);
        let [instant, steps] = self.place(step);
        instant.store(at.ticks(), Ordering::Relaxed);
        steps.store(position as u64, Ordering::Relaxed);
        self.written.store(step + 1, Ordering::Release);
    }

    /// The number of the next step.
    pub(crate) fn next(&self) -> u64 {
        self.written.load(Ordering::Acquire)
    }

    /// The step with this number.
    pub(crate) fn get(&self, step: u64) -> Recorded {
        if step >= self.next() {
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

/// The track's answer for one step.
pub(crate) enum Recorded {
    Step(Clock, i64),
    NotYet,
    Overwritten,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
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
                        // As far behind as possible, at the place where the writer works.
                        Recorded::Overwritten => {
                            next = track.next().saturating_sub(KEPT as u64);
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
}
