// SPDX-License-Identifier: GPL-3.0-or-later
//! Bytes only: the protocol of Klipper's docs/Protocol.md, with no I/O and no state of the
//! machine.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod block;
pub mod clock;
mod crc;
pub mod dictionary;
pub mod format;
pub mod vlq;

/// The bytes end before the message does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;
