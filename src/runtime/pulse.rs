// SPDX-License-Identifier: GPL-3.0-or-later
//! Signs of life, in a page of memory that program and guardian share: the core's heartbeat, and
//! what each worker is at.
//!
//! A beat is the instant of it, so that a listener knows when silence began and need not look
//! more often than silence may last. How long that is, the core says with each beat: while the
//! machine runs, about half a second ([`RUNNING`]); else half a minute ([`IDLE`]), as opening a
//! device or ending a worker may take its time, and outputs stand at their start or shutdown
//! values then.
//!
//! But they stand there only once the workers have seen to those that are theirs. So the heart
//! stands still while a worker owes the answer to a shutdown value, and if that takes longer
//! than [`STOPPING`], the core counts as one that hangs, whatever else it does meanwhile.

#![forbid(unsafe_code)]

use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use crate::sys::{self, SHARED_WORDS};
use crate::time::{Clock, Monotonic, NS_PER_TICK, TimeSource};

/// How long the core may be silent while the machine runs.
pub(super) const RUNNING: Duration = Duration::from_millis(550);
/// How long the core may be silent while the machine is being configured or is shut down.
const IDLE: Duration = Duration::from_secs(30);
/// How long a worker may take to put a device into its shutdown state.
const STOPPING: Duration = Duration::from_secs(1);
/// A core with nothing to do beats this often: it may be late by what is left of [`RUNNING`].
pub(super) const BEAT: Duration = Duration::from_millis(300);

/// Instants in the page are counted in 2^16 ticks, 1.3 ms: they wrap after 65 days.
const STAMP_SHIFT: u32 = 16;

// The page's words.
const STAMP: usize = 0;
const PATIENCE_MS: usize = 1;
/// Answers that the workers owe, all together.
const OWED: usize = 2;
/// From here on each worker has its words.
const WORKERS: usize = SLOT_WORDS;
/// What a worker owes, since when it is at its present job (0 without one), and its bus's name.
const SLOT_WORDS: usize = 8;
const NAME_BYTES: usize = 4 * (SLOT_WORDS - 2);

/// The core's heartbeat, and the page itself.
#[derive(Clone, Copy)]
pub(super) struct Pulse {
    page: &'static [AtomicU32; SHARED_WORDS],
    clock: Monotonic,
}

impl Pulse {
    /// A heart that beats now. `clock` is the core's.
    pub(super) fn new(clock: Monotonic) -> io::Result<Pulse> {
        let pulse = Pulse { page: sys::shared_words()?, clock };
        pulse.beat(clock.now(), false);
        Ok(pulse)
    }

    /// The core is alive at `now`; `running` is whether its machine is configured and not shut
    /// down. Only the core calls this.
    #[inline]
    pub(super) fn beat(&self, now: Clock, running: bool) {
        if self.page[OWED].load(Ordering::Relaxed) == 0 {
            self.page[STAMP].store(stamp(now), Ordering::Relaxed);
        }
        let patience = if running { RUNNING } else { IDLE };
        // Who sees less patience sees the beat, too.
        self.page[PATIENCE_MS].store(patience.as_millis() as u32, Ordering::Release);
    }

    /// interim
    pub(super) fn owe(&self, _subject: &str, _now: Clock) {}
    /// interim
    pub(super) fn paid(&self) {}

    /// The present instant of the core's clock.
    pub(super) fn now(&self) -> Clock {
        self.clock.now()
    }

    /// The core's instant of a time since the kernel's start.
    pub(super) fn at(&self, time: Duration) -> Clock {
        let since = time.saturating_sub(self.clock.duration_of(Clock::EPOCH));
        Clock::from_ticks(since.as_nanos() as u64 / NS_PER_TICK)
    }

    fn patience(&self) -> Duration {
        if self.page[OWED].load(Ordering::Acquire) != 0 {
            return STOPPING;
        }
        Duration::from_millis(self.page[PATIENCE_MS].load(Ordering::Acquire).into())
    }

    /// Whether the heartbeat is missing at `now`.
    pub(super) fn is_silent(&self, now: Clock) -> bool {
        let patience = self.patience();
        elapsed(self.page[STAMP].load(Ordering::Relaxed), now) >= patience
    }

