// SPDX-License-Identifier: GPL-3.0-or-later
//! Everything that may end the program or watches over it: signals, the guardian, the watchdogs.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};

use pinion_linux::clock::monotonic;

use crate::guardian::GuardianWatch;
use crate::process::signals::{Signal, Signals};
use crate::process::watchdog::{Vigil, Watchdog};

/// How long a host has to read why the program ends.
pub(crate) const FAREWELL: Duration = Duration::from_secs(1);

/// Watches over the program: signals, the guardian and the watchdogs.
pub(crate) struct Oversight {
    /// Signals and the guardian. Both are rare, so they share one descriptor, and the link waits for fewer.
    events: Epoll,
    signals: Signals,
    guardian: Option<GuardianWatch>,
    vigil: Vigil,
    /// When to end (CLOCK_MONOTONIC), because the guardian is gone.
    leave_at: Option<Duration>,
}

impl Oversight {
    /// `guardian` is `None` if the board has no outputs to guard.
    ///
    /// # Errors
    ///
    /// The kernel has no room.
    pub(crate) fn new(signals: Signals, guardian: Option<GuardianWatch>, vigil: Vigil) -> io::Result<Oversight> {
        let events = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        events.add(signals.event(), EpollEvent::new(EpollFlags::EPOLLIN, 0))?;
        if let Some(guardian) = &guardian {
            // The kernel reports a hang-up in any case.
            events.add(guardian.socket(), EpollEvent::new(EpollFlags::empty(), 0))?;
        }
        Ok(Oversight { events, signals, guardian, vigil, leave_at: None })
    }

    /// Feeds a hardware watchdog from now on.
    pub(crate) fn feed(&mut self, watchdog: Watchdog) {
        self.vigil.feed(watchdog);
    }

    /// Informs the service manager that a host may come.
    pub(crate) fn ready(&mut self) {
        self.vigil.ready();
    }

    /// Informs the service manager about the program's state.
    pub(crate) fn status(&self, status: &str) {
        self.vigil.status(status);
    }

    /// Informs the service manager that the program begins to end.
    pub(crate) fn stopping(&self) {
        self.vigil.stopping();
    }

    /// Stops the watchdogs.
    pub(crate) fn end(self) {
        self.vigil.end();
    }

    /// When to call [`Oversight::tick`] next, at the latest (CLOCK_MONOTONIC).
    pub(crate) fn due(&self) -> Option<Duration> {
        let look = self.guardian.as_ref().and_then(GuardianWatch::due);
        [self.leave_at, self.vigil.due(), look].into_iter().flatten().min()
    }

    /// Feeds the watchdogs. `now` is the time (CLOCK_MONOTONIC). If the guardian is of no use any more, it returns the
    /// reason.
    pub(crate) fn tick(&mut self, now: Duration) -> Option<&'static str> {
        self.vigil.tick(now);
        let guardian = self.guardian.as_mut()?;
        let hangs = guardian.due().is_some() && guardian.hangs(now);
        hangs.then_some("the guardian has no heartbeat: was it stopped? (a restart ends it)")
    }

    /// A descriptor that is readable when a signal has come or the guardian is gone.
    pub(crate) fn event(&self) -> BorrowedFd<'_> {
        self.events.0.as_fd()
    }

    /// Whether there was a guardian, and its process has ended.
    pub(crate) fn has_lost_guardian(&self) -> bool {
        self.guardian.as_ref().is_some_and(|guardian| {
            let mut fds = [PollFd::new(guardian.socket(), PollFlags::empty())];
            poll(&mut fds, PollTimeout::ZERO).is_ok_and(|gone| gone > 0)
        })
    }

    /// The guardian is gone or of no use. The program ends when the host has had time to read why.
    pub(crate) fn lose_guardian(&mut self) {
        if let Some(guardian) = self.guardian.take() {
            let _ = self.events.delete(guardian.socket());
        }
        self.leave_at = Some(monotonic() + FAREWELL);
    }

    /// Whether the host has had that time.
    pub(crate) fn is_over(&self) -> bool {
        self.leave_at.is_some_and(|at| monotonic() >= at)
    }

    /// The next signal that has come.
    pub(crate) fn next_signal(&mut self) -> Option<Signal> {
        self.signals.next()
    }
}
