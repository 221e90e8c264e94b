// SPDX-License-Identifier: GPL-3.0-or-later
//! Memory that threads or processes share without a lock. It is all here, because it is hard to get right and easy to
//! check apart from the rest: `make sanitize` tries each structure in all orders that its threads may run in
//! (docs/develop/sanitizers.md).
//!
//! - [`ring`]: the newest records of one writer
//! - [`seqlock`]: the newest words of one writer, which belong together (a latched counter)
//! - [`heartbeat`]: heartbeats, pending shutdown values, and since when a worker has run its job
//! - [`sleep_flag`]: wake-ups between the core and the link
//! - [`progress`]: how far the core has come with the host's blocks
//! - [`watch`]: a line whose pulses one thread makes, and another one ends if the first is late
//!
//! A structure in memory that processes share is given its words, and is a view of them. They are zero at first.

#![forbid(unsafe_code)]

pub mod heartbeat;
pub mod progress;
pub mod ring;
pub mod seqlock;
pub mod sleep_flag;
pub mod watch;

/// The atomics of loom in its models, and those of the standard library everywhere else.
mod atomic {
    #[cfg(all(loom, test))]
    pub(crate) use loom::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
    #[cfg(not(all(loom, test)))]
    pub(crate) use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
}

#[cfg(all(loom, test))]
#[path = "../tests/support/model.rs"]
mod model;
