// SPDX-License-Identifier: GPL-3.0-or-later
//! How the core waits: it sleeps until a learned margin before the instant, then it spins.
//!
//! The margin covers nearly every wake-up, if that is worth its price. Each microsecond of margin makes the wake-ups that
//! come later than the margin a microsecond less late, and it makes the core spin a microsecond longer at all others. So
//! there are two curves by margin: the time spent and the lateness saved. On a quiet computer wake-ups are nearly equally
//! late, and a margin above all of them is cheap. On a busy one a few wake-ups are far later than the others, and to
//! cover those the core would spin before most edges. So the margin ends where the curves meet: spinning takes at most as
//! much time as it saves lateness. Timers that are close together have a smaller margin.

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
    /// Covers all wake-ups but one in [`LATE_SHARE`].
    covering: Fine,
    /// The margin at which spinning takes as much time as it saves lateness.
    worthwhile: Fine,
    /// Waits since the last wake-up that were too short to sleep.
    unslept: u32,
    /// The last exact timer.
    last_exact: Clock,
    /// It was close to the one before it.
    is_close: bool,
}

/// A margin in 1/256 ticks.
type Fine = i64;

/// Exact timers at most this far apart are close together.
const CLOSE: i64 = Ticks::from_us(10).0 as i64;
/// After this many waits that were too short to sleep, a smaller margin is tried.
const UNSLEPT_MAX: u32 = 500;
/// Longest wait without a sleep. A shorter sleep is late by the time that going into it and out of it takes. It saves
/// nothing, and would make the margin grow.
const NAP_MIN: i64 = Ticks::from_us(1).0 as i64;
/// If it is worthwhile, only one wake-up in this many comes after the instant.
const LATE_SHARE: i64 = 50;
/// How many wake-ups count for the worthwhile margin, approximately. It follows a load as quickly as the covering one.
const BALANCED: i64 = 32;
/// How many sleeps are tried at the start, and how long each is.
const TRIALS: usize = 16;
const TRIAL: Ticks = Ticks::from_us(100);
const FINE: i64 = 256;

impl Margin {
    /// A margin that covers a wake-up that comes `late` after its time, and a quarter more. It learns the rest from
    /// late edges.
    pub fn new(limits: MarginLimits, late: i64) -> Margin {
        let start = late.clamp(0, i64::from(u32::MAX)) * FINE * 5 / 4;
        let mut margin =
            Margin { limits, covering: 0, worthwhile: 0, unslept: 0, last_exact: Clock::EPOCH, is_close: false };
        margin.displace(start, start);
        margin
    }

