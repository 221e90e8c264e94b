// SPDX-License-Identifier: GPL-3.0-or-later
//! The turn goes to the printer and comes back, over a socket that klippy inherits.
//!
//! | from | bytes (little-endian) |
//! |---|---|
//! | klippy, first; again if its process runs another program | "pinion1\0", its process number (u64) |
//! | klippy | its time now, the time until which it waits, both in ns (u64); [`NEVER`] is no time |
//! | printer | the time now in ns (u64), whether it has sent something (u64: 1 or 0) |
//!
//! klippy's first turn begins with a message of the printer.

use std::ffi::c_void;
use std::sync::atomic::{AtomicI32, AtomicU64, Ordering};

use crate::real::real;

/// The time of a wait without an end.
pub(crate) const NEVER: u64 = u64::MAX;
/// The time that a reading of the clock takes, so that a loop that waits for a time ends.
const READ_NS: u64 = 20;

/// The socket; -1 in a process without the printer's clock.
static SOCKET: AtomicI32 = AtomicI32::new(-1);
static NOW_NS: AtomicU64 = AtomicU64::new(0);
/// The difference between the computer's clock and the printer's.
static WALL_NS: AtomicU64 = AtomicU64::new(0);

/// Whether this process has the printer's clock.
pub(crate) fn is_on() -> bool {
    SOCKET.load(Ordering::Relaxed) >= 0
}

/// The process is a child: it has the computer's clock from now on.
pub(crate) fn leave() {
    let socket = SOCKET.swap(-1, Ordering::Relaxed);
    if socket >= 0 {
        real!(fn close(socket: libc::c_int) -> libc::c_int);
    }
}

pub(crate) fn now_ns() -> u64 {
    NOW_NS.load(Ordering::Relaxed)
}

/// The time, a little later than before.
pub(crate) fn read_ns() -> u64 {
    NOW_NS.fetch_add(READ_NS, Ordering::Relaxed) + READ_NS
}

/// The difference between the time of day and the printer's time.
pub(crate) fn wall_ns() -> u64 {
    WALL_NS.load(Ordering::Relaxed)
}

/// Takes part, and waits for the first turn.
pub(crate) fn join(socket: i32) {
    let mut wall = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    let at: *mut libc::timespec = &raw mut wall;
    let clock = libc::CLOCK_REALTIME;
    real!(fn clock_gettime(clock: libc::clockid_t, at: *mut libc::timespec) -> libc::c_int);
    SOCKET.store(socket, Ordering::Relaxed);
    send(u64::from_le_bytes(*b"pinion1\0"), u64::from(std::process::id()));
    let (now, _) = receive();
    NOW_NS.store(now, Ordering::Relaxed);
    let wall_ns = wall.tv_sec as u64 * 1_000_000_000 + wall.tv_nsec as u64;
    WALL_NS.store(wall_ns.wrapping_sub(now), Ordering::Relaxed);
}

/// Gives the turn to the printer until `deadline_ns`. Returns whether it has sent something.
pub(crate) fn pass(deadline_ns: u64) -> bool {
    send(now_ns(), deadline_ns);
    let (now, news) = receive();
    NOW_NS.fetch_max(now, Ordering::Relaxed);
    news != 0
}

fn send(first: u64, second: u64) {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&first.to_le_bytes());
    bytes[8..].copy_from_slice(&second.to_le_bytes());
    let (socket, buffer, len) = (SOCKET.load(Ordering::Relaxed), bytes.as_ptr().cast::<c_void>(), bytes.len());
    let flags = libc::MSG_NOSIGNAL;
    // So short a message goes whole or not at all.
    if real!(fn send(socket: i32, buffer: *const c_void, len: usize, flags: i32) -> isize) != len as isize {
        end();
    }
}

fn receive() -> (u64, u64) {
    let mut bytes = [0_u8; 16];
    let socket = SOCKET.load(Ordering::Relaxed);
    let mut filled = 0;
    while filled < bytes.len() {
        let (buffer, len, flags) = (bytes[filled..].as_mut_ptr().cast::<c_void>(), bytes.len() - filled, 0);
        match real!(fn recv(socket: i32, buffer: *mut c_void, len: usize, flags: i32) -> isize) {
            0 => end(),
            got if got > 0 => filled += got as usize,
            _ if std::io::Error::last_os_error().kind() == std::io::ErrorKind::Interrupted => {}
            _ => end(),
        }
    }
    let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap_or_default());
    (word(0), word(8))
}

/// The printer is gone. Nobody would ever pass the turn again.
fn end() -> ! {
    // SAFETY: it does not return.
    unsafe { libc::_exit(0) }
}
