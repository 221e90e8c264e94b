// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's time, and the timers that are due by it.

use std::sync::Arc;

use crate::lateness::Lateness;
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, Ticks, TimeSource, Timing};

use super::stats::Stats;
use super::timers::{NEVER, Timers};
use super::{Context, Mcu, Note, OBJECTS_MAX, TimerId, WireClock, base};

/// Longest wait within a timer's event. Nothing else runs in that time, not even a command that stops the MCU.
pub const SPIN_MAX: Ticks = Ticks::from_us(50);
/// How many timers run before the MCU checks the delay and commands get a turn (`TIMER_REPEAT_COUNT` of Klipper's
/// linux/timer.c).
const REPEAT_COUNT: u32 = 20;
/// The same after a turn without a command to run (`TIMER_IDLE_REPEAT_COUNT`).
const IDLE_REPEAT_COUNT: u32 = 100;
/// How many edges may follow each other without a read of the clock. A read takes a tenth of an edge's time.
const UNTIMED_MAX: u32 = 4;
/// The time between two `stats` responses.
const STATS_TICKS: Ticks = Ticks::from_ms(5000);
/// Two timers for each object, three for the MCU, and the running one, which may be started again.
const TIMERS_MAX: usize = 2 * OBJECTS_MAX + 4;

/// The time, and the timers that wait for it.
pub(super) struct Scheduler {
    timing: Timing,
    timers: Timers,
    last_read: Clock,
    /// Untimed edges since then.
    untimed: u32,
    /// Whether some timers were still due after the last run.
    is_behind: bool,
    /// How late the timers were.
    lateness: Lateness,
    /// The latest of them since somebody asked.
    latest: Latest,
    /// How busy the core was.
    stats: Stats,
    /// Whether a line of the configuration is in a bank.
    has_banks: bool,
}

/// A timer that ran late.
#[derive(Clone, Copy, Debug, Default)]
pub struct Latest {
    /// How late it was; zero without one.
    pub late: Ticks,
    /// Its object; `None` for the MCU's own.
    pub oid: Option<u8>,
}

impl Scheduler {
    /// A schedule with only the timer of the next `stats`.
    pub(super) fn new(timing: Timing) -> Scheduler {
        let now = timing.clock.now();
        let mut timers = Timers::with_capacity(TIMERS_MAX);
        timers.insert(now + STATS_TICKS, TimerId::STATS);
        let (lateness, latest, stats) = (Lateness::default(), Latest::default(), Stats::default());
        Scheduler {
            timing,
            timers,
            last_read: now,
            is_behind: false,
            untimed: 0,
            lateness,
            latest,
            stats,
            has_banks: false,
        }
    }

    /// Makes room for all timers that an MCU can have. `has_banks`: a line of the configuration is in a bank.
    pub(super) fn finalize(&mut self, has_banks: bool) {
        self.timers.reserve(TIMERS_MAX);
        self.has_banks = has_banks;
    }

    /// Removes the timers of objects.
    pub(super) fn clear(&mut self) {
        self.timers.clear();
    }

    /// The time now.
    #[inline]
    pub(super) fn now(&mut self) -> Clock {
        self.untimed = 0;
        self.last_read = self.timing.clock.now();
        self.last_read
    }

    /// Call this instead of [`Scheduler::now`] after an edge that begins no timed pulse. It reads the time after every
    /// fourth of them.
    #[inline]
    pub(super) fn made_edge(&mut self) {
        self.untimed += 1;
        if self.untimed >= UNTIMED_MAX {
            self.now();
        }
    }

    /// Takes a time that the caller has just read.
    #[inline]
    pub(super) fn saw(&mut self, now: Clock) {
        self.untimed = 0;
        self.last_read = now;
    }

    /// Spins until `end`, for [`SPIN_MAX`] at most. No other timer or command runs in that time. So use it only for
    /// spans as short as a step's pulse.
    #[inline]
    pub(super) fn spin_until(&mut self, end: Clock) {
        if self.last_read < end {
            self.spin(end);
        }
    }

    #[inline(never)]
    fn spin(&mut self, end: Clock) {
        let limit = self.now() + SPIN_MAX;
        self.timing.clock.spin_until(end.min(limit));
        self.now();
    }

