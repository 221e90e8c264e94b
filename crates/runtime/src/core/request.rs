// SPDX-License-Identifier: GPL-3.0-or-later
//! The requests of the link to the core.

use std::sync::Arc;

use pinion_firmware::mcu::Dialect;
use pinion_firmware::shutdown::Shutdown;
use pinion_protocol::block::PAYLOAD_MAX;

/// The payload of a message block on its way to the core.
#[derive(Clone, Copy)]
pub(crate) struct Payload {
    len: u8,
    bytes: [u8; PAYLOAD_MAX],
}

impl Payload {
    /// A copy of `payload`, the payload of one block.
    pub(crate) fn new(payload: &[u8]) -> Payload {
        let len = payload.len().min(PAYLOAD_MAX);
        let mut bytes = [0; PAYLOAD_MAX];
        bytes[..len].copy_from_slice(&payload[..len]);
        Payload { len: len as u8, bytes }
    }

    pub(crate) fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// A request of the link to the core.
pub(crate) enum Request {
    /// Run the commands of a block.
    Run(Payload),
    /// Stop the MCU.
    Shutdown(Shutdown),
    /// Speak this dialect: another host came. The link keeps a copy, so that the core never frees one.
    Speak(Arc<Dialect>),
    /// Reset an MCU that is of no use to a new process of the host.
    Renew,
    /// Report how late timers were.
    Report,
    /// Stop the MCU and end. A running MCU stops for this reason, if there is one. Otherwise somebody asked for it.
    Quit(Option<Shutdown>),
    /// Hang forever, for a test.
    Hang,
}
