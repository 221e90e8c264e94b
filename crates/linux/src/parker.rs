// SPDX-License-Identifier: GPL-3.0-or-later
//! A sleep until a time, or until another thread ends it.

#![forbid(unsafe_code)]

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use crate::sys;

/// Parks one thread. Unlike [`std::thread::park_timeout`], it takes a time and not a span. So it need not read the
/// clock, and a sleep ends at its time, whatever happens before it begins.
#[derive(Debug, Default)]
pub struct Parker(AtomicU32);

/// Nobody sleeps, and nobody has called.
const AWAKE: u32 = 0;
/// Somebody has called: the next sleep ends at once.
const CALLED: u32 = 1;
/// One below [`AWAKE`], so that a subtraction takes back a call or begins a sleep.
const ASLEEP: u32 = u32::MAX;

impl Parker {
    /// Sleeps until `end` (CLOCK_MONOTONIC) or a call of [`Parker::unpark`]. It ends at once if there was a call since
    /// the last sleep. It may also end early. Only one thread may call this.
    pub fn park_until(&self, end: Duration) {
        if self.0.fetch_sub(1, Ordering::Acquire) == CALLED {
            return;
        }
        sys::futex_wait_until(&self.0, ASLEEP, end);
        self.0.swap(AWAKE, Ordering::Acquire);
    }

    /// Ends the sleep, or the next one. The thread then sees what this one did before.
    pub fn unpark(&self) {
        if self.0.swap(CALLED, Ordering::Release) == ASLEEP {
            sys::futex_wake(&self.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::monotonic;
    use std::sync::Arc;
    use std::thread;

    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn a_sleep_ends_at_its_time() {
        let parker = Parker::default();
        let end = monotonic() + Duration::from_millis(5);
        while monotonic() < end {
            parker.park_until(end);
        }
        // A time that has passed.
        parker.park_until(Duration::ZERO);
        parker.park_until(end);
        assert!(monotonic() < end + LONG);
    }

    #[test]
    fn a_call_before_a_sleep_ends_it_at_once_and_counts_once() {
        let parker = Parker::default();
        let begin = monotonic();
        parker.unpark();
        parker.unpark();
        parker.park_until(begin + LONG);
        assert!(monotonic() < begin + LONG);
        let end = monotonic() + Duration::from_millis(5);
        parker.park_until(end);
        assert_eq!(parker.0.load(Ordering::Relaxed), AWAKE);
    }

    #[test]
    fn no_call_is_lost() {
        let (parker, turn) = (Arc::new(Parker::default()), Arc::new(AtomicU32::new(0)));
        let begin = monotonic();
        let (sleeper, seen) = (parker.clone(), turn.clone());
        let thread = thread::spawn(move || {
            for next in 1..=100 {
                while seen.load(Ordering::Relaxed) != 2 * next - 1 {
                    sleeper.park_until(begin + LONG);
                }
                seen.store(2 * next, Ordering::Release);
            }
        });
        for next in 1..=100 {
            turn.store(2 * next - 1, Ordering::Relaxed);
            parker.unpark();
            while turn.load(Ordering::Acquire) != 2 * next {
                thread::yield_now();
            }
        }
        thread.join().unwrap();
        assert!(monotonic() < begin + LONG, "a sleep lasted to its end");
    }
}
