// SPDX-License-Identifier: GPL-3.0-or-later
//! Bytes only: the protocol of Klipper's docs/Protocol.md, with no I/O and no state of the
//! machine.

#![forbid(unsafe_code)]

pub mod block;
mod crc;
pub mod dictionary;
pub mod format;
pub mod vlq;

/// The bytes end before the message does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;
