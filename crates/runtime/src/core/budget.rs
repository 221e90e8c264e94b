// SPDX-License-Identifier: GPL-3.0-or-later
//! Keeps the core from being stopped by the kernel's real-time throttle.
//!
//! The kernel lets a SCHED_FIFO thread run for `sched_rt_runtime_us` of each `sched_rt_period_us`. After that it stops
//! the thread until the period is over (Documentation/scheduler/sched-rt-group.rst). By default that is 50 ms in
//! every second, which ends a print. The kernel counts each processor separately. So the core watches its own
//! running time, as the kernel counts it. It moves to another processor before its time on the present one is used up.
//! If there is no other, it runs as SCHED_OTHER for a small part of a busy second. SCHED_OTHER is never throttled.

use std::fs;
use std::path::Path;
use std::time::Duration;

use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks};

/// The core's scheduling class.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Class {
    Fifo,
    Other,
}

/// The SCHED_FIFO running time that the core has left on a processor, kept as a bucket. It fills at a share of real
/// time, and drains while the core runs as SCHED_FIFO. So the core runs for at most that share and one full bucket in
/// any period of the kernel. It does not matter when the period begins.
#[derive(Debug)]
pub(crate) struct Budget {
    class: Class,
    /// The running time left, in 1/1024 ticks.
    level_fine: i64,
    full_fine: i64,
    /// How much the bucket fills in a tick, in 1/1024 ticks.
    share_fine: i64,
    checked: Clock,
    /// The time of the next check.
    due: Clock,
    /// The thread's running time at the last check.
    ran: Duration,
}

/// Shortest time between two checks of the thread's running time. Only the kernel knows it, because it also counts the
/// way into a sleep and out of it. To ask the kernel costs a system call.
const LOOK: Ticks = Ticks::from_ms(1);

/// Fine units of a bucket in a tick.
const FINE: i64 = 1024;

/// The kernel's setting of the throttle, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Throttle {
    pub(crate) runtime_us: u32,
    pub(crate) period_us: u32,
}

impl Throttle {
    /// The throttle in force, as the files in this folder say. `None` if it is off, or if the kernel has none.
    pub(crate) fn read(folder: &Path) -> Option<Throttle> {
        let read = |name| fs::read_to_string(folder.join(name)).ok()?.trim().parse().ok();
        // A runtime of -1 switches the throttle off. It does not parse as a u32, so this returns none.
        let throttle = Throttle { runtime_us: read("sched_rt_runtime_us")?, period_us: read("sched_rt_period_us")? };
        (throttle.runtime_us < throttle.period_us).then_some(throttle)
    }
}

impl Budget {
    /// A full budget for a thread that runs as SCHED_FIFO and has run for `ran` so far. Nine tenths of the kernel's
    /// allowance are the share, and a twentieth is the bucket. The last twentieth is a reserve for time that the kernel
    /// counts and the checks do not see.
    pub(crate) fn new(throttle: Throttle, now: Clock, ran: Duration) -> Budget {
        let allowance = i64::from(throttle.runtime_us) * FINE / i64::from(throttle.period_us.max(1));
        let full_fine = i64::from(throttle.runtime_us) * i64::from(Ticks::from_us(1).0) * FINE / 20;
        Budget {
            class: Class::Fifo,
            level_fine: full_fine,
            full_fine,
            share_fine: allowance * 9 / 10,
            checked: now,
            due: now + LOOK,
            ran,
        }
    }

    /// Whether the thread should run as SCHED_FIFO now.
    pub(crate) fn is_fifo(&self) -> bool {
        self.class == Class::Fifo
    }

    /// Whether more than half of the bucket is left. Then work that is not urgent may use some.
    #[inline]
    pub(crate) fn is_ample(&self) -> bool {
        self.level_fine > self.full_fine / 2
    }

    /// Whether it is time to [`Budget::check`].
    #[inline]
    pub(crate) fn is_due(&self, now: Clock) -> bool {
        now >= self.due
    }

    /// Takes in the thread's total running time, `ran`. Returns the new class if the thread has to change it.
    pub(crate) fn check(&mut self, now: Clock, ran: Duration) -> Option<Class> {
        let span = now.since(self.checked).clamp(0, 1 << 40);
        let spent = ran.saturating_sub(self.ran).as_nanos() as i64 / NS_PER_TICK as i64;
        self.checked = now;
        self.ran = ran;
        let drain = if self.class == Class::Fifo { spent * FINE } else { 0 };
        self.level_fine = (self.level_fine + span * self.share_fine - drain).min(self.full_fine);
        // Running for a tick drains at most a tick. So half of the present level is left then.
        let half = if self.class == Class::Fifo { self.level_fine / FINE / 2 } else { 0 };
        self.due = now + Ticks(half.clamp(i64::from(LOOK.0), i64::from(u32::MAX)) as u32);
        let class = match self.class {
            Class::Fifo if self.level_fine <= 0 => Class::Other,
            Class::Other if self.level_fine >= self.full_fine / 2 => Class::Fifo,
            _ => return None,
        };
        self.class = class;
        Some(class)
    }

