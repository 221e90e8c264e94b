// SPDX-License-Identifier: GPL-3.0-or-later
//! The board's connection to the guardian process, which gets every output.

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pinion_firmware::shutdown::{Shutdown, reason};

/// Holds copies of the outputs' descriptors. If the program dies, it sets the outputs to their shutdown values.
///
/// An output is known by its name, for example `gpiochip0 line 5` or `pwmchip0/pwm1`. The log uses the same name. A new
/// output with the same name replaces the earlier one.
///
/// Each call fails if the guardian refuses or does not answer.
pub trait Guard: Send {
    /// Copies an output line's descriptor (a GPIO line handle of the character device). `sleeping` is the name of the
    /// line's chip, if calls to this chip may block. The lines of this chip have a thread of their own, so that no
    /// other output waits for it.
    fn output(&mut self, name: &str, line: RawFd, shutdown_value: bool, sleeping: Option<&str>) -> io::Result<()>;

    /// Copies the descriptors of the files that set one output, for example a PWM's `duty_cycle` and `enable`.
    /// `shutdown` has the text to write at the beginning of each file, in this order.
    fn files(&mut self, name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()>;

    /// Drops the copies of a line or channel that is no longer an output.
    fn forget(&mut self, name: &str) -> io::Result<()>;

    /// Drops all copies. When this returns, the lines can be requested again.
    fn release(&mut self) -> io::Result<()>;
}

/// The guard, if there is one, shared by the board and its workers. A call waits for the guardian's answer. So the core
/// calls it only until the MCU is configured. Later only workers call it.
#[derive(Clone)]
pub(super) struct SharedGuard(Option<Arc<Mutex<Box<dyn Guard>>>>);

impl SharedGuard {
    pub(super) fn new(guard: Option<Box<dyn Guard>>) -> SharedGuard {
        SharedGuard(guard.map(|guard| Arc::new(Mutex::new(guard))))
    }

    fn lock(&self) -> Option<MutexGuard<'_, Box<dyn Guard>>> {
        self.0.as_ref().map(|guard| guard.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// See [`Guard::output`].
    pub(super) fn output(
        &self,
        name: &str,
        line: RawFd,
        shutdown_value: bool,
        sleeping: Option<&str>,
    ) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => {
                guard.output(name, line, shutdown_value, sleeping).map_err(|error| not_taken(name, &error))
            }
            None => Ok(()),
        }
    }

    /// See [`Guard::files`].
    pub(super) fn files(&self, name: &str, shutdown: &[(RawFd, &[u8])]) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => guard.files(name, shutdown).map_err(|error| not_taken(name, &error)),
            None => Ok(()),
        }
    }

    /// See [`Guard::forget`].
    pub(super) fn forget(&self, name: &str) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => guard.forget(name).map_err(|error| not_taken(name, &error)),
            None => Ok(()),
        }
    }

    /// See [`Guard::release`].
    pub(super) fn release(&self) -> io::Result<()> {
        self.lock().map_or(Ok(()), |mut guard| guard.release())
    }
}

fn not_taken(name: &str, error: &io::Error) -> Shutdown {
    let cause = format!("the guardian does not take {name}: {error}");
    Shutdown::because(reason::GUARDIAN_LOST, cause).remedy("restart Pinion")
}
