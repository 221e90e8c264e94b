// SPDX-License-Identifier: GPL-3.0-or-later
//! How a test waits for another thread or process: for the thing itself, never for a time.

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

/// Runs the part of a test in which an MCU gets commands for a time to come. The part gets that time in seconds. An MCU
/// stops if it or its host is too late, as on a busy computer. Then the part runs again, with more time.
pub fn in_time<T>(mut part: impl FnMut(f64) -> T) -> T {
    for seconds in [1.0, 4.0] {
        let panic = match catch_unwind(AssertUnwindSafe(|| part(seconds))) {
            Ok(result) => return result,
            Err(panic) => panic,
        };
        let text = panic.downcast_ref::<String>().map_or("", |text| text);
        if !["Timer too close", "Rescheduled timer in the past"].iter().any(|late| text.contains(late)) {
            resume_unwind(panic);
        }
    }
    part(16.0)
}
