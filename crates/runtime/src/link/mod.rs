// SPDX-License-Identifier: GPL-3.0-or-later
//! The link's thread: it takes blocks from the host to the core, and responses back.

pub(crate) mod core_end;
pub(crate) mod handshake;
pub(crate) mod host_end;
pub(crate) mod ledger;
pub(crate) mod oversight;
mod survey;
pub(crate) mod thread;
