// SPDX-License-Identifier: GPL-3.0-or-later
//! How the core waits: it sleeps until a learned margin before the instant, then it spins.
//!
//! The margin follows the upper quantile of the wake-ups' lateness. So most wake-ups come before the instant, and an
//! edge is late only by the clock's own reading. Timers that are close together have a smaller margin.

use std::hint;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

use pinion_firmware::time::{Clock, Ticks, TimeSource};
use pinion_linux::parker::Parker;

use crate::core::budget::{Budget, Class, Throttle};
use crate::process::realtime::{self, Processors, Scheduling};
use crate::recorder::Sleep;

/// The margin's bounds.
#[derive(Clone, Copy, Debug)]
pub struct MarginLimits {
    /// Lowest margin. It keeps the margin alive when wake-ups are quick.
    pub min: Ticks,
    /// Lowest margin while timers are [`CLOSE`] together. The core is awake for most of their time anyway, and one of
    /// them that comes a little later costs less than to spin for each.
    pub close: Ticks,
    /// Highest margin: the time that a wake-up of this computer may cost in spinning.
    pub max: Ticks,
}

impl Default for MarginLimits {
    fn default() -> MarginLimits {
        MarginLimits::up_to_us(200)
    }
}

impl MarginLimits {
    /// Bounds of 4.5 (3 for close timers) and `us` microseconds. A bound that is longer than `us` is `us`.
    pub fn up_to_us(us: u32) -> MarginLimits {
        MarginLimits {
            min: Ticks::from_us(us).min(Ticks(225)),
            close: Ticks::from_us(us.min(3)),
            max: Ticks::from_us(us),
        }
    }

    /// These bounds, all the same.
    pub fn always(margin: Ticks) -> MarginLimits {
        MarginLimits { min: margin, close: margin, max: margin }
    }
}

/// Learns how early to wake.
#[derive(Debug)]
pub struct Margin {
    limits: MarginLimits,
    /// In 1/256 ticks.
    fine: i64,
    /// Waits since the last wake-up that were too short to sleep.
    unslept: u32,
    /// The last exact timer.
    last_exact: Clock,
    /// It was close to the one before it.
    is_close: bool,
}

/// Exact timers at most this far apart are close together.
const CLOSE: i64 = Ticks::from_us(10).0 as i64;
/// After this many waits that were too short to sleep, a smaller margin is tried.
const UNSLEPT_MAX: u32 = 500;
/// Longest wait without a sleep. A shorter sleep is late by the time that going into it and out of it takes. It saves
/// nothing, and would make the margin grow.
const NAP_MIN: i64 = Ticks::from_us(1).0 as i64;
/// One wake-up in this many may come after the instant.
const LATE_SHARE: i64 = 50;
/// How many sleeps are tried at the start, and how long each is.
const TRIALS: usize = 16;
const TRIAL: Ticks = Ticks::from_us(100);
const FINE: i64 = 256;

impl Margin {
    /// A margin that covers a wake-up that comes `late` after its time, and a quarter more. It learns the rest from
    /// late edges.
    pub fn new(limits: MarginLimits, late: i64) -> Margin {
        let mut margin = Margin { limits, fine: 0, unslept: 0, last_exact: Clock::EPOCH, is_close: false };
        margin.displace(late.clamp(0, i64::from(u32::MAX)) * FINE * 5 / 4);
        margin
    }

    /// How long before an instant to wake. Before a close timer, it is three quarters of what was learned: to spin for
    /// each costs more than one of them that comes a little later.
    pub fn get(&self) -> Ticks {
        let learned = (self.fine / FINE) as u32;
        Ticks(if self.is_close { learned / 4 * 3 } else { learned }).max(self.floor())
    }

    /// The present lower bound.
    fn floor(&self) -> Ticks {
        if self.is_close { self.limits.close } else { self.limits.min }
    }

    /// The next wait is for this exact timer.
    fn approach(&mut self, exact: Option<Clock>) {
        // The core may wait for one timer several times.
        if let Some(exact) = exact.filter(|exact| *exact != self.last_exact) {
            self.is_close = exact.since(self.last_exact).abs() <= CLOSE;
            self.last_exact = exact;
        }
    }

