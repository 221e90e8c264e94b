// SPDX-License-Identifier: GPL-3.0-or-later
//! The program's other processes: the guardian, and the search for the host. Both are forked before the program has
//! threads, as a process with threads can not be.

#![forbid(unsafe_code)]

use std::ffi::CStr;
use std::io;
use std::os::fd::RawFd;

use log::warn;
use nix::sys::prctl;
use nix::sys::signal::Signal;
use nix::unistd::{chdir, setsid};

use crate::sys;
use crate::time::Monotonic;

use super::guardian::{self, Guardian};
use super::host::{self, HostSearch};

/// What the kernel calls their processes, whose command lines are the program's.
pub(crate) const NAMES: [&CStr; 2] = [guardian::NAME, host::NAME];

/// The processes that a program has.
#[derive(Default)]
pub struct Helpers {
    /// That of the board's outputs.
    pub guardian: Option<Guardian>,
    /// Without it every host is served in the dialect that most hosts take.
    pub search: Option<HostSearch>,
}

impl Helpers {
    /// Forks them, and then gives up what this process does not need itself. To be called before any thread is
    /// started. `guarded`, if outputs are to be guarded, has the core's clock and whether it runs in real time.
    ///
    /// # Errors
    ///
    /// There are threads already, or the kernel has no room for a process, a socket or a page.
    pub fn start(guarded: Option<(Monotonic, bool)>, searches: bool) -> io::Result<Helpers> {
        // The search comes first: it is to share nothing with the guardian.
        let search = searches.then(HostSearch::start).transpose()?;
        let guardian = guarded.map(|(clock, realtime)| Guardian::start(clock, realtime)).transpose()?;
        if let Err(error) = sys::keep_only(sys::SERVE) {
            warn!(
                "CAP_SYS_PTRACE and CAP_DAC_READ_SEARCH can not be given up: {error}: Pinion works, with more rights than it needs"
            );
        }
        Ok(Helpers { guardian, search })
    }
}

/// Gives a new process its name and its session, and leaves it no descriptors but these. It has the signals that ask a
/// program to end ignored: a terminal and a service manager send them to all processes, and these end with the program.
pub(super) fn settle(name: &CStr, kept: &[RawFd]) {
    // Failures are ignored here: without any of these the process can still do its work.
    let _ = prctl::set_name(name);
    let _ = setsid();
    let _ = chdir("/");
    let _ = sys::close_all_but(kept);
    for ignored in [
        Signal::SIGTERM,
        Signal::SIGINT,
        Signal::SIGHUP,
        Signal::SIGQUIT,
        Signal::SIGTSTP,
        Signal::SIGTTIN,
        Signal::SIGTTOU,
        Signal::SIGUSR1,
        Signal::SIGUSR2,
    ] {
        let _ = sys::ignore(ignored);
    }
}
