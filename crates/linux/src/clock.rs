// SPDX-License-Identifier: GPL-3.0-or-later
//! The kernel's clock.

#![forbid(unsafe_code)]

use std::collections::BTreeSet;
use std::io;
use std::mem;
use std::sync::{Arc, OnceLock};
use std::thread::{self, Thread};
use std::time::Duration;

use nix::poll::PollTimeout;
use nix::time::{ClockId, clock_getres, clock_gettime};

use pinion_firmware::time::{CLOCK_FREQ, Clock, NS_PER_TICK, TimeSource};

/// CLOCK_MONOTONIC in ticks. Tick 0 is at a whole second, so that the lateness of an edge can be measured from outside.
#[derive(Clone, Copy, Debug)]
pub struct Monotonic {
    origin_s: u64,
}

impl Monotonic {
    /// A clock with tick 0 at the whole second before this call.
    ///
    /// (Klipper's own program takes the next second, so its clock starts near 2^32. The host accepts both.)
    pub fn start() -> Monotonic {
        Monotonic { origin_s: monotonic().as_secs() }
    }

    /// The clock for an MCU. Its functions are where this is made, in this crate's part of the program (`build.rs`).
    pub fn shared(self) -> Arc<dyn TimeSource> {
        Arc::new(self)
    }

    #[inline]
    fn at(&self, s: u64, ns: u32) -> Clock {
        let s = s.saturating_sub(self.origin_s);
        Clock::from_ticks(s * u64::from(CLOCK_FREQ) + u64::from(ns) / NS_PER_TICK)
    }
}

impl TimeSource for Monotonic {
    fn now(&self) -> Clock {
        // Without a [`Duration`] in between, which would have to be checked.
        let now = clock_gettime(ClockId::CLOCK_MONOTONIC);
        now.map_or(Clock::EPOCH, |now| self.at(now.tv_sec() as u64, now.tv_nsec() as u32))
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.at(monotonic.as_secs(), monotonic.subsec_nanos())
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        Duration::from_secs(self.origin_s) + Duration::from_nanos(clock.ticks() * NS_PER_TICK)
    }

    fn step_ns(&self) -> u32 {
        static STEP_NS: OnceLock<u32> = OnceLock::new();
        *STEP_NS.get_or_init(|| step_of((0..10_000).map(|_| monotonic().as_nanos() as u64)))
    }

    fn tick_after(&self, at: Clock) -> Option<Clock> {
        let Some(tick) = TICK.get() else {
            if let Some(watcher) = TICK_WATCHER.get() {
                watcher.unpark();
            }
            return None;
        };
        Some(self.instant_of(tick.after(self.duration_of(at))))
    }
}

/// The kernel's tick, when [`watch_tick`] has found it.
static TICK: OnceLock<KernelTick> = OnceLock::new();

/// The thread that finds it.
static TICK_WATCHER: OnceLock<Thread> = OnceLock::new();

/// Starts the thread that finds the kernel's tick. It sleeps until [`TimeSource::tick_after`] asks for the first time:
/// most printers have nothing that asks, and watching some ten ticks takes 30 to 40 ms of a processor.
///
/// # Errors
///
/// The kernel's refusal of a thread.
pub fn watch_tick() -> io::Result<thread::JoinHandle<()>> {
    let watcher = thread::Builder::new().name("tick".into()).spawn(|| {
        thread::park();
        if let Some(tick) = KernelTick::measure() {
            let _ = TICK.set(tick);
        }
    })?;
    let _ = TICK_WATCHER.set(watcher.thread().clone());
    Ok(watcher)
}

/// The step of a clock that was read at once after each reading. All spans between readings are multiples of the step,
/// rounded to nanoseconds. So the smallest difference of two spans is the step, or a multiple if all readings took
/// equally long.
fn step_of(mut readings_ns: impl Iterator<Item = u64>) -> u32 {
    /// An interruption takes longer.
    const LONGEST_NS: u64 = 10_000;
    let mut last = readings_ns.next().unwrap_or_default();
    let mut spans = BTreeSet::from([0]);
    spans.extend(readings_ns.map(|at| at - mem::replace(&mut last, at)).filter(|span| *span < LONGEST_NS));
    // A multiple is rounded to one of two values. Three in a row are those of a step below that.
    let is_fine = spans.iter().any(|span| *span > 0 && spans.contains(&(span + 1)) && spans.contains(&(span + 2)));
    let gaps = spans.iter().zip(spans.iter().skip(1)).map(|(from, to)| to - from).filter(|gap| *gap > 1);
    match gaps.min() {
        _ if is_fine => 2,
        // Both ends may be rounded.
        Some(gap) => gap as u32 + 2,
        None => LONGEST_NS as u32,
    }
}

