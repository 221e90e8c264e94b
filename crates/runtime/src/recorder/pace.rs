// SPDX-License-Identifier: GPL-3.0-or-later
//! How often something may be done.

use std::time::Duration;

/// A number of times at once, and then one more after each span of time.
pub(super) struct Pace {
    at_once: u32,
    every: Duration,
    /// When all admitted work would be done at an even pace.
    due: Duration,
}

impl Pace {
    pub(super) const fn new(at_once: u32, every: Duration) -> Pace {
        Pace { at_once, every, due: Duration::ZERO }
    }

    /// Whether it may be done once more. If so, this counts.
    pub(super) fn admits(&mut self, now: Duration) -> bool {
        let due = self.due.max(now);
        let is_admitted = due - now <= self.every * (self.at_once - 1);
        if is_admitted {
            self.due = due + self.every;
        }
        is_admitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn some_are_admitted_at_once_and_then_one_after_each_span() {
        let second = Duration::from_secs(1);
        for (at_once, start) in [(1, 0), (1, 1000), (5, 0), (5, 1000)] {
            let mut pace = Pace::new(at_once, 60 * second);
            let mut admitted = |at: u32| (0..20).filter(|_| pace.admits((start + at) * second)).count();
            assert_eq!([0, 59, 60, 119, 120].map(&mut admitted), [at_once as usize, 0, 1, 0, 1]);
            assert_eq!(admitted(120 + 600), at_once as usize, "it has rested");
        }
    }
}
