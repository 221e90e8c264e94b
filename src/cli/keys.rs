// SPDX-License-Identifier: GPL-3.0-or-later
//! Keys that a person presses at the terminal, without Enter. Ctrl-C and the like stay the terminal's.

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::AsFd;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};
use nix::unistd::{getpgrp, read, tcgetpgrp};

/// The terminal on stdin, whose keys come one by one. Dropped, it is as before.
pub(super) struct Keys {
    before: Termios,
}

impl Keys {
    /// None where stdin is no terminal, or another program reads from it.
    pub(super) fn take() -> Option<Keys> {
        let stdin = io::stdin();
        let before = tcgetattr(&stdin).ok()?;
        if !is_ours() {
            return None;
        }
        let mut keyed = before.clone();
        keyed.local_flags.remove(LocalFlags::ICANON | LocalFlags::ECHO);
        tcsetattr(&stdin, SetArg::TCSANOW, &keyed).ok()?;
        Some(Keys { before })
    }

    /// Whether somebody has pressed this key. It does not wait.
    pub(super) fn has(&self, key: u8) -> bool {
        let stdin = io::stdin();
        let mut fds = [PollFd::new(stdin.as_fd(), PollFlags::POLLIN)];
        if !is_ours() || !matches!(poll(&mut fds, PollTimeout::ZERO), Ok(1)) {
            return false;
        }
        let mut pressed = [0; 64];
        read(&stdin, &mut pressed).is_ok_and(|count| pressed[..count].contains(&key))
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        if is_ours() {
            // A terminal that is gone needs nothing back.
            let _ = tcsetattr(io::stdin(), SetArg::TCSANOW, &self.before);
        }
    }
}

/// Whether the shell has this program in the foreground. Without job control nobody says so.
fn is_ours() -> bool {
    tcgetpgrp(io::stdin()).map_or(true, |group| group == getpgrp())
}
