// SPDX-License-Identifier: GPL-3.0-or-later
//! How long a thread polls for the next job, or for its result, before it sleeps.
//!
//! A wake-up takes 20 to 50 us on the computers measured. Most answers of a bus take less. So the core polls for an
//! answer, and a worker polls for the next question. With a single processor nothing polls, because the other thread
//! needs that processor. Polling is rationed. So an endless series of jobs takes no processor from the host. Nor does
//! it use up the time that the kernel allows real-time threads.

use pinion_firmware::time::{Clock, Ticks};

/// Longest time that a thread may poll without a break, after it has not polled for some time.
const RATION: i64 = Ticks::from_ms(100).0 as i64;
/// A thread that does not poll earns one part in this many of the time for polling. So it polls for at most a quarter
/// of all time.
const EARNS: i64 = 3;

/// Decides for one thread whether it polls.
#[derive(Debug)]
pub(crate) struct PollBudget {
    may_poll: bool,
    until: Clock,
    polled_at: Clock,
    /// Ticks left for polling.
    ration: i64,
}

impl PollBudget {
    /// Nothing is expected yet. Without `may_poll` the thread never polls.
    pub(crate) fn new(may_poll: bool, now: Clock) -> PollBudget {
        PollBudget { may_poll, until: now, polled_at: now, ration: RATION }
    }

    /// The next job, or its result, is expected within `span`.
    #[inline]
    pub(crate) fn expect(&mut self, now: Clock, span: Ticks) {
        if self.may_poll {
            self.ration = (self.ration + now.since(self.polled_at).max(0) / EARNS).min(RATION);
            self.polled_at = now;
            self.until = now + span;
        }
    }

    /// Whether to poll once more before sleeping.
    #[inline]
    pub(crate) fn goes_on(&mut self, now: Clock) -> bool {
        if now >= self.until {
            return false;
        }
        self.ration -= now.since(self.polled_at).max(0);
        self.polled_at = now;
        if self.ration <= 0 {
            self.until = now;
        }
        self.ration > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SPAN: Ticks = Ticks::from_us(50);
    const SECOND: u64 = 50_000_000;

    fn at(us: u64) -> Clock {
        Clock::from_ticks(us * u64::from(Ticks::from_us(1).0))
    }

    #[test]
    fn it_polls_for_its_span_and_not_when_idle() {
        let mut polling = PollBudget::new(true, at(0));
        assert!(!polling.goes_on(at(0)) && !polling.goes_on(at(1_000)), "nothing is expected");
        polling.expect(at(2_000), SPAN);
        assert!(polling.goes_on(at(2_000)) && polling.goes_on(at(2_049)));
        assert!(!polling.goes_on(at(2_050)) && !polling.goes_on(at(9_000)));
        polling.expect(at(9_000), SPAN);
        assert!(polling.goes_on(at(9_020)));
        // An event during the polling begins another span.
        polling.expect(at(9_040), SPAN);
        assert!(polling.goes_on(at(9_089)) && !polling.goes_on(at(9_090)));
    }

    #[test]
    fn a_single_processor_is_left_to_the_thread_that_is_waited_for() {
        let mut polling = PollBudget::new(false, at(0));
        polling.expect(at(0), SPAN);
        assert!(!polling.goes_on(at(0)) && !polling.goes_on(at(1)));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// In any second, any series of jobs polls for at most a quarter of the time and one ration.
        #[test]
        fn polling_is_rationed(turns in proptest::collection::vec((0u64..20_000, 1u64..20_000), 1..20)) {
            let mut polling = PollBudget::new(true, Clock::from_ticks(0));
            let (mut now, mut polled) = (0, Vec::new());
            for (works, waits) in turns.iter().cycle() {
                if now > 4 * SECOND {
                    break;
                }
                now += works + 1;
                polling.expect(Clock::from_ticks(now), SPAN);
                let answered = now + waits;
                while now < answered && polling.goes_on(Clock::from_ticks(now)) {
                    polled.push(now);
                    now += 25;
                }
                now = now.max(answered);
            }
            for from in (0..3 * SECOND).step_by(SECOND as usize / 10) {
                let before = |end: u64| polled.partition_point(|at| *at < end) as u64;
                let within = (before(from + SECOND) - before(from)) * 25;
                // Each turn may have one look more than the ration allows.
                prop_assert!(within <= SECOND / 4 + RATION as u64 + SECOND / 50, "{} from {}", within, from);
            }
        }
    }
}
