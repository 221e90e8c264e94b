// SPDX-License-Identifier: GPL-3.0-or-later
//! The guarded program, as a process.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, getppid};

use pinion_linux::clock::{monotonic, wait_until};
use pinion_linux::sys;

/// How long to wait for the end of a process that was asked to end, or was killed.
pub(super) const END_LIMIT: Duration = Duration::from_secs(2);

/// The guarded program.
#[derive(Debug)]
pub(super) struct Program {
    pub(super) pid: Pid,
    pub(super) pidfd: Option<OwnedFd>,
}

impl Program {
    /// The process `pid`, which must be our parent.
    pub(super) fn new(pid: Pid) -> Program {
        // Linux before 5.3 has no pidfd. There only the socket shows that the program has ended.
        Program { pid, pidfd: sys::pidfd(pid).ok() }
    }

    pub(super) fn has_ended(&self) -> bool {
        match &self.pidfd {
            Some(pidfd) => is_readable(pidfd.as_fd()),
            None => getppid() != self.pid,
        }
    }

    pub(super) fn kill(&self) {
        // While it is our parent, its process number has not been given to another process.
        if getppid() == self.pid {
            let _ = kill(self.pid, Signal::SIGKILL);
        }
    }

    pub(super) fn wait_for_end(&self) {
        wait_until(monotonic() + END_LIMIT, || self.has_ended());
    }
}

fn is_readable(fd: BorrowedFd<'_>) -> bool {
    let mut fds = [PollFd::new(fd, PollFlags::POLLIN)];
    poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}
