// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's time.

#![forbid(unsafe_code)]

use std::cell::Cell;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

/// Seconds from `earlier` to `later`; none if they are the other way round.
pub fn seconds(earlier: Clock, later: Clock) -> f64 {
    later.since(earlier).max(0) as f64 / f64::from(CLOCK_FREQ)
}

/// A simulated motor follows at any pace: a computer without real time, as most that try the printer, is
/// late by milliseconds now and then.
pub(crate) const STEP_LATE_LIMIT: Ticks = Ticks::from_us(100_000);

thread_local! {
    /// The instant for which what this thread does now was due, if it was due at one.
    static DUE: Cell<Option<Clock>> = const { Cell::new(None) };
}

/// The printer's time: the machine's clock, but while the core runs a timer the instant for which
/// that timer was set, and while a worker runs an errand the instant that this waited for.
///
/// So an edge happens when it was due, and not as late as the computer is: most computers that try
/// the printer are without real time, and its parts would hear rubbish of whatever is timed by
/// microseconds (the bits of a UART, the pulses of a servo, the steps that make an axis ring).
pub(crate) struct PrinterTime {
    clock: Arc<dyn TimeSource>,
}

impl PrinterTime {
    pub(crate) fn new(clock: Arc<dyn TimeSource>) -> PrinterTime {
        PrinterTime { clock }
    }

    /// What this thread does from now on was due at this instant; none: it is no timer.
    pub(crate) fn set_due(&self, due: Option<Clock>) {
        DUE.set(due);
    }

    /// The instant of what this thread does with a line.
    pub(crate) fn of_the_caller(&self) -> Clock {
        DUE.get().unwrap_or_else(|| self.clock.now())
    }
}

impl TimeSource for PrinterTime {
    fn now(&self) -> Clock {
        self.clock.now()
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.clock.instant_of(monotonic)
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        self.clock.duration_of(clock)
    }
}

/// The time of the errands on a worker. While one runs it stands still but for the errand's waits, so
/// that no bit is longer than it was meant to be.
pub(crate) struct ErrandTime(pub(crate) Arc<dyn TimeSource>);

impl TimeSource for ErrandTime {
    fn now(&self) -> Clock {
        DUE.get().unwrap_or_else(|| self.0.now())
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.0.instant_of(monotonic)
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        self.0.duration_of(clock)
    }

    /// As the lines have the errand's time, whatever it is meanwhile, nothing has to spin: between two
    /// bits is no time to sleep, between a thousand there is.
    fn spin_until(&self, end: Clock) {
        let Some(due) = DUE.get() else { return self.0.spin_until(end) };
        DUE.set(Some(due.max(end)));
        if end.since(self.0.now()) > i64::from(AHEAD.0) {
            self.sleep_until(end);
        }
    }

    fn begin_errand(&self) {
        DUE.set(Some(self.0.now()));
    }

    /// Not before it ends in its own time.
    fn end_errand(&self) {
        if let Some(due) = DUE.take() {
            self.sleep_until(due);
        }
    }
}

/// How far an errand may be ahead of the machine's clock.
const AHEAD: Ticks = Ticks::from_us(1000);

impl ErrandTime {
    fn sleep_until(&self, end: Clock) {
        let ticks = end.since(self.0.now()).max(0) as u64;
        thread::sleep(Duration::from_micros(ticks / u64::from(Ticks::from_us(1).0)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::{NS_PER_TICK, VirtualClock};

    #[test]
    fn an_errand_does_not_feel_how_late_the_computer_is() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let machine = Arc::new(clock.clone());
        let (errand, printer) = (ErrandTime(machine.clone()), PrinterTime::new(machine));
        errand.begin_errand();
        for bit in 1..4 {
            // Each wait ends much too late.
            clock.set(Clock::EPOCH + Ticks(1000 * bit));
            errand.spin_until(Clock::EPOCH + Ticks(10 * bit));
            assert_eq!(errand.now(), Clock::EPOCH + Ticks(10 * bit));
            assert_eq!(printer.of_the_caller(), errand.now(), "and so have the lines");
        }
        assert_eq!(printer.now(), clock.now());
        errand.end_errand();
        assert_eq!(errand.now(), Clock::EPOCH + Ticks(3000));
        assert_eq!(printer.of_the_caller(), errand.now());
    }

    /// A clock that goes by itself.
    struct Going(std::time::Instant);

    impl TimeSource for Going {
        fn now(&self) -> Clock {
            self.instant_of(self.0.elapsed())
        }

        fn instant_of(&self, monotonic: Duration) -> Clock {
            Clock::from_ticks(monotonic.as_nanos() as u64 / NS_PER_TICK)
        }

        fn duration_of(&self, clock: Clock) -> Duration {
            Duration::from_nanos(clock.ticks() * NS_PER_TICK)
        }
    }

    #[test]
    fn an_errand_takes_its_time() {
        let machine = Arc::new(Going(std::time::Instant::now()));
        let errand = ErrandTime(machine.clone());
        errand.begin_errand();
        let end = errand.now() + Ticks::from_us(5500);
        while errand.now() < end {
            errand.spin_until(errand.now() + Ticks::from_us(25));
            assert!(errand.now().since(machine.now()) <= i64::from(AHEAD.0));
        }
        errand.end_errand();
        // Of a microsecond, as sleep is told.
        assert!(machine.now() + Ticks::from_us(1) >= end);
    }

    #[test]
    fn a_timer_of_the_core_does_not_hold_back_the_time_of_a_worker() {
        let clock = VirtualClock::at(Clock::from_ticks(5_000));
        let time = Arc::new(PrinterTime::new(Arc::new(clock)));
        time.set_due(Some(Clock::from_ticks(1_000)));
        let worker = std::thread::spawn({
            let time = time.clone();
            move || time.of_the_caller()
        });
        assert_eq!(worker.join().ok(), Some(Clock::from_ticks(5_000)));
        assert_eq!(time.of_the_caller(), Clock::from_ticks(1_000));
        time.set_due(None);
        assert_eq!(time.of_the_caller(), Clock::from_ticks(5_000));
    }
}