    /// The clock, for pacing on a worker.
    pub(super) fn clock(&self) -> Arc<dyn TimeSource> {
        self.timing.clock.clone()
    }

    /// The last time that was read. While timers run, it is a short time ago.
    #[inline]
    pub(super) fn last_read(&self) -> Clock {
        self.last_read
    }

    /// The time that the host means: the one nearest to now.
    pub(super) fn instant(&mut self, clock: WireClock) -> Clock {
        let now = self.now();
        Clock::widen(clock.0, now)
    }

    /// Starts a timer. It is too close if it is the first of all timers and its time has passed.
    pub(super) fn schedule(&mut self, timer: TimerId, at: Clock, is_stopped: bool) -> Result<(), Shutdown> {
        // As in Klipper's C, a running timer is still the first of the queue.
        let first = self.timers.next();
        self.timers.insert(at, timer);
        if first.is_none_or(|first| at < first) && !is_stopped {
            let late = self.now().since(at);
            if late > 0 {
                return Err(Shutdown::because(
                    reason::TIMER_TOO_CLOSE,
                    format!(
                        "the host asked for an event {} us after its time: the host or this computer is overloaded",
                        late as u64 / u64::from(Ticks::from_us(1).0)
                    ),
                )
                .late_for(at));
            }
        }
        Ok(())
    }

    /// Starts a timer that may be late.
    pub(super) fn start(&mut self, timer: TimerId, at: Clock) {
        self.timers.insert(at, timer);
    }

    /// Stops a timer, if it runs.
    pub(super) fn cancel(&mut self, timer: TimerId) {
        self.timers.remove(timer);
    }

    /// The time of the next timer.
    #[inline]
    pub(super) fn next_timer(&self) -> Option<Clock> {
        self.timers.next()
    }

    /// The timers of the next instant, in their order.
    pub(super) fn of_instant(&self, at: Clock) -> impl Iterator<Item = TimerId> {
        self.timers.of_instant(at)
    }

    /// A command runs: the next timers get a full turn again.
    #[inline]
    pub(super) fn begin_command(&mut self) {
        self.is_behind = false;
    }

    /// How late the timers were.
    pub(super) fn lateness(&self) -> &Lateness {
        &self.lateness
    }

    /// Longest delay of a step before the MCU stops.
    pub(super) fn step_late_limit(&self) -> Ticks {
        self.timing.step_late_limit
    }

    /// Begins to run the next timer, which is this one, and records how late it is.
    #[inline(always)]
    fn begin(&mut self, at: Clock, timer: TimerId) {
        self.timers.run();
        if timer.is_exact() {
            // It is due, so the difference is not negative.
            let late = Ticks((self.last_read.since(at) as u64).min(u32::MAX.into()) as u32);
            self.lateness.count(late);
            // The latest since somebody asked is never later than the latest of all.
            if late > self.latest.late {
                self.lateness.note_longest(late);
                self.latest = Latest { late, oid: timer.oid().number() };
            }
        }
    }
}

impl Mcu {
    /// The time now.
    #[inline]
    pub fn now(&mut self) -> Clock {
        self.state.scheduler.now()
    }

    /// Takes a time that the caller has just read.
    #[inline]
    pub fn saw(&mut self, now: Clock) {
        self.state.scheduler.saw(now);
    }

    /// The last time that was read.
    #[inline]
    pub fn last_read(&self) -> Clock {
        self.state.scheduler.last_read
    }

    /// The time of the next timer.
    #[inline]
    pub fn next_timer(&self) -> Option<Clock> {
        self.state.scheduler.next_timer()
    }

    /// The time of the next exact timer. The core must be awake then.
    #[inline]
    pub fn next_exact_timer(&self) -> Option<Clock> {
        self.state.scheduler.timers.next_exact()
    }

