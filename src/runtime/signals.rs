// SPDX-License-Identifier: GPL-3.0-or-later
//! Signals, as the link takes them in.

#![forbid(unsafe_code)]

use std::fs;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;

use nix::sys::signal::Signal::{SIGTSTP, SIGTTIN, SIGTTOU};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1, SIGUSR2};
use signal_hook::iterator::backend::SignalDelivery;
use signal_hook::iterator::exfiltrator::SignalOnly;

use crate::sys;

/// What a signal asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Signal {
    /// To end the program in order.
    End,
    /// To tell in the log how late timers were.
    Report,
    /// A core that hangs, for a test.
    Hang,
}

/// The signals that came.
pub(super) struct Signals(SignalDelivery<UnixStream, SignalOnly>);

impl Signals {
    /// From now on the signals that we know come here.
    pub(super) fn new() -> io::Result<Signals> {
        // A key that stops programs, or a log line to a terminal that takes none from the background,
        // is no reason to leave heaters to themselves.
        for stop in [SIGTSTP, SIGTTIN, SIGTTOU] {
            sys::ignore(stop)?;
        }
        let (read, write) = UnixStream::pair()?;
        let mut known = vec![SIGTERM, SIGINT, SIGUSR1];
        // A terminal that hangs up ends the program, unless nohup(1) started it. (The C program
        // dies of it, its pins as they are.)
        if !hang_up_is_ignored(&fs::read_to_string("/proc/self/status")?) {
            known.push(SIGHUP);
        }
        if std::env::var_os("PINION_TEST_HANG").is_some() {
            known.push(SIGUSR2);
        }
        SignalDelivery::with_pipe(read, write, SignalOnly, known).map(Signals)
    }

    /// Readable once a signal has come.
    pub(super) fn event(&self) -> BorrowedFd<'_> {
        self.0.get_read().as_fd()
    }

    /// The next signal that has come.
    pub(super) fn next(&mut self) -> Option<Signal> {
        let signal = self.0.pending().next()?;
        Some(match signal {
            SIGUSR1 => Signal::Report,
            SIGUSR2 => Signal::Hang,
            _ => Signal::End,
        })
    }
}

/// By /proc/PID/status.
fn hang_up_is_ignored(status: &str) -> bool {
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    ignored.is_some_and(|mask| mask & 1 << (SIGHUP - 1) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_starts_the_program_may_have_hang_up_ignored() {
        let status = |mask: &str| format!("Name:\tpinion\nSigBlk:\t0000000000000001\nSigIgn:\t{mask}\n");
        assert!(hang_up_is_ignored(&status("0000000000001001")));
        assert!(!hang_up_is_ignored(&status("0000000000001002")));
        assert!(!hang_up_is_ignored("Name:\tpinion\n"));
    }
}
