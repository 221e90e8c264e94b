// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's output: responses for the host, and notes for the log.

use crate::lateness::Lateness;
use crate::shutdown::Shutdown;
use crate::time::Ticks;
use crate::trouble::Trouble;

/// Where the MCU leaves responses for the host and notes for the log. Its methods run in the core. They must not
/// allocate or block.
pub trait Outbox: Send {
    /// Takes a response to the host: the payload of one message block. The response is dropped if the host does not
    /// read and there is no room.
    fn send(&mut self, payload: &[u8]);

    /// Takes a note for the log.
    fn note(&mut self, note: Note<'_>);
}

/// A warning about a device, for the log.
#[derive(Debug)]
pub struct DeviceWarning {
    /// The first words of the warning. The log limits the lines that begin with them.
    pub kind: &'static str,
    /// The warning.
    pub trouble: Trouble,
}

impl DeviceWarning {
    /// A warning that begins with `kind`.
    pub fn new(kind: &'static str, trouble: impl Into<Trouble>) -> DeviceWarning {
        DeviceWarning { kind, trouble: trouble.into() }
    }
}

/// An event that belongs in the log.
#[derive(Debug)]
pub enum Note<'a> {
    /// The MCU stopped.
    Shutdown(&'a Shutdown),
    /// A failure that does not stop the MCU.
    Warning(&'a Shutdown),
    /// A warning that no object is named in.
    Device(&'a DeviceWarning),
    /// Another failure while the MCU stops or is stopped.
    Trouble(&'a Shutdown),
    /// This output is at its shutdown value after failed attempts.
    Safe(&'a str),
    /// The host configured this many objects of each kind.
    Configured(&'a [(&'static str, usize)]),
    /// How late timers were since the MCU was created, and how long before a timer the core wakes now.
    Lateness(&'a Lateness, Ticks),
    /// The MCU has forgotten its configuration and waits for another.
    Reset,
    /// Another process has come than the one that configured the MCU, so a stopped MCU is reset.
    Renewed,
}