/// CLOCK_MONOTONIC as the time since the kernel's start.
pub fn monotonic() -> Duration {
    // clock_gettime(2) fails only for an unknown clock or a bad pointer.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(Duration::ZERO, Duration::from)
}

/// The kernel's tick. It comes to all processors at once, at equal distances on CLOCK_MONOTONIC (`TICK_NSEC`, 4 ms at 250
/// Hz), unless the kernel was started with `skew_tick=1`. A processor that sleeps leaves ticks out.
#[derive(Clone, Copy, Debug)]
struct KernelTick {
    /// One of them, since the kernel's start.
    at_ns: u64,
    every_ns: u64,
}

impl KernelTick {
    /// How many ticks must have been seen, and how many are watched for that.
    const SEEN: usize = 7;
    const WATCHED: usize = 50;
    /// How long a tick may interrupt the watching thread. A longer pause had another cause.
    const LONGEST: Duration = Duration::from_micros(100);

    /// Watches ticks. A tick sets CLOCK_MONOTONIC_COARSE, whose resolution is the time between two ticks.
    fn measure() -> Option<KernelTick> {
        let coarse = ClockId::CLOCK_MONOTONIC_COARSE;
        let every_ns = clock_getres(coarse).map_or(0, |every| Duration::from(every).as_nanos() as u64);
        if every_ns == 0 {
            return None;
        }
        let mut seen_ns = Vec::new();
        for _ in 0..KernelTick::WATCHED {
            let first = clock_gettime(coarse).ok()?;
            let mut last = monotonic();
            // The time after which it came, and by which it had come.
            let (after, by) = loop {
                let has_come = clock_gettime(coarse).ok()? != first;
                let now = monotonic();
                if has_come {
                    break (last, now);
                }
                last = now;
            };
            if by - after <= KernelTick::LONGEST {
                seen_ns.push(after.as_nanos() as u64);
            }
            if let Ok(seen_ns) = <[u64; KernelTick::SEEN]>::try_from(&*seen_ns) {
                return KernelTick::of(seen_ns, every_ns);
            }
        }
        None
    }

    /// The tick that began at these times. Another processor may see it later, and one read may have been too early.
    /// `None` if they are not times of one tick.
    fn of(mut seen_ns: [u64; KernelTick::SEEN], every_ns: u64) -> Option<KernelTick> {
        let after = |from: u64, to: u64| (to % every_ns + every_ns - from % every_ns) % every_ns;
        // From the earliest one on, all come soon.
        let spread = |from: u64| seen_ns.iter().map(|to| after(from, *to)).max().unwrap_or_default();
        let earliest = seen_ns.into_iter().min_by_key(|from| spread(*from))?;
        let is_regular = spread(earliest) < every_ns / 4;
        seen_ns.sort_by_key(|seen| after(earliest, *seen));
        is_regular.then_some(KernelTick { at_ns: seen_ns[1], every_ns })
    }

    /// The first tick after this time.
    fn after(&self, time: Duration) -> Duration {
        let phase_ns = self.at_ns % self.every_ns;
        let since_ns = (time.as_nanos() as u64 + self.every_ns).saturating_sub(phase_ns);
        Duration::from_nanos(phase_ns + since_ns / self.every_ns * self.every_ns)
    }
}

/// Checks every millisecond whether something is done, until `deadline` (CLOCK_MONOTONIC). Returns whether it is done.
pub fn wait_until(deadline: Duration, mut is_done: impl FnMut() -> bool) -> bool {
    loop {
        if is_done() {
            return true;
        }
        if monotonic() >= deadline {
            return false;
        }
        thread::sleep(Duration::from_millis(1));
    }
}

