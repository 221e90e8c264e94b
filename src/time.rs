// SPDX-License-Identifier: GPL-3.0-or-later
//! Instants and spans in ticks of 20 ns.
//!
//! Inside, an instant is a `u64` that never wraps. It becomes 32 bits only on the wire, and a
//! 32-bit clock from the host is widened to the instant nearest to a reference.

#![forbid(unsafe_code)]

use std::fmt;
use std::ops::{Add, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

/// Ticks in a second, as the linux MCU of Klipper has it (`CLOCK_FREQ`).
pub const CLOCK_FREQ: u32 = 50_000_000;
/// Nanoseconds in a tick.
pub const NS_PER_TICK: u64 = 1_000_000_000 / CLOCK_FREQ as u64;

/// An instant in ticks. Tick 0 of the wire is [`Clock::EPOCH`], a whole turn of the 32-bit
/// clock above zero, so that an instant before it can still be told.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Clock(u64);

/// A span in ticks, as the wire carries it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Hash, Debug)]
pub struct Ticks(pub u32);

impl Ticks {
    /// The span of `us` microseconds.
    pub const fn from_us(us: u32) -> Ticks {
        Ticks(us * (CLOCK_FREQ / 1_000_000))
    }
}

impl Clock {
    /// Tick 0.
    pub const EPOCH: Clock = Clock(1 << 32);

    /// The instant `ticks` after tick 0.
    pub const fn from_ticks(ticks: u64) -> Clock {
        Clock(Clock::EPOCH.0 + ticks)
    }

    /// Ticks since tick 0; an instant before it counts as tick 0.
    pub const fn ticks(self) -> u64 {
        self.0.saturating_sub(Clock::EPOCH.0)
    }

    /// The 32 bits that the host sees.
    pub const fn wire(self) -> u32 {
        self.0 as u32
    }

    /// The instant nearest to `near` whose 32 bits are `wire`.
    pub const fn widen(wire: u32, near: Clock) -> Clock {
        near.displaced(wire.wrapping_sub(near.wire()))
    }

    /// This instant displaced by a span that wraps as the firmware's 32-bit clocks do: from
    /// 2^31 ticks on it lies in the past.
    pub const fn displaced(self, ticks: u32) -> Clock {
        Clock(self.0.wrapping_add_signed(ticks as i32 as i64))
    }

    /// Ticks from `earlier` to this instant, negative if this one is before it.
    pub const fn since(self, earlier: Clock) -> i64 {
        self.0.wrapping_sub(earlier.0) as i64
    }
}

impl Add<Ticks> for Clock {
    type Output = Clock;
    fn add(self, span: Ticks) -> Clock {
        Clock(self.0 + u64::from(span.0))
    }
}

impl Sub<Ticks> for Clock {
    type Output = Clock;
    fn sub(self, span: Ticks) -> Clock {
        Clock(self.0.wrapping_sub(u64::from(span.0)))
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Clock({})", self.0.wrapping_sub(Clock::EPOCH.0) as i64)
    }
}

/// Where the machine reads the time.
pub trait TimeSource: Send + Sync {
    /// The present instant; never earlier than an instant that it told before.
    fn now(&self) -> Clock;

    /// An errand begins on this thread, which may have a time of its own
    /// ([`crate::board::Board::errand_clock`]).
    fn begin_errand(&self) {}

    /// The errand has ended.
    fn end_errand(&self) {}

    /// The instant that CLOCK_MONOTONIC tells as `monotonic`: the kernel dates by that clock.
    fn instant_of(&self, monotonic: Duration) -> Clock;

    /// Waits until `end` without sleeping: for the pulses of a bus, which are shorter than a sleep.
    fn spin_until(&self, end: Clock) {
        while self.now() < end {
            std::hint::spin_loop();
        }
    }
}

/// CLOCK_MONOTONIC in ticks. Tick 0 is a whole second of it, so that the lateness of an edge
/// can be measured from outside.
#[derive(Clone, Copy, Debug)]
pub struct Monotonic {
    origin_s: u64,
}

impl Monotonic {
    /// A clock whose tick 0 is the whole second before this call.
    ///
    /// (Klipper's own program takes the next second, which starts it with a clock near 2^32;
    /// its host accepts both.)
    pub fn start() -> Monotonic {
        Monotonic { origin_s: monotonic().as_secs() }
    }

    /// The instant of CLOCK_MONOTONIC, as the time since the kernel's start.
    pub fn duration_of(&self, clock: Clock) -> Duration {
        Duration::from_secs(self.origin_s) + Duration::from_nanos(clock.ticks() * NS_PER_TICK)
    }
}

impl TimeSource for Monotonic {
    fn now(&self) -> Clock {
        self.instant_of(monotonic())
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        let s = monotonic.as_secs().saturating_sub(self.origin_s);
        Clock::from_ticks(s * u64::from(CLOCK_FREQ) + u64::from(monotonic.subsec_nanos()) / NS_PER_TICK)
    }
}

/// CLOCK_MONOTONIC as the time since the kernel's start.
pub fn monotonic() -> Duration {
    // clock_gettime(2) fails for an unknown clock or a bad pointer only.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(Duration::ZERO, Duration::from)
}

/// A clock that stands still until it is told to advance: the whole machine runs on it in
/// tests, the same each time.
#[derive(Clone, Debug)]
pub struct VirtualClock(Arc<AtomicU64>);

impl VirtualClock {
    /// A clock that stands at `now`.
    pub fn at(now: Clock) -> VirtualClock {
        VirtualClock(Arc::new(AtomicU64::new(now.0)))
    }

    /// Moves the clock to `now`; never back.
    pub fn set(&self, now: Clock) {
        self.0.fetch_max(now.0, Ordering::SeqCst);
    }

    /// Runs `work` in a time of its own that begins now, as another thread does, and tells when it
    /// ended. The clock itself stands where it stood.
    pub fn aside(&self, work: impl FnOnce()) -> Clock {
        let now = self.now();
        work();
        Clock(self.0.swap(now.0, Ordering::SeqCst))
    }
}

impl TimeSource for VirtualClock {
    fn now(&self) -> Clock {
        Clock(self.0.load(Ordering::SeqCst))
    }

    /// Its tick 0 is that clock's zero.
    fn instant_of(&self, monotonic: Duration) -> Clock {
        let s = monotonic.as_secs();
        Clock::from_ticks(s * u64::from(CLOCK_FREQ) + u64::from(monotonic.subsec_nanos()) / NS_PER_TICK)
    }

    fn spin_until(&self, end: Clock) {
        self.set(end);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_wire_clock_widens_to_the_nearest_instant(near in 1u64 << 33..1 << 62, wire: u32) {
            let near = Clock(near);
            let wide = Clock::widen(wire, near);
            prop_assert_eq!(wide.wire(), wire);
            prop_assert!((-(1 << 31)..1 << 31).contains(&wide.since(near)));
        }

        #[test]
        fn an_instant_comes_back_from_the_wire(near in 1u64 << 33..1 << 60, offset in -(1i64 << 31)..(1 << 31)) {
            let instant = Clock(near.wrapping_add_signed(offset));
            prop_assert_eq!(Clock::widen(instant.wire(), Clock(near)), instant);
        }
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
