// SPDX-License-Identifier: GPL-3.0-or-later
//! A serial port: a UART, or the port of a USB gadget (`ttyGS0`). The port does not say whether a host is at its other
//! end. So a host counts as there while it sends.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::time::Duration;

use log::{info, warn};
use nix::errno::Errno;
use nix::fcntl::Flock;
use nix::sys::termios::{FlushArg, tcflush};
use nix::unistd::{read, write};

use pinion_firmware::mcu::Wire;
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::monotonic;
use pinion_linux::uart;

use super::{Input, Transport};

/// How long to wait before a port that is gone is opened again.
const REOPEN: Duration = Duration::from_secs(1);

/// A serial port.
pub(crate) struct SerialLine {
    path: PathBuf,
    baud: Option<u32>,
    state: State,
}

enum State {
    /// No other program may open it while it is in use.
    Open(Flock<File>),
    /// The port is gone. The time of the next try to open it.
    Gone(Duration),
}

impl SerialLine {
    /// Opens a port. A missing port is opened later.
    pub(crate) fn open(path: &Path, baud: Option<u32>) -> Result<SerialLine, Trouble> {
        let state = if path.exists() {
            State::Open(uart::open_line(path, baud)?)
        } else {
            warn!(
                "there is no {}: plug it in, load its driver, or name another (pinion pins lists them; Pinion opens it when it is there)",
                path.display()
            );
            State::Gone(monotonic() + REOPEN)
        };
        Ok(SerialLine { path: path.to_owned(), baud, state })
    }

    fn lose(&mut self) -> Input {
        warn!(
            "{} is gone, and the host with it: plug it in again (Pinion opens it when it is there)",
            self.path.display()
        );
        self.state = State::Gone(monotonic() + REOPEN);
        Input::Gone
    }
}

impl Transport for SerialLine {
    fn place(&self) -> String {
        self.path.display().to_string()
    }

    fn detail(&self) -> String {
        self.baud.map_or_else(|| "USB gadget".to_owned(), |baud| format!("{baud} baud"))
    }

    fn wire(&self) -> Wire {
        self.baud.map_or(Wire::Terminal, Wire::Serial)
    }

    fn event(&self) -> Option<BorrowedFd<'_>> {
        match &self.state {
            State::Open(file) => Some(file.as_fd()),
            State::Gone(_) => None,
        }
    }

    fn due(&self) -> Option<Duration> {
        match self.state {
            State::Open(_) => None,
            State::Gone(until) => Some(until),
        }
    }

    fn read(&mut self, buffer: &mut [u8], hung_up: bool) -> io::Result<Input> {
        match &self.state {
            State::Gone(until) if monotonic() < *until => {}
            State::Gone(_) => match uart::open_line(&self.path, self.baud) {
                Ok(file) => {
                    info!("{} is there", self.path.display());
                    self.state = State::Open(file);
                }
                Err(_) => self.state = State::Gone(monotonic() + REOPEN),
            },
            State::Open(_) if hung_up => return Ok(self.lose()),
            State::Open(file) => match read(file.as_fd(), buffer) {
                Ok(0) if !buffer.is_empty() => return Ok(self.lose()),
                Ok(len) => return Ok(Input::Bytes(len)),
                Err(Errno::EAGAIN | Errno::EINTR) => {}
                Err(_) => return Ok(self.lose()),
            },
        }
        Ok(Input::Bytes(0))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let State::Open(file) = &self.state else { return Ok(bytes.len()) };
        match write(file.as_fd(), bytes) {
            Ok(len) => Ok(len),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(0),
            // A read reports that the port is gone.
            Err(Errno::EIO | Errno::ENODEV | Errno::ENXIO) => Ok(bytes.len()),
            Err(error) => Err(error.into()),
        }
    }

    fn part_from_host(&mut self) {
        if let State::Open(file) = &self.state {
            // If this fails, the next host reads some blocks that were meant for this one, and skips them.
            let _ = tcflush(&**file, FlushArg::TCOFLUSH);
        }
    }
}
