// SPDX-License-Identifier: GPL-3.0-or-later
//! The host's end of the link thread: whether a host is there, the blocks of its input, and the output for it.

use std::io;
use std::os::fd::BorrowedFd;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use log::{info, warn};

use pinion_firmware::shutdown::Shutdown;
use pinion_linux::LOOK_AT_LOG;
use pinion_linux::clock::monotonic;
use pinion_protocol::block::{Received, Receiver, Refusal, SYNC, Sequence, frame};

use crate::core::Payload;
use crate::status::HostStatus;
use crate::transport::{Input, Transport, serving};

/// The text that a shell writes to a pty to stop the MCU, as in Klipper's service file.
const FORCE_SHUTDOWN: &[u8] = b"FORCE_SHUTDOWN\n";
/// Highest number of bytes read from the link and not yet taken in.
const INPUT_BYTES: usize = 4096;
/// Highest number of bytes for a host that does not read. After that, responses wait in the ring; then they are lost.
const OUTPUT_BYTES: usize = 16 * 1024;

/// A link, with its input and its output.
pub(crate) struct HostEnd {
    link: Box<dyn Transport>,
    receiver: Receiver,
    input: Box<[u8; INPUT_BYTES]>,
    /// How many bytes of the input were read.
    filled: usize,
    /// How many of these are taken in.
    taken: usize,
    output: Vec<u8>,
    is_attached: bool,
    /// When a host that is silent counts as gone (CLOCK_MONOTONIC).
    silent_until: Option<Duration>,
    /// How long a host that is there may be silent.
    silence_max: Option<Duration>,
    /// Shows whether a host is there.
    shown: Arc<HostStatus>,
}

/// The result of a read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Read {
    /// A host has come.
    pub(crate) is_new_host: bool,
    /// The host has gone.
    pub(crate) is_gone: bool,
    /// No host can come any more.
    pub(crate) is_over: bool,
    /// Somebody wrote `FORCE_SHUTDOWN`.
    pub(crate) is_forced: bool,
    /// Only sync bytes came, between blocks. `pinion link` sends one while its host is silent.
    pub(crate) is_sign: bool,
}

/// The next item of the input.
pub(crate) enum Next {
    /// No complete block.
    Nothing,
    /// Something to refuse.
    Nak(Refusal),
    /// A block.
    Block(Payload),
}

impl HostEnd {
    /// The end of a link without a host.
    pub(crate) fn new(link: Box<dyn Transport>, shown: Arc<HostStatus>) -> HostEnd {
        HostEnd {
            silence_max: link.silence_max(),
            link,
            receiver: Receiver::default(),
            input: Box::new([0; INPUT_BYTES]),
            filled: 0,
            taken: 0,
            output: Vec::with_capacity(2 * OUTPUT_BYTES),
            is_attached: false,
            silent_until: None,
            shown,
        }
    }

