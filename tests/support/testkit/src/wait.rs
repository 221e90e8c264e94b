// SPDX-License-Identifier: GPL-3.0-or-later
//! How a test waits for another thread or process: for the thing itself, never for a time.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::thread;
use std::time::{Duration, Instant};

/// Timeout of a test: long enough for any busy computer, because no test here measures speed.
pub const WAIT_MAX: Duration = Duration::from_secs(120);
/// Pause between two looks.
const PAUSE: Duration = Duration::from_millis(10);

/// Waits until this holds.
///
/// # Panics
///
/// It does not hold in time.
#[track_caller]
pub fn until(what: &str, mut holds: impl FnMut() -> bool) {
    until_some(|| holds().then_some(()), || what.to_owned());
}

/// Waits for a result, and returns it. `what` names it after the timeout.
///
/// # Panics
///
/// It does not come in time.
#[track_caller]
pub fn until_some<T>(mut result: impl FnMut() -> Option<T>, what: impl FnOnce() -> String) -> T {
    let end = Instant::now() + WAIT_MAX;
    loop {
        if let Some(result) = result() {
            return result;
        }
        if Instant::now() >= end {
            panic!("waited in vain for {}", what());
        }
        thread::sleep(PAUSE);
    }
}

/// What an MCU says that is too late itself, or whose host or search is; what [`was_late`] says.
const LATE: [&str; 4] =
    ["Timer too close", "Rescheduled timer in the past", "the host's messages were not found within", TEST_WAS_LATE];
const TEST_WAS_LATE: &str = "the test itself was late";

thread_local! {
    /// The logs of the programs of a part that fails.
    static LOGS: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Takes the log of a program while its test panics, for [`in_time`].
pub fn failed_with(log: &str) {
    LOGS.with_borrow_mut(|logs| logs.push_str(log));
}

/// Fails in a way after which [`in_time`] repeats its part: the test was so late that a program did not wait for it.
///
/// # Panics
///
/// Always.
#[track_caller]
pub fn was_late(what: &str) -> ! {
    panic!("{TEST_WAS_LATE}: {what}")
}

/// Runs the part of a test that a busy computer may spoil. An MCU stops if it or its host is too late: a host sends its
/// commands for a time to come, and an idle core must run once in a second. The search for the host has three. Then the
/// part runs again. It gets a time to come in seconds, each time more.
pub fn in_time<T>(mut part: impl FnMut(f64) -> T) -> T {
    for seconds in [1.0, 4.0] {
        LOGS.take();
        let panic = match catch_unwind(AssertUnwindSafe(|| part(seconds))) {
            Ok(result) => return result,
            Err(panic) => panic,
        };
        let text = panic.downcast_ref::<String>().map_or("", |text| text);
        let logs = LOGS.take();
        if !LATE.iter().any(|late| text.contains(late) || logs.contains(late)) {
            resume_unwind(panic);
        }
    }
    part(16.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_part_that_was_late_runs_again() {
        let mut runs = 0;
        let seconds = in_time(|seconds| {
            runs += 1;
            match runs {
                1 => failed_with("INFO  shutdown: Timer too close: the host's block came late"),
                2 => was_late("as it says"),
                _ => return seconds,
            }
            panic!("a log line that is missing")
        });
        assert_eq!((runs, seconds), (3, 16.0));
        let mut runs = 0;
        let wrong = catch_unwind(AssertUnwindSafe(|| {
            in_time(|_| {
                runs += 1;
                assert_eq!(runs, 0, "something else");
            })
        }));
        assert!(wrong.is_err() && runs == 1);
    }
}
