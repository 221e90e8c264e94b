// SPDX-License-Identifier: GPL-3.0-or-later
//! Work that may block. It travels as an [`Errand`] to the worker of its bus and runs there. It returns to the object
//! that sent it.
//!
//! An object has a [`Slot`](super::Slot) for each errand, made at configuration. The errand carries everything that the
//! work needs, in a box that is reused. So sending it does not allocate, and it may have any size. An object never has
//! more errands on their way than slots. So their number limits the queue of a bus.
//!
//! Commands wait for errands that a command sent (`hold.rs`).

#![forbid(unsafe_code)]

use std::any::Any;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::{Context, Hold, Mcu, Oid};

/// Work that may block.
pub trait Errand: Send + 'static {
    /// The result of the work.
    type Answer: Copy + Send;
    /// Why the work failed.
    type Failure: Send;

    /// Does the work. Runs on a worker.
    ///
    /// # Errors
    ///
    /// The errors of the devices that it uses.
    fn run(&mut self) -> Result<Self::Answer, Self::Failure>;
}

/// An errand of any kind with its result, as it travels.
pub trait Parcel: Any + Send {
    /// Does the work, and keeps its result. Runs on a worker.
    fn run(&mut self);
}

/// An errand on its way to a worker and back.
pub struct SentJob {
    /// The object that sent it.
    oid: Oid,
    /// The place of the object's output that it writes, if it does that.
    output: Option<usize>,
    parcel: Box<dyn Parcel>,
    holds: bool,
}

impl SentJob {
    /// Work for an object. `holds`: commands wait for its return.
    pub fn new(oid: Oid, parcel: Box<dyn Parcel>, holds: bool) -> SentJob {
        SentJob { oid, output: None, parcel, holds }
    }

    /// The same, for an output of the object.
    pub(super) fn to_output(self, output: Option<usize>) -> SentJob {
        SentJob { output, ..self }
    }

    /// The object that sent it.
    pub fn oid(&self) -> Oid {
        self.oid
    }

    /// Whether commands wait for its return.
    pub fn holds(&self) -> bool {
        self.holds
    }

    /// Does the work, and keeps its result. Runs on a worker.
    pub fn run(&mut self) {
        self.parcel.run();
    }

    pub(super) fn into_parcel(self) -> Box<dyn Parcel> {
        self.parcel
    }
}

/// A job that a worker cannot accept, and the reason.
pub struct Refused {
    /// The job, for its sender.
    pub job: SentJob,
    /// "Bus worker queue overflow".
    pub why: Shutdown,
}

/// An errand that is done, on its way back from its worker.
pub struct FinishedJob {
    /// The work and its result.
    pub job: SentJob,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker finished the work.
    pub ended: Clock,
}

/// A finished errand on its way to its slot.
pub struct Done {
    /// `None` after its slot has taken it.
    pub(super) parcel: Option<Box<dyn Parcel>>,
    pub(super) began: Clock,
    pub(super) ended: Clock,
}

/// A worker, by the number that [`Workers::start`] gave it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkerId(pub usize);

/// Runs errands. The errands of one bus run one after the other.
pub trait Workers: Send {
    /// The worker of a bus. Starts one if the bus has none yet.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it cannot be started.
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown>;

    /// Whether two workers can run at the same time. Then one may wait for the other without sleeping.
    fn are_parallel(&self) -> bool {
        false
    }

    /// Marks a worker whose devices need not be free to be opened again. [`Workers::reset`] does not wait for its work.
    fn leave_behind(&mut self, worker: WorkerId) {
        let _ = worker;
    }

    /// Hands a job over, without waiting.
    ///
    /// # Errors
    ///
    /// The job, if the worker cannot accept it.
    fn submit(&mut self, worker: WorkerId, job: SentJob) -> Result<(), Refused>;

    /// The next finished errand. The errands of one bus finish in the order in which they were sent.
    fn completion(&mut self) -> Option<FinishedJob>;

    /// Whether [`Workers::completion`] has one.
    fn has_completion(&self) -> bool;

    /// Calls `each` with the name of each worker's bus and its number of jobs.
    fn tell(&self, _each: &mut dyn FnMut(&str, usize)) {}

    /// Ends every worker. No completion of an earlier job comes after this.
    fn reset(&mut self);
}

impl Context<'_> {
    pub(super) fn submit(&mut self, worker: WorkerId, job: SentJob) -> Result<(), Refused> {
        self.state.workers.submit(worker, job)
    }

    /// The worker of a bus. Call it only before `finalize_config`, because it may start a thread.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it cannot be started.
    pub fn worker(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        self.state.workers.start(bus)
    }

    /// The worker of a device that is only read, may be slow, and may be opened twice. A `config_reset` does not wait
    /// for it.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it cannot be started.
    pub fn reader(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        let worker = self.state.workers.start(bus)?;
        self.state.workers.leave_behind(worker);
        Ok(worker)
    }

    /// Whether two workers can run at the same time.
    pub fn has_parallel_workers(&self) -> bool {
        self.state.workers.are_parallel()
    }
}

impl Mcu {
    /// Whether [`Mcu::run_workers`] has something to do.
    #[inline]
    pub fn has_completion(&self) -> bool {
        self.state.workers.has_completion()
    }

    /// Returns the finished errands to their objects.
    #[inline]
    pub fn run_workers(&mut self) {
        while let Some(completion) = self.state.workers.completion() {
            self.give_back(completion);
        }
        self.reset_if_due();
    }

    fn give_back(&mut self, completion: FinishedJob) {
        let FinishedJob { job: SentJob { oid, output, parcel, holds }, began, ended } = completion;
        let state = &mut self.state;
        state.barrier.take_back(holds);
        let mut done = Done { parcel: Some(parcel), began, ended };
        let done = match output {
            Some(place) => state.output_returned(place, &mut done),
            None => match state.objects.take(oid) {
                Some(mut object) => {
                    let done = object.returned(&mut Context::new(state, oid), &mut done);
                    let done = done.map_err(|stop| state.blame(stop, object.kind(), oid));
                    state.objects.put_back(oid, object);
                    done
                }
                None => Ok(()),
            },
        };
        state.barrier.end_command();
        if let Err(shutdown) = done {
            self.shut_down(shutdown);
        }
        self.state.release(Hold(holds));
    }
}
