// SPDX-License-Identifier: GPL-3.0-or-later
//! The time of an errand that drives lines itself, with a few microseconds between two edges.
//!
//! Where the firmware waits in a loop, or has a timer for each bit, a worker waits in a loop here. Meanwhile the core
//! is free, and nothing has to wake up between two edges.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::mcu::Mcu;
use crate::time::{Clock, Ticks, TimeSource};

/// Longest time that a wait continues after a stop.
const SLICE: Ticks = Ticks::from_us(1000);
/// How long [`Pace::until_interrupted`] waits: a little longer than the kernel's tick at 250 Hz.
const TICK_MAX: Ticks = Ticks::from_us(4100);
/// How often it looks at the clock.
const LOOK: Ticks = Ticks(25);
/// Shortest time without the processor that counts as an interruption: 1 us.
const INTERRUPTION: i64 = 50;

/// Keeps time on a worker, until the core stops it. The errand and its object have a copy each.
#[derive(Clone)]
pub(super) struct Pace {
    clock: Arc<dyn TimeSource>,
    stopped: Arc<AtomicBool>,
}

impl Pace {
    /// The pace of an object's errands.
    pub(super) fn new(mcu: &Mcu) -> Pace {
        Pace::of(mcu.clock())
    }

    /// A pace with this clock.
    pub(super) fn of(clock: Arc<dyn TimeSource>) -> Pace {
        Pace { clock, stopped: Arc::default() }
    }

    pub(super) fn now(&self) -> Clock {
        self.clock.now()
    }

    /// Waits until `at`. False if the errand must end, because the MCU stopped.
    pub(super) fn until(&self, at: Clock) -> bool {
        loop {
            if self.stopped.load(Ordering::Relaxed) {
                return false;
            }
            let now = self.clock.now();
            if now >= at {
                return true;
            }
            self.clock.spin_until(at.min(now + SLICE));
        }
    }

    /// Waits until `at`, also if the MCU stopped. Only for times of microseconds.
    #[inline]
    pub(super) fn spin_until(&self, at: Clock) {
        self.clock.spin_until(at);
    }

    /// Waits until this thread has been interrupted, at most [`TICK_MAX`]. Most interruptions are ticks of the kernel, at
    /// equal distances. So it has the processor for itself for a while now.
    pub(super) fn until_interrupted(&self) {
        let mut last = self.clock.now();
        let limit = last + TICK_MAX;
        while last < limit && !self.stopped.load(Ordering::Relaxed) {
            let look = last + LOOK;
            self.clock.spin_until(look);
            last = self.clock.now();
            if last.since(look) > INTERRUPTION {
                return;
            }
        }
    }

    /// Makes the errand under way end soon. No wait succeeds until [`Pace::resume`].
    pub(super) fn stop(&self) {
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// Lets errands wait again.
    pub(super) fn resume(&self) {
        self.stopped.store(false, Ordering::Relaxed);
    }
}
