// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's time.

use std::cell::Cell;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use pinion_firmware::time::{CLOCK_FREQ, Clock, DueTime, NS_PER_TICK, Ticks, TimeSource};

/// Seconds from `earlier` to `later`; 0 if they are the other way round.
pub fn seconds(earlier: Clock, later: Clock) -> f64 {
    later.since(earlier).max(0) as f64 / f64::from(CLOCK_FREQ)
}

/// Longest delay of a timer or a step. A simulated motor follows at any pace. Most computers that try the printer have
/// no real time. If they are busy, they are late by a tenth of a second now and then. After 550 ms without a heartbeat
/// the guardian ends the program.
pub(crate) const LATE_LIMIT: Ticks = Ticks::from_ms(400);

/// How far a job may be ahead of the clock.
const AHEAD: Ticks = Ticks::from_ms(1);

/// How a board's clock differs from the printer's. It is fast and slow by turns, over hours, so the difference stays
/// small: the program also compares its clock with the computer's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Drift {
    /// Radians for each tick.
    speed: f64,
    /// Highest difference in ticks.
    most: f64,
}

impl Drift {
    /// Longest difference of two clocks, in seconds.
    const MOST_S: f64 = 0.05;

    /// A clock that goes wrong by `ppm` millionths at most.
    pub(crate) fn of(ppm: f64) -> Drift {
        let most = if ppm == 0.0 { 0.0 } else { Drift::MOST_S * f64::from(CLOCK_FREQ) };
        Drift { speed: ppm * 1e-6 / (Drift::MOST_S * f64::from(CLOCK_FREQ)), most }
    }

    fn off(self, at: Clock) -> i64 {
        // The clock is wrong by `ppm` at the start.
        ((at.ticks() as f64 * self.speed).sin() * self.most).round() as i64
    }

    /// The board's time at an instant of the printer.
    pub(crate) fn of_board(self, at: Clock) -> Clock {
        Clock::from_ticks(at.ticks().saturating_add_signed(self.off(at)))
    }

    /// The instant of the printer at a time of the board.
    pub(crate) fn of_printer(self, board: Clock) -> Clock {
        // The difference changes so slowly that two rounds find it to a tick.
        let guess = |at: Clock| Clock::from_ticks(board.ticks().saturating_add_signed(-self.off(at)));
        guess(guess(board))
    }
}

/// The clock of a board.
struct BoardClock {
    clock: Arc<dyn TimeSource>,
    drift: Drift,
}

impl TimeSource for BoardClock {
    fn now(&self) -> Clock {
        self.drift.of_board(self.clock.now())
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.drift.of_board(self.clock.instant_of(monotonic))
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        self.clock.duration_of(self.drift.of_printer(clock))
    }

    fn spin_until(&self, end: Clock) {
        self.clock.spin_until(self.drift.of_printer(end));
    }

    fn sleep_until(&self, end: Clock) {
        self.clock.sleep_until(self.drift.of_printer(end));
    }

    fn step_ns(&self) -> u32 {
        self.clock.step_ns()
    }
}

thread_local! {
    /// The instant of the job that this thread runs; `None` if it runs no job.
    static JOB: Cell<Option<Clock>> = const { Cell::new(None) };
}

/// The printer's time. While the core runs a timer, it is the timer's due time. While a worker runs a job, it is
/// the instant that the job waited for. Otherwise it is the clock.
///
/// So an edge happens at its due time, however late the computer is. Most computers that try the printer have no real
/// time. Their parts would misread everything that is timed by microseconds: the bits of a UART, the pulses of a servo,
/// the steps that make an axis ring.
pub(crate) struct PrinterTime {
    clock: Arc<dyn TimeSource>,
    due: DueTime,
    drift: Drift,
}

impl PrinterTime {
    /// The time of a board whose clock drifts from this one.
    pub(crate) fn new(clock: Arc<dyn TimeSource>, drift: Drift) -> PrinterTime {
        let clock = if drift.most == 0.0 { clock } else { Arc::new(BoardClock { clock, drift }) };
        PrinterTime { clock, due: DueTime::default(), drift }
    }

    /// The MCU sets this to the due time of the timer that it runs.
    pub(crate) fn due(&self) -> DueTime {
        self.due.clone()
    }

    /// The printer's instant of this thread's access to a line. Workers use lines in jobs only.
    pub(crate) fn of_the_caller(&self) -> Clock {
        self.drift.of_printer(JOB.get().or_else(|| self.due.get()).unwrap_or_else(|| self.clock.now()))
    }
}

