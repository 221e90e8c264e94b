// SPDX-License-Identifier: GPL-3.0-or-later
//! The calls that start klippy's children.

use crate::children::{forked, free_word};
use crate::real::real;
use crate::threads::is_one;

/// Starts a child, which is no participant.
///
/// # Safety
///
/// That of fork(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fork() -> libc::pid_t {
    let word = is_one().then(free_word);
    // SAFETY: they have no arguments.
    let is_main = unsafe { libc::gettid() == libc::getpid() };
    let pid = real!(fn fork() -> libc::pid_t);
    if let Some(word) = word {
        forked(pid, word, is_main);
    }
    pid
}

/// The same: a function cannot return twice on the stack of its caller.
///
/// # Safety
///
/// That of vfork(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vfork() -> libc::pid_t {
    // SAFETY: all that vfork(2) permits, fork(2) permits, too.
    unsafe { fork() }
}

macro_rules! spawn {
    ($name:ident) => {
        /// Starts a program, which is no participant.
        ///
        /// # Safety
        ///
        /// That of posix_spawn(3).
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $name(
            pid: *mut libc::pid_t,
            program: *const libc::c_char,
            actions: *const libc::posix_spawn_file_actions_t,
            attributes: *const libc::posix_spawnattr_t,
            arguments: *const *mut libc::c_char,
            environment: *const *mut libc::c_char,
        ) -> libc::c_int {
            let mut started = 0;
            let pid = if pid.is_null() { &raw mut started } else { pid };
            let status = real!(fn $name(
                pid: *mut libc::pid_t,
                program: *const libc::c_char,
                actions: *const libc::posix_spawn_file_actions_t,
                attributes: *const libc::posix_spawnattr_t,
                arguments: *const *mut libc::c_char,
                environment: *const *mut libc::c_char
            ) -> libc::c_int);
            if status == 0 && is_one() {
                // SAFETY: it is the caller's, or ours.
                forked(unsafe { *pid }, free_word(), false);
            }
            status
        }
    };
}
spawn!(posix_spawn);
spawn!(posix_spawnp);
