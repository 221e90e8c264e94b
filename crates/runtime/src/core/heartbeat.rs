// SPDX-License-Identifier: GPL-3.0-or-later
//! The heartbeats, in a page of memory that the program and the guardian share. The page has the core's heartbeat and
//! the guardian's. It also has the pending shutdown values, and each worker's present job.
//!
//! A beat is the instant at which it was given. So a listener knows when silence began, and need not check more often
//! than silence may last. The core sets that limit with each beat. It is about half a second while the MCU runs
//! ([`RUNNING`]), and half a minute otherwise ([`IDLE`]). Otherwise the outputs are at their start or shutdown values.
//! Opening a device or ending a worker may then take its time.
//!
//! At a shutdown, workers write some of the outputs. Until they have done so, these shutdown values are pending
//! ([`Heartbeat::set_pending`]). Beats do not count until then. After [`STOPPING`] the guardian takes over, as it does
//! for a core that hangs.
//!
//! The guardian beats each time it listens. With its monitor (`monitors.rs`) the program notices a guardian that is
//! stopped or hangs.

use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, NS_PER_TICK, TimeSource};
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::Monotonic;
use pinion_linux::sys::{self, SHARED_WORDS};
use pinion_shm::heartbeat::{LastBeat, SharedHeartbeat, WorkerSlot};

/// How long the core may be silent while the MCU runs.
pub(crate) const RUNNING: Duration = Duration::from_millis(550);
/// How long the core may be silent while the MCU is being configured or is shut down.
pub(super) const IDLE: Duration = Duration::from_secs(30);
/// How long a shutdown value may be on its way to an output.
const STOPPING: Duration = Duration::from_secs(1);
/// How often an idle core beats. A beat may be late by the rest of [`RUNNING`].
pub(crate) const BEAT: Duration = Duration::from_millis(300);
/// Shortest standstill after which a running MCU is stopped. The host's limits (max_duration) and the limits of late
/// timers and steps handle shorter ones.
const STANDSTILL: Duration = Duration::from_secs(1);

/// Instants in the page are counted in 2^16 ticks, 1.3 ms: they wrap after 65 days.
const STAMP_SHIFT: u32 = 16;
const STANDSTILL_STAMPS: i32 = (STANDSTILL.as_nanos() / (NS_PER_TICK << STAMP_SHIFT) as u128) as i32;

// The page's words.
/// When the guardian last listened; 0 while it holds no outputs.
const LISTENED_AT: usize = 0;
/// Whether the guardian did not answer.
const UNANSWERED: usize = 1;
/// How long the computer was suspended. The core clears it when it has seen it.
const SUSPENDED_MS: usize = 2;
/// The first word of the core's heartbeat. It has pending shutdown values.
const HEART: usize = 5;
/// The first word of the workers.
const WORKERS: usize = 24;
/// How many words a worker has: the start of its present job (0 without one), and the name of its bus.
const SLOT_WORDS: usize = 8;

/// The core's heartbeat, and the page itself.
#[derive(Clone, Copy)]
pub(crate) struct Heartbeat {
    page: &'static [AtomicU32; SHARED_WORDS],
    pub(super) clock: Monotonic,
}

impl Heartbeat {
    /// Gives a first beat now. `clock` is the core's.
    pub(crate) fn new(clock: Monotonic) -> io::Result<Heartbeat> {
        let heartbeat = Heartbeat { page: sys::shared_words()?, clock };
        heartbeat.beat(clock.now(), false);
        Ok(heartbeat)
    }

    /// The core is alive at `now`. `running`: its MCU is configured and not shut down. Only the core calls this.
    #[inline]
    pub(crate) fn beat(&self, now: Clock, running: bool) {
        let silence_max = if running { RUNNING } else { IDLE };
        self.heart().beat(stamp(now), silence_max.as_millis() as u32);
    }