    /// A descriptor: readable when the host has written, and hung up when the host is gone. `None` while the link is
    /// closed.
    pub(crate) fn event(&self) -> Option<BorrowedFd<'_>> {
        self.link.event()
    }

    /// When to call [`HostEnd::read`] although the descriptor reports nothing (CLOCK_MONOTONIC).
    pub(crate) fn due(&self) -> Option<Duration> {
        self.link.due().into_iter().chain(self.silent_until).min()
    }

    /// Whether the link's descriptor would report room for bytes.
    pub(crate) fn reports_room(&self) -> bool {
        self.link.due().is_none()
    }

    /// The terminal that a host on this computer opens.
    pub(crate) fn terminal(&self) -> Option<&Path> {
        self.link.terminal()
    }

    /// Whether the link is there. A port or an interface may come later.
    pub(crate) fn is_open(&self) -> bool {
        self.link.event().is_some()
    }

    /// Whether the host is on another computer, as far as was found out: `pinion attach` has the terminal open.
    pub(crate) fn is_carried(&self) -> bool {
        self.shown.is_carried()
    }

    pub(crate) fn is_attached(&self) -> bool {
        self.is_attached
    }

    /// Shows whether a host is there, and returns a line about it for the service manager.
    pub(crate) fn summary(&self) -> String {
        self.shown.attach(self.is_attached);
        self.shown.serve_on(self.link.detail());
        let host = if self.is_attached { "a host is attached" } else { "no host is attached" };
        format!("{} {}, {host}", serving(self.is_open()), self.link.place())
    }

    /// Reads the host's bytes. `hung_up`: the descriptor has hung up.
    pub(crate) fn read(&mut self, hung_up: bool) -> io::Result<Read> {
        let mut read = Read::default();
        let bytes = match self.link.read(&mut self.input[self.filled..], hung_up)? {
            Input::Bytes(bytes) => bytes,
            heard => {
                read.is_over = heard == Input::Over;
                read.is_gone = true;
                self.part();
                return Ok(read);
            }
        };
        let fresh = self.filled..self.filled + bytes;
        self.filled = fresh.end;
        if bytes > 0 && !self.is_attached {
            if self.link.meet_host() {
                self.is_attached = true;
                read.is_new_host = true;
                info!("host attached");
            } else {
                // The writer may have left the terminal useless, and another one is in place.
                self.shown.serve_on(self.link.detail());
            }
        }
        if let Some(silence_max) = self.silence_max.filter(|_| self.is_attached) {
            let now = monotonic();
            if bytes > 0 {
                self.silent_until = Some(now + silence_max);
            } else if self.silent_until.is_some_and(|until| now >= until) {
                read.is_gone = true;
                self.part();
            }
        }
        read.is_sign = bytes > 0 && self.input[..self.filled].iter().all(|byte| *byte == SYNC);
        if self.input[fresh.clone()] == *FORCE_SHUTDOWN {
            self.filled = fresh.start;
            read.is_forced = true;
            warn!("FORCE_SHUTDOWN was written to {}", self.link.detail());
        }
        Ok(read)
    }

    /// The fault of another program on the same wire, if it must stop the MCU.
    pub(crate) fn intrusion(&mut self) -> Option<Shutdown> {
        self.link.intrusion()
    }

    /// The host is gone.
    fn part(&mut self) {
        self.link.part_from_host();
        self.is_attached = false;
        self.silent_until = None;
        self.output.clear();
        info!("host gone");
    }

    /// The next block of the input.
    pub(crate) fn next(&mut self) -> Next {
        loop {
            let (bytes, received) = self.receiver.next(&self.input[self.taken..self.filled]);
            self.taken += bytes;
            match received {
                Received::Nothing => return Next::Nothing,
                Received::Skip => {}
                Received::Nak(why) => return Next::Nak(why),
                Received::Payload(payload) => return Next::Block(Payload::new(payload)),
            }
        }
    }

    /// Drops the input that was taken in. True if some input is left.
    pub(crate) fn forget_taken(&mut self) -> bool {
        let taken = std::mem::take(&mut self.taken);
        self.input.copy_within(taken..self.filled, 0);
        self.filled -= taken;
        self.filled > 0
    }

    /// Whether the host has to read before it gets more.
    pub(crate) fn is_full(&self) -> bool {
        self.output.len() >= OUTPUT_BYTES
    }

    /// Whether the link has taken all framed bytes.
    pub(crate) fn is_out(&self) -> bool {
        self.output.is_empty()
    }

    /// Frames a response with the sequence number after block `number`. An empty payload is an acknowledgement.
    pub(crate) fn frame(&mut self, payload: &[u8], number: u32) {
        frame(payload, Sequence::after(number), &mut self.output);
    }

    /// Writes as much as the link has room for. Returns the number of bytes.
    pub(crate) fn write(&mut self) -> u32 {
        if !self.is_attached {
            self.output.clear();
        }
        if self.output.is_empty() {
            return 0;
        }
        match self.link.write(&self.output) {
            Ok(written) => {
                self.output.drain(..written);
                written as u32
            }
            Err(error) => {
                warn!(
                    "{} cannot be written, and answers to the host are lost: {error}: {LOOK_AT_LOG}",
                    self.link.detail()
                );
                self.output.clear();
                0
            }
        }
    }
}
