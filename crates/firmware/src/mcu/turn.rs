// SPDX-License-Identifier: GPL-3.0-or-later
//! An object's turn in the core.

#![forbid(unsafe_code)]

use std::ops::{Deref, DerefMut};

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::errand::{Job, Refused};
use super::{Mcu, Oid, Response, Timer, TimerId, WorkerId};

/// An object's turn in the core: the MCU and the object's id. The timers, errands and holds that an object starts in
/// its turn are its own.
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

    /// Sends a response, if the host uses it.
    pub fn send<R: Response>(&mut self, response: R) {
        self.mcu.send(response);
    }

    /// Starts a timer of the object.
    ///
    /// # Errors
    ///
    /// "Timer too close" if it is the first of all timers and its time has passed.
    #[inline]
    pub fn schedule(&mut self, timer: Timer, at: Clock) -> Result<(), Shutdown> {
        self.mcu.schedule(TimerId::of(self.oid, timer), at)
    }

    /// Starts a timer for an activity of the object's own. It may be late: that is not the host's fault.
    pub fn go_on(&mut self, timer: Timer, at: Clock) {
        self.mcu.go_on(TimerId::of(self.oid, timer), at);
    }

    /// Stops a timer of the object, if it runs.
    pub fn cancel(&mut self, timer: Timer) {
        self.mcu.cancel(TimerId::of(self.oid, timer));
    }

    /// Call this when an output or device of the object has failed. The returned error stops a running MCU. If the MCU
    /// is already stopped, the failure is logged and the shutdown value is retried later.
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

    /// Logs a failure of the object that does not stop the MCU.
    pub fn warn(&mut self, kind: &str, trouble: Shutdown) {
        self.mcu.warn(self.oid, kind, trouble);
    }

    /// Call this after answering [`Safe::Later`](super::Safe::Later), when the object's outputs are at their shutdown
    /// values.
    pub fn is_safe(&mut self) {
        self.mcu.is_safe(self.oid);
    }
}
