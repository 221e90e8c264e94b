// SPDX-License-Identifier: GPL-3.0-or-later
//! The track of an axis: its last steps, each with its instant, for parts that feel a motion and not only a position.
//!
//! The core writes without a lock. Readers on any thread follow at their own pace, each with its own place. A reader
//! that falls behind by more than the track holds notices it. It then continues where the axis is.

use std::sync::atomic::AtomicU64;

use pinion_firmware::time::Clock;
use pinion_shm::ring::{Lookup, Ring, words};

/// Number of steps kept: half a second at 32,000 steps per second.
pub(crate) const KEPT: usize = 1 << 14;

/// The last steps: the instant in ticks, and the position in steps after the step.
#[derive(Debug)]
pub(crate) struct Track(Box<[AtomicU64]>);

impl Track {
    pub(crate) fn new() -> Track {
        Track(Box::new([const { AtomicU64::new(0) }; words(KEPT)]))
    }

    fn ring(&self) -> Ring<'_> {
        Ring::new(&self.0)
    }

    /// Adds a step. Only one thread may push.
    pub(crate) fn push(&self, at: Clock, position: i64) {
        self.ring().push([at.ticks(), position as u64]);
    }

    /// The number of the next step.
    pub(crate) fn next(&self) -> u64 {
        self.ring().next()
    }

    /// The step with this number.
    pub(crate) fn get(&self, step: u64) -> Recorded {
        match self.ring().get(step) {
            Lookup::Record([at, position]) => Recorded::Step(Clock::from_ticks(at), position as i64),
            Lookup::NotYet => Recorded::NotYet,
            Lookup::Overwritten => Recorded::Overwritten,
        }
    }
}

/// The track's answer for one step.
pub(crate) enum Recorded {
    Step(Clock, i64),
    NotYet,
    Overwritten,
}
