// SPDX-License-Identifier: GPL-3.0-or-later
//! Instants and spans in ticks of 20 ns, and what an MCU times itself by.

#![forbid(unsafe_code)]

use std::ops::{Add, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

pub use pinion_protocol::clock::Clock;

/// Ticks in a second, as the linux MCU of Klipper has it (`CLOCK_FREQ`).
pub const CLOCK_FREQ: u32 = 50_000_000;
/// Nanoseconds in a tick.
pub const NS_PER_TICK: u64 = 1_000_000_000 / CLOCK_FREQ as u64;

/// A span in ticks, as the wire carries it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Hash, Debug)]
pub struct Ticks(pub u32);

impl Ticks {
    /// The span of `us` microseconds.
    pub const fn from_us(us: u32) -> Ticks {
        Ticks(us * (CLOCK_FREQ / 1_000_000))
    }

    /// The span of `ms` milliseconds.
    pub const fn from_ms(ms: u32) -> Ticks {
        Ticks(ms * (CLOCK_FREQ / 1000))
    }

    /// The span in whole milliseconds.
    pub const fn as_ms(self) -> u32 {
        self.0 / Ticks::from_ms(1).0
    }
}

impl Add<Ticks> for Clock {
    type Output = Clock;
    fn add(self, span: Ticks) -> Clock {
        self.later(u64::from(span.0))
    }
}

impl Sub<Ticks> for Clock {
    type Output = Clock;
    fn sub(self, span: Ticks) -> Clock {
        self.earlier(u64::from(span.0))
    }
}

/// Where an MCU reads the time.
pub trait TimeSource: Send + Sync {
    /// The present instant; never earlier than an instant that it told before.
    fn now(&self) -> Clock;

    /// Runs the work of an errand on this thread, and tells when it ended. A clock that is not of this world gives
    /// the work a time of its own.
    fn errand(&self, work: &mut dyn FnMut()) -> Clock {
        work();
        self.now()
    }

    /// The instant that CLOCK_MONOTONIC tells as `monotonic`: the kernel dates by that clock.
    fn instant_of(&self, monotonic: Duration) -> Clock;

    /// What CLOCK_MONOTONIC tells at this instant.
    fn duration_of(&self, clock: Clock) -> Duration;

    /// Waits until `end` without sleeping: for the pulses of a bus, which are shorter than a sleep.
    fn spin_until(&self, end: Clock) {
        while self.now() < end {
            std::hint::spin_loop();
        }
    }
}

/// What an MCU times itself by.
#[derive(Clone)]
pub struct Timing {
    /// The clock of the core, and of the errands on its workers.
    pub clock: Arc<dyn TimeSource>,
    /// What the MCU tells of the timer that runs.
    pub due: Due,
    /// How late a step may be before the MCU stops: a motor that is stepped too late loses steps.
    pub step_late_limit: Ticks,
}

impl Timing {
    /// By this clock, with steps that may be 1 ms late, as in the firmware.
    pub fn of(clock: Arc<dyn TimeSource>) -> Timing {
        Timing { clock, due: Due::default(), step_late_limit: Ticks::from_ms(1) }
    }
}

/// The instant for which the timer that runs was set. The core sets it; a simulated printer reads it, whose parts are
/// not to feel how late the computer is.
#[derive(Clone, Debug)]
pub struct Due(Arc<AtomicU64>);

impl Due {
    /// No timer runs. No instant has these bits: they lie 11,000 years ahead.
    const NO_TIMER: u64 = u64::MAX;

    /// A timer runs that was due at this instant; `None`: no timer runs.
    #[inline]
    pub fn set(&self, due: Option<Clock>) {
        self.0.store(due.map_or(Due::NO_TIMER, Clock::to_bits), Ordering::Relaxed);
    }

    /// When the timer that runs was due; `None` if no timer runs.
    #[inline]
    pub fn get(&self) -> Option<Clock> {
        Some(self.0.load(Ordering::Relaxed)).filter(|bits| *bits != Due::NO_TIMER).map(Clock::from_bits)
    }
}

impl Default for Due {
    fn default() -> Due {
        Due(Arc::new(AtomicU64::new(Due::NO_TIMER)))
    }
}

/// A clock that stands still until it is told to advance: the whole MCU runs on it in
/// tests, the same each time.
#[derive(Clone, Debug)]
pub struct VirtualClock(Arc<AtomicU64>);

impl VirtualClock {
    /// A clock that stands at `now`.
    pub fn at(now: Clock) -> VirtualClock {
        VirtualClock(Arc::new(AtomicU64::new(now.ticks())))
    }

    /// Moves the clock to `now`; never back.
    pub fn set(&self, now: Clock) {
        self.0.fetch_max(now.ticks(), Ordering::SeqCst);
    }
}

impl TimeSource for VirtualClock {
    fn now(&self) -> Clock {
        Clock::from_ticks(self.0.load(Ordering::SeqCst))
    }

    /// Its tick 0 is that clock's zero.
    fn instant_of(&self, monotonic: Duration) -> Clock {
        let s = monotonic.as_secs();
        Clock::from_ticks(s * u64::from(CLOCK_FREQ) + u64::from(monotonic.subsec_nanos()) / NS_PER_TICK)
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        Duration::from_nanos(clock.ticks() * NS_PER_TICK)
    }

    fn spin_until(&self, end: Clock) {
        self.set(end);
    }

    /// The work has a time of its own that begins now, as on another thread. The clock itself stands where it stood.
    fn errand(&self, work: &mut dyn FnMut()) -> Clock {
        let now = self.now();
        work();
        Clock::from_ticks(self.0.swap(now.ticks(), Ordering::SeqCst))
    }
}
