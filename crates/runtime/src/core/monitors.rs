// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian's monitor of the core's heartbeat, and the program's monitor of the guardian's.

use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

use pinion_firmware::time::{Clock, NS_PER_TICK};
use pinion_linux::clock::monotonic;

use super::heartbeat::{Heartbeat, RUNNING, elapsed, stamp};

/// How long the guardian may be silent while it holds outputs. It beats every [`RUNNING`].
const GUARDIAN: Duration = Duration::from_secs(2);
/// Longest oversleep that counts as listening. After a longer one, only this much of the sleep counts.
const OVERSLEPT: Duration = Duration::from_millis(100);
/// Highest difference that the clocks' resolution may cause.
const SUSPENSION_MIN: Duration = Duration::from_millis(1);

/// How long a heartbeat is missing. Silence counts only while the listener itself was awake. Both processes may
/// stand still together, as in a frozen control group. Then neither one believes that the other hangs.
struct Silence {
    /// The last beat that was heard.
    heard: u32,
    length: Duration,
    checked_at: Clock,
    /// How long the listener meant to sleep after its last check.
    pause: Duration,
}

impl Silence {
    /// No silence so far. The last beat is `beat` at `now`.
    fn new(beat: u32, now: Clock) -> Silence {
        Silence { heard: beat, length: Duration::ZERO, checked_at: now, pause: Duration::ZERO }
    }

    /// Takes in that the last beat is `beat` at `now`. Returns the time until the next check, at most `longest`. `None` if
    /// no beat has come for `silence_max`.
    fn listen(&mut self, beat: u32, now: Clock, silence_max: Duration, longest: Duration) -> Option<Duration> {
        let slept = Duration::from_nanos(now.since(self.checked_at).max(0) as u64 * NS_PER_TICK);
        let listened = if slept > self.pause + OVERSLEPT { OVERSLEPT } else { slept };
        self.length = if beat == self.heard { self.length + listened } else { elapsed(beat, now).min(listened) };
        let left = silence_max.checked_sub(self.length).filter(|left| !left.is_zero())?;
        self.pause = left.min(longest);
        (self.heard, self.checked_at) = (beat, now);
        Some(self.pause)
    }
}

/// The guardian's monitor. It listens to the heartbeat, and beats itself each time. It lives as long as the
/// guardian holds outputs.
pub(crate) struct HeartbeatMonitor {
    heartbeat: Heartbeat,
    silence: Silence,
    suspensions: Suspensions,
}

impl HeartbeatMonitor {
    /// Listens from `now` on.
    pub(crate) fn new(heartbeat: Heartbeat, now: Clock) -> HeartbeatMonitor {
        let (_, beat_at) = heartbeat.listen();
        HeartbeatMonitor { heartbeat, silence: Silence::new(beat_at, now), suspensions: Suspensions::new() }
    }

    /// The time until the next check. `None` if the heartbeat is missing at `now`.
    pub(crate) fn listen(&mut self, now: Clock) -> Option<Duration> {
        self.heartbeat.set_listened_at(stamp(now).max(1));
        if let Some(suspended) = self.suspensions.newest() {
            self.heartbeat.publish_suspension(suspended);
        }
        let (silence_max, beat_at) = self.heartbeat.listen();
        // No longer than the limit of a running MCU: by then the core may have begun to run.
        self.silence.listen(beat_at, now, silence_max, RUNNING)
    }
}

impl Drop for HeartbeatMonitor {
    fn drop(&mut self) {
        self.heartbeat.set_listened_at(0);
    }
}

/// Notices that the computer was suspended. CLOCK_BOOTTIME counts that time. CLOCK_MONOTONIC does not, and everything
/// else here uses it.
struct Suspensions {
    /// How far CLOCK_BOOTTIME is ahead, as measured.
    ahead: Duration,
}

impl Suspensions {
    fn new() -> Suspensions {
        // A process that is kept from running between two readings reads the second clock too late. That makes the
        // difference too large here, and too small below. So neither looks like a suspension.
        let before = monotonic();
        Suspensions { ahead: boottime().saturating_sub(before) }
    }

