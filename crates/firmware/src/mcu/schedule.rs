// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's time, and the timers that are due by it.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::lateness::Lateness;
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, Ticks, TimeSource, Timing};

use super::stats::Stats;
use super::timers::Timers;
use super::{Mcu, Next, Note, OBJECTS_MAX, Oid, TimerId, Turn, WireClock, base};

/// Longest wait within a timer's event. Nothing else runs meanwhile, not even a command that stops the MCU.
pub const SPIN_MAX: Ticks = Ticks::from_us(50);
/// How many timers run before the MCU checks the delay and commands get a turn (`TIMER_REPEAT_COUNT` of the firmware's
/// linux/timer.c).
const REPEAT_COUNT: u32 = 20;
/// The same after a turn without a command to run (`TIMER_IDLE_REPEAT_COUNT`).
const IDLE_REPEAT_COUNT: u32 = 100;
/// How many edges may follow each other without a look at the clock. A look takes a tenth of an edge's time.
const UNTIMED_MAX: u32 = 4;
/// The time between two `stats` responses.
const STATS_TICKS: Ticks = Ticks::from_ms(5000);
/// Two timers for each object and three for the MCU.
const TIMERS_MAX: usize = 2 * OBJECTS_MAX + 3;

/// The time, and the timers that wait for it.
pub(super) struct Schedule {
    timing: Timing,
    pub(super) timers: Timers,
    pub(super) last_read: Clock,
    /// Untimed edges since then.
    untimed: u32,
    /// Whether some timers were still due after the last run.
    pub(super) is_behind: bool,
    /// How late the timers were.
    pub(super) lateness: Lateness,
    /// The latest of them since somebody asked.
    latest: Latest,
    /// How busy the core was.
    stats: Stats,
    /// Whether a line of the configuration is in a bank.
    pub(super) has_banks: bool,
}

/// A timer that ran late.
#[derive(Clone, Copy, Debug, Default)]
pub struct Latest {
    /// How late it was; zero without one.
    pub late: Ticks,
    /// Its object; `None` for the MCU's own.
    pub oid: Option<u8>,
}

