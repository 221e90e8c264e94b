// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's way out: responses for the host, and notes for the log.

#![forbid(unsafe_code)]

use crate::lateness::Lateness;
use crate::shutdown::Shutdown;
use crate::time::Ticks;

/// Where the MCU leaves responses for the host and notes for the log. Its calls run in the core:
/// they must not allocate or block.
pub trait Outbox: Send {
    /// Takes a response to the host, the payload of one message block. If the host does not read
    /// and there is no room left, the response is dropped.
    fn send(&mut self, payload: &[u8]);

    /// Takes a note for the log.
    fn note(&mut self, note: Note<'_>);
}

/// An event that belongs in the log.
#[derive(Debug)]
pub enum Note<'a> {
    /// The MCU stopped.
    Shutdown(&'a Shutdown),
    /// Something failed that does not stop the MCU.
    Warning(&'a Shutdown),
    /// Something else failed while the MCU stopped, or is stopped.
    Trouble(&'a Shutdown),
    /// This output is at its shutdown value, after attempts that failed.
    Safe(&'a str),
    /// The host configured this many objects of each kind.
    Configured(&'a [(&'static str, usize)]),
    /// How late timers were since the MCU was made, and how long before a timer the core wakes
    /// at present.
    Lateness(&'a Lateness, Ticks),
    /// The MCU was rebuilt and waits for a configuration.
    Reset,
}