    /// How long the computer was suspended since the last call.
    fn newest(&mut self) -> Option<Duration> {
        let boottime = boottime();
        self.grown_to(boottime.saturating_sub(monotonic()))
    }

    fn grown_to(&mut self, ahead: Duration) -> Option<Duration> {
        let suspended = ahead.checked_sub(self.ahead).filter(|suspended| *suspended >= SUSPENSION_MIN)?;
        self.ahead = ahead;
        Some(suspended)
    }
}

fn boottime() -> Duration {
    // clock_gettime(2) fails for an unknown clock or a bad pointer only.
    clock_gettime(ClockId::CLOCK_BOOTTIME).map_or(Duration::ZERO, Duration::from)
}

/// The program's monitor. It listens to the guardian's heartbeat while the guardian holds outputs.
pub(crate) struct GuardianMonitor {
    heartbeat: Heartbeat,
    silence: Option<Silence>,
    due: Duration,
}

impl GuardianMonitor {
    pub(crate) fn new(heartbeat: Heartbeat) -> GuardianMonitor {
        GuardianMonitor { heartbeat, silence: None, due: Duration::ZERO }
    }

    /// The time of the next check (CLOCK_MONOTONIC). `None` while the guardian holds nothing.
    pub(crate) fn due(&self) -> Option<Duration> {
        if self.heartbeat.is_unanswered() {
            return Some(Duration::ZERO);
        }
        (self.heartbeat.listened_at() != 0).then_some(self.due)
    }

    /// Whether the guardian is lost at `now`: it did not answer, or has been silent for
    /// [`GUARDIAN`].
    pub(crate) fn is_lost(&mut self, now: Duration) -> bool {
        if self.heartbeat.is_unanswered() {
            return true;
        }
        let beat = self.heartbeat.listened_at();
        if beat == 0 || now < self.due {
            return false;
        }
        let clock = self.heartbeat.at(now);
        let silence = self.silence.get_or_insert_with(|| Silence::new(beat, clock));
        let pause = silence.listen(beat, clock, GUARDIAN, GUARDIAN);
        self.due = now + pause.unwrap_or_default();
        pause.is_none()
    }
}

#[cfg(test)]
mod tests {
    use super::super::heartbeat::{BEAT, IDLE};
    use super::*;
    use pinion_firmware::time::{CLOCK_FREQ, Ticks, TimeSource as _};
    use pinion_linux::clock::Monotonic;

    /// Highest difference that the stamps' resolution may cause.
    const FINE: Duration = Duration::from_millis(2);

    fn at(ms: u64) -> Clock {
        Clock::from_ticks(ms * u64::from(CLOCK_FREQ) / 1000)
    }

    fn heartbeat() -> Heartbeat {
        let heartbeat = Heartbeat::new(Monotonic::start()).unwrap();
        heartbeat.beat(at(0), false);
        heartbeat
    }

    /// After how many milliseconds a punctual listener hears that the heartbeat is missing, and how often it checked_at.
    fn silent_after(monitor: &mut HeartbeatMonitor, from_ms: u64) -> (u64, u32) {
        let (mut ms, mut looks) = (from_ms, 0);
        while let Some(pause) = monitor.listen(at(ms)) {
            ms += pause.as_millis().max(1) as u64;
            looks += 1;
            assert!(looks < 1000);
        }
        (ms - from_ms, looks)
    }