    /// How long before an instant to wake. Before a close timer, it is three quarters of what was learned: to spin for
    /// each costs more than one of them that comes a little later.
    pub fn get(&self) -> Ticks {
        let learned = (self.covering.min(self.worthwhile) / FINE) as u32;
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

    /// Learns from a wake-up that came `late` after its time.
    ///
    /// If the covering margin did not cover it, that margin grows by a step. Otherwise it shrinks by a fiftieth of a
    /// step. The two balance where one wake-up in fifty is later.
    ///
    /// With the worthwhile margin the core would have spun for the rest of the margin, or not at all. The margin would
    /// have saved the whole lateness, or as much as the margin. It grows by the difference between what it saved and the
    /// spinning. The two balance where they are equal on average.
    pub fn learn(&mut self, late: i64) {
        // Steps are in proportion to the margin: quick to follow a load, fine without one.
        let step = (self.covering / FINE).max(64) * FINE / 24;
        let late = late.saturating_mul(FINE);
        let covering = if late > self.covering { step } else { -step / LATE_SHARE };
        let saved = late.min(self.worthwhile);
        let spun = self.worthwhile - saved;
        self.displace(covering, (saved - spun) / BALANCED);
    }

    /// A wait was too short to sleep, so nothing was learned. Otherwise a margin above the step interval would stay
    /// there, and the core would never sleep.
    fn unslept(&mut self) {
        self.unslept += 1;
        if self.unslept >= UNSLEPT_MAX {
            self.displace(-self.covering / 8, -self.worthwhile / 8);
        }
    }

    fn displace(&mut self, covering: Fine, worthwhile: Fine) {
        self.unslept = 0;
        let bound =
            |margin: Fine| margin.clamp(i64::from(self.limits.close.0) * FINE, i64::from(self.limits.max.0) * FINE);
        (self.covering, self.worthwhile) = (bound(self.covering + covering), bound(self.worthwhile + worthwhile));
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
pub enum WakeReason {
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
    ) -> WakeReason {
        self.margin.approach(exact);
        let mut slept = deadline.since(now) < i64::from(self.margin.floor().0);
        let mut spins = false;
        loop {
            if now >= deadline {
                return WakeReason::Due(now);
            }
            if called(now) {
                return WakeReason::Called(now);
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
    use proptest::prelude::*;

    use super::*;
    use pinion_linux::clock::Monotonic;

    /// Numbers below `below`, spread evenly by a full-period generator.
    struct Spread(u64);

    impl Spread {
        fn below(&mut self, below: i64) -> i64 {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.0 >> 33) as i64 % below
        }
    }

    /// The result of many wake-ups with a margin that has settled, in ticks.
    struct Settled {
        /// The sum of the time that the core spun.
        spun: i64,
        /// The sum of the lateness that edges do not have, thanks to the margin.
        saved: i64,
        /// The share of wake-ups that were later than the margin.
        later: f64,
        /// The mean of the margin.
        margin: i64,
    }

    fn settle(limits: MarginLimits, mut late: impl FnMut() -> i64) -> Settled {
        const ROUNDS: i64 = 20_000;
        let mut margin = Margin::new(limits, 0);
        (0..ROUNDS).for_each(|_| margin.learn(late()));
        let (mut spun, mut saved, mut later, mut sum) = (0, 0, 0, 0);
        for _ in 0..ROUNDS {
            let (late, present) = (late(), i64::from(margin.get().0));
            spun += (present - late).max(0);
            saved += late.min(present);
            later += i64::from(late > present);
            sum += present;
            margin.learn(late);
        }
        Settled { spun, saved, later: later as f64 / ROUNDS as f64, margin: sum / ROUNDS }
    }

    /// A computer on which one wake-up in `one_in` is up to `longer` ticks later than the others.
    fn busy(one_in: i64, longer: i64) -> impl FnMut() -> i64 {
        let mut spread = Spread(1);
        move || 600 + if spread.below(one_in) == 0 { spread.below(longer) } else { spread.below(50) }
    }

    #[test]
    fn on_a_quiet_computer_one_wake_up_in_fifty_is_later() {
        let mut spread = Spread(1);
        let settled = settle(MarginLimits::default(), || 1000 + spread.below(900));
        assert!((0.01..0.04).contains(&settled.later), "{} were later", settled.later);
    }

    #[test]
    fn on_a_busy_computer_spinning_takes_what_it_saves() {
        let Settled { spun, saved, later, margin } = settle(MarginLimits::default(), busy(10, 5000));
        assert!((0.9..1.05).contains(&(spun as f64 / saved as f64)), "{spun} for {saved}");
        assert!(later > 0.06 && margin < 1500, "a margin of {margin}");
        // Later wake-ups alone do not make the core spin longer.
        let farther = settle(MarginLimits::default(), busy(10, 50_000));
        assert!((margin - 100..margin + 100).contains(&farther.margin), "{margin} and {}", farther.margin);
    }

    #[test]
    fn it_follows_a_load_that_begins_and_ends() {
        let mut margin = Margin::new(MarginLimits::default(), 0);
        let mut wake_ups_until = |late: i64, is_enough: &dyn Fn(u32) -> bool| {
            let count = (0..100_000).find(|_| {
                margin.learn(late);
                is_enough(margin.get().0)
            });
            count.expect("an end")
        };
        let up = wake_ups_until(4000, &|margin| margin > 4000);
        let down = wake_ups_until(500, &|margin| margin < 1100);
        assert!(up < 200 && down < 200, "{up} up, {down} down");
    }

    proptest! {
        /// Whatever a computer's wake-ups are like: the margin covers all but one in fifty, or covering more of them
        /// would cost more than it saves. And it never costs more than it saves.
        #[test]
        fn the_margin_is_as_large_as_it_is_worth(
            levels in prop::collection::vec((0i64..8000, 1u8..10), 1..6), seed: u64
        ) {
            let limits = MarginLimits::default();
            let all: Vec<i64> =
                levels.iter().flat_map(|(late, weight)| std::iter::repeat_n(*late, (*weight).into())).collect();
            let mut spread = Spread(seed);
            let settled = settle(limits, || all[spread.below(all.len() as i64) as usize]);
            let price = settled.spun as f64 / settled.saved.max(1) as f64;
            let is_least = settled.margin <= i64::from(limits.min.0) + 1;
            prop_assert!(price < 1.15 || is_least, "{} for {}", settled.spun, settled.saved);
            prop_assert!(settled.later < 0.05 || price > 0.6 || is_least, "{} later, {price}", settled.later);
        }
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
        // Also if the worthwhile margin is the lower one.
        let mut late = busy(10, 9000);
        (0..1000).for_each(|_| margin.learn(late()));
        let before = (margin.covering, margin.worthwhile);
        assert!(before.1 < before.0);
        for _ in 0..UNSLEPT_MAX {
            margin.unslept();
        }
        assert_eq!((margin.covering, margin.worthwhile), (before.0 - before.0 / 8, before.1 - before.1 / 8));
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
        let WakeReason::Due(now) = waiter.wait(clock.now(), deadline, Some(deadline), |_| false) else {
            panic!("nobody calls")
        };
        assert!(deadline <= now && now <= clock.now());
        let (begin, mut asked) = (clock.now(), Clock::EPOCH);
        let far = begin + Ticks::from_ms(10_000);
        let woken = waiter.wait(begin, far, Some(far), |now| {
            asked = now;
            true
        });
        assert_eq!(woken, WakeReason::Called(asked));
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
