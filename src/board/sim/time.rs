// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's time.

#![forbid(unsafe_code)]

use std::cell::Cell;
use std::sync::Arc;

use crate::time::{Clock, TimeSource};

thread_local! {
    /// The instant for which the timer was set that this thread runs. Only the core runs timers: a worker
    /// that drives lines itself (an HX711's clock) does so now, whatever the core does meanwhile.
    static DUE: Cell<Option<Clock>> = const { Cell::new(None) };
}

/// The printer's time: the machine's clock, but while the core runs a timer the instant for which
/// that timer was set.
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

    /// What this thread, the core, runs from now on was due at this instant; none: it is no timer.
    pub(super) fn set_due(&self, due: Option<Clock>) {
        DUE.set(due);
    }

    /// The instant of what the caller does to a line.
    pub(super) fn of_the_caller(&self) -> Clock {
        DUE.get().unwrap_or_else(|| self.clock.now())
    }
}

impl TimeSource for PrinterTime {
    fn now(&self) -> Clock {
        self.clock.now()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::VirtualClock;

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
