// SPDX-License-Identifier: GPL-3.0-or-later
//! One thread per bus: it runs the conversations of the bus's devices, one at a time, so that
//! the core never waits for them.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::{self, JoinHandle, Thread};

use rtrb::{Consumer, Producer, RingBuffer};

use crate::board::Device;
use crate::mcu::{Completion, Job, Workers};
use crate::shutdown::{Reason, Shutdown};
use crate::wire::block::PAYLOAD_MAX;

use super::pulse::{JobClock, Pulse};

/// Jobs that wait for one bus.
const QUEUE_JOBS: usize = 256;
/// Further ones that only a machine that stops may queue: one for each object that it can have.
const QUEUE_SPARE: usize = 256;

enum Order {
    Attach(usize, Box<dyn Device>),
    Run(Job),
}

struct Worker {
    bus: String,
    orders: Producer<Order>,
    answers: Consumer<Completion>,
    quit: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

/// Called by each new worker's thread before anything else.
pub(super) type Prepare = Arc<dyn Fn() + Send + Sync>;

/// The workers of a machine; they come into being with the first device of their bus.
pub(super) struct Threads {
    core: Thread,
    prepare: Prepare,
    pulse: Pulse,
    /// Shutdown values that are on their way.
    owed: Arc<AtomicU32>,
    workers: Vec<Worker>,
    /// Which worker has the device.
    devices: Vec<usize>,
}

impl Threads {
    /// Workers that wake `core` when they have an answer, and show in `pulse` what they are at.
    pub(super) fn new(core: Thread, prepare: Prepare, pulse: Pulse) -> Threads {
        Threads { core, prepare, pulse, owed: Arc::default(), workers: Vec::new(), devices: Vec::new() }
    }

    fn start(&self, bus: &str) -> Result<Worker, Shutdown> {
        let (orders, inbox) = RingBuffer::new(QUEUE_JOBS + QUEUE_SPARE);
        let (outbox, answers) = RingBuffer::new(QUEUE_JOBS + QUEUE_SPARE);
        let quit = Arc::new(AtomicBool::new(false));
        let (core, prepare, stop) = (self.core.clone(), self.prepare.clone(), quit.clone());
        let clock = self.pulse.worker(bus).ok_or_else(|| overflow(bus, "so many buses at once are not possible"))?;
        let owed = self.owed.clone();
        let thread = thread::Builder::new()
            .name(bus.into())
            .spawn(move || {
                prepare();
                serve(inbox, outbox, &stop, &core, &clock, &owed);
            })
            .map_err(|error| {
                overflow(bus, &format!("its thread can not be started ({error}): raise TasksMax or ulimit -u"))
            })?;
        Ok(Worker { bus: bus.into(), orders, answers, quit, thread })
    }
}

fn overflow(bus: &str, why: &str) -> Shutdown {
    Shutdown::because(Reason::WorkerOverflow, format!("the worker of {bus}: {why}"))
}

impl Workers for Threads {
    fn attach(&mut self, bus: &str, device: Box<dyn Device>) -> Result<usize, Shutdown> {
        let worker = match self.workers.iter().position(|worker| worker.bus == bus) {
            Some(worker) => worker,
            None => {
                self.workers.push(self.start(bus)?);
                self.workers.len() - 1
            }
        };
        let number = self.devices.len();
        self.devices.push(worker);
        self.order(worker, Order::Attach(number, device))?;
        Ok(number)
    }

    fn submit(&mut self, job: Job) -> Result<(), Shutdown> {
        match self.devices.get(job.device) {
            Some(worker) => self.order(*worker, Order::Run(job)),
            None => Ok(()),
        }
    }

    fn has_room(&self) -> bool {
        self.workers.iter().all(|worker| worker.orders.slots() >= QUEUE_SPARE + PAYLOAD_MAX)
    }

    fn completion(&mut self) -> Option<Completion> {
        let completion = self.workers.iter_mut().find_map(|worker| worker.answers.pop().ok());
        if completion.is_some() && self.owed.load(Ordering::SeqCst) == 0 {
            self.pulse.paid();
        }
        completion
    }

    fn has_completion(&self) -> bool {
        self.workers.iter().any(|worker| !worker.answers.is_empty())
    }