    #[test]
    fn a_core_that_beats_is_not_silent_and_seldom_looked_for() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        let (mut look_ms, mut looks) = (0, 0);
        for ms in 0..60_000 {
            // As late as a core may be.
            if ms % 540 == 0 {
                heartbeat.beat(at(ms), true);
            }
            if ms >= look_ms {
                look_ms =
                    ms + monitor.listen(at(ms)).unwrap_or_else(|| panic!("silent at {ms} ms")).as_millis() as u64 + 1;
                looks += 1;
            }
        }
        assert!(looks < 300, "{looks} looks in a minute");
        for ms in (60_000..120_000).step_by(BEAT.as_millis() as usize) {
            heartbeat.beat(at(ms), true);
            assert!(!heartbeat.is_silent(at(ms + 500)));
        }
    }

    #[test]
    fn a_running_core_is_missed_before_600_ms_are_over() {
        for beat_ms in [0, 1, 150, 299, 549] {
            let heartbeat = heartbeat();
            let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
            heartbeat.beat(at(0), true);
            monitor.listen(at(0)).unwrap();
            heartbeat.beat(at(beat_ms), true);
            let (after, looks) = silent_after(&mut monitor, 550);
            let silence = Duration::from_millis(550 + after - beat_ms);
            assert!(silence + FINE >= RUNNING && silence <= RUNNING + FINE, "{silence:?}");
            assert!(looks <= 3, "{looks} looks");
            assert!(heartbeat.is_silent(at(550 + after) + Ticks::from_ms(2)));
        }
    }

    #[test]
    fn an_mcu_that_begins_to_run_is_watched_closely_at_once() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        let pause = monitor.listen(at(0)).unwrap();
        heartbeat.beat(at(1), true);
        let (after, _) = silent_after(&mut monitor, pause.as_millis() as u64);
        assert!(pause.as_millis() as u64 + after <= 555);
    }

    #[test]
    fn a_core_that_is_configured_may_take_its_time() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        let (after, _) = silent_after(&mut monitor, 0);
        assert!((29_990..30_010).contains(&after), "{after} ms");
        assert_eq!(heartbeat.diagnosis(), "the core had no heartbeat for 30000 ms");
    }

    #[test]
    fn what_the_listener_slept_through_is_no_silence() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        heartbeat.beat(at(0), true);
        monitor.listen(at(0)).unwrap();
        heartbeat.beat(at(290), true);
        monitor.listen(at(550)).unwrap();
        // The computer stood still for a minute, and the core is not awake yet.
        let pause = monitor.listen(at(60_000)).expect("it was not heard");
        assert!(pause >= Duration::from_millis(150), "{pause:?}");
        // A listener that never gets its turn in time still hears a core that hangs.
        let looks = (61..80).take_while(|s| monitor.listen(at(s * 1000)).is_some()).count();
        assert!((1..4).contains(&looks), "{looks}");
    }

    #[test]
    fn a_pending_shutdown_value_stops_the_heartbeat() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        heartbeat.beat(at(0), true);
        monitor.listen(at(0)).unwrap();
        heartbeat.set_pending("spi0", at(0));
        for ms in (0..=900).step_by(100) {
            // The core itself continues.
            heartbeat.beat(at(ms), false);
            assert!(monitor.listen(at(ms)).is_some(), "{ms} ms");
        }
        // The first output has its value, and another has not: the time goes on.
        heartbeat.set_pending("pwmchip10/pwm1", at(950));
        heartbeat.beat(at(1000), false);
        let (after, _) = silent_after(&mut monitor, 901);
        assert!((98..=103).contains(&after), "{after} ms");
        let diagnosis = "pwmchip10/pwm1 is not at its shutdown value within 1000 ms: ";
        assert!(heartbeat.diagnosis().starts_with(diagnosis), "{}", heartbeat.diagnosis());
        // It was only slow.
        heartbeat.clear_pending(at(1010));
        assert!(monitor.listen(at(1010)).is_some());
        assert_eq!(heartbeat.listen().0, IDLE);
    }

    #[test]
    fn work_of_the_core_before_a_value_is_pending_does_not_count() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        // The core fails to open a device, and the MCU stops.
        for ms in (0..4000).step_by(500) {
            assert!(monitor.listen(at(ms)).is_some());
        }
        heartbeat.set_pending("pwmchip0/pwm0", at(4000));
        let (after, _) = silent_after(&mut monitor, 4000);
        assert!((998..=1003).contains(&after), "{after} ms");
    }

    #[test]
    fn a_running_mcu_that_was_suspended_is_stopped_once() {
        let heartbeat = heartbeat();
        let mut monitor = HeartbeatMonitor::new(heartbeat, at(0));
        heartbeat.beat(at(0), true);
        monitor.listen(at(0)).unwrap();
        assert!(heartbeat.standstill(at(1)).is_none(), "this computer was not suspended");
        heartbeat.publish_suspension(Duration::from_secs(60));
        let shutdown = heartbeat.standstill(at(3)).unwrap();
        assert!(shutdown.trouble.cause.contains("suspended for 60000 ms"), "{shutdown}");
        assert!(heartbeat.standstill(at(4)).is_none());
    }

    #[test]
    fn a_suspension_is_what_one_clock_is_ahead_of_the_other() {
        let s = Duration::from_secs;
        let mut suspensions = Suspensions { ahead: s(10) };
        assert_eq!(suspensions.grown_to(s(10)), None);
        // The process did not run between two readings.
        assert_eq!(suspensions.grown_to(s(8)), None);
        assert_eq!(suspensions.grown_to(s(15)), Some(s(5)));
        assert_eq!(suspensions.grown_to(s(15)), None);
    }

    /// A time of CLOCK_MONOTONIC.
    fn time(heartbeat: Heartbeat, ms: u64) -> Duration {
        heartbeat.clock.duration_of(at(ms))
    }

    /// The core's beat and the guardian's look, at each instant of `ms`.
    fn listen_at(monitor: &mut HeartbeatMonitor, ms: impl IntoIterator<Item = u64>) {
        for ms in ms {
            monitor.heartbeat.beat(at(ms), true);
            monitor.listen(at(ms)).unwrap();
        }
    }

    #[test]
    fn a_guardian_that_holds_outputs_is_missed_after_two_seconds() {
        let heartbeat = heartbeat();
        let mut program = GuardianMonitor::new(heartbeat);
        assert_eq!(program.due(), None, "it holds nothing");
        let mut guardian = HeartbeatMonitor::new(heartbeat, at(0));
        listen_at(&mut guardian, [0]);
        let (mut ms, mut looks) = (0, 0);
        // It listens until the tenth second, then it is stopped.
        let lost_at = loop {
            assert!(ms < 20_000, "it is not missed");
            if ms % 500 == 0 && ms <= 10_000 {
                listen_at(&mut guardian, [ms]);
            }
            if program.due().is_some_and(|due| time(heartbeat, ms) >= due) {
                looks += 1;
                if program.is_lost(time(heartbeat, ms)) {
                    break ms;
                }
            }
            ms += 10;
        };
        assert!((12_000..=12_020).contains(&lost_at), "{lost_at} ms");
        assert!(looks < 12, "{looks} looks");
        drop(guardian);
        assert_eq!(program.due(), None);
    }

    #[test]
    fn a_guardian_that_stood_still_together_with_the_program_is_not_missed() {
        let heartbeat = heartbeat();
        let mut program = GuardianMonitor::new(heartbeat);
        let mut guardian = HeartbeatMonitor::new(heartbeat, at(0));
        listen_at(&mut guardian, (0..=5000).step_by(500));
        assert!(!program.is_lost(time(heartbeat, 5100)));
        // Both are frozen for a minute, and the program continues first.
        assert!(!program.is_lost(time(heartbeat, 65_000)));
        assert!(program.due().unwrap() > time(heartbeat, 66_000));
        listen_at(&mut guardian, [65_010]);
        assert!(!program.is_lost(program.due().unwrap()));
    }

    #[test]
    fn a_guardian_that_does_not_answer_is_lost_at_once() {
        let heartbeat = heartbeat();
        let mut program = GuardianMonitor::new(heartbeat);
        heartbeat.miss_answer();
        assert_eq!(program.due(), Some(Duration::ZERO));
        assert!(program.is_lost(time(heartbeat, 1)));
    }
}
