// SPDX-License-Identifier: GPL-3.0-or-later
//! Gives an unmodified klippy the clock of a simulated printer. `pinion sim --try` starts klippy with this library in
//! `LD_PRELOAD`.
//!
//! klippy and the printer take turns. While klippy has the turn, exactly one of its threads runs; computing takes no time.
//! A call that would wait lets the next thread run that can (`threads`). If none can, klippy passes the turn to the
//! printer, with the time until which it waits (`turns`). The printer returns it at that time, or earlier if it has sent
//! something. So the time depends on no computer.
//!
//! # Invariants
//!
//! Each `unsafe` block relies on one of these:
//!
//! 1. A function here has the name and the C signature of a function of the C library, and callers keep the contract of
//!    that one: pointers that they pass are valid for the call.
//! 2. `real` returns the C library's function of a name; its type is the one of that function's manual page.
//! 3. What a waiting thread waits for is on its stack. It stays there until that thread has the token again, because the
//!    thread is inside its call. Others read it only while they hold the lock.
//! 4. Nothing here calls a function that this library replaces, except through `real`. The lock of `threads` and the
//!    waits for the token use the futex call of the kernel directly.
//!
//! A child that klippy starts is no participant: it runs in real time (`children`, `fork`).
//!
//! On a computer of 32 bits nothing is here: programs with times of 64 bits call other functions there.

#![allow(unsafe_code)]

#[cfg(target_pointer_width = "64")]
mod begin;
#[cfg(target_pointer_width = "64")]
mod children;
#[cfg(target_pointer_width = "64")]
mod clocks;
#[cfg(target_pointer_width = "64")]
mod descriptors;
#[cfg(target_pointer_width = "64")]
mod fork;
#[cfg(target_pointer_width = "64")]
mod locks;
#[cfg(target_pointer_width = "64")]
mod real;
#[cfg(target_pointer_width = "64")]
mod threads;
#[cfg(target_pointer_width = "64")]
mod turns;
