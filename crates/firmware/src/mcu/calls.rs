// SPDX-License-Identifier: GPL-3.0-or-later
//! Calls to devices: the rule for failed calls, and the counts of calls.
//!
//! A bus fails now and then. A spike on a long cable is no reason to stop a print. There are two limits:
//!
//! - A worker repeats a failed call at once, up to [`TRIES`] tries in all. It does so only if a second call
//!   has the same effect as one: reading a register or a level, setting an output.
//! - A sampled input may be [`Unread`] for [`UNREAD_LIMIT`] before the MCU stops. An input that stops a move has
//!   no limit: its failure stops the MCU at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use crate::time::{Clock, Ticks, TimeSource};

use super::BusCounts;

/// How many times a call is made before it counts as failed.
const TRIES: u32 = 3;
/// How long after the start of the first try a failed call may still be repeated. A driver that waits longer before it
/// gives up has waited enough.
const RETRY_LIMIT: Ticks = Ticks::from_ms(20);
/// Longest time that a sampled input may stay unread, because its device fails or hangs.
pub const UNREAD_LIMIT: Ticks = Ticks::from_ms(100);

/// Makes the calls to one device. Its clones count together.
#[derive(Clone)]
pub struct Calls {
    clock: Arc<dyn TimeSource>,
    counters: Arc<Counters>,
}

#[derive(Default)]
struct Counters {
    calls: AtomicU32,
    errors: AtomicU32,
    retries: AtomicU32,
}

impl Calls {
    /// The calls to a device whose worker has this clock.
    pub fn new(clock: Arc<dyn TimeSource>) -> Calls {
        Calls { clock, counters: Arc::default() }
    }

    /// Makes a call that must not be repeated, for example a command or a read of a FIFO.
    ///
    /// # Errors
    ///
    /// The errors of the call.
    pub fn once<T, E>(&self, call: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let done = call();
        self.counters.calls.fetch_add(1, Ordering::Relaxed);
        self.counters.errors.fetch_add(u32::from(done.is_err()), Ordering::Relaxed);
        done
    }

    /// Makes a call that may be repeated, and repeats it if it fails.
    ///
    /// # Errors
    ///
    /// The error of the last try.
    pub fn repeat<T, E>(&self, mut call: impl FnMut() -> Result<T, E>) -> Result<T, E> {
        let limit = self.clock.now() + RETRY_LIMIT;
        let mut tries = 1;
        loop {
            match self.once(&mut call) {
                Err(_) if tries < TRIES && self.clock.now() < limit => {
                    tries += 1;
                    self.counters.retries.fetch_add(1, Ordering::Relaxed);
                }
                done => return done,
            }
        }
    }

    /// How many calls, errors and retries there were.
    pub fn counts(&self) -> BusCounts {
        let load = |count: &AtomicU32| count.load(Ordering::Relaxed);
        let Counters { calls, errors, retries } = &*self.counters;
        BusCounts { transfers: load(calls), errors: load(errors), retries: load(retries) }
    }
}

/// The time since which an input is unread.
#[derive(Default)]
pub struct Unread(Option<Clock>);

impl Unread {
    /// A read of the input was requested.
    pub fn asked(&mut self, at: Clock) {
        self.0.get_or_insert(at);
    }

    /// The input was read.
    pub fn read(&mut self) {
        self.0 = None;
    }

    /// Whether the input is unread for too long, so that the MCU must stop.
    pub fn is_too_long(&self, now: Clock) -> bool {
        self.0.is_some_and(|since| now.since(since) >= i64::from(UNREAD_LIMIT.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::VirtualClock;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_call_is_made_again_while_it_fails_and_there_is_time(
            fails in proptest::collection::vec(any::<bool>(), 3),
            takes_us in 0u32..30_000,
        ) {
            let clock = VirtualClock::at(Clock::EPOCH);
            let calls = Calls::new(Arc::new(clock.clone()));
            let mut made = 0;
            let done = calls.repeat(|| {
                let failed = fails[made];
                made += 1;
                clock.set(clock.now() + Ticks::from_us(takes_us));
                if failed { Err(made) } else { Ok(made) }
            });
            let tries = match takes_us {
                0..10_000 => 3,
                10_000..20_000 => 2,
                _ => 1,
            };
            let expected = fails.iter().take(tries).position(|failed| !failed).map_or(Err(tries), |at| Ok(at + 1));
            prop_assert_eq!(done, expected);
            let errors = made as u32 - u32::from(done.is_ok());
            prop_assert_eq!(calls.counts(), BusCounts { transfers: made as u32, errors, retries: made as u32 - 1 });
        }
    }

    #[test]
    fn an_input_is_unread_from_the_first_question_without_an_answer() {
        let at = |us| Clock::EPOCH + Ticks::from_us(us);
        let mut unread = Unread::default();
        assert!(!unread.is_too_long(at(1_000_000)));
        unread.asked(at(0));
        unread.asked(at(60_000));
        assert!(!unread.is_too_long(at(99_999)));
        assert!(unread.is_too_long(at(100_000)));
        unread.read();
        assert!(!unread.is_too_long(at(100_000)));
        unread.asked(at(100_000));
        assert!(!unread.is_too_long(at(150_000)));
    }
}
