// SPDX-License-Identifier: GPL-3.0-or-later
//! Edges of several objects that are due at one instant, on lines of one bank: one store makes all the high ones, and
//! one all the low ones.
//!
//! A batch has the timers that would have run one after the other. Its edges go out first. Then each object's event
//! runs, and finds its edge made. So a direction that changes after a step still does, and no other order changes.

use std::ptr;

use crate::board::Bank;
use crate::time::Clock;

use super::{Mcu, State};

/// Edges that go out together.
pub struct Batch {
    now: Clock,
    bank: Option<&'static dyn Bank>,
    high: u32,
    low: u32,
}

impl Batch {
    /// The time when its edges go out.
    pub fn now(&self) -> Clock {
        self.now
    }

    /// Adds the edge of the lines `line` of a bank to this level. It refuses an edge of another bank, and a second edge
    /// of a line.
    pub(super) fn add(&mut self, bank: &'static dyn Bank, line: u32, level: bool) -> bool {
        let takes = self.bank.is_none_or(|own| ptr::addr_eq(own, bank)) && (self.high | self.low) & line == 0;
        if takes {
            self.bank = Some(bank);
            *if level { &mut self.high } else { &mut self.low } |= line;
        }
        takes
    }
}

impl Mcu {
    /// Runs the next timer and the others of its instant, as far as each begins with an edge on the same bank. No
    /// command runs between them.
    #[inline(never)]
    pub(super) fn run_batch(&mut self, at: Clock) {
        let mut batch = Batch { now: self.last_read(), bank: None, high: 0, low: 0 };
        let State { scheduler, objects, .. } = &mut self.state;
        let joining = scheduler
            .of_instant(at)
            .take_while(|timer| objects.get_mut(timer.oid()).is_some_and(|object| object.join(&mut batch)));
        let count = joining.count();
        if let Some(bank) = batch.bank {
            bank.change(batch.high, batch.low);
            // Read the time after the edges have reached the lines: their pulses begin now.
            bank.flush();
            self.now();
        }
        for _ in 0..count.max(1) {
            // A failure removes the other timers.
            let Some(timer) = self.state.scheduler.of_instant(at).next() else { break };
            self.run_timer(at, timer);
        }
    }
}
