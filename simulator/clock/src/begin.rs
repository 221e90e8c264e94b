// SPDX-License-Identifier: GPL-3.0-or-later
//! How a process comes to take part.

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
    crate::descriptors::find_mcus_in(folder.into());
    crate::turns::join(socket);
    crate::children::begin();
    crate::threads::begin();
}

/// The loader calls it before the program's own code.
#[used]
#[unsafe(link_section = ".init_array")]
static BEGIN: extern "C" fn() = begin;
