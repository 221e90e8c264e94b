// SPDX-License-Identifier: GPL-3.0-or-later
//! Times and spans in ticks of 20 ns, and the clocks of an MCU.

use std::ops::{Add, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

pub use pinion_protocol::clock::Clock;

/// Ticks in a second, as in Klipper's Linux MCU (`CLOCK_FREQ`).
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

    /// The span between two times: zero if `to` is before `from`, and [`u32::MAX`] if it is longer.
    #[inline]
    pub fn between(from: Clock, to: Clock) -> Ticks {
        Ticks(u32::try_from(to.to_bits().saturating_sub(from.to_bits())).unwrap_or(u32::MAX))
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

/// The clock of an MCU.
pub trait TimeSource: Send + Sync {
    /// The time now; never earlier than a time that it returned before.
    fn now(&self) -> Clock;

    /// Runs the work of a job on this thread, and returns when the work ended. A clock other than the real one
    /// gives the work a time of its own.
    fn run_job(&self, work: &mut dyn FnMut()) -> Clock {
        work();
        self.now()
    }

    /// Converts a time of CLOCK_MONOTONIC, which the kernel uses for its events.
    fn instant_of(&self, monotonic: Duration) -> Clock;

    /// Converts a time to CLOCK_MONOTONIC.
    fn duration_of(&self, clock: Clock) -> Duration;

    /// Waits until `end` without sleeping. The pulses of a bus are shorter than a sleep.
    fn spin_until(&self, end: Clock) {
        while self.now() < end {
            std::hint::spin_loop();
        }
    }

    /// Sleeps until about `end`. A clock that stands still does not wait for itself.
    fn sleep_until(&self, end: Clock) {
        std::thread::sleep(self.duration_of(end).saturating_sub(self.duration_of(self.now())));
    }

    /// How far apart two successive values of the clock are, in nanoseconds, before they are rounded down to ticks.
    fn step_ns(&self) -> u32 {
        1
    }

    /// The span to measure for work that must last at least `ns`. A measured span may be longer than the real one, by a
    /// step of the clock and a part of a tick.
    fn at_least(&self, ns: u32) -> Ticks {
        Ticks((ns + self.span_error_ns()).div_ceil(NS_PER_TICK as u32))
    }

    /// The longest measured span of work that may last `ns` at most. A measured span may be shorter than the real one,
    /// by as much.
    fn at_most(&self, ns: u32) -> Ticks {
        Ticks(ns.saturating_sub(self.span_error_ns()) / NS_PER_TICK as u32)
    }

    /// Largest difference between a measured span and the real one, in nanoseconds.
    fn span_error_ns(&self) -> u32 {
        NS_PER_TICK as u32 - 1 + self.step_ns()
    }

    /// When the first tick of the kernel after this instant begins. It interrupts all processors at once. `None` if
    /// nothing is known of it. The first call may start the search for it.
    fn tick_after(&self, at: Clock) -> Option<Clock> {
        let _ = at;
        None
    }
}

/// The clock and the time limits of an MCU.
#[derive(Clone)]
pub struct Timing {
    /// The clock of the core and of the workers' jobs.
    pub clock: Arc<dyn TimeSource>,
    /// The due time of the running timer, which the MCU stores here.
    pub due: DueTime,
    /// Longest delay of a timer before the MCU stops.
    pub late_limit: Ticks,
    /// Longest delay of a step before the MCU stops. A motor that is stepped too late loses steps.
    pub step_late_limit: Ticks,
}

impl Timing {
    /// Timing by this clock, with timers at most 100 ms late and steps at most 1 ms, as in Klipper's C.
    pub fn of(clock: Arc<dyn TimeSource>) -> Timing {
        Timing { clock, due: DueTime::default(), late_limit: Ticks::from_ms(100), step_late_limit: Ticks::from_ms(1) }
    }
}

/// The due time of the running timer. The core sets it. A simulated printer reads it, so that a late computer does not
/// affect its parts.
#[derive(Clone, Debug)]
pub struct DueTime(Arc<AtomicU64>);

impl DueTime {
    /// The value while no timer runs. No time has these bits: they are 11,000 years ahead.
    const NO_TIMER: u64 = u64::MAX;

    /// Sets the due time of the running timer; `None` if no timer runs.
    #[inline]
    pub fn set(&self, due: Option<Clock>) {
        self.0.store(due.map_or(DueTime::NO_TIMER, Clock::to_bits), Ordering::Relaxed);
    }

    /// The due time of the running timer; `None` if no timer runs.
    #[inline]
    pub fn get(&self) -> Option<Clock> {
        Some(self.0.load(Ordering::Relaxed)).filter(|bits| *bits != DueTime::NO_TIMER).map(Clock::from_bits)
    }
}

impl Default for DueTime {
    fn default() -> DueTime {
        DueTime(Arc::new(AtomicU64::new(DueTime::NO_TIMER)))
    }
}

/// A clock that stands still until it is advanced. In tests, the whole MCU runs on it with the same result each time.
#[derive(Clone, Debug)]
pub struct VirtualClock(Arc<AtomicU64>);

impl VirtualClock {
    /// A clock that stands at `now`.
    pub fn at(now: Clock) -> VirtualClock {
        VirtualClock(Arc::new(AtomicU64::new(now.ticks())))
    }

    /// Moves the clock forward to `now`. It never goes back.
    pub fn set(&self, now: Clock) {
        self.0.fetch_max(now.ticks(), Ordering::SeqCst);
    }
}

impl TimeSource for VirtualClock {
    fn now(&self) -> Clock {
        Clock::from_ticks(self.0.load(Ordering::SeqCst))
    }

    /// Tick 0 is the zero of CLOCK_MONOTONIC.
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

    /// Somebody else moves the clock.
    fn sleep_until(&self, _end: Clock) {}

    /// The work runs in a time that begins now, as on another thread. The clock itself does not advance.
    fn run_job(&self, work: &mut dyn FnMut()) -> Clock {
        let now = self.now();
        work();
        Clock::from_ticks(self.0.swap(now.ticks(), Ordering::SeqCst))
    }
}
