// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer's time.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::time::{Clock, TimeSource};

/// Stands for no instant.
const NONE: u64 = u64::MAX;

/// The printer's time: the machine's clock, but while the core runs a timer the instant for which
/// that timer was set.
///
/// So an edge happens when it was due, and not as late as the computer is: most computers that try
/// the printer are without real time, and its parts would hear rubbish of whatever is timed by
/// microseconds (the bits of a UART, the pulses of a servo, the steps that make an axis ring).
pub(super) struct PrinterTime {
    clock: Arc<dyn TimeSource>,
    due: AtomicU64,
}

impl PrinterTime {
    pub(super) fn new(clock: Arc<dyn TimeSource>) -> PrinterTime {
        PrinterTime { clock, due: AtomicU64::new(NONE) }
    }

    /// What the core runs from now on was due at this instant; none: it is no timer.
    pub(super) fn set_due(&self, due: Option<Clock>) {
        self.due.store(due.map_or(NONE, Clock::ticks), Ordering::Relaxed);
    }

    /// The instant of what the core does.
    pub(super) fn of_the_core(&self) -> Clock {
        match self.due.load(Ordering::Relaxed) {
            NONE => self.clock.now(),
            due => Clock::from_ticks(due),
        }
    }
}

impl TimeSource for PrinterTime {
    fn now(&self) -> Clock {
        self.clock.now()
    }
}
