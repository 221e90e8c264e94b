// SPDX-License-Identifier: GPL-3.0-or-later
//! What the board gives to the guardian process.

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::shutdown::{Shutdown, reason};

/// Keeps copies of the outputs, to drive them to their shutdown values if the program dies.
///
/// An output is known by its name, which is also what the log calls it, such as `gpiochip0 line 5`
/// or `pwmchip0/pwm1`. One that is given again replaces what was known of it.
pub trait Guard: Send {
    /// Copies an output line's descriptor (a GPIO line handle of the character device).
    /// `sleeping` is the line's chip if its driver may sleep, as it talks to the chip over a bus:
    /// the lines of such a chip are driven apart from all others, which do not wait for it.
    fn output(&mut self, name: &str, line: RawFd, shutdown_value: bool, sleeping: Option<&str>) -> io::Result<()>;

    /// Copies the descriptors of the files that drive one output (a PWM's duty cycle and its
    /// switch), and what is to be written at the beginning of each, in this order.
    fn files(&mut self, name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()>;

    /// Gives back the copies of one output, which is none any more.
    fn forget(&mut self, name: &str) -> io::Result<()>;

    /// Gives back every copy, so that the lines can be claimed anew. When this returns, they
    /// are free.
    fn release(&mut self) -> io::Result<()>;
}

/// The guard, if there is one, as board and workers share it. A call waits for the guardian: the
/// board makes it while the machine is configured, later only workers do.
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
    let detail = format!("the guardian does not take {name}: {error}: restart Pinion");
    Shutdown::because(reason::GUARDIAN_LOST, detail)
}
