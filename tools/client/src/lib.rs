// SPDX-License-Identifier: GPL-3.0-or-later
//! The host's end of the wire: a small client for the demonstration of `pinion sim`, for the tests over a real pty, for
//! the tests on kernel drivers and for the benches.
//!
//! - [`serial`]: blocks over a tty, acknowledged and sent again as in klippy
//! - [`messages`]: commands and responses by their names in a dictionary
//! - [`client`]: a session: the dictionary, commands and responses, the MCU's clock
//! - [`config`]: oids, config commands, their checksum; resetting an MCU in use
//! - [`motion`]: step sequences, pacing them into the move queue, homing
//! - [`console`]: a session with a text interface
//!
//! There is one thread: a call that waits also reads, acknowledges and sends blocks again.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod client;
pub mod config;
pub mod console;
#[cfg(test)]
#[path = "../tests/support/fake.rs"]
mod fake;
pub mod messages;
pub mod motion;
pub mod serial;

use std::fmt;
use std::io;
use std::time::Duration;

pub use client::Client;
pub use messages::{Arg, Params};
pub use serial::BlockLink;

/// Why an operation of the client failed. Each error prints as one line with a remedy.
#[derive(Debug)]
pub enum Error {
    /// The tty refused an operation.
    Io {
        /// The operation.
        doing: &'static str,
        /// The tty's name.
        port: String,
        /// The kernel's answer.
        source: io::Error,
    },
    /// The path is not a terminal. Nothing was written to it.
    NoTerminal {
        /// The path.
        port: String,
    },
    /// The other end closed the connection.
    Closed {
        /// The tty's name.
        port: String,
    },
    /// Nothing arrived in time.
    Timeout {
        /// The expected event.
        waiting_for: String,
        /// The length of the wait.
        after: Duration,
    },
    /// The MCU shut down.
    Shutdown {
        /// The MCU's text.
        reason: String,
    },
    /// The data dictionary is invalid.
    Dictionary {
        /// The fault.
        why: String,
    },
    /// A message that does not fit the dictionary.
    Message {
        /// The command or response.
        message: String,
        /// The fault.
        why: String,
    },
    /// A plan that cannot be carried out.
    Plan {
        /// The axis, heater or value.
        subject: String,
        /// The fault, and the remedy.
        why: String,
    },
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Io { doing, port, source } => {
                write!(f, "cannot {doing} {port}: {source}: check that the MCU program runs and that you may open it")
            }
            Error::NoTerminal { port } => {
                write!(f, "{port} is not a terminal: name the link of a running Pinion, such as /tmp/klipper_host_mcu")
            }
            Error::Closed { port } => {
                write!(f, "{port} was closed by the other end: look at its log")
            }
            Error::Timeout { waiting_for, after } => write!(
                f,
                "no {waiting_for} within {:.1} s: check that the MCU program runs, and no other host on its tty",
                after.as_secs_f64()
            ),
            Error::Shutdown { reason } => {
                write!(f, "the MCU shut down: {reason}: look at its log, then reset it")
            }
            Error::Dictionary { why } => {
                write!(f, "the MCU's data dictionary is unusable: {why}: check that this tty is an MCU's")
            }
            Error::Message { message, why } => {
                write!(f, "{message}: {why}: look it up with `pinion dict`")
            }
            Error::Plan { subject, why } => write!(f, "{subject}: {why}"),
        }
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Error::Io { source, .. } => Some(source),
            _ => None,
        }
    }
}
