// SPDX-License-Identifier: GPL-3.0-or-later
//! Bytes over a tty, and the blocks in them.

use std::fs::{File, OpenOptions};
use std::io::{self, IsTerminal, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Instant;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::termios::{self, FlushArg, SetArg};
use nix::sys::time::TimeSpec;
use pinion_protocol::block::{Resync, Resynced, Sequence, frame};

use crate::Error;

/// Carries bytes over a tty, pty, socket or any other pollable file. Finds the blocks in the input, in any order. Tests
/// send bytes through it that a [`BlockLink`](super::BlockLink) would never send.
#[derive(Debug)]
pub struct Port {
    file: File,
    pub(super) name: String,
    resync: Resync,
    input: Vec<u8>,
    pub(super) output: Vec<u8>,
    /// Number of bytes outside intact blocks.
    pub(super) garbage: u64,
}

impl Port {
    /// Opens a tty, makes it raw and discards the remains of an earlier session.
    pub fn open(path: &Path) -> Result<Port, Error> {
        let name = path.display().to_string();
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags((OFlag::O_NOCTTY | OFlag::O_NONBLOCK).bits())
            .open(path)
            .map_err(|source| Error::Io { doing: "open", port: name.clone(), source })?;
        // Bytes written to a regular file would stay in it.
        if !file.is_terminal() {
            return Err(Error::NoTerminal { port: name });
        }
        Port::new(file, name)
    }

    /// Takes over an open descriptor. A tty is made raw. Errors use `name` for it.
    pub fn from_fd(fd: OwnedFd, name: &str) -> Result<Port, Error> {
        Port::new(File::from(fd), name.to_owned())
    }

    fn new(file: File, name: String) -> Result<Port, Error> {
        let set_up = || -> Result<(), Errno> {
            let flags = OFlag::from_bits_truncate(fcntl(&file, FcntlArg::F_GETFL)?);
            fcntl(&file, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK))?;
            match termios::tcgetattr(&file) {
                Ok(mut attributes) => {
                    termios::cfmakeraw(&mut attributes);
                    termios::tcsetattr(&file, SetArg::TCSANOW, &attributes)?;
                    termios::tcflush(&file, FlushArg::TCIFLUSH)
                }
                Err(Errno::ENOTTY) => Ok(()),
                Err(errno) => Err(errno),
            }
        };
        match set_up() {
            Ok(()) => {
                Ok(Port { file, name, resync: Resync::default(), input: Vec::new(), output: Vec::new(), garbage: 0 })
            }
            Err(errno) => Err(Error::Io { doing: "set up", port: name, source: errno.into() }),
        }
    }

    /// The tty's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Appends bytes, unchanged, to the output buffer.
    pub fn queue(&mut self, bytes: &[u8]) {
        self.output.extend_from_slice(bytes);
    }

    /// Appends an intact block with this sequence number to the output buffer.
    pub fn queue_block(&mut self, payload: &[u8], sequence: Sequence) {
        frame(payload, sequence, &mut self.output);
    }

    /// Writes the output buffer, and reads until bytes arrive or the time is over. Returns whether bytes arrived.
    pub fn exchange(&mut self, until: Instant) -> Result<bool, Error> {
        self.write_some()?;
        let wait = until.saturating_duration_since(Instant::now());
        let mut interest = PollFlags::POLLIN;
        if !self.output.is_empty() {
            interest |= PollFlags::POLLOUT;
        }
        let mut fds = [PollFd::new(self.file.as_fd(), interest)];
        match ppoll(&mut fds, Some(TimeSpec::from_duration(wait)), None) {
            Ok(0) | Err(Errno::EINTR) => return Ok(false),
            Ok(_) => {}
            Err(errno) => return Err(self.failed("poll", errno.into())),
        }
        let ready = fds[0].revents().unwrap_or(PollFlags::empty());
        if ready.contains(PollFlags::POLLOUT) {
            self.write_some()?;
        }
        if ready.intersects(PollFlags::POLLIN | PollFlags::POLLHUP | PollFlags::POLLERR) {
            return self.read_some();
        }
        Ok(false)
    }

    /// The next intact block among the bytes read so far.
    pub(super) fn next_block(&mut self) -> Option<(Sequence, Vec<u8>)> {
        loop {
            let (taken, found) = self.resync.next(&self.input);
            let block = match found {
                Resynced::Nothing => return None,
                Resynced::Block(sequence, payload) => Some((sequence, payload.to_vec())),
                Resynced::Garbage { .. } => {
                    self.garbage += taken as u64;
                    None
                }
            };
            self.input.drain(..taken);
            if block.is_some() {
                return block;
            }
        }
    }

    /// The next intact block; `None` if none arrives in time.
    pub fn wait_block(&mut self, until: Instant) -> Result<Option<(Sequence, Vec<u8>)>, Error> {
        loop {
            if let Some(block) = self.next_block() {
                return Ok(Some(block));
            }
            if !self.exchange(until)? && Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    pub(super) fn write_some(&mut self) -> Result<(), Error> {
        while !self.output.is_empty() {
            match (&self.file).write(&self.output) {
                Ok(written) => drop(self.output.drain(..written)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(self.failed("write to", error)),
            }
        }
        Ok(())
    }

    fn read_some(&mut self) -> Result<bool, Error> {
        let mut bytes = [0; 4096];
        match (&self.file).read(&mut bytes) {
            Ok(0) => Err(Error::Closed { port: self.name.clone() }),
            Ok(count) => {
                self.input.extend_from_slice(&bytes[..count]);
                Ok(true)
            }
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => Ok(false),
            Err(error) => Err(self.failed("read from", error)),
        }
    }

    fn failed(&self, doing: &'static str, source: io::Error) -> Error {
        // If the other end is gone, a pty fails with EIO, and a socket with EPIPE or ECONNRESET.
        if let Some(libc::EIO | libc::EPIPE | libc::ECONNRESET) = source.raw_os_error() {
            return Error::Closed { port: self.name.clone() };
        }
        Error::Io { doing, port: self.name.clone(), source }
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd;
    use std::os::unix::net::UnixStream;
    use std::time::Duration;

    use nix::pty::openpty;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn any_bytes_at_all_do_no_harm(noise in proptest::collection::vec(any::<u8>(), 0..300)) {
            let (ours, theirs) = UnixStream::pair().unwrap();
            let mut port = Port::from_fd(ours.into(), "noise").unwrap();
            (&theirs).write_all(&noise).unwrap();
            while port.wait_block(Instant::now() + Duration::from_millis(1)).unwrap().is_some() {}
        }
    }

    #[test]
    fn a_pty_carries_every_byte() {
        let pty = openpty(None, None).unwrap();
        let path = std::fs::read_link(format!("/proc/self/fd/{}", pty.slave.as_raw_fd())).unwrap();
        let mut port = Port::open(&path).unwrap();
        let mut other = Port::from_fd(pty.master, "master").unwrap();
        let until = Instant::now() + Duration::from_secs(60);
        for first in (0..=255u8).step_by(32) {
            let payload: Vec<u8> = (first..=first | 31).collect();
            port.queue_block(&payload, Sequence::default());
            port.exchange(Instant::now()).unwrap();
            assert_eq!(other.wait_block(until).unwrap(), Some((Sequence::default(), payload)));
        }
    }
}
