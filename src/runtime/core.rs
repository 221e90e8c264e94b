// SPDX-License-Identifier: GPL-3.0-or-later
//! The core: owns the machine; runs due timers, then commands while no timer is near, then
//! waits.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use rtrb::Consumer;

use crate::mcu::Mcu;
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, NS_PER_TICK, Ticks, TimeSource};
use crate::wire::block::PAYLOAD_MAX;
use crate::wire::vlq::Reader;

use super::outlet::{LinkWake, Progress};
use super::pulse::{BEAT, Pulse};
use super::wakeup::{Waiter, Woken};

/// The payload of a message block on its way to the core.
#[derive(Clone, Copy)]
pub(super) struct Payload {
    len: u8,
    bytes: [u8; PAYLOAD_MAX],
}

impl Payload {
    /// A copy of `payload`, which is that of a block.
    pub(super) fn new(payload: &[u8]) -> Payload {
        let len = payload.len().min(PAYLOAD_MAX);
        let mut bytes = [0; PAYLOAD_MAX];
        bytes[..len].copy_from_slice(&payload[..len]);
        Payload { len: len as u8, bytes }
    }

    pub(super) fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// What the link asks of the core.
pub(super) enum Request {
    /// Run the commands of a block.
    Run(Payload),
    /// Stop the machine.
    Shutdown(Shutdown),
    /// Say how late timers were.
    Report,
    /// Stop the machine and end.
    Quit,
    /// Never come back, for a test.
    Hang,
}

/// A command takes a microsecond or two: within this span of a timer none is begun.
const NEAR: Ticks = Ticks::from_us(5);
/// A timer beyond this leaves time for a nap; for a nearer one there is no heartbeat in between.
const FAR: i64 = (BEAT.as_nanos() / NS_PER_TICK as u128) as i64;
/// So long the core looks for the next command before it sleeps: hosts send in bursts, and to be
/// woken takes as long (20 to 50 us on the machines measured). A lone processor is the host's.
const LINGER: Ticks = Ticks::from_us(30);
/// As long may another thread keep the processor of one that yields (3.5 ms were measured).
const SLICE: Ticks = Ticks::from_us(5000);
/// So often commands give way to timers that are near, then one gets its turn.
const PATIENCE: u32 = 20;

pub(super) struct Core {
    mcu: Mcu,
    clock: Arc<dyn TimeSource>,
    requests: Consumer<Request>,
    waiter: Waiter,
    pulse: Pulse,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    /// The block whose commands are run, and how far they were.
    block: Option<(Payload, usize)>,
    gave_way: u32,
    linger: Ticks,
    /// Until when to look for the next command.
    linger_until: Clock,
}

/// What the core is made of.
pub(super) struct Parts {
    pub(super) mcu: Mcu,
    pub(super) clock: Arc<dyn TimeSource>,
    pub(super) requests: Consumer<Request>,
    pub(super) waiter: Waiter,
    pub(super) pulse: Pulse,
    pub(super) progress: Arc<Progress>,
    pub(super) wake: Arc<LinkWake>,
}

/// What a turn for commands came to.
enum Turn {
    Done,
    Idle,
    Quit,
}

impl Core {
    pub(super) fn new(parts: Parts) -> Core {
        let Parts { mcu, clock, requests, waiter, pulse, progress, wake } = parts;
        let linger_until = clock.now();
        let linger = if thread::available_parallelism().is_ok_and(|count| count.get() > 1) { LINGER } else { Ticks(0) };
        let (block, gave_way) = (None, 0);
        Core { mcu, clock, requests, waiter, pulse, progress, wake, block, gave_way, linger, linger_until }
    }

