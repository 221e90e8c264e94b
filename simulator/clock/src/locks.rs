// SPDX-License-Identifier: GPL-3.0-or-later
//! Mutexes, condition variables and semaphores of threads that take turns.
//!
//! A mutex and a semaphore keep their state in the C library's object. Only the wait is ours. A condition variable has
//! no state: nobody runs between its unlock and its wait.

use libc::{c_int, clockid_t, pthread_cond_t, pthread_mutex_t, sem_t, timespec};

use crate::clocks::deadline;
use crate::real::real;
use crate::threads::{Wait, WakeReason, is_one, wait, wake};
use crate::turns::{NEVER, now_ns};

/// # Safety
///
/// That of pthread_mutex_lock(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_mutex_lock(mutex: *mut pthread_mutex_t) -> c_int {
    if !is_one() {
        return real!(fn pthread_mutex_lock(mutex: *mut pthread_mutex_t) -> c_int);
    }
    loop {
        let status = real!(fn pthread_mutex_trylock(mutex: *mut pthread_mutex_t) -> c_int);
        if status != libc::EBUSY {
            return status;
        }
        wait(Wait::Address(mutex as usize), NEVER);
    }
}

/// # Safety
///
/// That of pthread_mutex_unlock(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_mutex_unlock(mutex: *mut pthread_mutex_t) -> c_int {
    let status = real!(fn pthread_mutex_unlock(mutex: *mut pthread_mutex_t) -> c_int);
    wake(mutex as usize, 1);
    status
}

/// Waits for a condition variable.
///
/// # Safety
///
/// That of pthread_cond_wait(3).
unsafe fn await_signal(condition: *mut pthread_cond_t, mutex: *mut pthread_mutex_t, deadline_ns: u64) -> c_int {
    // SAFETY: the same contract.
    unsafe { pthread_mutex_unlock(mutex) };
    let is_late = deadline_ns <= now_ns() || wait(Wait::Address(condition as usize), deadline_ns) == WakeReason::ByTime;
    // SAFETY: the same contract.
    unsafe { pthread_mutex_lock(mutex) };
    if is_late { libc::ETIMEDOUT } else { 0 }
}

/// # Safety
///
/// That of pthread_cond_wait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_cond_wait(condition: *mut pthread_cond_t, mutex: *mut pthread_mutex_t) -> c_int {
    if !is_one() {
        return real!(fn pthread_cond_wait(condition: *mut pthread_cond_t, mutex: *mut pthread_mutex_t) -> c_int);
    }
    // SAFETY: the same contract.
    unsafe { await_signal(condition, mutex, NEVER) }
}

/// # Safety
///
/// That of pthread_cond_timedwait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_cond_timedwait(
    condition: *mut pthread_cond_t,
    mutex: *mut pthread_mutex_t,
    time: *const timespec,
) -> c_int {
    if !is_one() {
        return real!(fn pthread_cond_timedwait(condition: *mut pthread_cond_t, mutex: *mut pthread_mutex_t,
            time: *const timespec) -> c_int);
    }
    // SAFETY: the same contract.
    unsafe { await_signal(condition, mutex, deadline(time)) }
}

/// # Safety
///
/// That of pthread_cond_clockwait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_cond_clockwait(
    condition: *mut pthread_cond_t,
    mutex: *mut pthread_mutex_t,
    clock: clockid_t,
    time: *const timespec,
) -> c_int {
    if !is_one() {
        return real!(fn pthread_cond_clockwait(condition: *mut pthread_cond_t, mutex: *mut pthread_mutex_t,
            clock: clockid_t, time: *const timespec) -> c_int);
    }
    // SAFETY: the same contract.
    unsafe { await_signal(condition, mutex, deadline(time)) }
}

/// # Safety
///
/// That of pthread_cond_signal(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_cond_signal(condition: *mut pthread_cond_t) -> c_int {
    wake(condition as usize, 1);
    if is_one() { 0 } else { real!(fn pthread_cond_signal(condition: *mut pthread_cond_t) -> c_int) }
}

/// # Safety
///
/// That of pthread_cond_broadcast(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_cond_broadcast(condition: *mut pthread_cond_t) -> c_int {
    wake(condition as usize, usize::MAX);
    if is_one() { 0 } else { real!(fn pthread_cond_broadcast(condition: *mut pthread_cond_t) -> c_int) }
}

/// Waits for a semaphore.
fn await_semaphore(semaphore: *mut sem_t, deadline_ns: u64) -> c_int {
    loop {
        if real!(fn sem_trywait(semaphore: *mut sem_t) -> c_int) == 0 {
            return 0;
        }
        if std::io::Error::last_os_error().raw_os_error() != Some(libc::EAGAIN) {
            return -1;
        }
        if deadline_ns <= now_ns() || wait(Wait::Address(semaphore as usize), deadline_ns) == WakeReason::ByTime {
            // SAFETY: the address of this thread's error number.
            unsafe { *libc::__errno_location() = libc::ETIMEDOUT };
            return -1;
        }
    }
}

/// # Safety
///
/// That of sem_wait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sem_wait(semaphore: *mut sem_t) -> c_int {
    if is_one() { await_semaphore(semaphore, NEVER) } else { real!(fn sem_wait(semaphore: *mut sem_t) -> c_int) }
}

/// # Safety
///
/// That of sem_timedwait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sem_timedwait(semaphore: *mut sem_t, time: *const timespec) -> c_int {
    if !is_one() {
        return real!(fn sem_timedwait(semaphore: *mut sem_t, time: *const timespec) -> c_int);
    }
    // SAFETY: invariant 1.
    await_semaphore(semaphore, unsafe { deadline(time) })
}

/// # Safety
///
/// That of sem_clockwait(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sem_clockwait(semaphore: *mut sem_t, clock: clockid_t, time: *const timespec) -> c_int {
    if !is_one() {
        return real!(fn sem_clockwait(semaphore: *mut sem_t, clock: clockid_t, time: *const timespec) -> c_int);
    }
    // SAFETY: invariant 1.
    await_semaphore(semaphore, unsafe { deadline(time) })
}

/// # Safety
///
/// That of sem_post(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sem_post(semaphore: *mut sem_t) -> c_int {
    let status = real!(fn sem_post(semaphore: *mut sem_t) -> c_int);
    wake(semaphore as usize, 1);
    status
}