    /// Learns from a wake-up that came `late` after its time. If the margin did not cover it, the margin grows by a
    /// step. Otherwise it shrinks by a fiftieth of a step. The two balance where one wake-up in fifty is later.
    pub fn learn(&mut self, late: i64) {
        let present = self.fine / FINE;
        // Steps are in proportion to the margin: quick to follow a load, fine without one.
        let step = present.max(64) * FINE / 24;
        self.displace(if late > present { step } else { -step / LATE_SHARE });
    }

    /// A wait was too short to sleep, so nothing was learned. Otherwise a margin above the step interval would stay
    /// there, and the core would never sleep.
    fn unslept(&mut self) {
        self.unslept += 1;
        if self.unslept >= UNSLEPT_MAX {
            self.displace(-self.fine / 8);
        }
    }

    fn displace(&mut self, by: i64) {
        self.unslept = 0;
        self.fine = (self.fine + by).clamp(i64::from(self.limits.close.0) * FINE, i64::from(self.limits.max.0) * FINE);
    }
}

/// How long the calling thread has run, as the kernel counts it.
fn running_time() -> Duration {
    // clock_gettime(2) fails for an unknown clock or a bad pointer only.
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

/// How late the calling thread wakes from short sleeps: the second latest of a few. The latest may have another cause.
fn try_wake_ups(clock: &dyn TimeSource, parker: &Parker) -> i64 {
    let mut late = [0; TRIALS];
    for late in &mut late {
        let wake_at = clock.now() + TRIAL;
        parker.park_until(clock.duration_of(wake_at));
        *late = clock.now().since(wake_at);
    }
    late.sort_unstable();
    late[TRIALS - 2]
}

/// Why a wait ended.
#[derive(Debug, PartialEq, Eq)]
pub enum Woken {
    /// The instant came. This is the time now.
    Due(Clock),
    /// There is something else to do. This is the time now.
    Called(Clock),
}

/// Waits as the core does.
pub struct Waiter {
    clock: Arc<dyn TimeSource>,
    parker: Arc<Parker>,
    margin: Margin,
    processors: Processors,
    scheduling: Scheduling,
    /// For a thread that runs as SCHED_FIFO under a throttle.
    budget: Option<Budget>,
    /// The last sleep.
    sleep: Option<Sleep>,
}

impl Waiter {
    /// A waiter for the calling thread, which has this `scheduling` and these `processors`. Others wake it by `parker`.
    /// It sleeps a few times, two milliseconds in all, to learn how late it wakes.
    pub fn new(
        clock: Arc<dyn TimeSource>,
        parker: Arc<Parker>,
        limits: MarginLimits,
        scheduling: Scheduling,
        processors: Processors,
    ) -> Waiter {
        let throttle =
            if scheduling == Scheduling::RealTime { Throttle::read(Path::new("/proc/sys/kernel")) } else { None };
        let budget = throttle.map(|throttle| Budget::new(throttle, clock.now(), running_time()));
        let margin = Margin::new(limits, try_wake_ups(&*clock, &parker));
        Waiter { clock, parker, margin, processors, scheduling, budget, sleep: None }
    }

    /// How long before the next exact timer the thread wakes.
    pub fn margin(&self) -> Ticks {
        self.margin.get()
    }

    /// Whether the thread runs as SCHED_FIFO at present.
    pub fn is_realtime(&self) -> bool {
        self.scheduling == Scheduling::RealTime && self.budget.as_ref().is_none_or(Budget::is_fifo)
    }

    /// Whether polling leaves the thread enough running time for due work.
    #[inline]
    pub(crate) fn has_time_to_spare(&self) -> bool {
        self.budget.as_ref().is_none_or(Budget::is_ample)
    }

    /// The thread ran until now. Past its budget it continues on another processor, or as SCHED_OTHER.
    #[inline]
    pub fn ran(&mut self, now: Clock) {
        let Some(budget) = self.budget.as_mut().filter(|budget| budget.is_due(now)) else { return };
        match budget.check(now, running_time()) {
            Some(Class::Other) if self.processors.change() => budget.moved(),
            Some(class) => realtime::change(class),
            None => {}
        }
    }

    /// Sleeps from `now` until `end` or until the thread is unparked, without spinning. Returns the time now.
    pub fn nap(&mut self, now: Clock, end: Clock) -> Clock {
        self.ran(now);
        self.sleep(now, end)
    }

    fn sleep(&mut self, from: Clock, until: Clock) -> Clock {
        self.parker.park_until(self.clock.duration_of(until));
        let to = self.clock.now();
        self.sleep = Some(Sleep { from, to, until });
        to
    }

    /// The last sleep, unless it was taken.
    #[inline]
    pub(crate) fn take_sleep(&mut self) -> Option<Sleep> {
        self.sleep.take()
    }

    /// Waits for `deadline`, or until `called` says that there is something to do. `now` was read a short time ago.
    /// `called` gets the time now. A thread that changes the result of `called` unparks this thread. `exact` is
    /// the deadline or a later one. This thread sleeps until a margin before `exact`, so that it is awake then. From
    /// there on it spins.
    pub fn wait(
        &mut self,
        mut now: Clock,
        deadline: Clock,
        exact: Option<Clock>,
        mut called: impl FnMut(Clock) -> bool,
    ) -> Woken {
        self.margin.approach(exact);
        let mut slept = deadline.since(now) < i64::from(self.margin.floor().0);
        let mut spins = false;
        loop {
            if now >= deadline {
                return Woken::Due(now);
            }
            if called(now) {
                return Woken::Called(now);
            }
            if !spins {
                let wake_at = wake_at(deadline, exact, self.margin.get());
                if wake_at.since(now) > NAP_MIN {
                    slept = true;
                    self.ran(now);
                    now = self.sleep(now, wake_at);
                    let late = now.since(wake_at);
                    // A call woke the thread before its time. That says nothing about the margin.
                    if late >= 0 {
                        self.margin.learn(late);
                    }
                    continue;
                }
                spins = true;
                if !slept {
                    self.margin.unslept();
                }
            }
            hint::spin_loop();
            now = self.clock.now();
        }
    }
}

/// When to end the sleep before `deadline`, for a thread that must be awake a margin before `exact`.
fn wake_at(deadline: Clock, exact: Option<Clock>, margin: Ticks) -> Clock {
    exact.map_or(deadline, |exact| (exact - margin).min(deadline))
}

#[cfg(test)]
mod tests {
    use nix::sched::{CpuSet, sched_getaffinity};
    use nix::unistd::Pid;

    use super::*;
    use pinion_linux::clock::Monotonic;

    #[test]
    fn the_margin_settles_where_one_wake_up_in_fifty_is_later() {
        let mut margin = Margin::new(MarginLimits::default(), 0);
        let mut later = 0;
        // Lateness spread evenly over 0..2000 ticks by a full-period generator.
        let mut random = 1u64;
        for round in 0..200_000 {
            random = random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let late = (random >> 33) as i64 % 2000;
            if round >= 100_000 && late > i64::from(margin.get().0) {
                later += 1;
            }
            margin.learn(late);
        }
        assert!((1_000..4_000).contains(&later), "{later} of 100000 were later");
    }

    #[test]
    fn it_starts_above_the_wake_ups_that_were_tried() {
        let start = |late| Margin::new(MarginLimits::up_to_us(200), late).get();
        assert_eq!(start(4000), Ticks(5000));
        assert_eq!((start(-5), start(10), start(i64::MAX)), (Ticks(225), Ticks(225), Ticks(10_000)));
    }

    #[test]
    fn it_is_lower_before_a_timer_close_to_the_last_one() {
        let limits = MarginLimits::default();
        let mut margin = Margin::new(limits, 0);
        let mut before = |us: u32| {
            margin.approach(Some(Clock::EPOCH + Ticks::from_us(us)));
            margin.get()
        };
        assert_eq!(before(1000), limits.min);
        assert_eq!((before(1010), before(1003)), (limits.close, limits.close));
        assert_eq!(before(1003), limits.close, "it is waited for again");
        assert_eq!((before(1014), before(1014)), (limits.min, limits.min));
        assert_eq!(before(1015), limits.close);
        margin.approach(None);
        assert_eq!(margin.get(), limits.close);
        (0..20).for_each(|_| margin.learn(i64::from(limits.max.0)));
        assert!(margin.get() > limits.close, "late wake-ups still count");
    }

    #[test]
    fn a_margin_that_allows_no_sleep_shrinks() {
        let mut margin = Margin::new(MarginLimits::default(), 4000);
        let start = margin.get();
        for _ in 0..UNSLEPT_MAX {
            margin.unslept();
        }
        assert_eq!(margin.get().0, start.0 - start.0.div_ceil(8));
    }

    #[test]
    fn it_is_awake_early_for_what_is_exact_only() {
        let at = Clock::from_ticks;
        let wake = |deadline, exact: Option<u64>| wake_at(at(deadline), exact.map(at), Ticks(1_000)).ticks();
        assert_eq!(wake(10_000, None), 10_000);
        assert_eq!(wake(10_000, Some(10_000)), 9_000);
        assert_eq!(wake(10_000, Some(10_500)), 9_500);
        assert_eq!(wake(10_000, Some(50_000)), 10_000);
    }

    #[test]
    fn past_its_budget_the_thread_moves_to_another_processor() {
        let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
        let processors = Processors::new(None).unwrap();
        let limits = MarginLimits::default();
        let mut waiter = Waiter::new(clock.clone(), Arc::default(), limits, Scheduling::Ordinary, processors);
        let meagre = Throttle { runtime_us: 100, period_us: 1_000_000 };
        waiter.budget = Some(Budget::new(meagre, clock.now(), running_time()));
        let before = sched_getaffinity(Pid::from_raw(0)).unwrap();
        // A quota of processor time changes nothing here. It only changes the number of threads to use.
        let several = (0..CpuSet::count()).filter(|cpu| before.is_set(*cpu) == Ok(true)).count() > 1;
        let start = running_time();
        while running_time() < start + Duration::from_millis(2) {
            waiter.ran(clock.now());
        }
        assert_eq!(sched_getaffinity(Pid::from_raw(0)) != Ok(before), several);
    }

    #[test]
    fn a_thread_is_in_real_time_while_its_budget_lasts() {
        let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
        let processors = Processors::new(None).unwrap();
        let mut waiter =
            Waiter::new(clock.clone(), Arc::default(), MarginLimits::default(), Scheduling::Ordinary, processors);
        assert!(!waiter.is_realtime());
        waiter.scheduling = Scheduling::RealTime;
        assert!(waiter.is_realtime());
        let meagre = Throttle { runtime_us: 100, period_us: 1_000_000 };
        let mut budget = Budget::new(meagre, clock.now(), Duration::ZERO);
        budget.check(clock.now(), Duration::from_secs(1));
        waiter.budget = Some(budget);
        assert!(!waiter.is_realtime());
    }

    #[test]
    fn a_wait_ends_at_its_instant_or_by_a_call_with_the_time_now() {
        let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
        let processors = Processors::new(None).unwrap();
        let mut waiter =
            Waiter::new(clock.clone(), Arc::default(), MarginLimits::default(), Scheduling::Ordinary, processors);
        let deadline = clock.now() + Ticks::from_ms(1);
        let Woken::Due(now) = waiter.wait(clock.now(), deadline, Some(deadline), |_| false) else {
            panic!("nobody calls")
        };
        assert!(deadline <= now && now <= clock.now());
        let (begin, mut asked) = (clock.now(), Clock::EPOCH);
        let far = begin + Ticks::from_ms(10_000);
        let woken = waiter.wait(begin, far, Some(far), |now| {
            asked = now;
            true
        });
        assert_eq!(woken, Woken::Called(asked));
        assert!(begin <= asked && asked < far);
    }

    #[test]
    fn the_margin_stays_within_its_bounds() {
        let limits = MarginLimits { min: Ticks(50), close: Ticks(30), max: Ticks(500) };
        let mut margin = Margin::new(limits, 100);
        for _ in 0..10_000 {
            margin.learn(1_000_000);
        }
        assert_eq!(margin.get(), limits.max);
        for _ in 0..100_000 {
            margin.learn(0);
        }
        assert_eq!(margin.get(), limits.min);
    }
}