    /// Runs until it is asked to quit.
    pub(super) fn run(mut self) {
        let mut busy_since = self.clock.now();
        let mut was_shutdown = false;
        loop {
            if self.mcu.is_shutdown() != was_shutdown {
                was_shutdown = !was_shutdown;
                if was_shutdown {
                    self.mcu.report_lateness(self.waiter.margin());
                }
            }
            let next = self.mcu.run_timers();
            self.pulse.beat(self.mcu.last_read(), self.mcu.is_running());
            self.mcu.run_workers();
            self.waiter.ran(self.mcu.last_read());
            let near = next.is_some_and(|next| next < self.mcu.last_read() + NEAR);
            if !near || self.gave_way >= PATIENCE {
                match self.run_command() {
                    Turn::Done => {
                        self.linger_until = self.mcu.last_read() + self.linger;
                        continue;
                    }
                    Turn::Quit => {
                        // Workers and devices may take their time to end.
                        self.pulse.beat(self.mcu.now(), false);
                        if !was_shutdown {
                            self.mcu.report_lateness(self.waiter.margin());
                        }
                        return;
                    }
                    Turn::Idle => {}
                }
            }
            let deadline = self.mcu.next_timer();
            let now = self.mcu.now();
            if deadline.is_some_and(|deadline| deadline <= now) {
                self.gave_way += 1;
                continue;
            }
            if now < self.linger_until && may_yield(self.waiter.is_realtime(), now, deadline) {
                thread::yield_now();
                continue;
            }
            self.mcu.account(Ticks(now.since(busy_since) as u32));
            let (requests, mcu, pending) = (&mut self.requests, &self.mcu, self.block.is_some());
            let to_go = deadline.map_or(2 * FAR, |deadline| deadline.since(now));
            if to_go > FAR {
                // Half the way leaves room for a late wake-up.
                self.nap(BEAT.min(Duration::from_nanos(to_go as u64 / 2 * NS_PER_TICK)));
                busy_since = self.clock.now();
                continue;
            }
            let woken = self.waiter.wait(deadline, || {
                // Within reach of a timer a call has to wait its turn.
                !near && (pending || may_begin(requests, mcu) || mcu.has_completion())
            });
            busy_since = self.clock.now();
            if woken == Woken::Due {
                self.gave_way += 1;
            }
        }
    }

    /// Sleeps for a span in which no timer is due, or until it is called, so that the heartbeat
    /// goes on. Unlike the wait for a timer it ends without spinning.
    fn nap(&mut self, longest: Duration) {
        if self.block.is_none() && !may_begin(&mut self.requests, &self.mcu) && !self.mcu.has_completion() {
            self.waiter.nap(longest);
        }
    }

    /// How many commands have time before the next timer, if each takes as long as is near.
    fn room(&self) -> i64 {
        let to_go = |next: Clock| next.since(self.mcu.last_read()) / i64::from(NEAR.0);
        self.mcu.next_timer().map_or(i64::MAX, to_go).max(1)
    }

