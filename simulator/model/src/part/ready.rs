// SPDX-License-Identifier: GPL-3.0-or-later
//! A chip that converts by its own clock, and its line, which is low while a conversion waits.

use std::sync::Arc;

use crate::engine::seqlock::Seqlock;
use crate::engine::wire::{Wire, input};
use pinion_firmware::time::Clock;

/// The timing of a chip's conversions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Conversions {
    /// The end of the first conversion.
    pub(crate) first: Clock,
    /// Ticks of 20 ns from one end to the next; 0 while the chip does not convert.
    pub(crate) period: f64,
    /// Number of conversions that no longer wait.
    pub(crate) seen: u64,
    /// Whether the line reports them.
    pub(crate) reported: bool,
}

impl Conversions {
    pub(crate) const NONE: Conversions =
        Conversions { first: Clock::from_ticks(0), period: 0.0, seen: 0, reported: false };

    fn words(self) -> [u64; 4] {
        [self.first.ticks(), self.period.to_bits(), self.seen, self.reported.into()]
    }

    fn of([first, period, seen, reported]: [u64; 4]) -> Conversions {
        Conversions { first: Clock::from_ticks(first), period: f64::from_bits(period), seen, reported: reported != 0 }
    }

    /// Number of finished conversions.
    pub(crate) fn over(&self, now: Clock) -> u64 {
        let since = now.since(self.first);
        if self.period == 0.0 || since < 0 { 0 } else { (since as f64 / self.period) as u64 + 1 }
    }
}

/// The state that a chip and its line share. Only the chip writes it, from its bus's worker.
pub(crate) struct ReadyLine {
    /// For example `interrupt of ldc1612`.
    name: &'static str,
    conversions: Seqlock<4>,
}

impl ReadyLine {
    pub(crate) fn new(name: &'static str) -> Arc<ReadyLine> {
        Arc::new(ReadyLine { name, conversions: Seqlock::new(Conversions::NONE.words()) })
    }

    pub(crate) fn set(&self, conversions: Conversions) {
        self.conversions.store(conversions.words());
    }

    /// The level of the line.
    pub(crate) fn level(&self, at: Clock) -> bool {
        let conversions = Conversions::of(self.conversions.load());
        !conversions.reported || conversions.over(at) <= conversions.seen
    }
}

/// The pin at the line.
pub(crate) fn ready_pin(line: Arc<ReadyLine>) -> impl Wire {
    input(line.name.into(), move |at| line.level(at))
}
