// SPDX-License-Identifier: GPL-3.0-or-later
//! Where the machine leaves what it has to say.

#![forbid(unsafe_code)]

use crate::lateness::Lateness;
use crate::shutdown::Shutdown;
use crate::time::Ticks;

/// Where the machine leaves what it has to say.
pub trait Outbox: Send {
    /// A response to the host: the payload of one message block. It is dropped if the host
    /// does not read.
    fn send(&mut self, payload: &[u8]);

    /// Something for the log.
    fn note(&mut self, note: Note<'_>);
}

/// Something for the log.
#[derive(Debug)]
pub enum Note<'a> {
    /// The machine stopped.
    Shutdown(&'a Shutdown),
    /// Something failed that does not stop the machine.
    Warning(&'a Shutdown),
    /// Something else failed while it stopped.
    Trouble(&'a Shutdown),
    /// An output is at its shutdown value, after attempts that failed.
    Safe(&'a str),
    /// The host configured this many objects of each kind.
    Configured(&'a [(&'static str, usize)]),
    /// How late timers were since the machine was made, and how early the core now wakes for
    /// them.
    Lateness(&'a Lateness, Ticks),
    /// The machine was rebuilt and waits for a configuration.
    Reset,
}
