// SPDX-License-Identifier: GPL-3.0-or-later
//! Signals, as the link takes them in.

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;

use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1, SIGUSR2};
use signal_hook::iterator::backend::SignalDelivery;
use signal_hook::iterator::exfiltrator::SignalOnly;

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
        let (read, write) = UnixStream::pair()?;
        let mut known = vec![SIGTERM, SIGINT, SIGUSR1];
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
