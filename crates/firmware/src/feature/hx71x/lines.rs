// SPDX-License-Identifier: GPL-3.0-or-later
//! An HX711 or HX717 on two GPIO lines. A worker makes each pulse of the clock.
//!
//! The worker may be interrupted while the clock is high. So on a line that is written through registers, a second worker
//! watches the pulses of a reading, on another processor. It lowers the clock if a pulse lasts for 5 us. Then only both
//! being late at once makes a long pulse. The first worker begins a pulse when the second one watches it
//! (`pinion_shm::watch`). The clock may be low for any time, and may be lowered twice.
//!
//! A pulse cannot be cut short: the second worker itself has seen the clock high for 5 us before it lowers it.

use std::sync::Arc;

use pinion_shm::watch::Watch;

use crate::board::{Line, Pin};
use crate::feature::pace::between_ticks;
use crate::mcu::{Context, DeviceWarning, Job};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks, TimeSource};

use super::{SUBJECT, Shifted};

/// Shortest time that the clock is high, and low: 200 ns (T3 and T4 of the data sheet).
const PULSE_NS: u32 = 200;
/// Longest time that the clock may be high before the chip switches itself off: 60 us.
const POWER_DOWN_NS: u32 = 60_000;
/// How long the second worker sees the clock high before it lowers it. A pulse without an interruption takes less than
/// a microsecond.
const PULSE_MAX: Ticks = Ticks::from_us(5);
/// How long a reading takes at most, unless a worker is interrupted.
const READING: Ticks = Ticks::from_us(100);
/// How long the two workers wait for each other before a reading. Then the first one reads alone.
const MEETING: Ticks = Ticks::from_ms(1);
/// How long they wait for each other during a reading. Then the reading fails.
const ABSENCE_MAX: Ticks = Ticks::from_ms(5);

/// Shifts out a sample.
pub(super) struct Shift {
    sclk: Arc<dyn Line>,
    dout: Arc<dyn Line>,
    /// Pulses of the sample, and for gain and channel.
    pulses: u8,
    time: Arc<dyn TimeSource>,
    watch: Option<Arc<Watch>>,
    /// The pulse that was announced to the second worker last.
    announced: u32,
    /// The clock line's name in the log.
    name: String,
    /// Whether there was a warning about a clock that was high for too long.
    has_warned: bool,
    /// A warning for the log.
    pub(super) warning: Option<DeviceWarning>,
}

impl Shift {
    pub(super) fn new(
        context: &Context,
        sclk_pin: Pin,
        sclk: Arc<dyn Line>,
        dout: Arc<dyn Line>,
        pulses: u8,
        watcher: Option<&Watcher>,
    ) -> Shift {
        let watch = watcher.map(|watcher| watcher.watch.clone());
        Shift {
            sclk,
            dout,
            pulses,
            time: context.clock(),
            watch,
            announced: 0,
            name: context.name(sclk_pin),
            has_warned: false,
            warning: None,
        }
    }

    /// Sets the clock line while no sample is shifted out.
    pub(super) fn power_down(&self, down: bool) -> Result<(), Shutdown> {
        self.sclk.write(down)
    }

    pub(super) fn run(&mut self) -> Result<Shifted, Shutdown> {
        let begin = between_ticks(&*self.time, READING);
        self.time.spin_until(begin);
        let shifted = match self.watch.clone() {
            Some(watch) => {
                let is_watched = self.announce(&watch, MEETING).is_some();
                if !is_watched {
                    watch.close();
                }
                let shifted = self.shift(is_watched.then_some(&watch));
                watch.close();
                shifted
            }
            None => self.shift(None),
        };
        let (raw, longest) = shifted?;
        let Some(longest) = longest else { return Ok(Shifted { raw, too_long: true }) };
        let too_long = longest > i64::from(self.time.at_most(POWER_DOWN_NS).0);
        if too_long && !self.has_warned {
            self.has_warned = true;
            self.warning = Some(DeviceWarning::new(SUBJECT, too_slow(&self.name, longest)));
        }
        Ok(Shifted { raw, too_long })
    }