    /// What is wrong with a program that gave no sign of life, for the log.
    pub(super) fn diagnosis(&self) -> String {
        let owing = self.workers().filter(|worker| worker.owes()).map(|worker| worker.name());
        let owing = owing.collect::<Vec<_>>().join(", ");
        let ms = self.patience().as_millis();
        match owing.is_empty() {
            true => format!("the core gave no sign of life for {ms} ms"),
            false => format!(
                "the worker of {owing} did not set the shutdown state within {ms} ms: does the driver or the chip hang (dmesg)?"
            ),
        }
    }

    /// Words for a new worker; none if there are no more. Only the core calls this.
    pub(super) fn worker(&self, bus: &str) -> Option<JobClock> {
        let slot = self.slots().find(|slot| !slot.is_taken())?;
        slot.set_name(bus);
        Some(JobClock { slot, pulse: *self })
    }

    /// The bus of a worker that has been at one job for longer than `limit` at `now`.
    pub(super) fn stuck(&self, now: Clock, limit: Duration) -> Option<String> {
        self.workers().find(|slot| slot.busy_for(now) > limit).map(|slot| slot.name())
    }

    fn slots(&self) -> impl Iterator<Item = Slot> {
        self.page[WORKERS..].chunks_exact(SLOT_WORDS).map(Slot)
    }

    fn workers(&self) -> impl Iterator<Item = Slot> {
        self.slots().filter(Slot::is_taken)
    }
}

fn stamp(now: Clock) -> u32 {
    (now.ticks() >> STAMP_SHIFT) as u32
}

/// The time from a stamp until `now`; a stamp set meanwhile may lie behind it.
fn elapsed(since: u32, now: Clock) -> Duration {
    let stamps = (stamp(now).wrapping_sub(since) as i32).max(0);
    Duration::from_nanos(((stamps as u64) << STAMP_SHIFT) * NS_PER_TICK)
}