    fn heart(&self) -> SharedHeartbeat<'static> {
        SharedHeartbeat::new(&self.page[HEART..WORKERS])
    }

    /// Why a running MCU has to be stopped, if it stood still since the last beat. Its control group was frozen, or the
    /// computer was suspended. Its outputs stayed as they were, and nobody knows the state of the parts that they heat
    /// or move. The core asks before each beat.
    #[inline]
    pub(crate) fn standstill(&self, now: Clock) -> Option<Shutdown> {
        let stamps = stamp(now).wrapping_sub(self.heart().own_beat()) as i32;
        let stood_still = stamps >= STANDSTILL_STAMPS;
        let suspended = self.page[SUSPENDED_MS].load(Ordering::Relaxed) != 0;
        if stood_still || suspended { self.explain_standstill(now) } else { None }
    }

    #[cold]
    fn explain_standstill(&self, now: Clock) -> Option<Shutdown> {
        let suspended_ms = self.page[SUSPENDED_MS].swap(0, Ordering::Relaxed);
        let ms = elapsed(self.heart().own_beat(), now).as_millis();
        if self.heart().own_limit_ms() != RUNNING.as_millis() as u32 {
            return None;
        }
        let trouble = match suspended_ms {
            0 => Trouble::new(format!("Pinion stood still for {ms} ms"))
                .remedy("was it stopped, its control group frozen, or the computer paused? Then FIRMWARE_RESTART"),
            _ => Trouble::new(format!("the computer was suspended for {suspended_ms} ms with outputs in use"))
                .remedy("keep it from that (systemctl mask sleep.target), then FIRMWARE_RESTART"),
        };
        Some(Shutdown::because(reason::TIMER_PAST, trouble))
    }

    pub(super) fn publish_suspension(&self, suspended: Duration) {
        self.page[SUSPENDED_MS].store(suspended.as_millis() as u32, Ordering::Relaxed);
    }

    /// From now on the shutdown value of `subject`, such as `pwmchip0/pwm1`, is pending. The first call is a beat at
    /// `now`. So earlier work of the core does not count, such as opening a device for seconds. A further call
    /// replaces the subject, not the time. Only the core calls this.
    pub(crate) fn set_pending(&self, subject: &str, now: Clock) {
        self.heart().set_pending(subject, stamp(now));
    }

    /// Every output is at its shutdown value. This is a beat at `now`. Only the core calls this.
    pub(crate) fn clear_pending(&self, now: Clock) {
        self.heart().clear_pending(stamp(now));
    }

    /// The guardian did not answer the program, and counts as lost.
    pub(crate) fn miss_answer(&self) {
        self.page[UNANSWERED].store(1, Ordering::Relaxed);
    }

    pub(super) fn is_unanswered(&self) -> bool {
        self.page[UNANSWERED].load(Ordering::Relaxed) != 0
    }

    /// The stamp of the guardian's last beat; 0 while it holds no outputs.
    pub(super) fn listened_at(&self) -> u32 {
        self.page[LISTENED_AT].load(Ordering::Relaxed)
    }

    pub(super) fn set_listened_at(&self, stamp: u32) {
        self.page[LISTENED_AT].store(stamp, Ordering::Relaxed);
    }

    /// The present instant of the core's clock.
    pub(crate) fn now(&self) -> Clock {
        self.clock.now()
    }

    /// Converts a time since the kernel's start to an instant of the core's clock.
    pub(crate) fn at(&self, time: Duration) -> Clock {
        let since = time.saturating_sub(self.clock.duration_of(Clock::EPOCH));
        Clock::from_ticks(since.as_nanos() as u64 / NS_PER_TICK)
    }

    /// How long the core may be silent, and the time of its last beat.
    pub(super) fn listen(&self) -> (Duration, u32) {
        let LastBeat { silence_max_ms, beat_at } = self.heart().listen();
        (silence_max_ms.map_or(STOPPING, |ms| Duration::from_millis(ms.into())), beat_at)
    }

    /// Whether the heartbeat is missing at `now`.
    pub(crate) fn is_silent(&self, now: Clock) -> bool {
        let (silence_max, beat_at) = self.listen();
        elapsed(beat_at, now) >= silence_max
    }

    /// For the log: the fault of a program without a heartbeat.
    pub(crate) fn diagnosis(&self) -> String {
        let (silence_max, ms) = (self.heart().listen().silence_max_ms, self.listen().0.as_millis());
        match silence_max {
            Some(_) => format!("the core had no heartbeat for {ms} ms"),
            None => format!(
                "{} is not at its shutdown value within {ms} ms: check its power and wiring, and look at the kernel's log (dmesg)",
                self.heart().subject().get()
            ),
        }
    }

    /// Words for a new worker. `None` if no words are left. Only the core calls this.
    pub(crate) fn worker(&self, bus: &str) -> Option<JobClock> {
        let slot = self.slots().find(|slot| !slot.name().is_set())?;
        slot.name().set(bus);
        Some(JobClock { slot, heartbeat: *self })
    }

    /// The bus of a worker whose present job takes longer than `limit` at `now`.
    pub(crate) fn stuck(&self, now: Clock, limit: Duration) -> Option<String> {
        let is_stuck = |slot: &WorkerSlot| slot.busy_since().is_some_and(|since| elapsed(since, now) > limit);
        self.slots().find(is_stuck).map(|slot| slot.name().get())
    }

    fn slots(&self) -> impl Iterator<Item = WorkerSlot<'static>> {
        self.page[WORKERS..].chunks_exact(SLOT_WORDS).map(WorkerSlot::new)
    }
}

