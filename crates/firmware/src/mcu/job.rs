// SPDX-License-Identifier: GPL-3.0-or-later
//! Jobs: slow operations on devices.
//!
//! A device lives in the worker of its bus, and has an id. A [`Job`] runs there. An object has a [`JobSlot`] for each
//! job, made at configuration, with a number. The job travels to the worker and back in a box that is reused. So
//! sending it does not allocate, and it may have any size. An object never has more jobs on their way than slots. So
//! their number limits the queue of a bus. A finished job comes back under its number, like a timer
//! ([`Object::finished`]).
//!
//! Commands wait for jobs that a command sent (`barrier.rs`).

use std::any::Any;
use std::marker::PhantomData;

use crate::board::OnWorker;
use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::{Context, DeviceWarning, Hold, Mcu, Note, Oid, State};

#[cfg(doc)]
use super::{JobSlot, Object};

/// A slow operation on a device.
pub trait Job: Send + 'static {
    /// The device. `()` if the job brings all that it needs, for example lines.
    type Device: ?Sized + 'static;
    /// The result.
    type Out: Copy + Send;
    /// Why it failed.
    type Failure: Send;

    /// Does the work. Runs on the worker of the device, and may block there.
    ///
    /// # Errors
    ///
    /// The errors of the device.
    fn run(&mut self, device: &mut Self::Device) -> Result<Self::Out, Self::Failure>;

    /// A warning for the log, from the last run. Runs in the core.
    fn take_warning(&mut self) -> Option<DeviceWarning> {
        None
    }
}

/// A device, which lives in its worker.
pub struct DeviceId<D: ?Sized> {
    worker: WorkerId,
    place: usize,
    device: PhantomData<fn(&mut D)>,
}

impl<D: ?Sized> Clone for DeviceId<D> {
    fn clone(&self) -> DeviceId<D> {
        *self
    }
}

impl<D: ?Sized> Copy for DeviceId<D> {}

/// The devices of one worker.
#[derive(Default)]
pub struct Devices(Vec<Box<dyn Any + Send>>);

impl Devices {
    /// Takes a device from [`Workers::give`].
    pub fn add(&mut self, device: Box<dyn Any + Send>) {
        self.0.push(device);
    }

    fn get<D: ?Sized + 'static>(&mut self, place: usize) -> Option<&mut D> {
        self.0.get_mut(place)?.downcast_mut::<Box<D>>().map(|device| &mut **device)
    }
}

/// A job of any kind with its result, as it travels.
pub trait AnyJob: Any + Send {
    /// Does the work, and keeps its result. Runs on a worker.
    fn run(&mut self, devices: &mut Devices);

    /// See [`Job::take_warning`].
    fn take_warning(&mut self) -> Option<DeviceWarning> {
        None
    }
}

/// A job in the box in which it travels, with its last result.
pub(super) struct Boxed<J: Job> {
    pub(super) job: J,
    place: usize,
    pub(super) outcome: Option<Result<J::Out, J::Failure>>,
}

impl<J: Job> Boxed<J> {
    pub(super) fn new(job: J) -> Box<Boxed<J>> {
        Box::new(Boxed { job, place: 0, outcome: None })
    }
}

impl<J: Job> AnyJob for Boxed<J> {
    fn run(&mut self, devices: &mut Devices) {
        self.outcome = devices.get(self.place).map(|device| self.job.run(device));
    }

    fn take_warning(&mut self) -> Option<DeviceWarning> {
        self.job.take_warning()
    }
}

/// The receiver of a finished job.
#[derive(Clone, Copy)]
pub(super) enum Receiver {
    /// The object, under this number.
    Object(u8),
    /// The object's output at this place of the table of lines.
    Output(usize),
}

/// A job on its way to a worker and back.
pub struct SentJob {
    /// The object that sent it.
    oid: Oid,
    receiver: Receiver,
    pub(super) job: Box<dyn AnyJob>,
    holds: bool,
}

impl SentJob {
    /// A job of an object, which it gets back under `number`. `holds`: commands wait for its return.
    pub fn new(oid: Oid, number: u8, job: Box<dyn AnyJob>, holds: bool) -> SentJob {
        SentJob { oid, receiver: Receiver::Object(number), job, holds }
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
    pub fn run(&mut self, devices: &mut Devices) {
        self.job.run(devices);
    }
}

/// A job that is done, on its way back from its worker to its slot ([`JobSlot::back`]).
pub struct Finished {
    /// The job and its result.
    pub job: SentJob,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker finished the work.
    pub ended: Clock,
}

/// A worker, by the number that [`Workers::start`] gave it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkerId(pub usize);

/// Runs jobs. The jobs of one bus run one after the other.
pub trait Workers: Send {
    /// The worker of a bus. Starts one if the bus has none yet.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it cannot be started.
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown>;

