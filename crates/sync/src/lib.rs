// SPDX-License-Identifier: GPL-3.0-or-later
//! Memory that threads or processes share without a lock. It is all here, because it is hard to get right and easy to
//! check apart from the rest: `make sanitize` tries each structure in all orders that its threads may run in
//! (docs/develop/sanitizers.md).
//!
//! - [`ring`]: the newest records of one writer
//! - [`together`]: the newest words of one writer, which belong together
//! - [`life`]: signs of life, debts, and what workers are at
//! - [`calls`]: wake-ups between the core and the link, and what each has done
//! - [`watch`]: a line whose pulses one thread makes, and another one ends if the first is late
//!
//! A structure in memory that processes share is given its words, and is a view of them. They are zero at first.

#![forbid(unsafe_code)]

pub mod calls;
pub mod life;
pub mod ring;
pub mod together;
pub mod watch;

/// The atomics of loom in its models, and those of the standard library everywhere else.
mod atomic {
    #[cfg(all(loom, test))]
    pub(crate) use loom::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
    #[cfg(not(all(loom, test)))]
    pub(crate) use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
}

#[cfg(all(loom, test))]
mod model;