    /// Runs the commands of a block that have time, or takes in what the link asks.
    #[inline]
    fn run_command(&mut self) -> Turn {
        self.gave_way = 0;
        let (payload, mut at) = match self.block.take() {
            Some(block) => block,
            None if !may_begin(&mut self.requests, &self.mcu) => return Turn::Idle,
            None => match self.requests.pop() {
                Ok(Request::Run(payload)) => {
                    self.progress.begin();
                    (payload, 0)
                }
                Ok(Request::Shutdown(shutdown)) => {
                    self.mcu.shut_down(shutdown);
                    return Turn::Done;
                }
                Ok(Request::Report) => {
                    self.mcu.report_lateness(self.waiter.margin());
                    return Turn::Done;
                }
                Ok(Request::Quit) => {
                    self.mcu.shut_down(Shutdown::because(
                        Reason::ForceShutdown,
                        "the program ends; the host sees the connection close",
                    ));
                    return Turn::Quit;
                }
                Ok(Request::Hang) => loop {
                    thread::park();
                },
                Err(_) => return Turn::Idle,
            },
        };
        let bytes = payload.as_slice();
        let mut reader = Reader::new(&bytes[at..]);
        for _ in 0..self.room() {
            if reader.is_empty() {
                break;
            }
            self.mcu.execute(&mut reader);
        }
        at = bytes.len() - reader.rest().len();
        if at < bytes.len() {
            self.block = Some((payload, at));
        } else {
            self.progress.finish();
            // The end of the next block will do, if that may begin; but a machine that is being
            // configured takes its time for a block.
            if !may_begin(&mut self.requests, &self.mcu) || !self.mcu.is_running() {
                self.wake.wake();
            }
        }
        Turn::Done
    }
}

/// Whether to yield does not cost a timer its time: an ordinary thread may then be without a
/// processor for as long as others' slices take, where one that wakes up is given its turn.
fn may_yield(realtime: bool, now: Clock, deadline: Option<Clock>) -> bool {
    realtime || deadline.is_none_or(|deadline| deadline > now + SLICE)
}

/// Whether what comes next may be taken in: a block waits, unacknowledged, while a bus has no room
/// for what it may ask. Not so where a request to stop waits behind it, be it the host's.
fn may_begin(requests: &mut Consumer<Request>, mcu: &Mcu) -> bool {
    !requests.is_empty() && (mcu.has_room() || is_asked_to_stop(requests, mcu))
}

#[cold]
fn is_asked_to_stop(requests: &mut Consumer<Request>, mcu: &Mcu) -> bool {
    let stops = |request: &Request| match request {
        Request::Run(payload) => mcu.is_stopped_by(payload.as_slice()),
        Request::Shutdown(_) | Request::Quit => true,
        Request::Report | Request::Hang => false,
    };
    requests.read_chunk(requests.slots()).is_ok_and(|waiting| {
        let (first, second) = waiting.as_slices();
        first.iter().chain(second).any(stops)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::mpsc::{self, Receiver, Sender};
    use std::thread::JoinHandle;
    use std::time::Instant;

    use nix::poll::{PollFd, PollFlags, poll};
    use rtrb::{Producer, RingBuffer};

    use crate::board::{Attachment, Bias, Board, Buffer, Device, Input, Output, Pin, PwmConfig, Range, SpiConfig};
    use crate::feature::FEATURES;
    use crate::mcu::{Dialect, Note, Outbox};
    use crate::runtime::realtime::{Processors, Scheduling};
    use crate::runtime::wakeup::MarginLimits;
    use crate::runtime::workers::Threads;
    use crate::time::Monotonic;
    use crate::wire::vlq::Writer;

    /// Blocks with one transfer each: more than wait for a bus.
    const BLOCKS: u32 = 400;
    const CONFIGURATION: u32 = 4;

    /// A board with an SPI bus and nothing else.
    struct SpiBoard(Option<Gate>);

    /// A device that waits to be let go on.
    struct Gate(Receiver<()>);

    impl Device for Gate {
        fn run(&mut self, _data: &mut Buffer) -> Result<(), Shutdown> {
            let _ = self.0.recv();
            Ok(())
        }
    }

    fn nothing<T>() -> Result<T, Shutdown> {
        Err(Shutdown::because(Reason::NotOutput, "the board has an SPI bus only"))
    }

    impl Board for SpiBoard {
        fn describe(&self) -> String {
            String::new()
        }
        fn pins(&self) -> Vec<Range> {
            Vec::new()
        }
        fn spi_buses(&self) -> Vec<Range> {
            Vec::new()
        }
        fn output(&mut self, _pin: Pin, _value: bool, _shutdown_value: bool) -> Result<Box<dyn Output>, Shutdown> {
            nothing()
        }
        fn input(&mut self, _pin: Pin, _bias: Bias) -> Result<Box<dyn Input>, Shutdown> {
            nothing()
        }
        fn adc(&mut self, _pin: Pin) -> Result<Attachment, Shutdown> {
            nothing()
        }
        fn spi(&mut self, _config: SpiConfig) -> Result<Attachment, Shutdown> {
            let gate = self.0.take().unwrap();
            Ok(Attachment::Worker { bus: "spi0".into(), device: Box::new(gate) })
        }
        fn pwm(&mut self, _config: PwmConfig) -> Result<Attachment, Shutdown> {
            nothing()
        }
        fn reset(&mut self) {}
    }

    #[derive(Clone, Default)]
    struct Heard(Arc<Mutex<Vec<Vec<u8>>>>);

    impl Outbox for Heard {
        fn send(&mut self, payload: &[u8]) {
            self.0.lock().unwrap().push(payload.to_vec());
        }
        fn note(&mut self, _note: Note<'_>) {}
    }

    /// A clock that counts how often it is read, which the core does in each turn.
    struct Counting(Monotonic, AtomicUsize);

    impl TimeSource for Counting {
        fn now(&self) -> Clock {
            self.1.fetch_add(1, Ordering::Relaxed);
            self.0.now()
        }
    }

    /// A core at work, and what stands for its link.
    struct Bench {
        thread: JoinHandle<()>,
        dialect: Arc<Dialect>,
        clock: Arc<Counting>,
        requests: Producer<Request>,
        progress: Arc<Progress>,
        wake: Arc<LinkWake>,
        heard: Heard,
        gate: Sender<()>,
    }

    impl Bench {
        /// Lets the host ask for more transfers than the bus can queue, while it does none.
        fn overloaded() -> Bench {
            let (gate, closed) = mpsc::channel();
            let board = SpiBoard(Some(Gate(closed)));
            let dialect = Arc::new(Dialect::new(FEATURES, &board).unwrap());
            let monotonic = Monotonic::start();
            let clock = Arc::new(Counting(monotonic, AtomicUsize::new(0)));
            let (requests, inbox) = RingBuffer::new(2 * BLOCKS as usize);
            let progress = Arc::new(Progress::default());
            let heard = Heard::default();
            let (core_dialect, core_progress, core_heard) = (dialect.clone(), progress.clone(), heard.clone());
            let core_clock: Arc<dyn TimeSource> = clock.clone();
            let wake = Arc::new(LinkWake::new().unwrap());
            let core_wake = wake.clone();
            let thread = thread::spawn(move || {
                let pulse = Pulse::new(monotonic).unwrap();
                let workers = Threads::new(thread::current(), Arc::new(|| ()), pulse);
                let mcu = Mcu::new(
                    core_dialect,
                    Box::new(board),
                    core_clock.clone(),
                    Box::new(workers),
                    Box::new(core_heard),
                );
                let (limits, processors) = (MarginLimits::default(), Processors::new(None).unwrap());
                let waiter = Waiter::new(core_clock.clone(), limits, Scheduling::Ordinary, processors);
                let (clock, progress, wake) = (core_clock, core_progress, core_wake);
                Core::new(Parts { mcu, clock, requests: inbox, waiter, pulse, progress, wake }).run();
            });
            let mut bench = Bench { thread, dialect, clock, requests, progress, wake, heard, gate };
            bench.run("allocate_oids count=%c", &[1]);
            bench.run("config_spi_without_cs oid=%c", &[0]);
            bench.run("spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u", &[0, 0, 0, 1]);
            bench.run("finalize_config crc=%u", &[1]);
            for n in 0..BLOCKS {
                // The bytes: how many, and which.
                bench.run("spi_transfer oid=%c data=%*s", &[0, 1, n % 64]);
            }
            bench.wait_until("the bus is full", || bench.progress.done() > CONFIGURATION + 100);
            bench
        }

        fn run(&mut self, format: &str, parameters: &[u32]) {
            let mut writer = Writer::default();
            writer.int(self.dialect.command_id(format).unwrap());
            parameters.iter().for_each(|parameter| writer.int(*parameter));
            self.request(Request::Run(Payload::new(writer.payload().unwrap())));
        }

        fn request(&mut self, request: Request) {
            self.requests.push(request).ok().unwrap();
            self.thread.thread().unpark();
        }

        /// The parameters of what the core said so far in responses of this format.
        fn said(&self, format: &str) -> Vec<Vec<u8>> {
            let id = self.dialect.dictionary().responses[format].as_u64().unwrap();
            let heard = self.heard.0.lock().unwrap();
            let parameters = heard.iter().filter_map(|payload| {
                let mut reader = Reader::new(payload);
                (u64::from(reader.int().unwrap()) == id).then(|| reader.rest().to_vec())
            });
            parameters.collect()
        }

        fn shutdowns(&self) -> usize {
            self.said("shutdown clock=%u static_string_id=%hu").len()
        }

        fn wait_until(&self, what: &str, mut holds: impl FnMut() -> bool) {
            let end = Instant::now() + Duration::from_secs(60);
            while !holds() {
                assert!(Instant::now() < end, "{what}: {} blocks done", self.progress.done());
                thread::sleep(Duration::from_millis(1));
            }
        }
    }

    #[test]
    fn a_slow_bus_holds_the_host_back_and_nothing_is_lost() {
        let mut bench = Bench::overloaded();
        let turns = bench.clock.1.load(Ordering::Relaxed);
        thread::sleep(2 * BEAT);
        let (done, turns) = (bench.progress.done(), bench.clock.1.load(Ordering::Relaxed) - turns);
        assert!(done < CONFIGURATION + BLOCKS, "{done} blocks were done");
        assert!(turns < 10_000, "the core sleeps as it waits, and read the clock {turns} times");

        (0..BLOCKS).for_each(|_| bench.gate.send(()).unwrap());
        bench.wait_until("every block is done", || bench.progress.done() == CONFIGURATION + BLOCKS);
        let format = "spi_transfer_response oid=%c response=%*s";
        bench.wait_until("every answer is there", || bench.said(format).len() == BLOCKS as usize);
        let expected: Vec<Vec<u8>> = (0..BLOCKS).map(|n| vec![0, 1, (n % 64) as u8]).collect();
        assert_eq!(bench.said(format), expected);
        assert_eq!(bench.shutdowns(), 0);
        bench.request(Request::Quit);
        bench.thread.join().unwrap();
    }

    #[test]
    fn a_block_that_is_done_is_acknowledged_while_the_next_one_is_held_back() {
        let mut bench = Bench::overloaded();
        thread::sleep(2 * BEAT);
        let done = bench.progress.done();
        // The link sleeps, and the bus makes room for one block.
        bench.wake.sleeping();
        bench.gate.send(()).unwrap();
        bench.wait_until("one block more is done", || bench.progress.done() > done);
        let mut fds = [PollFd::new(bench.wake.event(), PollFlags::POLLIN)];
        assert_eq!(poll(&mut fds, 2000u16), Ok(1), "the link is not told");
        drop(bench.gate);
        let _ = bench.requests.push(Request::Quit);
        bench.thread.thread().unpark();
        bench.thread.join().unwrap();
    }

    #[test]
    fn an_ordinary_thread_does_not_yield_with_a_timer_ahead() {
        let now = Clock::from_ticks(0);
        let (soon, late) = (now + Ticks::from_us(1000), now + Ticks::from_us(10_000));
        assert!(!may_yield(false, now, Some(soon)));
        assert!(may_yield(false, now, Some(late)) && may_yield(false, now, None));
        assert!(may_yield(true, now, Some(soon)));
    }

    #[test]
    fn an_emergency_stop_does_not_wait_for_a_bus_that_hangs() {
        let mut bench = Bench::overloaded();
        bench.run("emergency_stop", &[]);
        bench.wait_until("the machine stops", || bench.shutdowns() > 0);
        bench.wait_until("the blocks are refused", || bench.progress.done() == CONFIGURATION + BLOCKS + 1);
        drop(bench.gate);
        let _ = bench.requests.push(Request::Quit);
        bench.thread.thread().unpark();
        bench.thread.join().unwrap();
    }

    #[test]
    fn a_request_to_stop_does_not_wait_for_a_bus_that_hangs() {
        for request in [Request::Quit, Request::Shutdown(Shutdown::because(Reason::ForceShutdown, "a test"))] {
            let mut bench = Bench::overloaded();
            bench.request(request);
            bench.wait_until("the machine stops", || bench.shutdowns() > 0);
            bench.wait_until("the blocks are refused", || bench.progress.done() == CONFIGURATION + BLOCKS);
            drop(bench.gate);
            let _ = bench.requests.push(Request::Quit);
            bench.thread.thread().unpark();
            bench.thread.join().unwrap();
        }
    }
}
