// SPDX-License-Identifier: GPL-3.0-or-later
//! Work that may block: it travels to the worker of its bus as an [`Errand`], is done there, and
//! comes back to the object that sent it.
//!
//! An object has a [`Slot`](super::Slot) for each errand, made at configuration. The errand carries everything that the
//! work needs in a box that is used again and again. So sending it does not allocate, it may be of any size, and no
//! object has more errands under way than it has slots, so that the queue of a bus cannot grow beyond their number.
//!
//! Commands wait for errands that a command sent (`hold.rs`).

#![forbid(unsafe_code)]

use std::any::Any;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::{Hold, Mcu, Oid, Turn};

/// Work that may block.
pub trait Errand: Send + 'static {
    /// What comes of it.
    type Answer: Copy + Send;
    /// Why nothing comes of it.
    type Failure: Send;

    /// Does the work. Runs on a worker.
    ///
    /// # Errors
    ///
    /// Those of the devices that it uses.
    fn run(&mut self) -> Result<Self::Answer, Self::Failure>;
}

/// An errand of any kind with what came of it, as it travels.
pub trait Parcel: Any + Send {
    /// Does the work, and keeps what comes of it. Runs on a worker.
    fn run(&mut self);
}

/// An errand on its way to a worker.
pub struct Job {
    /// The object that sent it.
    pub oid: Oid,
    /// The work.
    pub parcel: Box<dyn Parcel>,
    /// Whether commands wait until it is back.
    pub holds: bool,
}

/// A job that a worker cannot take, and why.
pub struct Refused {
    /// The job, for its sender.
    pub job: Job,
    /// "Bus worker queue overflow".
    pub why: Shutdown,
}

/// An errand that is done, on its way back from its worker.
pub struct Completion {
    /// The object that sent it.
    pub oid: Oid,
    /// The work, and what came of it.
    pub parcel: Box<dyn Parcel>,
    /// Whether commands wait for it.
    pub holds: bool,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker had done it.
    pub ended: Clock,
}

/// An errand that is done and looks for its slot.
pub struct Done {
    /// `None` once its slot has taken it.
    pub(super) parcel: Option<Box<dyn Parcel>>,
    pub(super) began: Clock,
    pub(super) ended: Clock,
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
    /// The job, if the worker cannot take it.
    fn submit(&mut self, worker: WorkerId, job: Job) -> Result<(), Refused>;

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
        let Completion { oid, parcel, holds, began, ended } = completion;
        if let Some(mut object) = self.take(oid) {
            // If a command sent this errand, what the object sends now belongs to the command, too.
            self.holds.is_commanded = holds;
            let mut done = Done { parcel: Some(parcel), began, ended };
            let done = object.returned(&mut Turn::new(self, oid), &mut done);
            let done = done.map_err(|stop| self.blame(stop, object.kind(), oid));
            self.holds.is_commanded = false;
            self.put_back(oid, object);
            if let Err(shutdown) = done {
                self.shut_down(shutdown);
            }
        }
        self.release(Hold(holds));
    }
}
