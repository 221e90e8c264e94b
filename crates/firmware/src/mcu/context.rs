// SPDX-License-Identifier: GPL-3.0-or-later
//! The context of a call to a feature: the operations that the feature may use.

use std::sync::Arc;

use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks, TimeSource};

use super::stop::Subject;
use super::{Command, Dialect, Hold, MovePool, Object, Oid, Response, State, Timer, TimerId, WireClock};
use super::{DeviceWarning, Note};

/// The operations that a feature may use in a call. The timers and jobs that an object starts here are its own.
///
/// `config_` commands also claim lines, open devices and create objects ([`Context::assign`]). The MCU refuses this
/// after `finalize_config`.
pub struct Context<'a> {
    pub(super) state: &'a mut State,
    oid: Oid,
}

impl<'a> Context<'a> {
    #[inline]
    pub(super) fn new(state: &'a mut State, oid: Oid) -> Context<'a> {
        Context { state, oid }
    }

    pub(super) fn set_oid(&mut self, oid: Oid) {
        self.oid = oid;
    }

    /// The object that is called or configured.
    #[inline]
    pub fn oid(&self) -> Oid {
        self.oid
    }

    /// Sends a response, if the host uses it.
    pub fn send<R: Response>(&mut self, response: R) {
        self.state.wire.send(response);
    }

    /// Whether the host needs responses of type `R`.
    pub fn speaks<R: Response>(&self) -> bool {
        self.state.wire.speaks::<R>()
    }

    /// Whether the host needs this form of a command. Some behavior depends on the form of another command.
    pub fn takes(&self, command: &Command) -> bool {
        self.state.wire.dialect().needs(command.format)
    }

    /// The dialect of the present host. The MCU may not be able to serve it yet.
    pub fn heard(&self) -> &Arc<Dialect> {
        self.state.wire.heard()
    }

    /// The time now.
    #[inline]
    pub fn now(&mut self) -> Clock {
        self.state.scheduler.now()
    }

    /// Call this instead of [`Context::now`] after an edge that begins no timed pulse. It reads the time after every
    /// fourth of them.
    #[inline]
    pub fn made_edge(&mut self) {
        self.state.scheduler.made_edge();
    }

    /// The last time that was read. While timers run, it is a short time ago.
    #[inline]
    pub fn last_read(&self) -> Clock {
        self.state.scheduler.last_read()
    }

    /// Spins until `end`, for [`SPIN_MAX`](super::SPIN_MAX) at most. No other timer or command runs in that time. So
    /// use it only for spans as short as a step's pulse.
    #[inline]
    pub fn spin_until(&mut self, end: Clock) {
        self.state.scheduler.spin_until(end);
    }

    /// The clock, for pacing on a worker.
    pub fn clock(&self) -> Arc<dyn TimeSource> {
        self.state.scheduler.clock()
    }

    /// The time that the host means: the one nearest to now.
    pub fn instant(&mut self, clock: WireClock) -> Clock {
        self.state.scheduler.instant(clock)
    }

    /// Longest delay of a step before the MCU stops.
    pub fn step_late_limit(&self) -> Ticks {
        self.state.scheduler.step_late_limit()
    }

    /// Starts a timer of the object.
    ///
    /// # Errors
    ///
    /// "Timer too close" if it is the first of all timers and its time has passed.
    #[inline]
    pub fn schedule(&mut self, timer: Timer, at: Clock) -> Result<(), Shutdown> {
        let is_stopped = self.state.phase.is_stopped();
        self.state.scheduler.schedule(TimerId::of(self.oid, timer), at, is_stopped)
    }

    /// Starts a timer for an activity of the object's own. It may be late: that is not the host's fault.
    pub fn go_on(&mut self, timer: Timer, at: Clock) {
        self.state.scheduler.start(TimerId::of(self.oid, timer), at);
    }

    /// Stops a timer of the object, if it runs.
    pub fn cancel(&mut self, timer: Timer) {
        self.state.scheduler.cancel(TimerId::of(self.oid, timer));
    }

    /// The free moves, for a [`MoveQueue`](super::MoveQueue).
    #[inline]
    pub fn moves(&mut self) -> &mut MovePool {
        &mut self.state.moves
    }

    /// Whether the MCU is stopped.
    pub fn is_shutdown(&self) -> bool {
        self.state.phase.is_stopped()
    }

    /// Whether the configuration is complete.
    pub fn is_finalized(&self) -> bool {
        self.state.phase.is_finalized()
    }

    /// Returns the given shutdown as an error, which then stops the MCU. Returns `Ok` if the MCU is already stopped
    /// (Klipper's `try_shutdown`).
    ///
    /// # Errors
    ///
    /// `shutdown`, unless the MCU is stopped.
    pub fn try_shut_down(&self, shutdown: Shutdown) -> Result<(), Shutdown> {
        if self.is_shutdown() { Ok(()) } else { Err(shutdown) }
    }

    /// Call this when an output or device of the object has failed. The returned error stops a running MCU. If the MCU
    /// is already stopped, the failure is logged and the shutdown value is retried later.
    ///
    /// # Errors
    ///
    /// The failure, unless the MCU is stopped.
    pub fn device_failed(&mut self, kind: &str, failure: Shutdown) -> Result<(), Shutdown> {
        if !self.is_shutdown() {
            return Err(failure);
        }
        self.state.note_failure(Subject::Object(self.oid), Some(kind), failure);
        Ok(())
    }

    /// Logs a failure of the object that does not stop the MCU.
    pub fn warn(&mut self, kind: &str, trouble: Shutdown) {
        self.state.warn(self.oid, kind, trouble);
    }

    /// Logs a warning about a device.
    pub fn warn_of_device(&mut self, warning: &DeviceWarning) {
        self.state.wire.note(Note::Device(warning));
    }

    /// Call this after answering [`Safe::Later`](super::Safe::Later), when the object's outputs are at their shutdown
    /// values.
    pub fn is_safe(&mut self) {
        self.state.is_safe(Subject::Object(self.oid));
    }

    /// Makes further commands wait for this object until [`Context::release`]. It has an effect only if a command runs
    /// now.
    pub fn hold(&mut self) -> Hold {
        self.state.hold(self.oid)
    }

    /// Ends this hold. Commands run again if no other hold is left. Jobs that the object sends from now on hold
    /// nothing: they belong to its own work.
    pub fn release(&mut self, hold: Hold) {
        self.state.release(hold);
    }

    /// Call this after sending a command's job. Other commands of this kind to the same object need not wait, until
    /// `limit` jobs are on their way.
    pub fn let_join(&mut self, limit: u32) {
        self.state.barrier.let_join(limit);
    }

    /// Calls the object of type `T` under `oid`.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if there is no object, or an object of another type; any error of `f`.
    #[inline]
    pub fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Context) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        self.state.with(oid, f)
    }

    /// Checks that there is an object of type `T` under `oid`.
    ///
    /// # Errors
    ///
    /// "Invalid oid type".
    pub fn require<T: Object>(&mut self, oid: Oid) -> Result<(), Shutdown> {
        self.state.with::<T, _>(oid, |_, _| Ok(()))
    }

    /// Whether `f` is true for any object of type `T`.
    pub fn any<T: Object>(&self, f: impl FnMut(&T) -> bool) -> bool {
        self.state.objects.any(f)
    }

    /// Passes a trsync's trigger to an object that waits for it.
    ///
    /// # Errors
    ///
    /// Any error of [`Object::triggered`].
    pub fn trigger(&mut self, oid: Oid) -> Result<(), Shutdown> {
        let Some(mut object) = self.state.objects.take(oid) else { return Ok(()) };
        let result = object.triggered(&mut Context::new(self.state, oid));
        self.state.objects.put_back(oid, object);
        result
    }
}
