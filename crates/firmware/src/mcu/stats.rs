// SPDX-License-Identifier: GPL-3.0-or-later
//! How busy the core is: the sums for klippy's statistics.

use crate::time::Ticks;

/// The divisor of squares of ticks (`STATS_SUMSQ_BASE`).
pub(super) const SUMSQ_BASE: u32 = 256;

/// The core's busy spans since the last `stats` response: their number, the sum of their ticks, and the sum of their
/// squares divided by [`SUMSQ_BASE`].
#[derive(Debug, Default)]
pub(super) struct Stats {
    pub(super) count: u32,
    pub(super) sum: u32,
    pub(super) sumsq: u32,
}

impl Stats {
    /// Adds a busy span. The sum of squares saturates, as in Klipper's C.
    pub(super) fn add(&mut self, busy: Ticks) {
        let square = u64::from(busy.0) * u64::from(busy.0);
        let square = square.div_ceil(u64::from(SUMSQ_BASE));
        self.count = self.count.wrapping_add(1);
        self.sum = self.sum.wrapping_add(busy.0);
        self.sumsq = self.sumsq.saturating_add(u32::try_from(square).unwrap_or(u32::MAX));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_round_up_and_saturate() {
        let mut stats = Stats::default();
        stats.add(Ticks(1));
        stats.add(Ticks(512));
        assert_eq!((stats.count, stats.sum, stats.sumsq), (2, 513, 1 + 1024));
        stats.add(Ticks(u32::MAX));
        assert_eq!(stats.sumsq, u32::MAX);
    }
}
