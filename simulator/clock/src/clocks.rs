// SPDX-License-Identifier: GPL-3.0-or-later
//! Clocks and sleeps.

use std::ffi::c_void;

use libc::{c_int, clockid_t, timespec};

use crate::real::real;
use crate::threads::{Wait, has_read, is_one, wait, yield_token};
use crate::turns::{NEVER, is_on, now_ns, read_ns, wall_ns};

const SECOND_NS: u64 = 1_000_000_000;
/// The shortest sleep, as long as the kernel's usual timer slack.
const SLACK_NS: u64 = 50_000;
/// Readings that a yield counts as, so that a loop of yields reaches its end.
const YIELDS: u32 = 50;

fn is_wall(clock: clockid_t) -> bool {
    [libc::CLOCK_REALTIME, libc::CLOCK_REALTIME_COARSE].contains(&clock)
}

fn is_printers(clock: clockid_t) -> bool {
    let clocks = [libc::CLOCK_MONOTONIC, libc::CLOCK_MONOTONIC_RAW, libc::CLOCK_MONOTONIC_COARSE, libc::CLOCK_BOOTTIME];
    is_wall(clock) || clocks.contains(&clock)
}

fn timespec_of(ns: u64) -> timespec {
    timespec { tv_sec: (ns / SECOND_NS) as libc::time_t, tv_nsec: (ns % SECOND_NS) as libc::c_long }
}

pub(crate) fn ns_of(time: &timespec) -> u64 {
    (time.tv_sec.max(0) as u64).saturating_mul(SECOND_NS).saturating_add(time.tv_nsec.max(0) as u64)
}

/// The end of a wait of this length.
pub(crate) fn after(ns: u64) -> u64 {
    now_ns().saturating_add(ns)
}

/// A point in time as the printer's time. Those of the time of day are far greater than those of the other clocks.
///
/// # Safety
///
/// The pointer is null or valid.
pub(crate) unsafe fn deadline(time: *const timespec) -> u64 {
    // SAFETY: the caller's promise.
    let Some(time) = (unsafe { time.as_ref() }) else { return NEVER };
    let ns = ns_of(time);
    if ns > wall_ns() / 2 { ns.saturating_sub(wall_ns()) } else { ns }
}

/// # Safety
///
/// That of clock_gettime(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn clock_gettime(clock: clockid_t, time: *mut timespec) -> c_int {
    if !is_on() || !is_printers(clock) {
        return real!(fn clock_gettime(clock: clockid_t, time: *mut timespec) -> c_int);
    }
    let ns = read() + if is_wall(clock) { wall_ns() } else { 0 };
    // SAFETY: invariant 1.
    unsafe { *time = timespec_of(ns) };
    0
}

fn read() -> u64 {
    if is_one() {
        has_read();
    }
    read_ns()
}

/// # Safety
///
/// That of gettimeofday(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gettimeofday(time: *mut libc::timeval, zone: *mut c_void) -> c_int {
    if !is_on() {
        return real!(fn gettimeofday(time: *mut libc::timeval, zone: *mut c_void) -> c_int);
    }
    let now = timespec_of(read() + wall_ns());
    // SAFETY: invariant 1.
    unsafe { *time = libc::timeval { tv_sec: now.tv_sec, tv_usec: now.tv_nsec / 1000 } };
    0
}

/// # Safety
///
/// That of time(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn time(to: *mut libc::time_t) -> libc::time_t {
    if !is_on() {
        return real!(fn time(to: *mut libc::time_t) -> libc::time_t);
    }
    let seconds = timespec_of(read() + wall_ns()).tv_sec;
    if !to.is_null() {
        // SAFETY: invariant 1.
        unsafe { *to = seconds };
    }
    seconds
}

/// # Safety
///
/// That of clock_nanosleep(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn clock_nanosleep(
    clock: clockid_t,
    flags: c_int,
    time: *const timespec,
    rest: *mut timespec,
) -> c_int {
    if !is_one() || !is_printers(clock) {
        return real!(fn clock_nanosleep(clock: clockid_t, flags: c_int, time: *const timespec, rest: *mut timespec)
            -> c_int);
    }
    // SAFETY: invariant 1.
    let end =
        unsafe { if flags & libc::TIMER_ABSTIME != 0 { deadline(time) } else { after(ns_of(&*time).max(SLACK_NS)) } };
    while now_ns() < end {
        wait(Wait::Time, end);
    }
    0
}

/// # Safety
///
/// That of nanosleep(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nanosleep(time: *const timespec, rest: *mut timespec) -> c_int {
    if !is_one() {
        return real!(fn nanosleep(time: *const timespec, rest: *mut timespec) -> c_int);
    }
    // SAFETY: the same contract.
    unsafe { clock_nanosleep(libc::CLOCK_MONOTONIC, 0, time, rest) }
}

/// # Safety
///
/// That of usleep(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn usleep(us: libc::c_uint) -> c_int {
    let time = timespec_of(u64::from(us) * 1000);
    // SAFETY: the time is ours.
    unsafe { nanosleep(&time, std::ptr::null_mut()) }
}

/// # Safety
///
/// That of sleep(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sleep(seconds: libc::c_uint) -> libc::c_uint {
    let time = timespec_of(u64::from(seconds) * SECOND_NS);
    // SAFETY: the time is ours.
    unsafe { nanosleep(&time, std::ptr::null_mut()) };
    0
}

/// # Safety
///
/// That of sched_yield(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sched_yield() -> c_int {
    if !is_one() {
        return real!(fn sched_yield() -> c_int);
    }
    (0..YIELDS).for_each(|_| _ = read_ns());
    yield_token();
    0
}
