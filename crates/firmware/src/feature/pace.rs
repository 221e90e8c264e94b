// SPDX-License-Identifier: GPL-3.0-or-later
//! The time of a job that drives lines itself, with a few microseconds between two edges.
//!
//! Where Klipper's C waits in a loop, or has a timer for each bit, a worker waits in a loop here. So the core is
//! free, and nothing has to wake up between two edges.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::mcu::Context;
use crate::time::{Clock, Ticks, TimeSource};

/// Longest time that a wait continues after a stop.
const SLICE: Ticks = Ticks::from_us(1000);
/// How long before and after its beginning a tick of the kernel may disturb.
const TICK_BEGINS: Ticks = Ticks::from_us(20);
const TICK_LASTS: Ticks = Ticks::from_us(50);

/// When to begin work of this length, so that the kernel's next tick does not interrupt it. The tick comes to all
/// processors at once. Work that is longer than the time between two ticks begins after one.
pub(super) fn between_ticks(clock: &dyn TimeSource, length: Ticks) -> Clock {
    let now = clock.now();
    match clock.tick_after(now - TICK_LASTS) {
        Some(tick) if tick < now + Ticks(length.0.saturating_add(TICK_BEGINS.0)) => tick + TICK_LASTS,
        _ => now,
    }
}

/// Keeps time on a worker, until the core stops it. The job and its object have a copy each.
#[derive(Clone)]
pub(super) struct Pace {
    clock: Arc<dyn TimeSource>,
    stopped: Arc<AtomicBool>,
}

impl Pace {
    /// The pace of an object's jobs.
    pub(super) fn new(context: &Context) -> Pace {
        Pace::of(context.clock())
    }

    /// The pace of an object whose jobs begin between two ticks ([`Pace::until_between_ticks`]).
    pub(super) fn between_ticks(context: &Context) -> Pace {
        let pace = Pace::new(context);
        // This starts the search for the kernel's tick, which is over before the first message.
        let _ = pace.clock.tick_after(pace.now());
        pace
    }

    /// A pace with this clock.
    pub(super) fn of(clock: Arc<dyn TimeSource>) -> Pace {
        Pace { clock, stopped: Arc::default() }
    }

    pub(super) fn now(&self) -> Clock {
        self.clock.now()
    }

    /// Waits until `at`. False if the job must end, because the MCU stopped.
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

    /// Waits until the kernel's tick leaves this much time, if it ever does.
    pub(super) fn until_between_ticks(&self, length: Ticks) {
        self.until(between_ticks(&*self.clock, length));
    }

    /// Makes the job under way end soon. No wait succeeds until [`Pace::resume`].
    pub(super) fn stop(&self) {
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// Lets jobs wait again.
    pub(super) fn resume(&self) {
        self.stopped.store(false, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// A clock that stands, with ticks every 4 ms or never.
    struct Standing(u64, Option<u32>);

    impl TimeSource for Standing {
        fn now(&self) -> Clock {
            Clock::from_ticks(self.0)
        }
        fn instant_of(&self, _: Duration) -> Clock {
            self.now()
        }
        fn duration_of(&self, _: Clock) -> Duration {
            Duration::ZERO
        }
        fn tick_after(&self, at: Clock) -> Option<Clock> {
            let every = u64::from(self.1?);
            Some(Clock::from_ticks((at.ticks() / every + 1) * every))
        }
    }

    #[test]
    fn work_begins_after_a_tick_that_would_interrupt_it() {
        // 4 ms.
        const EVERY: u64 = 200_000;
        for (now, length, begins) in [
            // There is time enough until the next one.
            (EVERY + 10_000, 150_000, EVERY + 10_000),
            (EVERY + 10_000, 188_999, EVERY + 10_000),
            (EVERY + 10_000, 189_001, 2 * EVERY + 2500),
            (2 * EVERY - 1000, 1, 2 * EVERY + 2500),
            // The last one may still last.
            (EVERY + 1000, 100, EVERY + 2500),
            (EVERY + 2501, 100, EVERY + 2501),
            // It is interrupted whenever it begins.
            (EVERY + 10_000, 199_000, 2 * EVERY + 2500),
            (EVERY + 10_000, u64::from(u32::MAX), 2 * EVERY + 2500),
        ] {
            let clock = Standing(now, Some(EVERY as u32));
            assert_eq!(between_ticks(&clock, Ticks(length as u32)).ticks(), begins, "{now} {length}");
        }
        assert_eq!(between_ticks(&Standing(EVERY - 1, None), Ticks(100)).ticks(), EVERY - 1);
    }
}