    /// The thread has moved to another processor and continues as SCHED_FIFO. The bucket of that processor is full. If
    /// the thread was there before, the bucket has filled again since.
    pub(crate) fn moved(&mut self) {
        self.class = Class::Fifo;
        self.level_fine = self.full_fine;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const THROTTLE: Throttle = Throttle { runtime_us: 950_000, period_us: 1_000_000 };
    const SECOND: u64 = 50_000_000;

    #[test]
    fn only_a_throttle_that_takes_time_away_counts() {
        let folder = tempfile::tempdir().unwrap();
        let read = |runtime_us: &str, period_us: &str| {
            fs::write(folder.path().join("sched_rt_runtime_us"), runtime_us).unwrap();
            fs::write(folder.path().join("sched_rt_period_us"), period_us).unwrap();
            Throttle::read(folder.path())
        };
        assert_eq!(read("950000\n", "1000000\n"), Some(THROTTLE));
        for off in ["-1\n", "1000000\n"] {
            assert_eq!(read(off, "1000000\n"), None, "{off}");
        }
        fs::remove_file(folder.path().join("sched_rt_runtime_us")).unwrap();
        assert_eq!(Throttle::read(folder.path()), None, "a kernel without one");
    }

    /// When a core with these running and sleeping spans runs as SCHED_FIFO, for each processor.
    fn fifo_spans(spans: &[(u64, u64)], seconds: u64, processors: usize) -> Vec<Vec<(u64, u64)>> {
        let mut budget = Budget::new(THROTTLE, Clock::from_ticks(0), Duration::ZERO);
        let (mut now, mut ran, mut class) = (0, 0, Class::Fifo);
        let (mut fifo, mut cpu) = (vec![Vec::new(); processors], 0);
        for (run, sleep) in spans.iter().cycle() {
            if now > seconds * SECOND {
                break;
            }
            // The core checks its budget at least every 100 us while it runs.
            let mut left = *run;
            while left > 0 {
                let slice = left.min(5_000);
                if class == Class::Fifo {
                    match fifo[cpu].last_mut() {
                        Some((_, end)) if *end == now => *end += slice,
                        _ => fifo[cpu].push((now, now + slice)),
                    }
                }
                now += slice;
                ran += slice;
                left -= slice;
                if budget.is_due(Clock::from_ticks(now)) {
                    let ran = Duration::from_nanos(ran * NS_PER_TICK);
                    class = budget.check(Clock::from_ticks(now), ran).unwrap_or(class);
                    if class == Class::Other && processors > 1 {
                        budget.moved();
                        class = Class::Fifo;
                        cpu = (cpu + 1) % processors;
                    }
                }
            }
            now += sleep;
        }
        fifo
    }

    fn used(spans: &[(u64, u64)], from: u64) -> u64 {
        let to = from + SECOND;
        spans.iter().map(|(start, end)| (*end).min(to).saturating_sub((*start).max(from))).sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn no_second_of_any_phase_meets_the_throttle(
            spans in proptest::collection::vec((1u64..30_000_000, 0u64..3_000_000), 1..20),
            processors in 1usize..5,
        ) {
            for fifo in fifo_spans(&spans, 6, processors) {
                for from in (0..5 * SECOND).step_by(SECOND as usize / 20) {
                    prop_assert!(used(&fifo, from) < SECOND * 95 / 100, "from {}", from);
                }
            }
        }
    }

    #[test]
    fn polling_leaves_half_of_it() {
        for works in [0, 300, 600, 800] {
            let mut budget = Budget::new(THROTTLE, Clock::from_ticks(0), Duration::ZERO);
            let (mut polled, mut ran) = (0, 0);
            for ms in 0..10_000 {
                // A part of each millisecond is work. Polling takes the rest, if it may.
                let runs = if budget.is_ample() { 1000 } else { works };
                polled += runs - works;
                ran += runs;
                let change = budget.check(Clock::from_ticks((ms + 1) * 50_000), Duration::from_micros(ran));
                assert_eq!(change, None, "{works} after {ms} ms");
                assert!(budget.level_fine > budget.full_fine / 2 - budget.full_fine / 20);
            }
            // Polling uses all that the share leaves.
            assert!(polled > (840 - works) * 10_000, "{polled} of {works}");
        }
    }

    #[test]
    fn a_core_without_budget_is_ordinary_until_half_of_it_is_back() {
        let mut budget = Budget::new(THROTTLE, Clock::from_ticks(0), Duration::ZERO);
        let mut check = |ms: u64| budget.check(Clock::from_ticks(ms * SECOND / 1000), Duration::from_secs(1));
        assert_eq!(check(1000), Some(Class::Other));
        // The bucket of 47.5 ms filled by 853 us in each of 1000 ms, so 99 ms are missing. It has to be half full.
        let back = (1001..2000).find(|ms| check(*ms) == Some(Class::Fifo));
        assert_eq!(back, Some(1144));
    }

    #[test]
    fn a_core_that_never_sleeps_is_fifo_for_most_of_the_time() {
        let fifo = fifo_spans(&[(SECOND, 0)], 6, 1);
        assert!(used(&fifo[0], 3 * SECOND) > SECOND * 80 / 100);
    }

    #[test]
    fn with_a_second_processor_it_is_fifo_all_the_time() {
        let fifo = fifo_spans(&[(SECOND, 0)], 6, 2);
        assert_eq!(used(&fifo[0], 3 * SECOND) + used(&fifo[1], 3 * SECOND), SECOND);
    }

    #[test]
    fn a_core_that_sleeps_a_quarter_is_never_taken_out() {
        let fifo = fifo_spans(&[(75_000, 25_000)], 6, 1);
        let ran: u64 = fifo[0].iter().map(|(start, end)| end - start).sum();
        assert!(ran >= 6 * SECOND * 74 / 100);
    }
}
