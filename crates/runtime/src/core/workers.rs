// SPDX-License-Identifier: GPL-3.0-or-later
//! Workers: each bus has a thread that runs the jobs to the bus's devices, one after the other. So the core never
//! waits for a device.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use log::error;
use rtrb::{Consumer, Producer, PushError, RingBuffer};

use pinion_firmware::mcu::{Devices, Finished, SentJob, WorkerId, Workers};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, Ticks, TimeSource};
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::{monotonic, wait_until};
use pinion_linux::parker::Parker;

use pinion_trace::event::Event;
use pinion_trace::ring::Writer;

use crate::core::busy_poll::PollBudget;
use crate::core::heartbeat::{Heartbeat, JobClock};
use crate::recorder::{Recording, span};

/// Highest number of jobs that may wait for one bus. There are at most 256 objects, with one or two jobs each.
const QUEUE_JOBS: usize = 1024;
/// How long a worker polls for the next job after a job that a command waited for. The core runs the next command
/// within microseconds, if the host has sent it already.
const NEXT_JOB: Ticks = Ticks::from_us(50);
/// How long to wait for workers to end. Most drivers give up a silent chip within this time.
const END_LIMIT: Duration = Duration::from_secs(2);

struct Worker {
    bus: String,
    jobs: Producer<Message>,
    devices: usize,
    done: Consumer<Finished>,
    quit: Arc<AtomicBool>,
    thread: JoinHandle<()>,
    /// Nobody waits for its end.
    left_behind: bool,
}

/// To a worker.
enum Message {
    /// A device that it owns from now on.
    Device(Box<dyn Any + Send>),
    /// A job, and when it was submitted.
    Job(SentJob, Clock),
}

/// The thread of each new worker calls this first.
pub(crate) type Prepare = Arc<dyn Fn() + Send + Sync>;

/// The workers of an MCU. Each one starts when the first device of its bus is opened.
pub(crate) struct Threads {
    core: Arc<Parker>,
    prepare: Prepare,
    clock: Arc<dyn TimeSource>,
    heartbeat: Heartbeat,
    recording: Recording,
    may_poll: bool,
    workers: Vec<Worker>,
}

impl Threads {
    /// No workers yet. A worker unparks `core` when a job is done, and notes in `heartbeat` since when it runs the
    /// job. It records its jobs in `recording`. It paces itself by `clock`. `may_poll`: there is a second processor, so
    /// that workers may poll.
    pub(crate) fn new(
        core: Arc<Parker>,
        prepare: Prepare,
        clock: Arc<dyn TimeSource>,
        heartbeat: Heartbeat,
        recording: Recording,
        may_poll: bool,
    ) -> Threads {
        Threads { core, prepare, clock, heartbeat, recording, may_poll, workers: Vec::new() }
    }

    fn spawn(&self, bus: &str) -> Result<Worker, Shutdown> {
        let (jobs, inbox) = RingBuffer::new(QUEUE_JOBS);
        let (outbox, done) = RingBuffer::new(QUEUE_JOBS);
        let quit = Arc::new(AtomicBool::new(false));
        let shown = self.heartbeat.worker(bus).ok_or_else(|| overflow(bus, "there are more buses than workers"))?;
        let core = self.core.clone();
        let clock = self.clock.clone();
        let polling = PollBudget::new(self.may_poll, clock.now());
        let trace_writer = self.recording.worker(bus);
        let server = Server {
            jobs: inbox,
            devices: Devices::default(),
            done: outbox,
            quit: quit.clone(),
            core,
            clock,
            shown,
            polling,
            trace_writer,
        };
        let prepare = self.prepare.clone();
        let thread = thread::Builder::new()
            .name(bus.into())
            .spawn(move || {
                prepare();
                server.run();
            })
            .map_err(|error| {
                let trouble = Trouble::new(format!("its thread cannot be started ({error})"));
                overflow(bus, trouble.remedy("raise TasksMax or ulimit -u"))
            })?;
        Ok(Worker { bus: bus.into(), jobs, devices: 0, done, quit, thread, left_behind: false })
    }
}

/// The remedy for an error that should not be possible.
const REPORT: &str = "please report it";

