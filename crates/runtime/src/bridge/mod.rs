// SPDX-License-Identifier: GPL-3.0-or-later
//! Carries a host to an MCU on another computer, over ssh.
//!
//! ```text
//! host <-pty-> pinion link <-pipes-> ssh <-network-> sshd <-pipes-> pinion attach <-pty-> pinion run
//! ```
//!
//! The bytes between both ends are the host's and the MCU's, unchanged. An end that is silent sends a sync byte now and
//! then. Klipper's protocol skips sync bytes between blocks, so they need no protocol of their own. The first one says
//! that the far end has the terminal open.

pub(crate) mod attach;
pub(crate) mod near;
mod round_trip;
pub(crate) mod ssh;

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::poll::PollFlags;
use nix::unistd::{read, write};

use pinion_linux::clock::monotonic;
use pinion_protocol::block::SYNC;

/// How long an end may be silent before it sends a sync byte. klippy asks for the time each second.
const SIGN_EVERY: Duration = Duration::from_secs(2);
/// How long the other end may be silent. After that the connection is lost.
const SILENCE_MAX: Duration = Duration::from_secs(5);
/// Highest number of bytes on their way from one descriptor to another. Then the sender has to wait.
const FLOW_BYTES: usize = 4096;

/// The result of a read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Incoming {
    /// This many bytes came, or none.
    Bytes(usize),
    /// There will be no more.
    Over,
}

/// Bytes in one direction.
struct Flow(Vec<u8>);

impl Flow {
    fn new() -> Flow {
        Flow(Vec::with_capacity(FLOW_BYTES))
    }

    fn has_room(&self) -> bool {
        self.0.len() < FLOW_BYTES
    }

    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn clear(&mut self) {
        self.0.clear();
    }

    fn push(&mut self, bytes: &[u8]) {
        self.0.extend_from_slice(bytes);
    }

    /// Takes in the bytes of `input`, and returns them.
    fn fill(&mut self, input: impl FnOnce(&mut [u8]) -> io::Result<Incoming>) -> io::Result<(Incoming, &mut [u8])> {
        let before = self.0.len();
        self.0.resize(before.max(FLOW_BYTES), 0);
        let heard = input(&mut self.0[before..]);
        let bytes = match &heard {
            Ok(Incoming::Bytes(bytes)) => *bytes,
            _ => 0,
        };
        self.0.truncate(before + bytes);
        Ok((heard?, &mut self.0[before..]))
    }

    /// Writes as many bytes as `output` has room for.
    fn drain(&mut self, output: impl FnOnce(&[u8]) -> io::Result<usize>) -> io::Result<()> {
        if !self.0.is_empty() {
            let written = output(&self.0)?;
            self.0.drain(..written);
        }
        Ok(())
    }
}

/// The connection to the other end: two descriptors, and keepalives.
struct Wire {
    input: OwnedFd,
    output: OwnedFd,
    outward: Flow,
    heard_at: Duration,
    said_at: Duration,
}

impl Wire {
    fn new(input: OwnedFd, output: OwnedFd) -> io::Result<Wire> {
        for fd in [&input, &output] {
            let flags = OFlag::from_bits_retain(fcntl(fd, FcntlArg::F_GETFL)?);
            fcntl(fd, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK))?;
        }
        let now = monotonic();
        Ok(Wire { input, output, outward: Flow::new(), heard_at: now, said_at: now })
    }

    /// The event to wait for at the output.
    fn output_events(&self) -> PollFlags {
        if self.outward.is_empty() { PollFlags::empty() } else { PollFlags::POLLOUT }
    }

    /// Reads the other end's bytes into `flow`, and returns them.
    fn read<'a>(&mut self, flow: &'a mut Flow) -> io::Result<(Incoming, &'a mut [u8])> {
        self.heard_at = monotonic();
        flow.fill(|buffer| read_some(&self.input, buffer))
    }

    /// Writes as many bytes as the pipe has room for.
    fn write(&mut self) -> io::Result<()> {
        if !self.outward.is_empty() {
            self.said_at = monotonic();
        }
        self.outward.drain(|bytes| write_some(&self.output, bytes))
    }

    /// Sends a keepalive if one is due.
    fn give_sign(&mut self) -> io::Result<()> {
        if self.outward.is_empty() && monotonic() >= self.said_at + SIGN_EVERY {
            self.outward.push(&[SYNC]);
        }
        self.write()
    }

    /// Whether the other end has been silent for too long.
    fn is_silent(&self) -> bool {
        monotonic() >= self.heard_at + SILENCE_MAX
    }

    /// Silence counts from now on: until now nobody listened.
    fn forgive_silence(&mut self) {
        self.heard_at = monotonic();
    }

    /// When to call [`Wire::give_sign`] and [`Wire::is_silent`] (CLOCK_MONOTONIC).
    fn due(&self) -> Duration {
        (self.said_at + SIGN_EVERY).min(self.heard_at + SILENCE_MAX)
    }
}

fn read_some(fd: impl AsFd, buffer: &mut [u8]) -> io::Result<Incoming> {
    match read(fd, buffer) {
        Ok(0) if !buffer.is_empty() => Ok(Incoming::Over),
        Ok(bytes) => Ok(Incoming::Bytes(bytes)),
        Err(Errno::EAGAIN | Errno::EINTR) => Ok(Incoming::Bytes(0)),
        // A terminal or a socket whose other end is gone.
        Err(Errno::EIO | Errno::ECONNRESET) => Ok(Incoming::Over),
        Err(error) => Err(error.into()),
    }
}

/// Bytes for a reader that is gone count as written. The next read reports that it is gone.
fn write_some(fd: impl AsFd, bytes: &[u8]) -> io::Result<usize> {
    match write(fd, bytes) {
        Ok(written) => Ok(written),
        Err(Errno::EAGAIN | Errno::EINTR) => Ok(0),
        Err(Errno::EPIPE | Errno::EIO | Errno::ECONNRESET) => Ok(bytes.len()),
        Err(error) => Err(error.into()),
    }
}
