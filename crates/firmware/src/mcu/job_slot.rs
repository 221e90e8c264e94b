// SPDX-License-Identifier: GPL-3.0-or-later
//! An object's places for its jobs.
//!
//! A job in its slot cannot be lost. It is here, or a worker has it. If it cannot be sent, it stays here.

use std::any::Any;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::job::{AnyJob, Boxed, Receiver, SentJob};
use super::{Context, DeviceId, Finished, Hold, Job};

/// The place of a job, here or with a worker.
pub struct JobSlot<J: Job> {
    receiver: Receiver,
    /// `None` while a worker has it.
    here: Option<Box<Boxed<J>>>,
    /// Whether the object still wants the result.
    is_wanted: bool,
}

/// The result of a job that has returned.
pub struct Back<'a, J: Job> {
    /// The result. A failure stays in the slot, because otherwise the core would have to free its memory.
    pub result: Result<J::Out, &'a J::Failure>,
    /// False if the object [has dropped](JobSlot::drop_pending) the result.
    pub is_wanted: bool,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker finished the work.
    pub ended: Clock,
}

impl<J: Job> JobSlot<J> {
    /// Creates the only slot of an object, with its job. This allocates, so objects call it at configuration.
    pub fn new(job: J) -> JobSlot<J> {
        JobSlot::numbered(0, job)
    }

    /// Creates one of several slots of an object. The job returns under `number`.
    pub fn numbered(number: u8, job: J) -> JobSlot<J> {
        JobSlot { receiver: Receiver::Object(number), here: Some(Boxed::new(job)), is_wanted: false }
    }

    /// The same for a job of an output.
    pub(super) fn of_output(place: usize, job: J) -> JobSlot<J> {
        JobSlot { receiver: Receiver::Output(place), ..JobSlot::new(job) }
    }

    /// The job, to prepare it; `None` while it is away.
    pub fn here(&mut self) -> Option<&mut J> {
        self.here.as_mut().map(|boxed| &mut boxed.job)
    }

    /// Whether the job is here.
    pub fn is_here(&self) -> bool {
        self.here.is_some()
    }

    /// Whether the job is away and the object still wants its result.
    pub fn is_pending(&self) -> bool {
        !self.is_here() && self.is_wanted
    }

    /// Drops the result of a job that is away.
    pub fn drop_pending(&mut self) {
        self.is_wanted = false;
    }

    /// Sends the job to the worker of its device, if it is here. It returns to
    /// [`Object::finished`](super::Object::finished).
    ///
    /// If a command sends it, further commands wait until it is back. They also wait if an object sends it at the
    /// return of a job that held commands.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn send(&mut self, context: &mut Context, device: DeviceId<J::Device>) -> Result<(), Shutdown> {
        if !self.is_here() {
            return Ok(());
        }
        let hold = context.hold();
        self.send_with(context, device, hold)
    }

    /// The same, with a hold that the sender already has.
    pub(super) fn send_with(
        &mut self,
        context: &mut Context,
        device: DeviceId<J::Device>,
        hold: Hold,
    ) -> Result<(), Shutdown> {
        let Some(boxed) = self.here.take() else { return Ok(()) };
        self.is_wanted = true;
        context.submit(boxed, device, self.receiver, hold).map_err(|(job, why)| {
            self.put_back(job);
            why
        })
    }

    /// Takes the finished job back. `None` if it is the job of an earlier slot with this number.
    pub fn back(&mut self, finished: Finished) -> Option<Back<'_, J>> {
        let Finished { job: SentJob { job, .. }, began, ended } = finished;
        if self.is_here() {
            return None;
        }
        self.put_back(job);
        let result = self.here.as_ref()?.outcome.as_ref()?.as_ref().map(|out| *out);
        Some(Back { result, is_wanted: self.is_wanted, began, ended })
    }

    fn put_back(&mut self, job: Box<dyn AnyJob>) {
        let any: Box<dyn Any> = job;
        self.here = any.downcast().ok();
    }
}
