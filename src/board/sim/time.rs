// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's time.

#![forbid(unsafe_code)]

use std::cell::Cell;
use std::sync::Arc;
use std::time::Duration;

use crate::time::{Clock, TimeSource};

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
pub(super) struct PrinterTime {
    clock: Arc<dyn TimeSource>,
}

impl PrinterTime {
    pub(super) fn new(clock: Arc<dyn TimeSource>) -> PrinterTime {
        PrinterTime { clock }
    }

    /// What this thread does from now on was due at this instant; none: it is no timer.
    pub(super) fn set_due(&self, due: Option<Clock>) {
        DUE.set(due);
    }

    /// The instant of what this thread does with a line.
    pub(super) fn of_the_caller(&self) -> Clock {
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
}

/// The time of the errands on a worker. While one runs it stands still but for the errand's waits, so
/// that no bit is longer than it was meant to be.
pub(super) struct ErrandTime(pub(super) Arc<dyn TimeSource>);

impl TimeSource for ErrandTime {
    fn now(&self) -> Clock {
        DUE.get().unwrap_or_else(|| self.0.now())
    }

    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.0.instant_of(monotonic)
    }

    fn spin_until(&self, end: Clock) {
        self.0.spin_until(end);
        DUE.set(DUE.get().map(|due| due.max(end)));
    }

    fn begin_errand(&self) {
        DUE.set(Some(self.0.now()));
    }

    fn end_errand(&self) {
        DUE.set(None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{Ticks, VirtualClock};

    /// A clock that is late by this much at each wait.
    struct Late(VirtualClock, Ticks);

    impl TimeSource for Late {
        fn now(&self) -> Clock {
            self.0.now()
        }

        fn instant_of(&self, monotonic: Duration) -> Clock {
            self.0.instant_of(monotonic)
        }

        fn spin_until(&self, end: Clock) {
            self.0.set(end + self.1);
        }
    }

    #[test]
    fn an_errand_does_not_feel_how_late_the_computer_is() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let late = Arc::new(Late(clock.clone(), Ticks(1000)));
        let (errand, printer) = (ErrandTime(late.clone()), PrinterTime::new(late));
        errand.begin_errand();
        clock.set(Clock::EPOCH + Ticks(7));
        assert_eq!(errand.now(), Clock::EPOCH);
        for bit in 1..4 {
            errand.spin_until(Clock::EPOCH + Ticks(10 * bit));
            assert_eq!(errand.now(), Clock::EPOCH + Ticks(10 * bit));
            assert_eq!(printer.of_the_caller(), errand.now(), "and so have the lines");
        }
        assert_eq!(printer.now(), clock.now());
        errand.end_errand();
        assert_eq!(errand.now(), Clock::EPOCH + Ticks(1030));
        assert_eq!(printer.of_the_caller(), errand.now());
    }
}
