// SPDX-License-Identifier: GPL-3.0-or-later
//! Work that may take its time: it travels to the worker of its bus as an [`Errand`], is done
//! there, and comes back to the object that sent it.
//!
//! An errand carries everything that the work needs and what came of it, in a box that its
//! object makes at configuration and uses again and again. So a request costs no allocation, may
//! be of any size, and no object has more of them under way than it has boxes: a queue of a bus
//! can not grow.
//!
//! **One order.** The firmware runs a command to its end before it looks at the next, and
//! acknowledges a block after its last command; klippy relies on both. So an errand that a
//! command sends *holds*: until it is back, the core runs no further command and leaves the block
//! unacknowledged ([`Mcu::is_held`]). Timers go on, and errands that they send hold nothing. A
//! stopped machine is not held.

#![forbid(unsafe_code)]

use std::any::Any;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::{HOLD_LIMIT, Mcu, Oid, TimerId};

#[cfg(doc)]
use super::Object;

/// Work that may take its time.
pub trait Errand: Any + Send {
    /// Does it. Runs on a worker, and may block there.
    fn run(&mut self);
}

/// Whose errand it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    /// The object that sent it.
    pub oid: Oid,
    /// Whatever tells its errands apart.
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

/// An errand that is done.
pub struct Completion {
    /// Whose it is.
    pub ticket: Ticket,
    /// The work, with what came of it.
    pub errand: Box<dyn Errand>,
    /// Whether commands wait for it.
    pub holds: bool,
    /// When the worker took it up.
    pub began: Clock,
    /// When it was done.
    pub ended: Clock,
}

/// An errand back at its object.
pub struct Done {
    /// The number that the object gave it.
    pub tag: u8,
    /// The work, with what came of it.
    pub errand: Box<dyn Errand>,
    /// When the worker took it up.
    pub began: Clock,
    /// When it was done.
    pub ended: Clock,
}

impl Done {
    /// The errand as what it was sent; none if it is another.
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
    /// The worker of a bus, which is started if it is the first thing on that bus.
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown>;

    /// Hands a job over, without waiting.
    fn submit(&mut self, worker: WorkerId, job: Job) -> Result<(), Shutdown>;

    /// The next errand that is done, in order among those of one bus.
    fn completion(&mut self) -> Option<Completion>;

    /// Whether there is one.
    fn has_completion(&self) -> bool;

    /// Ends every worker. No completion of an earlier job comes after this.
    fn reset(&mut self);
}

impl Mcu {
    /// The worker of a bus. Only before `finalize_config`: it may start a thread.
    pub fn worker(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        self.workers.start(bus)
    }

    /// Sends an errand; it comes back to [`Object::returned`]. Commands wait for it if it is a
    /// command, or the return of an errand that holds, that sends it.
    pub fn dispatch(&mut self, worker: WorkerId, ticket: Ticket, errand: Box<dyn Errand>) -> Result<(), Shutdown> {
        let holds = self.hold(ticket.oid);
        self.hand_over(worker, Job { ticket, errand, holds })
    }

    /// Sends an errand for which commands wait already, by an earlier [`Mcu::hold`], or do not.
    pub(super) fn hand_over(&mut self, worker: WorkerId, job: Job) -> Result<(), Shutdown> {
        let holds = job.holds;
        let sent = self.workers.submit(worker, job);
        if sent.is_err() && holds {
            self.release();
        }
        sent
    }

    /// Lets commands wait for this object until as many calls of [`Mcu::release`], if a command
    /// runs now; returns whether that is so.
    pub fn hold(&mut self, oid: Oid) -> bool {
        if self.commanded {
            if self.holds == 0 {
                let limit = self.now() + HOLD_LIMIT;
                self.timers.insert(limit, TimerId::HOLD);
            }
            self.holds += 1;
            self.held_by = Some(oid);
        }
        self.commanded
    }

    /// Takes one [`Mcu::hold`] back.
    pub fn release(&mut self) {
        self.holds = self.holds.saturating_sub(1);
        if self.holds == 0 {
            self.timers.remove(TimerId::HOLD);
        }
    }

    /// Whether a conversation that a command began is still under way, or a `config_reset`, so that
    /// no further command may run.
    #[inline]
    pub fn is_held(&self) -> bool {
        self.holds > 0 && self.stop.reason.is_none() || self.reset_due
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
            // What the object sends now goes on with what the command began.
            self.commanded = holds;
            let done = object.returned(self, oid, Done { tag, errand, began, ended });
            let done = done.map_err(|stop| self.blame(stop, object.kind(), oid));
            self.commanded = false;
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