    fn reset(&mut self) {
        for worker in self.workers.drain(..) {
            worker.quit.store(true, Ordering::SeqCst);
            worker.thread.thread().unpark();
            // Only a transfer under way keeps it: lines and descriptors are free afterwards.
            let _ = worker.thread.join();
        }
        self.devices.clear();
        self.owed.store(0, Ordering::SeqCst);
        self.pulse.paid();
    }
}

impl Threads {
    fn order(&mut self, worker: usize, order: Order) -> Result<(), Shutdown> {
        let worker = &mut self.workers[worker];
        let stopping = matches!(&order, Order::Run(job) if job.stopping);
        let kept = if stopping { 0 } else { QUEUE_SPARE };
        if stopping {
            self.owed.fetch_add(1, Ordering::SeqCst);
            self.pulse.owe(&worker.bus, self.pulse.now());
        }
        if worker.orders.slots() <= kept || worker.orders.push(order).is_err() {
            if stopping {
                self.owed.fetch_sub(1, Ordering::SeqCst);
            }
            return Err(overflow(
                &worker.bus,
                "the bus is slower than what the host asks of it: lower the rate of the queries, or raise the bus speed",
            ));
        }
        worker.thread.thread().unpark();
        Ok(())
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        self.reset();
    }
}

fn serve(
    mut orders: Consumer<Order>,
    mut answers: Producer<Completion>,
    quit: &AtomicBool,
    core: &Thread,
    clock: &JobClock,
    owed: &AtomicU32,
) {
    let mut devices: Vec<(usize, Box<dyn Device>)> = Vec::new();
    loop {
        // Looked at first: what was ordered before the end is done before it, as the last of it
        // may switch an output off.
        let ending = quit.load(Ordering::SeqCst);
        let job = match orders.pop() {
            Err(_) if ending => return,
            Err(_) => {
                thread::park();
                continue;
            }
            Ok(Order::Attach(number, device)) => {
                devices.push((number, device));
                continue;
            }
            Ok(Order::Run(job)) => job,
        };
        let Job { device, ticket, mut data, stopping } = job;
        // Attached before its first job was ordered.
        let Some((_, device)) = devices.iter_mut().find(|(number, _)| *number == device) else { continue };
        clock.begin();
        let result = device.run(&mut data).map(|()| data);
        clock.end();
        if stopping {
            owed.fetch_sub(1, Ordering::SeqCst);
        }
        let mut completion = Completion { ticket, result };
        // The core takes answers in faster than a bus gives them.
        while let Err(rtrb::PushError::Full(back)) = answers.push(completion) {
            completion = back;
            if quit.load(Ordering::SeqCst) {
                // Nobody takes them in any more.
                break;
            }
            thread::yield_now();
        }
        core.unpark();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Buffer;
    use crate::mcu::{Oid, Ticket};
    use crate::time::Monotonic;
    use std::sync::mpsc::{self, Receiver, Sender};

    /// Says what it was asked, and waits to be let go on.
    struct Slow {
        go_on: Receiver<()>,
        asked: Sender<u8>,
    }

    impl Device for Slow {
        fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
            let _ = self.go_on.recv();
            let _ = self.asked.send(data.as_slice()[0]);
            Ok(())
        }
    }

    #[test]
    fn a_full_queue_has_room_for_the_last_word_of_a_machine_that_stops() {
        let (release, go_on) = mpsc::channel();
        let (asked, heard) = mpsc::channel();
        let mut threads = Threads::new(thread::current(), Arc::new(|| ()), Pulse::new(Monotonic::start()).unwrap());
        let device = threads.attach("pwm", Box::new(Slow { go_on, asked })).unwrap();
        let job = |value: u8, stopping| Job {
            device,
            ticket: Ticket { oid: Oid(0), tag: 0 },
            data: Buffer::new(&[value]),
            stopping,
        };
        let refusal = (0..2 * QUEUE_JOBS).find_map(|_| threads.submit(job(255, false)).err()).unwrap();
        assert_eq!(refusal.reason, Reason::WorkerOverflow);
        threads.submit(job(0, true)).unwrap();
        drop(release);
        threads.reset();
        assert_eq!(heard.iter().last(), Some(0));
    }
}