/// A worker's words.
#[derive(Clone, Copy)]
struct Slot(&'static [AtomicU32]);

impl Slot {
    fn owed(&self) -> &'static AtomicU32 {
        &self.0[0]
    }

    fn since(&self) -> &'static AtomicU32 {
        &self.0[1]
    }

    fn owes(&self) -> bool {
        self.owed().load(Ordering::Acquire) != 0
    }

    fn busy_for(&self, now: Clock) -> Duration {
        match self.since().load(Ordering::Relaxed) {
            0 => Duration::ZERO,
            since => elapsed(since, now),
        }
    }

    fn is_taken(&self) -> bool {
        self.0[2].load(Ordering::Acquire) != 0
    }

    /// An empty name frees the slot.
    fn set_name(&self, name: &str) {
        let mut bytes = [0; NAME_BYTES];
        for (to, from) in bytes.iter_mut().zip(name.bytes()) {
            *to = from;
        }
        // The first one last: with it the others are seen.
        for (word, bytes) in self.0[2..].iter().zip(bytes.chunks_exact(4)).rev() {
            let bytes = bytes.iter().rev().fold(0, |word, byte| word << 8 | u32::from(*byte));
            word.store(bytes, Ordering::Release);
        }
    }

    fn name(&self) -> String {
        let bytes = self.0[2..].iter().flat_map(|word| word.load(Ordering::Acquire).to_le_bytes());
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

/// What a worker is at, for others to see.
pub(super) struct JobClock {
    slot: Slot,
    pulse: Pulse,
}

impl JobClock {
    /// A job that puts a device into its shutdown state is on its way to the worker. The first is a
    /// sign of life at `now`: what the core was at until then, such as a device that took seconds to
    /// be opened, is not the worker's. Only the core calls this.
    pub(super) fn owe(&self, now: Clock) {
        if self.pulse.page[OWED].load(Ordering::Relaxed) == 0 {
            self.pulse.page[STAMP].store(stamp(now), Ordering::Relaxed);
        }
        self.slot.owed().fetch_add(1, Ordering::Release);
        self.pulse.page[OWED].fetch_add(1, Ordering::Release);
    }

    /// Such a job is done, or will not come.
    pub(super) fn pay(&self) {
        self.slot.owed().fetch_sub(1, Ordering::Release);
        self.pulse.page[OWED].fetch_sub(1, Ordering::Release);
    }

    /// A job begins.
    pub(super) fn begin(&self) {
        self.slot.since().store(stamp(self.pulse.now()).max(1), Ordering::Relaxed);
    }

    /// It is done.
    pub(super) fn end(&self) {
        self.slot.since().store(0, Ordering::Relaxed);
    }
}

impl Drop for JobClock {
    fn drop(&mut self) {
        self.end();
        while self.slot.owes() {
            self.pay();
        }
        self.slot.set_name("");
    }
}

/// A listener that sleeps longer than it meant to by more than this has heard no more of it.
const OVERSLEPT: Duration = Duration::from_millis(100);

/// Listens to a heartbeat from the second process. Silence counts only as far as the listener
/// itself was awake to hear it: a frozen machine is not taken for a core that hangs.
pub(super) struct Ear {
    pulse: Pulse,
    /// The last beat that was heard.
    heard: u32,
    silence: Duration,
    looked: Clock,
    /// For how long it meant to sleep then.
    pause: Duration,
}

impl Ear {
    /// Listens from `now` on.
    pub(super) fn new(pulse: Pulse, now: Clock) -> Ear {
        let heard = pulse.page[STAMP].load(Ordering::Relaxed);
        Ear { pulse, heard, silence: Duration::ZERO, looked: now, pause: Duration::ZERO }
    }

    /// For how long not to look again; none if the heartbeat is missing at `now`.
    pub(super) fn listen(&mut self, now: Clock) -> Option<Duration> {
        let patience = self.pulse.patience();
        let beat = self.pulse.page[STAMP].load(Ordering::Relaxed);
        let slept = Duration::from_nanos(now.since(self.looked).max(0) as u64 * NS_PER_TICK);
        let listened = if slept > self.pause + OVERSLEPT { OVERSLEPT } else { slept };
        self.silence = if beat == self.heard { self.silence + listened } else { elapsed(beat, now).min(listened) };
        let left = patience.checked_sub(self.silence).filter(|left| !left.is_zero())?;
        // By then the core may ask for less patience.
        self.pause = left.min(RUNNING);
        (self.heard, self.looked) = (beat, now);
        Some(self.pause)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{CLOCK_FREQ, Ticks};

    /// What the stamps' resolution may add or take.
    const FINE: Duration = Duration::from_millis(2);

    fn at(ms: u64) -> Clock {
        Clock::from_ticks(ms * u64::from(CLOCK_FREQ) / 1000)
    }

    fn pulse() -> Pulse {
        let pulse = Pulse::new(Monotonic::start()).unwrap();
        pulse.beat(at(0), false);
        pulse
    }

    /// After how many milliseconds a listener that sleeps as it means to hears that the
    /// heartbeat is missing, and how often it looked.
    fn silent_after(ear: &mut Ear, from_ms: u64) -> (u64, u32) {
        let (mut ms, mut looks) = (from_ms, 0);
        while let Some(pause) = ear.listen(at(ms)) {
            ms += pause.as_millis().max(1) as u64;
            looks += 1;
            assert!(looks < 1000);
        }
        (ms - from_ms, looks)
    }

    #[test]
    fn a_core_that_beats_is_not_silent_and_seldom_looked_for() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        let (mut look_ms, mut looks) = (0, 0);
        for ms in 0..60_000 {
            // As late as a core may be.
            if ms % 540 == 0 {
                pulse.beat(at(ms), true);
            }
            if ms >= look_ms {
                look_ms = ms + ear.listen(at(ms)).unwrap_or_else(|| panic!("silent at {ms} ms")).as_millis() as u64 + 1;
                looks += 1;
            }
        }
        assert!(looks < 300, "{looks} looks in a minute");
        for ms in (60_000..120_000).step_by(BEAT.as_millis() as usize) {
            pulse.beat(at(ms), true);
            assert!(!pulse.is_silent(at(ms + 500)));
        }
    }

    #[test]
    fn a_running_core_is_missed_before_600_ms_are_over() {
        for beat_ms in [0, 1, 150, 299, 549] {
            let pulse = pulse();
            let mut ear = Ear::new(pulse, at(0));
            pulse.beat(at(0), true);
            ear.listen(at(0)).unwrap();
            pulse.beat(at(beat_ms), true);
            let (after, looks) = silent_after(&mut ear, 550);
            let silence = Duration::from_millis(550 + after - beat_ms);
            assert!(silence + FINE >= RUNNING && silence <= RUNNING + FINE, "{silence:?}");
            assert!(looks <= 3, "{looks} looks");
            assert!(pulse.is_silent(at(550 + after) + Ticks::from_us(2000)));
        }
    }

    #[test]
    fn a_machine_that_begins_to_run_is_watched_closely_at_once() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        let pause = ear.listen(at(0)).unwrap();
        pulse.beat(at(1), true);
        let (after, _) = silent_after(&mut ear, pause.as_millis() as u64);
        assert!(pause.as_millis() as u64 + after <= 555);
    }

    #[test]
    fn a_core_that_is_configured_may_take_its_time() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        let (after, _) = silent_after(&mut ear, 0);
        assert!((29_990..30_010).contains(&after), "{after} ms");
        assert_eq!(pulse.diagnosis(), "the core gave no sign of life for 30000 ms");
    }

    #[test]
    fn what_the_listener_slept_through_is_no_silence() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        pulse.beat(at(0), true);
        ear.listen(at(0)).unwrap();
        pulse.beat(at(290), true);
        ear.listen(at(550)).unwrap();
        // The machine stood still for a minute, and the core has yet to be woken.
        let pause = ear.listen(at(60_000)).expect("it was not heard");
        assert!(pause >= Duration::from_millis(150), "{pause:?}");
        // A listener that never gets its turn in time still hears a core that hangs.
        let looks = (61..80).take_while(|s| ear.listen(at(s * 1000)).is_some()).count();
        assert!((1..4).contains(&looks), "{looks}");
    }

    #[test]
    fn a_worker_that_owes_a_shutdown_state_stops_the_heart() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        let (spi, pwm) = (pulse.worker("spi0").unwrap(), pulse.worker("pwmchip10").unwrap());
        pulse.beat(at(0), true);
        ear.listen(at(0)).unwrap();
        spi.owe(at(0));
        pwm.owe(at(0));
        for ms in (0..=900).step_by(100) {
            // The core itself gets on.
            pulse.beat(at(ms), false);
            assert!(ear.listen(at(ms)).is_some(), "{ms} ms");
        }
        spi.pay();
        pulse.beat(at(1000), false);
        let (after, _) = silent_after(&mut ear, 901);
        assert!((98..=103).contains(&after), "{after} ms");
        let diagnosis = pulse.diagnosis();
        assert!(diagnosis.starts_with("the worker of pwmchip10 did not set the shutdown state within 1000 ms:"));
        // It was only slow.
        pwm.pay();
        pulse.beat(at(1010), false);
        assert!(ear.listen(at(1010)).is_some());
    }

    #[test]
    fn what_the_core_was_at_before_a_worker_owed_anything_does_not_count() {
        let pulse = pulse();
        let mut ear = Ear::new(pulse, at(0));
        let pwm = pulse.worker("pwmchip0").unwrap();
        // The core opens a device, in vain, and the machine stops.
        for ms in (0..4000).step_by(500) {
            assert!(ear.listen(at(ms)).is_some());
        }
        pwm.owe(at(4000));
        let (after, _) = silent_after(&mut ear, 4000);
        assert!((998..=1003).contains(&after), "{after} ms");
    }

    #[test]
    fn workers_come_and_go() {
        let pulse = pulse();
        let places = (SHARED_WORDS - WORKERS) / SLOT_WORDS;
        for round in 0..2 {
            let workers: Vec<_> = (0..places).map(|n| pulse.worker(&format!("spi{n}")).unwrap()).collect();
            assert!(pulse.worker("spi").is_none(), "round {round}");
            workers[3].begin();
            let now = pulse.now();
            let later = pulse.at(crate::time::monotonic() + Duration::from_secs(11));
            assert_eq!(pulse.stuck(now, Duration::from_secs(10)), None);
            assert_eq!(pulse.stuck(later, Duration::from_secs(10)).as_deref(), Some("spi3"));
            workers[3].end();
            assert_eq!(pulse.stuck(later, Duration::from_secs(10)), None);
            workers[5].owe(now);
        }
        assert_eq!(pulse.patience(), IDLE);
        let long = pulse.worker("a bus whose name is longer than is shown").unwrap();
        assert_eq!(long.slot.name(), "a bus whose name is long");
    }
}
