// SPDX-License-Identifier: GPL-3.0-or-later
//! Errors of this crate when the kernel refuses a thread, a process or memory.

use std::fmt;
use std::io;

use pinion_firmware::trouble::Trouble;

/// The remedy if there can be no further process or thread.
pub(crate) const NO_PROCESS: &str = "raise TasksMax or ulimit -u";

/// That the kernel refuses something, in its words.
pub(crate) fn refused(what: impl fmt::Display, error: impl fmt::Display) -> Trouble {
    Trouble::new(error.to_string()).of(what)
}

/// That there is no memory or descriptor for a part of the program.
pub(crate) fn no_room(error: io::Error) -> Trouble {
    refused("Pinion cannot be started", error).remedy("raise LimitNOFILE, or free memory")
}

/// Adds the remedy for a thread that cannot be started.
pub fn started<T>(thread: io::Result<T>) -> Result<T, Trouble> {
    thread.map_err(|error| refused("no thread can be started", error).remedy(NO_PROCESS))
}
