// SPDX-License-Identifier: GPL-3.0-or-later
//! Workers in virtual time.

use std::any::Any;
use std::collections::VecDeque;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

use pinion_firmware::mcu::{Devices, Finished, SentJob, WorkerId, Workers};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, Ticks, TimeSource};

use super::bench::Bench;
use crate::memory::uncounted;

/// How long a reset waits for the workers.
const WORKERS_END: Ticks = Ticks::from_ms(2000);

/// Workers in virtual time. The jobs of one bus run one after the other, and each takes its time.
#[derive(Clone)]
pub struct FakeWorkers {
    bench: Bench,
    shop: Arc<Mutex<Shop>>,
}

struct Shop {
    buses: Vec<Bus>,
    /// In the order of their end times.
    under_way: VecDeque<UnderWay>,
    /// Jobs that hung when the workers were reset, with the devices of their workers.
    left_behind: Vec<(UnderWay, Option<Devices>)>,
}

/// A job on its way.
struct UnderWay {
    worker: usize,
    begin: Clock,
    end: Clock,
    work: Work,
}

/// A bus and its worker.
struct Bus {
    name: String,
    /// When it is free again.
    free: Clock,
    /// `None` while a job runs.
    devices: Option<Devices>,
    device_count: usize,
}

enum Work {
    ToDo(SentJob),
    Done(Finished),
}

impl Shop {
    /// Reserves memory for more jobs than a test sends, because the bench must not allocate later.
    fn new() -> Shop {
        Shop { buses: Vec::new(), under_way: VecDeque::with_capacity(256), left_behind: Vec::new() }
    }

    fn insert(&mut self, new: UnderWay) {
        let place = self.under_way.partition_point(|other| other.end <= new.end);
        uncounted(|| self.under_way.insert(place, new));
    }

    /// Delays the jobs after one that ran for a time of its own on this worker.
    fn delay(&mut self, worker: usize, ended: Clock, by: Ticks) {
        let free = &mut self.buses[worker].free;
        *free = (*free).max(ended);
        for other in self.under_way.iter_mut().filter(|other| other.worker == worker) {
            other.begin = other.begin + by;
            other.end = other.end + by;
            *free = (*free).max(other.end);
        }
        uncounted(|| self.under_way.make_contiguous().sort_by_key(|other| other.end));
    }
}

impl FakeWorkers {
    /// The workers of this bench.
    pub fn new(bench: Bench) -> FakeWorkers {
        FakeWorkers { bench, shop: Arc::new(Mutex::new(Shop::new())) }
    }

    /// How many jobs are on their way.
    pub fn under_way(&self) -> usize {
        self.shop.lock().unwrap().under_way.len()
    }

    /// When the next job ends.
    pub fn next_end(&self) -> Option<Clock> {
        self.shop.lock().unwrap().under_way.front().map(|next| next.end)
    }
}

impl Workers for FakeWorkers {
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        let mut shop = self.shop.lock().unwrap();
        let known = shop.buses.iter().position(|known| known.name == bus);
        Ok(WorkerId(known.unwrap_or_else(|| {
            let devices = Some(Devices::default());
            shop.buses.push(Bus { name: bus.into(), free: Clock::EPOCH, devices, device_count: 0 });
            shop.buses.len() - 1
        })))
    }

    fn give(&mut self, WorkerId(worker): WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown> {
        let bus = &mut self.shop.lock().unwrap().buses[worker];
        bus.devices.as_mut().expect("no job runs").add(device);
        bus.device_count += 1;
        Ok(bus.device_count - 1)
    }

    fn submit(&mut self, WorkerId(worker): WorkerId, mut job: SentJob) -> Result<(), (SentJob, Shutdown)> {
        if self.bench.state().refuses {
            return Err((job, Shutdown::because(reason::WORKER_OVERFLOW, "the bench refuses it")));
        }
        let takes = Ticks(self.bench.state().answer_ticks);
        let at_once = self.bench.state().byte_ticks != 0;
        let mut shop = self.shop.lock().unwrap();
        let bus = &mut shop.buses[worker];
        let begin = self.bench.clock.now().max(bus.free);
        let mut end = begin + takes;
        let work = if at_once {
            self.bench.state().bus_now = Some(end);
            job.run(bus.devices.as_mut().expect("no job runs"));
            end = self.bench.state().bus_now.take().unwrap_or(end);
            Work::Done(Finished { job, began: begin, ended: end })
        } else {
            Work::ToDo(job)
        };
        bus.free = end;
        shop.insert(UnderWay { worker, begin, end, work });
        Ok(())
    }

    /// A job calls its device at its own end, unless bytes take time. A job that keeps time itself goes on from
    /// there in a time of its own. It is finished when that time has come.
    fn completion(&mut self) -> Option<Finished> {
        while self.has_completion() {
            let UnderWay { worker, begin: began, end, work } = self.shop.lock().unwrap().under_way.pop_front()?;
            let mut job = match work {
                Work::ToDo(job) => job,
                Work::Done(finished) => return Some(finished),
            };
            let ago = Ticks(self.bench.clock.now().since(end) as u32);
            self.bench.state().on_worker = true;
            self.bench.ago.store(ago.0, Ordering::Relaxed);
            // A worker may take memory, for example for the words of what failed.
            let taken = || self.shop.lock().unwrap().buses[worker].devices.take();
            let mut devices = taken().expect("no other job runs");
            let ended = uncounted(|| self.bench.clock.run_job(&mut || job.run(&mut devices))) - ago;
            self.shop.lock().unwrap().buses[worker].devices = Some(devices);
            self.bench.ago.store(0, Ordering::Relaxed);
            self.bench.state().on_worker = false;
            if ended == end {
                return Some(Finished { job, began, ended });
            }
            let mut shop = self.shop.lock().unwrap();
            shop.delay(worker, ended, Ticks(ended.since(end) as u32));
            let work = Work::Done(Finished { job, began, ended });
            shop.insert(UnderWay { worker, begin: began, end: ended, work });
        }
        None
    }

    fn has_completion(&self) -> bool {
        let now = self.bench.clock.now();
        let mut shop = self.shop.lock().unwrap();
        // A worker that hung returns and ends.
        let back: Vec<_> = uncounted(|| shop.left_behind.extract_if(.., |(hung, _)| hung.end <= now).collect());
        drop(shop);
        uncounted(|| drop(back));
        self.next_end().is_some_and(|end| end <= now)
    }

    /// The program waits two seconds. Longer work is left behind.
    fn reset(&mut self) {
        let waits_until = self.bench.clock.now() + WORKERS_END;
        let mut shop = self.shop.lock().unwrap();
        let Shop { under_way, mut left_behind, mut buses } = std::mem::replace(&mut *shop, Shop::new());
        let hung = under_way.into_iter().filter(|work| work.begin <= waits_until && work.end > waits_until);
        left_behind.extend(hung.map(|work| {
            let devices = buses[work.worker].devices.take();
            (work, devices)
        }));
        shop.left_behind = left_behind;
    }
}
