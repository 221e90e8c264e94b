// SPDX-License-Identifier: GPL-3.0-or-later
//! Waits for descriptors, and the way to the simulated MCUs.
//!
//! A read from a descriptor that blocks is not replaced. During such a read real time passes, and none of the printer's. klippy
//! reads so from its children only.

use std::ffi::{CStr, OsStr};
use std::os::fd::IntoRawFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::OnceLock;

use libc::{c_char, c_int, epoll_event, fd_set, nfds_t, pollfd, timespec, timeval};

use crate::clocks::{after, ns_of};
use crate::real::real;
use crate::threads::{Wait, WakeReason, is_one, wait, yield_token};
use crate::turns::NEVER;

/// Waits until a descriptor is ready.
///
/// # Safety
///
/// That of poll(2).
unsafe fn await_any(fds: *mut pollfd, count: nfds_t, deadline_ns: u64) -> c_int {
    loop {
        let ms = 0;
        let ready = real!(fn poll(fds: *mut pollfd, count: nfds_t, ms: c_int) -> c_int);
        if ready != 0 || deadline_ns <= crate::turns::now_ns() {
            return ready;
        }
        if wait(Wait::Descriptors(fds, count as usize), deadline_ns) == WakeReason::ByTime {
            return real!(fn poll(fds: *mut pollfd, count: nfds_t, ms: c_int) -> c_int);
        }
    }
}

/// The end of a wait of milliseconds; without an end if they are negative.
fn after_ms(ms: c_int) -> u64 {
    u64::try_from(ms).map_or(NEVER, |ms| after(ms * 1_000_000))
}

/// # Safety
///
/// That of poll(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn poll(fds: *mut pollfd, count: nfds_t, ms: c_int) -> c_int {
    if !is_one() {
        return real!(fn poll(fds: *mut pollfd, count: nfds_t, ms: c_int) -> c_int);
    }
    if ms == 0 {
        yield_token();
    }
    // SAFETY: the same contract.
    unsafe { await_any(fds, count, after_ms(ms)) }
}

/// # Safety
///
/// That of poll(2), with the length of the array.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn __poll_chk(fds: *mut pollfd, count: nfds_t, ms: c_int, _bytes: usize) -> c_int {
    // SAFETY: the same contract.
    unsafe { poll(fds, count, ms) }
}

/// # Safety
///
/// That of ppoll(2). A mask of signals is ignored: klippy has no use for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ppoll(
    fds: *mut pollfd,
    count: nfds_t,
    time: *const timespec,
    mask: *const libc::sigset_t,
) -> c_int {
    if !is_one() {
        return real!(fn ppoll(fds: *mut pollfd, count: nfds_t, time: *const timespec, mask: *const libc::sigset_t)
            -> c_int);
    }
    // SAFETY: invariant 1.
    unsafe {
        let end = time.as_ref().map_or(NEVER, |time| after(ns_of(time)));
        await_any(fds, count, end)
    }
}

/// # Safety
///
/// That of epoll_wait(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn epoll_wait(epoll: c_int, events: *mut epoll_event, most: c_int, ms: c_int) -> c_int {
    let real =
        |ms: c_int| real!(fn epoll_wait(epoll: c_int, events: *mut epoll_event, most: c_int, ms: c_int) -> c_int);
    if !is_one() {
        return real(ms);
    }
    let mut fd = pollfd { fd: epoll, events: libc::POLLIN, revents: 0 };
    // SAFETY: the array has one entry.
    unsafe { await_any(&mut fd, 1, after_ms(ms)) };
    real(0)
}

/// # Safety
///
/// That of select(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn select(
    count: c_int,
    reads: *mut fd_set,
    writes: *mut fd_set,
    others: *mut fd_set,
    time: *mut timeval,
) -> c_int {
    let real = |time: *mut timeval| {
        real!(fn select(count: c_int, reads: *mut fd_set, writes: *mut fd_set, others: *mut fd_set, time: *mut timeval)
            -> c_int)
    };
    if !is_one() {
        return real(time);
    }
    // SAFETY: invariant 1.
    let has = |set: *mut fd_set, fd: c_int| !set.is_null() && unsafe { libc::FD_ISSET(fd, set) };
    let mut fds: Vec<pollfd> = Vec::new();
    for fd in 0..count {
        let events = [(reads, libc::POLLIN), (writes, libc::POLLOUT), (others, libc::POLLPRI)];
        let events = events.into_iter().filter(|(set, _)| has(*set, fd)).fold(0, |all, (_, event)| all | event);
        if events != 0 {
            fds.push(pollfd { fd, events, revents: 0 });
        }
    }
    // SAFETY: invariant 1; the array is ours.
    unsafe {
        let of = |time: &timeval| timespec { tv_sec: time.tv_sec, tv_nsec: time.tv_usec * 1000 };
        let span = time.as_ref().map(|time| ns_of(&of(time)));
        await_any(fds.as_mut_ptr(), fds.len() as nfds_t, span.map_or(NEVER, after));
    }
    real(&mut timeval { tv_sec: 0, tv_usec: 0 })
}

// ---- the MCUs

/// Paths that begin like this lead to sockets of the printer. klippy takes such a path for a pseudo terminal, and needs
/// nothing of it but bytes (`connect_pipe` in klippy/serialhdl.py).
const MCUS: &str = "/tmp/klipper_host_clock_";

/// The folder with the sockets.
static FOLDER: OnceLock<PathBuf> = OnceLock::new();

pub(crate) fn find_mcus_in(folder: PathBuf) {
    let _ = FOLDER.set(folder);
}

/// A connection to an MCU, if the path is one's.
///
/// # Safety
///
/// The path is valid.
unsafe fn connect_to_mcu(path: *const c_char) -> Option<c_int> {
    if !is_one() {
        return None;
    }
    // SAFETY: the caller's promise.
    let path = unsafe { CStr::from_ptr(path) };
    let mcu = path.to_bytes().strip_prefix(MCUS.as_bytes())?;
    let socket = UnixStream::connect(FOLDER.get()?.join(OsStr::from_bytes(mcu)));
    Some(socket.map_or(-1, IntoRawFd::into_raw_fd))
}

macro_rules! open {
    ($name:ident) => {
        /// # Safety
        ///
        /// That of open(2). A program may leave the mode out; what is in its place goes unused then.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $name(path: *const c_char, flags: c_int, mode: libc::mode_t) -> c_int {
            // SAFETY: invariant 1.
            match unsafe { connect_to_mcu(path) } {
                Some(socket) => socket,
                None => real!(fn $name(path: *const c_char, flags: c_int, mode: libc::mode_t) -> c_int),
            }
        }
    };
}
open!(open);
open!(open64);