pub(super) fn stamp(now: Clock) -> u32 {
    (now.ticks() >> STAMP_SHIFT) as u32
}

/// The time from a stamp until `now`. Zero if the stamp was set after `now` was read.
pub(super) fn elapsed(since: u32, now: Clock) -> Duration {
    let stamps = (stamp(now).wrapping_sub(since) as i32).max(0);
    Duration::from_nanos(((stamps as u64) << STAMP_SHIFT) * NS_PER_TICK)
}

/// Shows others since when a worker is at its present job.
pub(crate) struct JobClock {
    slot: WorkerSlot<'static>,
    heartbeat: Heartbeat,
}

impl JobClock {
    /// A job begins.
    pub(crate) fn begin(&self) {
        self.slot.begin(stamp(self.heartbeat.now()));
    }

    /// The job ends.
    pub(crate) fn end(&self) {
        self.slot.end();
    }
}

impl Drop for JobClock {
    fn drop(&mut self) {
        self.slot.free();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Clock {
        Clock::from_ticks(ms * u64::from(pinion_firmware::time::CLOCK_FREQ) / 1000)
    }

    fn heartbeat() -> Heartbeat {
        let heartbeat = Heartbeat::new(Monotonic::start()).unwrap();
        heartbeat.beat(at(0), false);
        heartbeat
    }

    #[test]
    fn a_running_mcu_that_stood_still_is_stopped_once() {
        let heartbeat = heartbeat();
        heartbeat.beat(at(0), true);
        assert!(heartbeat.standstill(at(990)).is_none());
        let shutdown = heartbeat.standstill(at(1010)).unwrap();
        assert_eq!(shutdown.reason, reason::TIMER_PAST);
        assert!(shutdown.trouble.cause.contains("stood still for 10"), "{shutdown}");
        heartbeat.beat(at(1010), true);
        assert!(heartbeat.standstill(at(1011)).is_none());
        // An MCU that is being configured may take its time, and reports nothing.
        heartbeat.beat(at(1010), false);
        assert!(heartbeat.standstill(at(9000)).is_none());
    }

    #[test]
    fn workers_come_and_go() {
        let heartbeat = heartbeat();
        let places = (SHARED_WORDS - WORKERS) / SLOT_WORDS;
        for round in 0..2 {
            let workers: Vec<_> = (0..places).map(|n| heartbeat.worker(&format!("spi{n}")).unwrap()).collect();
            assert!(heartbeat.worker("spi").is_none(), "round {round}");
            workers[3].begin();
            let now = heartbeat.now();
            let later = heartbeat.at(pinion_linux::clock::monotonic() + Duration::from_secs(11));
            assert_eq!(heartbeat.stuck(now, Duration::from_secs(10)), None);
            assert_eq!(heartbeat.stuck(later, Duration::from_secs(10)).as_deref(), Some("spi3"));
            workers[3].end();
            assert_eq!(heartbeat.stuck(later, Duration::from_secs(10)), None);
        }
        let long = heartbeat.worker("a bus whose name is longer than is shown").unwrap();
        assert_eq!(long.slot.name().get(), "a bus whose name is longer t");
    }
}
