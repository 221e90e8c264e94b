// SPDX-License-Identifier: GPL-3.0-or-later
//! Work that may block: it travels to the worker of its bus as an [`Errand`], is done there, and
//! comes back to the object that sent it.
//!
//! An errand carries everything that the work needs, and afterwards its result, in a box that the
//! object makes at configuration and uses again and again. So sending it does not allocate, it may be
//! of any size, and no object has more errands under way than it has boxes, so that the queue of a bus
//! can not grow beyond their number.
//!
//! Commands wait for errands that a command sent (`hold.rs`).

#![forbid(unsafe_code)]

use std::any::Any;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::{Mcu, Oid};

#[cfg(doc)]
use super::Object;

/// Work that may block.
pub trait Errand: Any + Send {
    /// Does the work, and keeps its result. Runs on a worker.
    fn run(&mut self);
}

/// Whose errand it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    /// The object that sent it.
    pub oid: Oid,
    /// A number by which the object tells its errands apart.
    pub tag: u8,
}

/// An errand on its way to a worker.
pub struct Job {
    /// Whose it is.
    pub ticket: Ticket,
    /// The work.
    pub errand: Box<dyn Errand>,
    /// Whether commands wait until it is back.
    pub holds: bool,
}

/// An errand that is done, on its way back from its worker.
pub struct Completion {
    /// Whose it is.
    pub ticket: Ticket,
    /// The work and its result.
    pub errand: Box<dyn Errand>,
    /// Whether commands wait for it.
    pub holds: bool,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker had done it.
    pub ended: Clock,
}

/// An errand that is done, as its object gets it back.
pub struct Done {
    /// The tag of the object's [`Ticket`].
    pub tag: u8,
    /// The work and its result.
    pub errand: Box<dyn Errand>,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker had done it.
    pub ended: Clock,
}

impl Done {
    /// The errand as the type `T` that was sent; none if it is of another type.
    pub fn errand<T: Errand>(self) -> Option<Box<T>> {
        let any: Box<dyn Any> = self.errand;
        any.downcast().ok()
    }
}

/// A worker, as [`Workers::start`] numbered it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkerId(pub usize);

/// Runs errands, those of one bus one after the other.
pub trait Workers: Send {
    /// The worker of a bus. It is started if the bus has none yet.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it can not be started.
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown>;

    /// Says that a worker's devices need not be free to be opened again: [`Workers::reset`] does not wait
    /// for what it has under way.
    fn leave_behind(&mut self, worker: WorkerId) {
        let _ = worker;
    }

    /// Hands a job over, without waiting.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    fn submit(&mut self, worker: WorkerId, job: Job) -> Result<(), Shutdown>;

    /// The next errand that is done. Those of one bus come in the order in which they were sent.
    fn completion(&mut self) -> Option<Completion>;

    /// Whether [`Workers::completion`] has one.
    fn has_completion(&self) -> bool;

    /// Tells of each worker the name of its bus, and how many jobs it has.
    fn tell(&self, each: &mut dyn FnMut(&str, usize)) {
        let _ = each;
    }

    /// Ends every worker. After this no completion of an earlier job comes.
    fn reset(&mut self);
}

impl Mcu {
    /// The worker of a bus. To be called before `finalize_config` only, as it may start a thread.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it can not be started.
    pub fn worker(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        self.workers.start(bus)
    }

    /// The worker of a device that is only read, may take its time, and may be opened twice. A
    /// `config_reset` does not wait for it.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it can not be started.
    pub fn reader(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        let worker = self.workers.start(bus)?;
        self.workers.leave_behind(worker);
        Ok(worker)
    }

    /// Sends an errand, which comes back to [`Object::returned`]. If a command sends it, further
    /// commands wait until it is back; likewise if an object sends it on the return of an errand for
    /// which commands wait.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn dispatch(&mut self, worker: WorkerId, ticket: Ticket, errand: Box<dyn Errand>) -> Result<(), Shutdown> {
        let holds = self.hold(ticket.oid);
        self.hand_over(worker, Job { ticket, errand, holds })
    }

    /// Sends an errand whose sender has called [`Mcu::hold`] itself; `job.holds` is what that returned.
    pub(super) fn hand_over(&mut self, worker: WorkerId, job: Job) -> Result<(), Shutdown> {
        let holds = job.holds;
        let sent = self.workers.submit(worker, job);
        if sent.is_err() && holds {
            self.release();
        }
        sent
    }

    /// Whether [`Mcu::run_workers`] has something to do.
    #[inline]
    pub fn has_completion(&self) -> bool {
        self.workers.has_completion()
    }

    /// Gives the errands that are done back to their objects.
    #[inline]
    pub fn run_workers(&mut self) {
        while let Some(completion) = self.workers.completion() {
            self.give_back(completion);
        }
        self.reset_if_due();
    }

    fn give_back(&mut self, completion: Completion) {
        let Completion { ticket: Ticket { oid, tag }, errand, holds, began, ended } = completion;
        if let Some(mut object) = self.take(oid) {
            // If a command sent this errand, what the object sends now belongs to the command, too.
            self.hold.is_commanded = holds;
            let done = object.returned(self, oid, Done { tag, errand, began, ended });
            let done = done.map_err(|stop| self.blame(stop, object.kind(), oid));
            self.hold.is_commanded = false;
            self.put_back(oid, object);
            if let Err(shutdown) = done {
                self.shut_down(shutdown);
            }
        }
        if holds {
            self.release();
        }
    }
}