impl Schedule {
    /// A schedule with only the timer of the next `stats`.
    pub(super) fn new(timing: Timing) -> Schedule {
        let now = timing.clock.now();
        let mut timers = Timers::with_capacity(TIMERS_MAX);
        timers.insert(now + STATS_TICKS, TimerId::STATS);
        let (lateness, latest, stats) = (Lateness::default(), Latest::default(), Stats::default());
        Schedule {
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

    /// Makes room for all timers that an MCU can have.
    pub(super) fn reserve(&mut self) {
        self.timers.reserve(TIMERS_MAX);
    }
}

impl Mcu {
    /// The time now.
    #[inline]
    pub fn now(&mut self) -> Clock {
        self.schedule.untimed = 0;
        self.schedule.last_read = self.schedule.timing.clock.now();
        self.schedule.last_read
    }

    /// Call this instead of [`Mcu::now`] after an edge that begins no timed pulse. It reads the time after every fourth
    /// of them.
    #[inline]
    pub fn made_edge(&mut self) {
        self.schedule.untimed += 1;
        if self.schedule.untimed >= UNTIMED_MAX {
            self.now();
        }
    }

    /// Takes a time that the caller has just read.
    #[inline]
    pub fn saw(&mut self, now: Clock) {
        self.schedule.untimed = 0;
        self.schedule.last_read = now;
    }

    /// Spins until `end`, for [`SPIN_MAX`] at most. No other timer or command runs meanwhile. So use it only for spans
    /// as short as a step's pulse.
    #[inline]
    pub fn spin_until(&mut self, end: Clock) {
        if self.schedule.last_read < end {
            self.spin(end);
        }
    }

    #[inline(never)]
    fn spin(&mut self, end: Clock) {
        let limit = self.now() + SPIN_MAX;
        self.schedule.timing.clock.spin_until(end.min(limit));
        self.now();
    }

    /// The clock, for pacing on a worker.
    pub fn clock(&self) -> Arc<dyn TimeSource> {
        self.schedule.timing.clock.clone()
    }

    /// The last time that was read. While timers run, it is a short time ago.
    #[inline]
    pub fn last_read(&self) -> Clock {
        self.schedule.last_read
    }

    /// The time that the host means: the one nearest to now.
    pub fn instant(&mut self, clock: WireClock) -> Clock {
        let now = self.now();
        Clock::widen(clock.0, now)
    }

    /// Starts a timer. It is too close if it is the first of all timers and its time has passed.
    pub(super) fn schedule(&mut self, timer: TimerId, at: Clock) -> Result<(), Shutdown> {
        // In the firmware, the running timer is still the first of the queue.
        let first = self.schedule.timing.due.get().or(self.schedule.timers.next());
        self.schedule.timers.insert(at, timer);
        if first.is_none_or(|first| at < first) && self.stop.reason.is_none() {
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

    /// Starts a timer for an activity of the MCU's own. It may be late: that is not the host's fault.
    pub(super) fn go_on(&mut self, timer: TimerId, at: Clock) {
        self.schedule.timers.insert(at, timer);
    }

    /// Stops a timer, if it runs.
    pub(super) fn cancel(&mut self, timer: TimerId) {
        self.schedule.timers.remove(timer);
    }

    /// The time of the next timer.
    #[inline]
    pub fn next_timer(&self) -> Option<Clock> {
        self.schedule.timers.next()
    }

    /// The time of the next exact timer. The core must be awake then.
    #[inline]
    pub fn next_exact_timer(&self) -> Option<Clock> {
        self.schedule.timers.next_exact()
    }

    /// Runs the due timers, up to a limit, so that commands get their turn. True if more timers are due: then one
    /// command gets its turn, if there is one.
    ///
    /// The firmware runs 20 timers and checks if they are too late. Then it lets commands run. If there are none, it
    /// runs 100 more timers before the next check. Pinion does the same, because the place of this check decides if the
    /// MCU stops. A batch counts as one timer.
    pub fn run_timers(&mut self) -> bool {
        for _ in 0..if self.schedule.is_behind { IDLE_REPEAT_COUNT } else { REPEAT_COUNT } {
            if self.schedule.timers.next().is_none_or(|at| at > self.schedule.last_read && at > self.now()) {
                self.schedule.is_behind = false;
                return false;
            }
            // Almost all timers are alone.
            if self.schedule.has_banks && self.schedule.timers.has_several_next() {
                self.run_batch();
            } else {
                self.run_timer();
            }
        }
        let next = self.schedule.timers.next();
        let late = next.map_or(0, |at| self.now().since(at));
        if let Some(next) = next.filter(|_| late > i64::from(self.schedule.timing.late_limit.0))
            && self.stop.reason.is_none()
        {
            let cause = format!(
                "events are {} ms late: more steps are asked for than this computer can do, or something kept it from running",
                late as u64 / u64::from(Ticks::from_ms(1).0)
            );
            let stop = Shutdown::because(reason::TIMER_PAST, cause).late_for(next);
            self.shut_down(stop.remedy("run Pinion in real time (-r, as the service does), or move more slowly"));
        }
        self.schedule.is_behind = self.schedule.timers.next().is_some_and(|at| at <= self.schedule.last_read);
        self.schedule.is_behind
    }

    #[inline(always)]
    pub(super) fn run_timer(&mut self) {
        let Some((at, timer)) = self.schedule.timers.pop() else { return };
        if timer.is_exact() {
            let late = self.schedule.last_read.since(at);
            self.schedule.lateness.record(late);
            if late > i64::from(self.schedule.latest.late.0) {
                let late = Ticks(u32::try_from(late).unwrap_or(u32::MAX));
                let oid = timer.oid().and_then(Oid::number);
                self.schedule.latest = Latest { late, oid };
            }
        }
        let Some(oid) = timer.oid() else { return self.run_own_timer(timer, at) };
        let Some(mut object) = self.take(oid) else { return };
        self.schedule.timing.due.set(Some(at));
        let result = object.event(&mut Turn::new(self, oid), timer.timer(), at);
        self.schedule.timing.due.set(None);
        match result {
            Ok(next) => {
                self.put_back(oid, object);
                if let Next::At(at) = next {
                    self.schedule.timers.insert(at, timer);
                }
            }
            Err(stop) => {
                let stop = self.blame(stop, object.kind(), oid);
                self.put_back(oid, object);
                self.shut_down(stop);
            }
        }
    }

    #[cold]
    fn run_own_timer(&mut self, timer: TimerId, at: Clock) {
        self.schedule.timing.due.set(Some(at));
        match timer {
            TimerId::RETRY => self.retry(),
            TimerId::HOLD => self.held_too_long(),
            _ => self.send_stats(at),
        }
        self.schedule.timing.due.set(None);
    }

    /// Counts a span in which the core was busy.
    #[inline]
    pub fn account(&mut self, busy: Ticks) {
        self.schedule.stats.add(busy);
    }

    /// The latest timer with a margin since [`Mcu::forget_latest`].
    #[inline]
    pub fn latest(&self) -> Latest {
        self.schedule.latest
    }

    /// Looks for the latest timer anew.
    pub fn forget_latest(&mut self) {
        self.schedule.latest = Latest::default();
    }

    /// Reports in the log how late timers were. `margin` is how long before a timer the core wakes.
    pub fn report_lateness(&mut self, margin: Ticks) {
        self.outbox.note(Note::Lateness(&self.schedule.lateness, margin));
    }

    fn send_stats(&mut self, at: Clock) {
        let Stats { count, sum, sumsq } = std::mem::take(&mut self.schedule.stats);
        // klippy divides by the count. It is 0 if the MCU stood still since the last `stats`.
        let count = count.max(1);
        self.send(base::Stats { count, sum, sumsq });
        // After a suspend, the MCU sends no `stats` for the time of the suspend.
        let next = at + STATS_TICKS;
        self.go_on(TimerId::STATS, next.max(self.schedule.last_read));
    }

    /// Longest delay of a step before the MCU stops.
    pub fn step_late_limit(&self) -> Ticks {
        self.schedule.timing.step_late_limit
    }
}