    /// Gives a device to a worker, which [adds](Devices::add) it. Returns how many devices the worker had before.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if it cannot accept it.
    fn give(&mut self, worker: WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown>;

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
    /// The job, if the worker cannot accept it, and "Bus worker queue overflow".
    fn submit(&mut self, worker: WorkerId, job: SentJob) -> Result<(), (SentJob, Shutdown)>;

    /// The next finished job. The jobs of one bus finish in the order in which they were sent.
    fn completion(&mut self) -> Option<Finished>;

    /// Whether [`Workers::completion`] has one.
    fn has_completion(&self) -> bool;

    /// Calls `each` with the name of each worker's bus and its number of jobs.
    fn report(&self, _each: &mut dyn FnMut(&str, usize)) {}

    /// Ends every worker, with its devices. No completion of an earlier job comes after this.
    fn reset(&mut self);
}

impl State {
    /// See [`Context::device`].
    pub(super) fn device<D: ?Sized + Send + 'static>(
        &mut self,
        bus: &str,
        device: Box<D>,
    ) -> Result<DeviceId<D>, Shutdown> {
        let worker = self.workers.start(bus)?;
        let place = self.workers.give(worker, Box::new(device))?;
        Ok(DeviceId { worker, place, device: PhantomData })
    }
}

impl Context<'_> {
    /// Gives a device to the worker of its bus. Call it only before `finalize_config`, because it may start a thread.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if the worker cannot be started.
    pub fn device<D: ?Sized + Send + 'static>(&mut self, bus: &str, device: Box<D>) -> Result<DeviceId<D>, Shutdown> {
        self.state.device(bus, device)
    }

    /// The same for a device that is only read, may be slow, and may be opened twice. A `config_reset` does not wait
    /// for its worker.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow" if the worker cannot be started.
    pub fn reader<D: ?Sized + Send + 'static>(
        &mut self,
        OnWorker { bus, device }: OnWorker<D>,
    ) -> Result<DeviceId<D>, Shutdown> {
        let device = self.device(&bus, device)?;
        self.state.workers.leave_behind(device.worker);
        Ok(device)
    }

    /// Whether two workers can run at the same time.
    pub fn has_parallel_workers(&self) -> bool {
        self.state.workers.are_parallel()
    }

    /// Sends a job to the worker of its device. Gives it back with an error if the worker cannot accept it.
    pub(super) fn submit<J: Job>(
        &mut self,
        mut job: Box<Boxed<J>>,
        device: DeviceId<J::Device>,
        receiver: Receiver,
        hold: Hold,
    ) -> Result<(), (Box<dyn AnyJob>, Shutdown)> {
        job.place = device.place;
        let sent = SentJob { oid: self.oid(), receiver, job, holds: hold.0 };
        self.state.workers.submit(device.worker, sent).map_err(|(sent, why)| {
            self.release(hold);
            (sent.job, why)
        })
    }
}

impl Mcu {
    /// Whether [`Mcu::run_workers`] has something to do.
    #[inline]
    pub fn has_completion(&self) -> bool {
        self.state.workers.has_completion()
    }

    /// Returns the finished jobs to their objects.
    #[inline]
    pub fn run_workers(&mut self) {
        while let Some(finished) = self.state.workers.completion() {
            self.take_back(finished);
        }
        if self.state.phase.is_reset_due() {
            self.reset_if_due();
        }
    }

    fn take_back(&mut self, mut finished: Finished) {
        let SentJob { oid, receiver, holds, job } = &mut finished.job;
        let (oid, receiver, holds) = (*oid, *receiver, *holds);
        if let Some(warning) = job.take_warning() {
            self.state.wire.note(Note::Device(&warning));
        }
        let state = &mut self.state;
        state.barrier.take_back(holds);
        let done = match receiver {
            Receiver::Output(place) => state.output_written(place, finished),
            Receiver::Object(number) => match state.objects.take(oid) {
                Some(mut object) => {
                    let done = object.finished(&mut Context::new(state, oid), number, finished);
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