/// A timeout for poll(2), rounded up to whole milliseconds. Without an end if it is longer than poll(2) can wait.
pub fn poll_timeout(timeout: Duration) -> PollTimeout {
    let ms = timeout.as_nanos().div_ceil(1_000_000);
    PollTimeout::try_from(ms).unwrap_or(PollTimeout::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::Ticks;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_tick_begins_when_it_was_seen_first_but_once() {
        let tick = |seen_us: [u64; KernelTick::SEEN]| {
            KernelTick::of(seen_us.map(|us| 1000 * us), 4 * MS).map(|tick| tick.at_ns / 1000 % 4000)
        };
        assert_eq!(tick([3998, 7999, 12_040, 15_998, 19_999, 24_024, 27_999]), Some(3998));
        // The third check was too early.
        assert_eq!(tick([3998, 7999, 11_925, 15_997, 19_999, 24_024, 27_999]), Some(3997));
        assert_eq!(tick([40, 7998, 11_999, 16_000, 20_001, 24_000, 27_998]), Some(3998));
        assert_eq!(tick([1000, 6500, 8000, 13_700, 16_000, 20_000, 24_000]), None);
    }

    #[test]
    fn ticks_come_at_equal_distances() {
        let tick = KernelTick { at_ns: 9_998_000, every_ns: 4 * MS };
        let after = |ns| tick.after(Duration::from_nanos(ns)).as_nanos();
        assert_eq!([after(9_998_000), after(13_997_999), after(13_998_000)], [13_998_000, 13_998_000, 17_998_000]);
        assert_eq!([after(0), after(1_998_000), after(5_997_999)], [1_998_000, 5_998_000, 5_998_000]);
    }

    #[test]
    fn the_kernel_s_next_tick_is_soon() {
        let clock = Monotonic::start();
        let watcher = watch_tick().unwrap();
        assert_eq!(clock.tick_after(clock.now()), None);
        watcher.join().unwrap();
        let Some(at) = clock.tick_after(clock.now()) else {
            return println!("NOT RUN: this computer is too busy to see ticks");
        };
        let every = i64::from((TICK.get().unwrap().every_ns / NS_PER_TICK) as u32);
        assert!((i64::from(CLOCK_FREQ / 2000)..=i64::from(CLOCK_FREQ / 50)).contains(&every), "{every}");
        let next = clock.tick_after(at + Ticks(1)).unwrap();
        assert!((next.since(at) - every).abs() <= 1, "{at:?} {next:?}");
        let now = clock.now();
        assert!((1..=every + 1).contains(&clock.tick_after(now).unwrap().since(now)));
    }

    /// The measurement of a clock of this frequency, if readings take these times.
    fn shown(hz: u64, takes_ns: &[u64]) -> impl Iterator<Item = u64> {
        let takes_ns: Vec<u64> = (0..100).flat_map(|_| takes_ns.to_vec()).collect();
        let mut at_ns = 0;
        takes_ns.into_iter().map(move |takes| {
            at_ns += takes;
            let cycles = u128::from(at_ns) * u128::from(hz) / 1_000_000_000;
            (cycles * 1_000_000_000 / u128::from(hz)) as u64
        })
    }

    #[test]
    fn the_step_of_a_clock_is_measured() {
        // A Raspberry Pi 2 or 3, whatever a reading takes.
        for takes_ns in [&[70][..], &[40], &[70, 71, 90, 4000], &[230, 240, 90_000]] {
            let step = step_of(shown(19_200_000, takes_ns));
            assert!((53..=55).contains(&step), "{takes_ns:?}: {step}");
        }
        // A Raspberry Pi 4 or 5.
        let step = step_of(shown(54_000_000, &[40, 45, 60]));
        assert!((19..=21).contains(&step), "{step}");
        // A PC's TSC, and one of its slow timers.
        assert_eq!(step_of(shown(3_000_000_000, &[20, 21, 22, 23, 30])), 2);
        let step = step_of(shown(3_579_545, &[1100, 1300]));
        assert!((280..=283).contains(&step), "{step}");
        assert_eq!(step_of([5; 1000].into_iter()), 10_000, "it stands still");
        assert_eq!(step_of([].into_iter()), 10_000);
        assert!(Monotonic::start().step_ns() >= 2);
    }

    #[test]
    fn a_wait_ends_when_it_is_done_or_at_its_deadline() {
        let mut looks = 0;
        let third = || {
            looks += 1;
            looks == 3
        };
        assert!(wait_until(monotonic() + Duration::from_secs(60), third));
        assert_eq!(looks, 3);
        let deadline = monotonic() + Duration::from_millis(3);
        assert!(!wait_until(deadline, || false) && monotonic() >= deadline);
    }

    #[test]
    fn tick_zero_is_a_whole_second() {
        let before = monotonic();
        let clock = Monotonic::start();
        assert_eq!(clock.duration_of(Clock::EPOCH).subsec_nanos(), 0);
        let now = Duration::from_nanos(clock.now().ticks() * NS_PER_TICK);
        // Less than a second when the clock was started, and what a busy computer took since then.
        assert!(now < Duration::from_secs(1) + (monotonic() - before), "{now:?}");
    }

    #[test]
    fn an_instant_of_the_kernel_s_clock_is_one_of_ours() {
        let clock = Monotonic::start();
        for ticks in [0, 1, 49_999_999, 50_000_000, 1 << 40] {
            let instant = Clock::from_ticks(ticks);
            assert_eq!(clock.instant_of(clock.duration_of(instant)), instant);
        }
    }
}
