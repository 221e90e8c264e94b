// SPDX-License-Identifier: GPL-3.0-or-later
//! The time of a trial: the one clock of klippy and the printer, or the computer's.

use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use pinion_linux::clock::poll_timeout;

use crate::clock::{OneClock, Stop};

/// The clock of a trial.
pub enum Time {
    /// Both have one clock.
    One(Box<OneClock>),
    /// The computer's. The flag is set when the program is asked to end.
    Real(Instant, Arc<AtomicBool>),
}

impl Time {
    /// Time since some instant.
    pub fn now(&self) -> Duration {
        match self {
            Time::One(clock) => clock.now(),
            Time::Real(since, _) => since.elapsed(),
        }
    }

    /// Waits until klippy has sent something, or until a time. Returns whether it has.
    ///
    /// # Errors
    ///
    /// klippy cannot send anything any more.
    pub(crate) fn await_bytes(&mut self, api: &UnixStream, until: Duration) -> Result<bool, Stop> {
        let is_readable = |timeout| {
            let mut fds = [PollFd::new(api.as_fd(), PollFlags::POLLIN)];
            match poll(&mut fds, timeout) {
                Ok(count) => Ok(count > 0),
                Err(Errno::EINTR) => Ok(false),
                Err(error) => Err(io::Error::from(error)),
            }
        };
        match self {
            Time::One(clock) => clock.run(until, &mut || is_readable(PollTimeout::ZERO).unwrap_or(true)),
            Time::Real(since, ended) => {
                if ended.load(Ordering::SeqCst) {
                    return Err(Stop::Asked);
                }
                is_readable(poll_timeout(until.saturating_sub(since.elapsed()))).map_err(|_| Stop::Ended)
            }
        }
    }

    /// Lets time pass.
    ///
    /// # Errors
    ///
    /// klippy takes no more turns.
    pub(crate) fn sleep(&mut self, span: Duration) -> Result<(), Stop> {
        match self {
            Time::One(clock) => {
                let until = clock.now() + span;
                clock.run(until, &mut || false).map(drop)
            }
            Time::Real(..) => {
                thread::sleep(span);
                Ok(())
            }
        }
    }

    /// klippy has been sent something.
    pub(crate) fn poke(&mut self) {
        if let Time::One(clock) = self {
            clock.poke();
        }
    }
}
