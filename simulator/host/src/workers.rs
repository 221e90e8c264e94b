// SPDX-License-Identifier: GPL-3.0-or-later
//! The buses of an MCU in one clock. A job runs when its bus is free, and is back when the time that it took is over.

use std::any::Any;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pinion_firmware::mcu::{Devices, Finished, SentJob, WorkerId, Workers};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, TimeSource};

/// Highest number of jobs that wait for a bus. There are at most 256 objects, with one or two jobs each.
const JOBS_MAX: usize = 1024;

/// The buses. Clones are the same ones: the MCU has one, and its owner asks for the next end.
#[derive(Clone)]
pub(crate) struct Buses {
    clock: Arc<dyn TimeSource>,
    all: Arc<Mutex<Vec<Bus>>>,
}

struct Bus {
    name: String,
    devices: Devices,
    count: usize,
    /// Jobs that wait.
    waiting: VecDeque<SentJob>,
    /// The job that is done, and not yet back.
    done: Option<Finished>,
}

impl Bus {
    /// Runs the next job, if the bus is free.
    fn begin(&mut self, clock: &dyn TimeSource) {
        if self.done.is_some() {
            return;
        }
        if let Some(mut job) = self.waiting.pop_front() {
            let began = clock.now();
            let ended = clock.run_job(&mut || job.run(&mut self.devices));
            self.done = Some(Finished { job, began, ended });
        }
    }

    fn end(&self) -> Option<Clock> {
        self.done.as_ref().map(|done| done.ended)
    }
}

impl Buses {
    pub(crate) fn new(clock: Arc<dyn TimeSource>) -> Buses {
        Buses { clock, all: Arc::default() }
    }

    fn all(&self) -> MutexGuard<'_, Vec<Bus>> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// When the next job is back.
    pub(crate) fn next_end(&self) -> Option<Clock> {
        self.all().iter().filter_map(Bus::end).min()
    }
}

fn no_bus() -> Shutdown {
    Shutdown::because(reason::WORKER_OVERFLOW, "the simulated MCU has no such bus")
}

impl Workers for Buses {
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        let mut all = self.all();
        let known = all.iter().position(|known| known.name == bus);
        Ok(WorkerId(known.unwrap_or_else(|| {
            let (devices, waiting) = (Devices::default(), VecDeque::new());
            all.push(Bus { name: bus.to_owned(), devices, count: 0, waiting, done: None });
            all.len() - 1
        })))
    }

    fn give(&mut self, WorkerId(bus): WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown> {
        let mut all = self.all();
        let bus = all.get_mut(bus).ok_or_else(no_bus)?;
        bus.devices.add(device);
        bus.count += 1;
        Ok(bus.count - 1)
    }

    fn submit(&mut self, WorkerId(bus): WorkerId, job: SentJob) -> Result<(), (SentJob, Shutdown)> {
        let mut all = self.all();
        let Some(bus) = all.get_mut(bus) else { return Err((job, no_bus())) };
        if bus.waiting.len() >= JOBS_MAX {
            return Err((
                job,
                Shutdown::because(reason::WORKER_OVERFLOW, "more jobs than devices are queued on a bus"),
            ));
        }
        bus.waiting.push_back(job);
        bus.begin(&*self.clock);
        Ok(())
    }

    fn completion(&mut self) -> Option<Finished> {
        let now = self.clock.now();
        let mut all = self.all();
        let due = all.iter_mut().filter(|bus| bus.end().is_some_and(|end| end <= now));
        let bus = due.min_by_key(|bus| bus.end())?;
        let done = bus.done.take();
        bus.begin(&*self.clock);
        done
    }

    fn has_completion(&self) -> bool {
        let now = self.clock.now();
        self.next_end().is_some_and(|end| end <= now)
    }

    fn report(&self, each: &mut dyn FnMut(&str, usize)) {
        self.all().iter().for_each(|bus| each(&bus.name, bus.waiting.len()));
    }

    fn reset(&mut self) {
        self.all().clear();
    }
}