    /// The bits, and the longest time in ticks that the clock may have been high. `None`: the second worker did not answer
    /// within [`ABSENCE_MAX`], and pulses are missing.
    fn shift(&mut self, watch: Option<&Watch>) -> Result<(u32, Option<i64>), Shutdown> {
        let mut raw = 0;
        let mut longest = 0;
        for _ in 0..self.pulses {
            let rises = self.time.now();
            self.sclk.write(true)?;
            self.wait();
            self.sclk.write(false)?;
            let mut high = self.time.now().since(rises);
            raw = raw << 1 | u32::from(self.dout.read()?);
            self.wait();
            if let Some(watch) = watch {
                match self.announce(watch, ABSENCE_MAX) {
                    Some(known) => high = high.min(known.into()),
                    None => return Ok((raw, None)),
                }
            }
            longest = high.max(longest);
        }
        Ok((raw, Some(longest)))
    }

    /// Waits for the rest of a pulse.
    fn wait(&self) {
        self.time.spin_until(self.time.now() + self.time.at_least(PULSE_NS));
    }

    /// Announces the next pulse to the second worker. Returns when it watches this pulse, and for how many ticks the clock
    /// may have been high during the one before, as the second worker knows. `None` after `limit`.
    fn announce(&mut self, watch: &Watch, limit: Ticks) -> Option<u32> {
        self.announced = self.announced.wrapping_add(1).max(1);
        watch.announce(self.announced);
        let end = self.time.now() + limit;
        loop {
            let known = watch.known_before(self.announced);
            if known.is_some() || self.time.now() >= end {
                return known;
            }
            std::hint::spin_loop();
        }
    }
}

/// For the log: the clock was high for too long, up to this many ticks.
fn too_slow(name: &str, ticks: i64) -> String {
    let us = ticks / i64::from(Ticks::from_us(1).0);
    format!(
        "HX71x sclk ({name}): the clock was high for up to {us} us, and from 60 us on the chip switches itself off: this computer is too slow or too busy for it: run Pinion with -r, or connect it to an SPI controller (docs/guide/pins.md); said once"
    )
}

/// Watches the pulses of one reading, on the second worker.
pub(super) struct Watcher {
    sclk: Arc<dyn Line>,
    time: Arc<dyn TimeSource>,
    watch: Arc<Watch>,
}

impl Watcher {
    pub(super) fn new(context: &Context, sclk: Arc<dyn Line>) -> Watcher {
        Watcher { sclk, time: context.clock(), watch: Arc::default() }
    }
}

/// Lets the watcher watch a reading.
pub(super) struct WatchReading;

impl Job for WatchReading {
    type Device = Watcher;
    type Out = ();
    type Failure = Shutdown;

    fn run(&mut self, watcher: &mut Watcher) -> Result<(), Shutdown> {
        watcher.run()
    }
}

