// SPDX-License-Identifier: GPL-3.0-or-later
//! Standard input and output: the host, or a program on the way to it, has started Pinion. Pinion ends with the input.

use std::io::{self, IsTerminal};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::stat::fstat;
use nix::sys::termios::{SetArg, Termios, cfmakeraw, tcgetattr, tcsetattr};
use nix::unistd::{read, write};
use signal_hook::iterator::Signals;
use signal_hook::low_level::emulate_default_handler;

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::monotonic;

use super::{Input, Transport};
use crate::process::signals;
use crate::trouble::{refused, started};

/// When to try again if the output has no room. A pipe has room for 64 KiB, so this is rare.
const FULL_PAUSE: Duration = Duration::from_millis(1);

/// Standard input and output as they were. Other programs may use them after this one.
static BEFORE: Mutex<Vec<Before>> = Mutex::new(Vec::new());

struct Before {
    fd: OwnedFd,
    flags: OFlag,
    /// `None` if it is no terminal.
    settings: Option<Termios>,
}

/// Standard input and output, in use until this is dropped. Then they are given back.
pub(crate) struct StdioGuard(());

impl StdioGuard {
    /// Call this before the program changes one of them. `more` are signals that end the program at once, beside those
    /// that always do.
    ///
    /// # Errors
    ///
    /// The kernel refuses them, or a thread.
    pub(crate) fn take(more: &[i32]) -> Result<StdioGuard, Trouble> {
        give_back_at_signal(more)?;
        let remember = |fd: BorrowedFd<'_>| -> io::Result<()> {
            let flags = OFlag::from_bits_retain(fcntl(fd, FcntlArg::F_GETFL)?);
            let before = Before { fd: fd.try_clone_to_owned()?, flags, settings: tcgetattr(fd).ok() };
            BEFORE.lock().unwrap_or_else(PoisonError::into_inner).push(before);
            Ok(())
        };
        let both = remember(io::stdin().as_fd()).and_then(|()| remember(io::stdout().as_fd()));
        both.map(|()| StdioGuard(())).map_err(|error| {
            refused("standard input and output cannot be used", error).remedy("let ssh or socat start Pinion")
        })
    }
}

impl Drop for StdioGuard {
    fn drop(&mut self) {
        give_back();
    }
}

/// Gives standard input and output back as they were. Does nothing if they are not lent.
pub fn give_back() {
    let before = std::mem::take(&mut *BEFORE.lock().unwrap_or_else(PoisonError::into_inner));
    // In reverse order, because both may be one file.
    for Before { fd, flags, settings } in before.into_iter().rev() {
        // If this fails, the terminal is gone.
        let _ = fcntl(&fd, FcntlArg::F_SETFL(flags));
        let _ = settings.map(|settings| tcsetattr(&fd, SetArg::TCSANOW, &settings));
    }
}

/// Starts a thread that gives them back if a signal ends the program at once. `more` are signals that do so, too.
fn give_back_at_signal(more: &[i32]) -> Result<(), Trouble> {
    let thread = Signals::new(signals::deadly().iter().chain(more)).and_then(|mut deadly| {
        thread::Builder::new().name("stdio".into()).spawn(move || {
            for signal in deadly.forever() {
                give_back();
                let _ = emulate_default_handler(signal);
            }
        })
    });
    started(thread).map(drop)
}

/// Standard input and output.
pub(crate) struct Stdio {
    _lent: StdioGuard,
    input: OwnedFd,
    output: OwnedFd,
    /// The output had no room. When to try again.
    full_until: Option<Duration>,
}

impl Stdio {
    /// Takes both over.
    ///
    /// # Errors
    ///
    /// They are the terminal that shows the log, or the kernel refuses them.
    pub(crate) fn open() -> Result<Stdio, Trouble> {
        can_use()?;
        let lent = StdioGuard::take(&[])?;
        let opened = || -> io::Result<Stdio> {
            Ok(Stdio {
                _lent: lent,
                input: io::stdin().as_fd().try_clone_to_owned()?,
                output: io::stdout().as_fd().try_clone_to_owned()?,
                full_until: None,
            })
        };
        let stdio = opened().and_then(|stdio| stdio.prepare().map(|()| stdio));
        stdio.map_err(|error| {
            refused("standard input and output cannot be used", error).remedy("let ssh or socat start Pinion")
        })
    }

    fn prepare(&self) -> io::Result<()> {
        for fd in [&self.input, &self.output] {
            let flags = OFlag::from_bits_retain(fcntl(fd, FcntlArg::F_GETFL)?);
            if let Ok(mut settings) = tcgetattr(fd) {
                cfmakeraw(&mut settings);
                tcsetattr(fd, SetArg::TCSANOW, &settings)?;
            }
            fcntl(fd, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK))?;
        }
        Ok(())
    }
}

/// Whether standard input and output may carry a host.
///
/// # Errors
///
/// They are a person's terminal.
pub fn can_use() -> Result<(), Trouble> {
    if shows_log(io::stdin()) || shows_log(io::stdout()) {
        return Err(Trouble::new("this terminal shows the log, and a host's bytes are not text")
            .of("--link stdio")
            .remedy("let socat or ssh start Pinion so, or leave out --link for a host on this computer"));
    }
    Ok(())
}

/// Whether this is a person's terminal. A program may use a terminal too (the option `pty` of socat), but its log goes
/// elsewhere: in the same terminal the log would spoil the bytes.
fn shows_log(fd: impl AsFd + IsTerminal) -> bool {
    let device = |fd: BorrowedFd<'_>| fstat(fd).map(|about| about.st_rdev);
    let log = io::stderr();
    fd.is_terminal() && log.is_terminal() && device(fd.as_fd()) == device(log.as_fd())
}

impl Transport for Stdio {
    fn place(&self) -> String {
        "standard input".into()
    }

    fn detail(&self) -> String {
        "stdio".into()
    }

    fn event(&self) -> Option<BorrowedFd<'_>> {
        Some(self.input.as_fd())
    }

    fn due(&self) -> Option<Duration> {
        self.full_until
    }

    fn read(&mut self, buffer: &mut [u8], _hung_up: bool) -> io::Result<Input> {
        // The pause is over, even if there is nothing to write any more.
        self.full_until = None;
        // There may be bytes before the end.
        match read(&self.input, buffer) {
            Ok(0) if !buffer.is_empty() => Ok(Input::Over),
            Ok(len) => Ok(Input::Bytes(len)),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(Input::Bytes(0)),
            // A terminal or a socket whose other end is gone.
            Err(Errno::EIO | Errno::ECONNRESET) => Ok(Input::Over),
            Err(error) => Err(error.into()),
        }
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.full_until = None;
        match write(&self.output, bytes) {
            Ok(len) => Ok(len),
            Err(Errno::EAGAIN | Errno::EINTR) => {
                self.full_until = Some(monotonic() + FULL_PAUSE);
                Ok(0)
            }
            // The input reports that the host is gone.
            Err(Errno::EPIPE | Errno::EIO | Errno::ECONNRESET) => Ok(bytes.len()),
            Err(error) => Err(error.into()),
        }
    }

    fn silence_max(&self) -> Option<Duration> {
        None
    }
}
