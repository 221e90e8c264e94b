// SPDX-License-Identifier: GPL-3.0-or-later
//! A chip that converts by its own clock, and its line, which is low while a conversion waits.

use std::sync::Arc;

use crate::engine::seqlock::Seqlock;
use crate::engine::wire::{Kind, Wire};
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
    pub(crate) told: bool,
}

impl Conversions {
    pub(crate) const NONE: Conversions = Conversions { first: Clock::from_ticks(0), period: 0.0, seen: 0, told: false };

    fn words(self) -> [u64; 4] {
        [self.first.ticks(), self.period.to_bits(), self.seen, self.told.into()]
    }

    fn of([first, period, seen, told]: [u64; 4]) -> Conversions {
        Conversions { first: Clock::from_ticks(first), period: f64::from_bits(period), seen, told: told != 0 }
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

    pub(crate) fn tell(&self, conversions: Conversions) {
        self.conversions.store(conversions.words());
    }

    /// The level of the line.
    pub(crate) fn level(&self, at: Clock) -> bool {
        let conversions = Conversions::of(self.conversions.load());
        !conversions.told || conversions.over(at) <= conversions.seen
    }
}

pub(crate) struct ReadyPin(pub(crate) Arc<ReadyLine>);

impl Wire for ReadyPin {
    fn kind(&self) -> Kind {
        Kind::Input
    }

    fn describe(&self) -> String {
        self.0.name.into()
    }

    fn sense(&self, _driven: bool, at: Clock) -> bool {
        self.0.level(at)
    }
}