    /// Runs the due timers, up to a limit, so that commands get their turn. True if more timers are due: then one
    /// command gets its turn, if there is one.
    ///
    /// Klipper's C runs 20 timers and checks if they are too late. Then it lets commands run. If there are none, it
    /// runs 100 more timers before the next check. Pinion does the same, because the place of this check decides if the
    /// MCU stops. A batch counts as one timer.
    pub fn run_timers(&mut self) -> bool {
        for _ in 0..if self.state.scheduler.is_behind { IDLE_REPEAT_COUNT } else { REPEAT_COUNT } {
            let scheduler = &mut self.state.scheduler;
            let due = scheduler.timers.due(scheduler.last_read);
            let Some((at, timer)) = due.or_else(|| {
                let now = scheduler.now();
                scheduler.timers.due(now)
            }) else {
                scheduler.timing.due.set(None);
                scheduler.is_behind = false;
                return false;
            };
            // Almost all timers are alone.
            if scheduler.has_banks && scheduler.timers.has_several_next() {
                self.run_batch(at);
            } else {
                self.run_timer(at, timer);
            }
        }
        self.state.scheduler.timing.due.set(None);
        let next = self.state.scheduler.timers.next();
        let late = next.map_or(0, |at| self.now().since(at));
        if let Some(next) = next.filter(|_| late > i64::from(self.state.scheduler.timing.late_limit.0))
            && !self.state.phase.is_stopped()
        {
            let cause = format!(
                "events are {} ms late: the host asks for more steps than this computer can make, or something kept Pinion from running",
                late as u64 / u64::from(Ticks::from_ms(1).0)
            );
            let stop = Shutdown::because(reason::TIMER_PAST, cause).late_for(next);
            self.shut_down(stop.remedy("run Pinion in real time (-r, as the service does), or move more slowly"));
        }
        self.state.scheduler.is_behind =
            self.state.scheduler.timers.next().is_some_and(|at| at <= self.state.scheduler.last_read);
        self.state.scheduler.is_behind
    }

    /// Runs the next timer, which is this one.
    #[inline(always)]
    pub(super) fn run_timer(&mut self, at: Clock, timer: TimerId) {
        self.state.scheduler.begin(at, timer);
        let oid = timer.oid();
        let Some(mut object) = self.state.objects.take(oid) else { return self.run_own_timer(timer, at) };
        self.state.scheduler.timing.due.set(Some(at));
        match object.run_event(&mut Context::new(&mut self.state, oid), timer.timer(), at) {
            Ok(next) => {
                self.state.objects.put_back(oid, object);
                match next {
                    NEVER => self.state.scheduler.timers.pop(),
                    next => self.state.scheduler.timers.repeat(next, timer),
                }
            }
            Err(stop) => {
                self.state.scheduler.timing.due.set(None);
                self.state.scheduler.timers.pop();
                let stop = self.state.blame(stop, object.kind(), oid);
                self.state.objects.put_back(oid, object);
                self.shut_down(stop);
            }
        }
    }

    #[cold]
    fn run_own_timer(&mut self, timer: TimerId, at: Clock) {
        self.state.scheduler.timing.due.set(Some(at));
        match timer {
            TimerId::RETRY => self.state.retry(),
            TimerId::HOLD => self.held_too_long(),
            TimerId::STATS => self.send_stats(at),
            // The timer of an object that is gone.
            _ => {}
        }
        self.state.scheduler.timers.pop();
    }

    /// Counts a span in which the core was busy.
    #[inline]
    pub fn account(&mut self, busy: Ticks) {
        self.state.scheduler.stats.add(busy);
    }

    /// The latest timer with a margin since [`Mcu::forget_latest`].
    #[inline]
    pub fn latest(&self) -> Latest {
        self.state.scheduler.latest
    }

    /// Looks for the latest timer anew.
    pub fn forget_latest(&mut self) {
        self.state.scheduler.latest = Latest::default();
    }

    /// Reports in the log how late timers were. `margin` is how long before a timer the core wakes.
    pub fn report_lateness(&mut self, margin: Ticks) {
        self.state.wire.note(Note::Lateness(&self.state.scheduler.lateness, margin));
    }

    fn send_stats(&mut self, at: Clock) {
        let Stats { count, sum, sumsq } = std::mem::take(&mut self.state.scheduler.stats);
        // klippy divides by the count. It is 0 if the MCU stood still since the last `stats`.
        let count = count.max(1);
        self.state.wire.send(base::Stats { count, sum, sumsq });
        // After a suspend, the MCU sends no `stats` for the time of the suspend.
        let next = at + STATS_TICKS;
        self.state.scheduler.start(TimerId::STATS, next.max(self.state.scheduler.last_read));
    }
}
