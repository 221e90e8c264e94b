// SPDX-License-Identifier: GPL-3.0-or-later
//! A process that shall end.

use std::process::Child;
use std::thread;
use std::time::{Duration, Instant};

/// Time between two looks at the process.
const LOOK: Duration = Duration::from_millis(20);

/// Waits for the end of a process, for at most this real time.
pub(crate) fn await_end(process: &mut Child, span: Duration) {
    let until = Instant::now() + span;
    while Instant::now() < until && matches!(process.try_wait(), Ok(None)) {
        thread::sleep(LOOK);
    }
}