fn overflow(bus: &str, why: impl Into<Trouble>) -> Shutdown {
    Shutdown::because(reason::WORKER_OVERFLOW, why.into().of(format_args!("the worker of {bus}")))
}

fn no_worker() -> Shutdown {
    overflow("a bus", Trouble::new("the device does not exist").remedy(REPORT))
}

impl Workers for Threads {
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        if let Some(worker) = self.workers.iter().position(|worker| worker.bus == bus) {
            return Ok(WorkerId(worker));
        }
        self.workers.push(self.spawn(bus)?);
        Ok(WorkerId(self.workers.len() - 1))
    }

    fn give(&mut self, WorkerId(worker): WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown> {
        let worker = self.workers.get_mut(worker).ok_or_else(no_worker)?;
        worker.jobs.push(Message::Device(device)).map_err(|_| overflow(&worker.bus, "it has too many devices"))?;
        worker.thread.thread().unpark();
        worker.devices += 1;
        Ok(worker.devices - 1)
    }

    fn are_parallel(&self) -> bool {
        self.may_poll
    }

    fn leave_behind(&mut self, WorkerId(worker): WorkerId) {
        if let Some(worker) = self.workers.get_mut(worker) {
            worker.left_behind = true;
        }
    }

    fn submit(&mut self, WorkerId(worker): WorkerId, job: SentJob) -> Result<(), (SentJob, Shutdown)> {
        let Some(worker) = self.workers.get_mut(worker) else {
            return Err((job, no_worker()));
        };
        if let Err(PushError::Full(Message::Job(job, _))) = worker.jobs.push(Message::Job(job, self.clock.now())) {
            let trouble = Trouble::new("more jobs than devices are queued on it");
            let why = overflow(&worker.bus, trouble.remedy(REPORT));
            return Err((job, why));
        }
        worker.thread.thread().unpark();
        Ok(())
    }

    fn completion(&mut self) -> Option<Finished> {
        self.workers.iter_mut().find_map(|worker| worker.done.pop().ok())
    }

    fn has_completion(&self) -> bool {
        self.workers.iter().any(|worker| !worker.done.is_empty())
    }

    fn report(&self, each: &mut dyn FnMut(&str, usize)) {
        self.workers.iter().for_each(|worker| each(&worker.bus, QUEUE_JOBS - worker.jobs.slots()));
    }

    /// Waits up to two seconds until the workers have done the submitted jobs. Only then are their devices free to be
    /// opened again. A worker that hangs is left behind, with its devices.
    fn reset(&mut self) {
        for worker in &self.workers {
            worker.quit.store(true, Ordering::Release);
            worker.thread.thread().unpark();
        }
        let end = monotonic() + END_LIMIT;
        for worker in self.workers.drain(..).filter(|worker| !worker.left_behind) {
            if wait_until(end, || worker.thread.is_finished()) {
                let _ = worker.thread.join();
            } else {
                error!(
                    "{} does not answer, and its pins and devices stay in use: its driver or chip hangs: look at the kernel's log (dmesg), then restart Pinion",
                    worker.bus
                );
            }
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        self.reset();
    }
}

/// A worker's thread.
struct Server {
    jobs: Consumer<Message>,
    devices: Devices,
    done: Producer<Finished>,
    quit: Arc<AtomicBool>,
    core: Arc<Parker>,
    clock: Arc<dyn TimeSource>,
    shown: JobClock,
    polling: PollBudget,
    trace_writer: Option<Writer>,
}

impl Server {
    fn run(mut self) {
        loop {
            // Read this before the queue. Then a job that was submitted before `quit` was set is seen and still done.
            // It may switch an output off.
            let ending = self.quit.load(Ordering::Acquire);
            // This worker was left behind. Another worker has its jobs now, and its devices are wanted.
            if self.jobs.is_abandoned() {
                return;
            }
            match self.jobs.pop() {
                Ok(Message::Device(device)) => self.devices.add(device),
                Ok(Message::Job(job, submitted)) => self.serve(job, submitted),
                Err(_) if ending => return,
                Err(_) if self.polling.goes_on(self.clock.now()) => thread::yield_now(),
                Err(_) => thread::park(),
            }
        }
    }

    fn serve(&mut self, mut job: SentJob, submitted: Clock) {
        self.shown.begin();
        let began = self.clock.now();
        let (number, holds) = (job.oid().number(), job.holds());
        self.record(began, Event::JobBegan { oid: number, waited: span(submitted, began) });
        let ended = self.clock.run_job(&mut || job.run(&mut self.devices));
        self.shown.end();
        self.record(ended, Event::JobEnded { oid: number, took: span(began, ended) });
        // This does not fail: there are no more jobs under way than boxes, and both queues have the same length.
        let _ = self.done.push(Finished { job, began, ended });
        // Commands that wait for this job also wait for the next one. The core is woken for the last of these jobs.
        if !(holds && self.jobs.peek().is_ok_and(|next| matches!(next, Message::Job(next, _) if next.holds()))) {
            self.core.unpark();
        }
        // Samples, which timers ask for, come at their own pace.
        if holds {
            self.polling.expect(ended, NEXT_JOB);
        }
    }

    fn record(&mut self, at: Clock, event: Event) {
        if let Some(trace_writer) = &mut self.trace_writer {
            trace_writer.write(at, event);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::mcu::{AnyJob, Oid};
    use pinion_linux::clock::Monotonic;
    use std::fs;
    use std::sync::atomic::AtomicU64;
    use std::sync::mpsc::{self, Receiver, Sender};

    /// Waits until it may continue, then reports its number.
    struct Slow {
        go_on: Arc<std::sync::Mutex<Receiver<()>>>,
        number: u8,
        said: Sender<u8>,
    }

    impl AnyJob for Slow {
        fn run(&mut self, _devices: &mut Devices) {
            let _ = self.go_on.lock().unwrap().recv();
            let _ = self.said.send(self.number);
        }
    }

    /// Makes slow jobs of a number. They go on when the sender is dropped. The receiver ends with the last job.
    fn slow() -> (impl Fn(u8) -> Box<dyn AnyJob>, Sender<()>, Receiver<u8>) {
        let (release, go_on) = mpsc::channel();
        let (said, heard) = mpsc::channel();
        let go_on = Arc::new(std::sync::Mutex::new(go_on));
        let job =
            move |number| -> Box<dyn AnyJob> { Box::new(Slow { go_on: go_on.clone(), number, said: said.clone() }) };
        (job, release, heard)
    }

    /// A clock on which each look takes a microsecond.
    #[derive(Default)]
    struct Looks(AtomicU64);

    impl TimeSource for Looks {
        fn now(&self) -> Clock {
            Clock::from_ticks((self.0.fetch_add(1, Ordering::Relaxed) + 1) * u64::from(Ticks::from_us(1).0))
        }

        fn instant_of(&self, _monotonic: Duration) -> Clock {
            self.now()
        }

        fn duration_of(&self, _clock: Clock) -> Duration {
            Duration::ZERO
        }
    }

    struct Quick;

    impl AnyJob for Quick {
        fn run(&mut self, _devices: &mut Devices) {}
    }

    fn submit(threads: &mut Threads, worker: WorkerId, job: Box<dyn AnyJob>, holds: bool) {
        let taken = threads.submit(worker, SentJob::new(Oid::new(0), 0, job, holds));
        assert!(taken.is_ok());
    }

    /// Whether the kernel has a thread of this process with this name asleep (proc_pid_stat(5)).
    fn is_asleep(name: &str) -> bool {
        let tasks = fs::read_dir("/proc/self/task").unwrap().flatten();
        let stats = tasks.filter_map(|task| fs::read_to_string(task.path().join("stat")).ok());
        // The kernel keeps 15 bytes of a name.
        let state = format!("({}) S ", &name[..name.len().min(15)]);
        stats.into_iter().any(|stat| stat.contains(&state))
    }

    /// How often a worker reads its clock after it got a job, until it sleeps.
    fn looks_after_a_job(holds: bool, may_poll: bool) -> u64 {
        let clock = Arc::new(Looks::default());
        let heartbeat = Heartbeat::new(Monotonic::start()).unwrap();
        let mut threads =
            Threads::new(Arc::default(), Arc::new(|| ()), clock.clone(), heartbeat, Recording::of_a_test(), may_poll);
        let name = format!("looks {holds} {may_poll}");
        let worker = threads.start(&name).unwrap();
        // It reads the clock once when it falls asleep. A thread that polls is never asleep, however busy the computer is.
        let asleep = || {
            loop {
                let looks = clock.0.load(Ordering::Relaxed);
                if is_asleep(&name) && clock.0.load(Ordering::Relaxed) == looks {
                    return looks;
                }
                thread::sleep(Duration::from_millis(1));
            }
        };
        let before = asleep();
        submit(&mut threads, worker, Box::new(Quick), holds);
        while threads.completion().is_none() {
            thread::yield_now();
        }
        asleep() - before
    }

    #[test]
    fn a_worker_polls_for_the_next_job_of_a_command_only() {
        // One look when the job is submitted, one when it begins, one when it ends, and one before the worker sleeps.
        assert_eq!(looks_after_a_job(false, true), 4);
        assert_eq!(looks_after_a_job(true, false), 4);
        assert_eq!(looks_after_a_job(true, true), 3 + u64::from(NEXT_JOB.0 / Ticks::from_us(1).0));
    }

    fn threads() -> Threads {
        let clock = Monotonic::start();
        let heartbeat = Heartbeat::new(clock).unwrap();
        Threads::new(Arc::default(), Arc::new(|| ()), Arc::new(clock), heartbeat, Recording::of_a_test(), true)
    }

    /// How many messages the first worker has not taken yet.
    fn waiting(threads: &Threads) -> usize {
        QUEUE_JOBS - threads.workers[0].jobs.slots()
    }

    #[test]
    fn what_was_asked_for_before_the_end_is_done_in_order() {
        let (job, release, heard) = slow();
        let mut threads = threads();
        let worker = threads.start("pwm").unwrap();
        assert_eq!(threads.start("pwm").unwrap(), worker);
        for number in 0..5 {
            submit(&mut threads, worker, job(number), false);
        }
        // The end as `reset` begins it, which would leave the worker behind if the computer is busy for two seconds.
        threads.workers[0].quit.store(true, Ordering::Release);
        drop(release);
        let end = monotonic() + Duration::from_secs(60);
        assert!(wait_until(end, || threads.workers[0].thread.is_finished()), "it does not end");
        threads.reset();
        drop(job);
        assert_eq!(heard.iter().collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn a_worker_that_hangs_is_left_behind_and_lets_go_of_all_once_it_is_back() {
        let (job, release, heard) = slow();
        let mut threads = threads();
        let worker = threads.start("i2c1").unwrap();
        for number in 0..2 {
            submit(&mut threads, worker, job(number), false);
        }
        drop(job);
        // A job that is not under way yet would be dropped.
        while waiting(&threads) > 1 {
            thread::sleep(Duration::from_millis(1));
        }
        threads.reset();
        assert!(!threads.has_completion());
        // Another one takes its place.
        threads.start("i2c1").unwrap();
        drop(release);
        // This ends when both jobs are dropped. The second one is not begun.
        assert_eq!(heard.iter().collect::<Vec<_>>(), [0]);
    }

    /// How long the end of a worker takes that only reads, and is in the middle of it.
    fn end_of_a_reader() -> Duration {
        let (job, release, heard) = slow();
        let mut threads = threads();
        let worker = threads.start("w1 28-1").unwrap();
        threads.leave_behind(worker);
        submit(&mut threads, worker, job(7), false);
        // A job that is not under way yet would be dropped.
        while waiting(&threads) > 0 {
            thread::sleep(Duration::from_millis(1));
        }
        let began = monotonic();
        threads.reset();
        let took = monotonic() - began;
        assert!(heard.try_recv().is_err());
        // It continues, and nobody gets its result.
        threads.start("w1 28-1").unwrap();
        drop(release);
        assert_eq!(heard.recv(), Ok(7));
        assert!(!threads.has_completion());
        took
    }

    #[test]
    fn a_worker_that_only_reads_is_not_waited_for() {
        // A busy computer may take as long for something else, but not each time.
        assert!((0..3).any(|_| end_of_a_reader() < END_LIMIT), "it was waited for");
    }
}
