// SPDX-License-Identifier: GPL-3.0-or-later
//! The program's other processes: the guardian, and the search for the host. Both are forked before the program has
//! threads, because a process with threads cannot be forked.

#![forbid(unsafe_code)]

use std::ffi::CStr;
use std::io;
use std::os::fd::RawFd;

use log::warn;
use nix::sys::prctl;
use nix::sys::signal::Signal;
use nix::unistd::{chdir, setsid};

use pinion_linux::clock::Monotonic;
use pinion_linux::sys;

use super::guardian::{self, Guardian};
use super::host::{self, HostSearch};

/// The kernel's names of these processes. Their command lines are the program's.
pub(crate) const NAMES: [&CStr; 2] = [guardian::NAME, host::NAME];

/// Highest number of threads when the program forks them. A test also has its harness's thread.
pub(super) const THREADS_MAX: usize = if cfg!(test) { 2 } else { 1 };

/// The program's helper processes.
#[derive(Default)]
pub struct Helpers {
    /// It guards the board's outputs.
    pub guardian: Option<Guardian>,
    /// Without it every host is served in the dialect that most hosts accept.
    pub search: Option<HostSearch>,
}

impl Helpers {
    /// Forks them, then gives up the rights that this process does not need. Call it before any thread starts.
    /// `guarded` asks for a guardian. It has the core's clock and whether the core runs in real time.
    ///
    /// # Errors
    ///
    /// There are threads already, or the kernel has no room for a process, a socket or a page.
    pub fn start(guarded: Option<(Monotonic, bool)>, searches: bool) -> io::Result<Helpers> {
        // The search comes first, because it must share nothing with the guardian.
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

/// Gives a new process its name and its session, and closes all descriptors except `kept`. The process ignores the
/// signals that ask a program to end. A terminal and a service manager send them to all processes, and these processes
/// end with the program.
pub(super) fn settle(name: &CStr, kept: &[RawFd]) {
    // A failure is ignored: the process can work without any of these.
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
