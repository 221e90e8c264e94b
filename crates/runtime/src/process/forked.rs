// SPDX-License-Identifier: GPL-3.0-or-later
//! The common start of the program's forked processes.

use std::ffi::CStr;
use std::os::fd::RawFd;

use nix::sys::prctl;
use nix::sys::signal::Signal;
use nix::unistd::{chdir, setsid};

use pinion_linux::sys;

/// Highest number of threads when the program forks them. A test also has its harness's thread.
pub(crate) const THREADS_MAX: usize = if cfg!(test) { 2 } else { 1 };

/// Gives a new process its name and its session, and closes all descriptors except `kept`. The process ignores the
/// signals that ask a program to end. A terminal and a service manager send them to all processes, and these processes
/// end with the program.
pub(crate) fn settle(name: &CStr, kept: &[RawFd]) {
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