/// A device takes this long for the job of the caller.
pub(crate) fn pass(span: Duration) {
    match JOB.get() {
        Some(now) => JOB.set(Some(now.later(span.as_nanos() as u64 / NS_PER_TICK))),
        None => thread::sleep(span),
    }
}

/// The time of a job advances only in its waits, so no bit is longer than intended.
impl TimeSource for PrinterTime {
    fn now(&self) -> Clock {
        JOB.get().unwrap_or_else(|| self.clock.now())
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.clock.instant_of(monotonic)
    }

    fn duration_of(&self, clock: Clock) -> Duration {
        self.clock.duration_of(clock)
    }

    /// Nothing has to spin, because the lines use the job's time and not the clock. The time between two bits is too
    /// short for a sleep. After about a thousand bits a sleep is possible.
    fn spin_until(&self, end: Clock) {
        let Some(now) = JOB.get() else { return self.clock.spin_until(end) };
        JOB.set(Some(now.max(end)));
        if end.since(self.clock.now()) > i64::from(AHEAD.0) {
            self.clock.sleep_until(end);
        }
    }

    /// The job ends when both its own time and the clock have reached its end.
    fn run_job(&self, work: &mut dyn FnMut()) -> Clock {
        JOB.set(Some(self.clock.now()));
        work();
        let Some(end) = JOB.take() else { return self.clock.now() };
        self.clock.sleep_until(end);
        end.max(self.clock.now())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::VirtualClock;

    #[test]
    fn a_job_does_not_feel_how_late_the_computer_is() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let time = PrinterTime::new(Arc::new(clock.clone()), Drift::of(0.0));
        let ended = time.run_job(&mut || {
            for bit in 1..4 {
                // Each wait ends much too late.
                clock.set(Clock::EPOCH + Ticks(1000 * bit));
                time.spin_until(Clock::EPOCH + Ticks(10 * bit));
                assert_eq!(time.now(), Clock::EPOCH + Ticks(10 * bit));
                assert_eq!(time.of_the_caller(), time.now(), "and so have the lines");
            }
        });
        assert_eq!(ended, Clock::EPOCH + Ticks(3000));
        assert_eq!((time.now(), time.of_the_caller()), (ended, ended));
    }

    /// A clock that advances by itself.
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
    fn a_job_takes_its_time() {
        let clock = Arc::new(Going(std::time::Instant::now()));
        let time = PrinterTime::new(clock.clone(), Drift::of(0.0));
        let mut end = Clock::EPOCH;
        let ended = time.run_job(&mut || {
            end = time.now() + Ticks::from_us(5500);
            while time.now() < end {
                time.spin_until(time.now() + Ticks::from_us(25));
                assert!(time.now().since(clock.now()) <= i64::from(AHEAD.0));
            }
        });
        // The sleep has a resolution of a microsecond.
        assert!(ended + Ticks::from_us(1) >= end);
    }

    #[test]
    fn a_timer_of_the_core_does_not_hold_back_the_time_of_a_worker() {
        let now = Clock::from_ticks(5_000);
        let time = Arc::new(PrinterTime::new(Arc::new(VirtualClock::at(now)), Drift::of(0.0)));
        time.due().set(Some(Clock::from_ticks(1_000)));
        let worker = std::thread::spawn({
            let time = time.clone();
            move || time.run_job(&mut || assert_eq!(time.of_the_caller(), now))
        });
        assert_eq!(worker.join().ok(), Some(now));
        assert_eq!(time.of_the_caller(), Clock::from_ticks(1_000));
        assert_eq!(time.now(), now, "but the MCU's clock goes on");
        time.due().set(None);
        assert_eq!(time.of_the_caller(), now);
    }

    #[test]
    fn a_boards_clock_drifts_and_comes_back() {
        let drift = Drift::of(20.0);
        let at = |seconds: f64| Clock::from_ticks((seconds * f64::from(CLOCK_FREQ)) as u64);
        let off = |seconds| drift.of_board(at(seconds)).since(at(seconds)) as f64 / f64::from(CLOCK_FREQ);
        assert!((off(10.0) - 200e-6).abs() < 1e-6, "{}", off(10.0));
        for seconds in [0.5, 100.0, 3e4, 1e6] {
            assert!(off(seconds).abs() <= 0.05);
            let back = drift.of_printer(drift.of_board(at(seconds)));
            assert!(back.since(at(seconds)).abs() <= 1, "{seconds}");
        }
        assert_eq!(Drift::of(0.0).of_board(at(7.0)), at(7.0));
    }
}