impl Watcher {
    fn run(&mut self) -> Result<(), Shutdown> {
        // The watched pulse, and the time from which it is watched.
        let (mut pulse, mut since) = (0, self.time.now());
        // The clock was low then, and the longest time that it may have been high during this pulse.
        let (mut low_at, mut longest) = (since, 0);
        let mut high_at: Option<Clock> = None;
        loop {
            let announced = self.watch.announced();
            let now = self.time.now();
            if announced != pulse {
                if announced == 0 {
                    return Ok(());
                }
                // The pulse before is over, and the clock is low.
                longest = now.since(low_at).max(longest);
                self.watch.begin(announced, longest as u32);
                (pulse, since, low_at, longest, high_at) = (announced, now, now, 0, None);
            }
            let is_over = |limit: Ticks| now.since(since) > i64::from(limit.0);
            if pulse == 0 {
                if is_over(MEETING) {
                    return Ok(());
                }
                std::hint::spin_loop();
            } else if !self.sclk.read()? {
                // Not while the clock is high: this worker may have been interrupted, too.
                if is_over(ABSENCE_MAX) {
                    return Ok(());
                }
                longest = self.time.now().since(low_at).max(longest);
                (low_at, high_at) = (now, None);
            } else if let Some(seen_at) = high_at {
                if now.since(seen_at) >= i64::from(PULSE_MAX.0) {
                    self.sclk.write(false)?;
                    let low = self.time.now();
                    longest = low.since(low_at).max(longest);
                    (low_at, high_at) = (low, None);
                }
            } else {
                high_at = Some(self.time.now());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Direction;
    use crate::time::NS_PER_TICK;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
    use std::thread;
    use std::time::{Duration, Instant};

    /// A clock that is slower than the computer's. So other programs disturb the workers less.
    struct Slow {
        began: Instant,
        factor: u32,
        /// Longest step between two reads. While none of the workers runs, no time passes.
        step_max: Duration,
        /// The computer's time at the last read, and this clock's.
        last: Mutex<(Duration, Duration)>,
    }

    impl TimeSource for Slow {
        fn now(&self) -> Clock {
            let (before, now) = &mut *self.last.lock().unwrap();
            let elapsed = self.began.elapsed() / self.factor;
            *now += elapsed.saturating_sub(*before).min(self.step_max);
            *before = elapsed.max(*before);
            Clock::EPOCH + Ticks(now.as_nanos() as u32 / NS_PER_TICK as u32)
        }

        fn instant_of(&self, _: Duration) -> Clock {
            self.now()
        }

        fn duration_of(&self, _: Clock) -> Duration {
            Duration::ZERO
        }
    }

    /// A chip whose sample is [`SAMPLE`], at both ends of its lines.
    #[derive(Default)]
    struct Chip {
        is_high: AtomicBool,
        pulses: AtomicU32,
        /// During this pulse the thread that made the clock high does not go on before the clock is low.
        interrupted: Option<u32>,
        /// How often the clock was made low while it was high.
        falls: AtomicU32,
        /// How long the first read of the clock line takes, if it is high.
        first_read: Mutex<Duration>,
    }

    const SAMPLE: u32 = 0x12_3457;
    /// A sample, and one pulse for gain and channel.
    const PULSES: u8 = 25;
    /// A test that hangs would say nothing.
    const TEST_MAX: Duration = Duration::from_secs(120);

    struct Wire {
        chip: Arc<Chip>,
        is_clock: bool,
    }

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let Chip { is_high, pulses, interrupted, falls, .. } = &*self.chip;
            let was_high = is_high.swap(level, Ordering::SeqCst);
            if !level {
                falls.fetch_add(was_high.into(), Ordering::SeqCst);
                return Ok(());
            }
            if *interrupted == Some(pulses.fetch_add(1, Ordering::SeqCst)) {
                let began = Instant::now();
                while is_high.load(Ordering::SeqCst) {
                    assert!(began.elapsed() < TEST_MAX, "nobody lowers the clock");
                    thread::yield_now();
                }
            }
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            let pulses = self.chip.pulses.load(Ordering::SeqCst);
            if self.is_clock && self.chip.is_high.load(Ordering::SeqCst) {
                thread::sleep(std::mem::take(&mut *self.chip.first_read.lock().unwrap()));
            }
            Ok(if self.is_clock { self.chip.is_high.load(Ordering::SeqCst) } else { SAMPLE >> (25 - pulses) & 1 != 0 })
        }

        fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    fn workers(interrupted: Option<u32>, slower: u32) -> (Shift, Watcher, Arc<Chip>) {
        let chip = Arc::new(Chip { interrupted, ..Chip::default() });
        let line = |is_clock| Arc::new(Wire { chip: chip.clone(), is_clock });
        let step_max = if slower > 1 { Duration::from_micros(1) } else { Duration::MAX };
        let time: Arc<dyn TimeSource> =
            Arc::new(Slow { began: Instant::now(), factor: slower, step_max, last: Mutex::default() });
        let watcher = Watcher { sclk: line(true), time: time.clone(), watch: Arc::default() };
        let shift = Shift {
            sclk: line(true),
            dout: line(false),
            pulses: PULSES,
            time,
            watch: Some(watcher.watch.clone()),
            announced: u32::MAX - 5,
            name: "gpio11".into(),
            has_warned: false,
            warning: None,
        };
        (shift, watcher, chip)
    }

    #[test]
    fn the_second_worker_lowers_the_clock_if_the_first_is_interrupted() {
        for interrupted in [0, 7, 24] {
            let (mut shift, mut watcher, chip) = workers(Some(interrupted), 10_000);
            let shifted = thread::scope(|scope| {
                scope.spawn(move || watcher.run().unwrap());
                shift.run().unwrap()
            });
            assert_eq!((shifted.raw, shifted.too_long), (SAMPLE, false), "pulse {interrupted}");
            assert_eq!(chip.pulses.load(Ordering::SeqCst), u32::from(PULSES));
            assert_eq!(chip.falls.load(Ordering::SeqCst), u32::from(PULSES), "it is ended once");
        }
    }

    /// A clock with steps of 2 ms.
    #[derive(Default)]
    struct Coarse {
        /// Until when a worker waited.
        waited: AtomicU64,
    }

    impl TimeSource for Coarse {
        fn now(&self) -> Clock {
            Clock::EPOCH
        }

        fn instant_of(&self, _: Duration) -> Clock {
            Clock::EPOCH
        }

        fn duration_of(&self, _: Clock) -> Duration {
            Duration::ZERO
        }

        fn spin_until(&self, end: Clock) {
            self.waited.store(end.since(Clock::EPOCH) as u64, Ordering::SeqCst);
        }

        fn step_ns(&self) -> u32 {
            2_000_000
        }
    }

    #[test]
    fn a_pulse_is_surely_long_enough_on_a_coarse_clock() {
        let (mut shift, ..) = workers(None, 1);
        let clock = Arc::new(Coarse::default());
        shift.time = clock.clone();
        shift.wait();
        let waited_ns = clock.waited.load(Ordering::SeqCst) * NS_PER_TICK;
        assert!(waited_ns >= 2_000_200, "200 ns may be none on this clock: {waited_ns}");
    }

    #[test]
    fn a_worker_without_a_second_one_reads_alone() {
        let (mut shift, watcher, chip) = workers(None, 100);
        let shifted = shift.run().unwrap();
        assert_eq!((shifted.raw, shifted.too_long), (SAMPLE, false));
        assert_eq!(chip.falls.load(Ordering::SeqCst), u32::from(PULSES));
        assert_eq!(watcher.watch.announced(), 0, "a second worker that comes now watches nothing");
    }

    #[test]
    fn a_second_worker_without_a_reading_ends() {
        let (_, mut watcher, chip) = workers(None, 100);
        chip.is_high.store(true, Ordering::SeqCst);
        watcher.run().unwrap();
        assert!(chip.is_high.load(Ordering::SeqCst), "the chip is to be off");
    }

    #[test]
    fn a_second_worker_that_was_itself_away_lowers_the_clock_before_it_ends() {
        let (_, mut watcher, chip) = workers(None, 1);
        chip.is_high.store(true, Ordering::SeqCst);
        *chip.first_read.lock().unwrap() = Duration::from_millis(10);
        watcher.watch.announce(1);
        watcher.run().unwrap();
        assert_eq!(chip.falls.load(Ordering::SeqCst), 1);
    }

    /// The other half of the pulses would come unwatched, and a late store of the second worker might cut one short.
    #[test]
    fn a_reading_whose_second_worker_stays_away_fails() {
        let (mut shift, watcher, chip) = workers(None, 100);
        let watch = watcher.watch.clone();
        let shifted = thread::scope(|scope| {
            scope.spawn(move || {
                let mut pulse = 0;
                while chip.pulses.load(Ordering::SeqCst) < 3 {
                    let announced = watch.announced();
                    if announced != pulse {
                        pulse = announced;
                        watch.begin(pulse, 0);
                    }
                }
                (chip, watch)
            });
            shift.run().unwrap()
        });
        assert!(shifted.too_long);
        assert_eq!(watcher.watch.announced(), 0);
    }

    #[test]
    fn the_log_says_which_clock_line_was_too_slow_and_for_how_long() {
        let line = too_slow("gpio11", i64::from(Ticks::from_us(75).0));
        assert!(line.contains("(gpio11)") && line.contains("up to 75 us") && line.contains("-r"), "{line}");
    }
}
