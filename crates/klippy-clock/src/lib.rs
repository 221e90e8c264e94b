// SPDX-License-Identifier: GPL-3.0-or-later
//! Gives an unmodified klippy the clock of a simulated printer. `pinion sim --try` starts klippy with this library in
//! `LD_PRELOAD`.
//!
//! klippy and the printer take turns. While klippy has the turn, exactly one of its threads runs; computing takes no time.
//! A call that would wait lets the next thread run that can ([`threads`]). If none can, klippy passes the turn to the
//! printer, with the time until which it waits ([`turns`]). The printer returns it at that time, or earlier if it has sent
//! something. So the time depends on no computer.
//!
//! # Invariants
//!
//! Each `unsafe` block relies on one of these:
//!
//! 1. A function here has the name and the C signature of a function of the C library, and callers keep the contract of
//!    that one: pointers that they pass are valid for the call.
//! 2. [`real`] returns the C library's function of a name; its type is the one of that function's manual page.
//! 3. What a waiting thread waits for is on its stack. It stays there until that thread has the token again, because the
//!    thread is inside its call. Others read it only while they hold the lock.
//! 4. Nothing here calls a function that this library replaces, except through [`real`]. The lock of [`threads`] and the
//!    waits for the token use the futex call of the kernel directly.
//!
//! A child that klippy starts is no participant: it runs in real time ([`children`]).

#![allow(unsafe_code)]

mod children;
mod clocks;
mod descriptors;
mod locks;
mod real;
mod threads;
mod turns;

use std::ffi::{CStr, CString};

/// The environment's word for this library: the descriptor of the socket, the number of the process that takes part (0: the
/// one that reads this first), and the folder with the MCUs.
const WORD: &CStr = c"PINION_CLOCK";

/// Takes part, if this process is the one. A program that replaces itself by another one keeps its number, as a script
/// that starts Python does. A child has another one.
extern "C" fn begin() {
    // SAFETY: the process has one thread yet.
    let word = unsafe { libc::getenv(WORD.as_ptr()) };
    if word.is_null() {
        return;
    }
    // SAFETY: it ends with a zero.
    let word = unsafe { CStr::from_ptr(word) }.to_string_lossy().into_owned();
    let mut parts = word.splitn(3, ':');
    let number = |part: Option<&str>| part.and_then(|part| part.parse::<i32>().ok());
    let (Some(socket), Some(pid), Some(folder)) = (number(parts.next()), number(parts.next()), parts.next()) else {
        return;
    };
    let mine = std::process::id() as i32;
    if pid != 0 && pid != mine {
        return;
    }
    let Ok(word) = CString::new(format!("{socket}:{mine}:{folder}")) else { return };
    // SAFETY: the process has one thread yet, and both strings end with a zero.
    unsafe { libc::setenv(WORD.as_ptr(), word.as_ptr(), 1) };
    descriptors::find_mcus_in(folder.into());
    turns::join(socket);
    children::begin();
    threads::begin();
}

/// The loader calls it before the program's own code.
#[used]
#[unsafe(link_section = ".init_array")]
static BEGIN: extern "C" fn() = begin;
