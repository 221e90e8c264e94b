// SPDX-License-Identifier: GPL-3.0-or-later
//! The kernel's clock.

#![forbid(unsafe_code)]

use std::thread;
use std::time::Duration;

use nix::poll::PollTimeout;
use nix::time::{ClockId, clock_gettime};

use pinion_firmware::time::{CLOCK_FREQ, Clock, NS_PER_TICK, TimeSource};

/// CLOCK_MONOTONIC in ticks. Tick 0 is at a whole second, so that the lateness of an edge can be measured from outside.
#[derive(Clone, Copy, Debug)]
pub struct Monotonic {
    origin_s: u64,
}

impl Monotonic {
    /// A clock with tick 0 at the whole second before this call.
    ///
    /// (Klipper's own program takes the next second, so its clock starts near 2^32. The host accepts both.)
    pub fn start() -> Monotonic {
        Monotonic { origin_s: monotonic().as_secs() }
    }

    #[inline]
    fn at(&self, s: u64, ns: u32) -> Clock {
        let s = s.saturating_sub(self.origin_s);
        Clock::from_ticks(s * u64::from(CLOCK_FREQ) + u64::from(ns) / NS_PER_TICK)
    }
}

impl TimeSource for Monotonic {
    fn now(&self) -> Clock {
        // Without a [`Duration`] in between, which would have to be checked.
        let now = clock_gettime(ClockId::CLOCK_MONOTONIC);
        now.map_or(Clock::EPOCH, |now| self.at(now.tv_sec() as u64, now.tv_nsec() as u32))
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.at(monotonic.as_secs(), monotonic.subsec_nanos())
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        Duration::from_secs(self.origin_s) + Duration::from_nanos(clock.ticks() * NS_PER_TICK)
    }
}

/// CLOCK_MONOTONIC as the time since the kernel's start.
pub fn monotonic() -> Duration {
    // clock_gettime(2) fails only for an unknown clock or a bad pointer.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(Duration::ZERO, Duration::from)
}

/// Looks every millisecond whether something is done, until `deadline` (CLOCK_MONOTONIC). Returns whether it is done.
pub fn wait_until(deadline: Duration, mut is_done: impl FnMut() -> bool) -> bool {
    loop {
        if is_done() {
            return true;
        }
        if monotonic() >= deadline {
            return false;
        }
        thread::sleep(Duration::from_millis(1));
    }
}

/// A timeout for poll(2), rounded up to whole milliseconds. Without an end if it is longer than poll(2) can wait.
pub fn poll_timeout(timeout: Duration) -> PollTimeout {
    let ms = timeout.as_nanos().div_ceil(1_000_000);
    PollTimeout::try_from(ms).unwrap_or(PollTimeout::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_ends_when_it_is_done_or_at_its_deadline() {
        let mut looks = 0;
        let third = || {
            looks += 1;
            looks == 3
        };
        assert!(wait_until(monotonic() + Duration::from_secs(60), third));
        assert_eq!(looks, 3);
        let deadline = monotonic() + Duration::from_millis(3);
        assert!(!wait_until(deadline, || false) && monotonic() >= deadline);
    }

    #[test]
    fn tick_zero_is_a_whole_second() {
        let clock = Monotonic::start();
        assert_eq!(clock.duration_of(Clock::EPOCH).subsec_nanos(), 0);
        assert!(clock.now().ticks() < 2 * u64::from(CLOCK_FREQ));
    }

    #[test]
    fn an_instant_of_the_kernel_s_clock_is_one_of_ours() {
        let clock = Monotonic::start();
        for ticks in [0, 1, 49_999_999, 50_000_000, 1 << 40] {
            let instant = Clock::from_ticks(ticks);
            assert_eq!(clock.instant_of(clock.duration_of(instant)), instant);
        }
    }
}
