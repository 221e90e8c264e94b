// SPDX-License-Identifier: GPL-3.0-or-later
//! An object's turn in the core.

#![forbid(unsafe_code)]

use std::ops::{Deref, DerefMut};

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::errand::{Job, Refused};
use super::{Mcu, Oid, Response, Timer, TimerId, WorkerId};

/// An object's turn in the core: the MCU, and which object it is. What an object starts in its turn (timers, errands,
/// holds) is its own.
pub struct Turn<'a> {
    mcu: &'a mut Mcu,
    oid: Oid,
}

impl Deref for Turn<'_> {
    type Target = Mcu;

    #[inline]
    fn deref(&self) -> &Mcu {
        self.mcu
    }
}

impl DerefMut for Turn<'_> {
    #[inline]
    fn deref_mut(&mut self) -> &mut Mcu {
        self.mcu
    }
}

impl<'a> Turn<'a> {
    #[inline]
    pub(super) fn new(mcu: &'a mut Mcu, oid: Oid) -> Turn<'a> {
        Turn { mcu, oid }
    }

    /// The object whose turn it is.
    #[inline]
    pub fn oid(&self) -> Oid {
        self.oid
    }

    /// Sends a response, if the host takes it.
    pub fn send<R: Response>(&mut self, response: R) {
        self.mcu.send(response);
    }

    /// Starts a timer of the object.
    ///
    /// # Errors
    ///
    /// "Timer too close" if it is the next of all and its instant has passed.
    #[inline]
    pub fn schedule(&mut self, timer: Timer, at: Clock) -> Result<(), Shutdown> {
        self.mcu.schedule(TimerId::of(self.oid, timer), at)
    }

    /// Starts a timer of the object for an activity of its own: late is late, but no fault of the host.
    pub fn go_on(&mut self, timer: Timer, at: Clock) {
        self.mcu.go_on(TimerId::of(self.oid, timer), at);
    }

    /// Stops a timer of the object, if it runs.
    pub fn cancel(&mut self, timer: Timer) {
        self.mcu.cancel(TimerId::of(self.oid, timer));
    }

    /// To be called when an output or device of the object has failed. A running MCU is stopped by the error that
    /// this returns. In a stopped one the log is told, and the shutdown value is tried again later.
    ///
    /// # Errors
    ///
    /// The failure, unless the MCU is stopped.
    pub fn device_failed(&mut self, kind: &str, failure: Shutdown) -> Result<(), Shutdown> {
        self.mcu.device_failed(self.oid, kind, failure)
    }

    pub(super) fn submit(&mut self, worker: WorkerId, job: Job) -> Result<(), Refused> {
        self.mcu.workers.submit(worker, job)
    }

    /// Says in the log that something of the object failed which does not stop the MCU.
    pub fn warn(&mut self, kind: &str, trouble: Shutdown) {
        self.mcu.warn(self.oid, kind, trouble);
    }

    /// To be called by an object that answered [`Safe::Later`](super::Safe::Later), once its outputs are at their
    /// shutdown values.
    pub fn is_safe(&mut self) {
        self.mcu.is_safe(self.oid);
    }
}
