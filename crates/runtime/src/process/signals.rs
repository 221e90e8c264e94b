// SPDX-License-Identifier: GPL-3.0-or-later
//! Signals to the program. The link waits for them beside the host's bytes.

use std::fs;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;

use nix::sys::signal::Signal::{SIGTSTP, SIGTTIN, SIGTTOU};
use signal_hook::consts::{
    SIGALRM, SIGHUP, SIGINT, SIGPROF, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2, SIGVTALRM, SIGXCPU, SIGXFSZ,
};
use signal_hook::iterator::backend::SignalDelivery;
use signal_hook::iterator::exfiltrator::SignalOnly;

use pinion_linux::proc::status_field;
use pinion_linux::sys;

/// The request of a signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Signal {
    /// SIGTERM, SIGINT, SIGHUP: end the program in order.
    End,
    /// SIGUSR1: log how late timers were.
    Report,
    /// SIGUSR2, in tests only: let the core hang.
    Hang,
}

/// The signals that have come and were not read yet.
pub(crate) struct Signals(SignalDelivery<UnixStream, SignalOnly>);

impl Signals {
    /// Catches the signals that the program knows, so that they do not end it.
    pub(crate) fn new() -> io::Result<Signals> {
        // These would stop the program and leave heaters as they are. Ctrl-Z sends one. A background program gets one
        // if it reads from its terminal, or writes to a terminal that allows no output.
        for stop in [SIGTSTP, SIGTTIN, SIGTTOU] {
            sys::ignore(stop)?;
        }
        let (read, write) = UnixStream::pair()?;
        let mut known = vec![SIGTERM, SIGINT, SIGUSR1];
        // SIGHUP comes when a terminal closes, and ends the program in order. (It kills the C program, which leaves its
        // pins as they are.)
        known.extend(hang_up()?);
        if lets_hang() {
            known.push(SIGUSR2);
        }
        SignalDelivery::with_pipe(read, write, SignalOnly, known).map(Signals)
    }

    /// A descriptor that is readable when a signal has come.
    pub(crate) fn event(&self) -> BorrowedFd<'_> {
        self.0.get_read().as_fd()
    }

    /// The next signal that has come.
    pub(crate) fn next(&mut self) -> Option<Signal> {
        let signal = self.0.pending().next()?;
        Some(match signal {
            SIGUSR1 => Signal::Report,
            SIGUSR2 => Signal::Hang,
            _ => Signal::End,
        })
    }
}

/// Whether SIGUSR2 lets the core hang, for a test.
fn lets_hang() -> bool {
    std::env::var_os("PINION_TEST_HANG").is_some()
}

/// The signals that end the program at once, except those of crashes. systemd sends SIGQUIT to a program that hangs.
pub(crate) fn deadly() -> Vec<i32> {
    let usr2 = (!lets_hang()).then_some(SIGUSR2);
    [SIGQUIT, SIGALRM, SIGVTALRM, SIGPROF, SIGXCPU, SIGXFSZ].into_iter().chain(usr2).collect()
}

/// SIGHUP, unless the program was started with it ignored, as by nohup(1). Registering an ignored SIGHUP would let it
/// end the program. The answer is right as long as nobody has done so.
///
/// # Errors
///
/// /proc/self/status cannot be read.
pub fn hang_up() -> io::Result<Option<i32>> {
    const STATUS: &str = "/proc/self/status";
    let status =
        fs::read_to_string(STATUS).map_err(|error| io::Error::new(error.kind(), format!("{STATUS}: {error}")))?;
    Ok((!is_hang_up_ignored_in(&status)).then_some(SIGHUP))
}

/// `status` is /proc/PID/status.
fn is_hang_up_ignored_in(status: &str) -> bool {
    let ignored = status_field(status, "SigIgn").and_then(|mask| u64::from_str_radix(mask, 16).ok());
    ignored.is_some_and(|mask| mask & 1 << (SIGHUP - 1) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_starts_the_program_may_have_hang_up_ignored() {
        let status = |mask: &str| format!("Name:\tpinion\nSigBlk:\t0000000000000001\nSigIgn:\t{mask}\n");
        assert!(is_hang_up_ignored_in(&status("0000000000001001")));
        assert!(!is_hang_up_ignored_in(&status("0000000000001002")));
        assert!(!is_hang_up_ignored_in("Name:\tpinion\n"));
    }
}
