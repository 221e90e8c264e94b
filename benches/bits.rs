// SPDX-License-Identifier: GPL-3.0-or-later
//! Measures how late bits are at 40 kbaud on this computer. A worker times them as Pinion does. The core times them
//! with a timer for each bit, as the firmware does. Both run alone, and beside four steppers of 10,000 steps a second.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use pinion::FIRMWARE;
use pinion::runtime::realtime::{self, Processors, Role};
use pinion::runtime::wakeup::{MarginLimits, Waiter};
use pinion_firmware::board::{
    Adc, Board, BusDevice, ClaimedLine, Direction, I2cConfig, Line, OnWorker, Pin, Pwm, PwmConfig, Range, SpiConfig,
};
use pinion_firmware::lateness::Lateness;
use pinion_firmware::mcu::{
    Completion, Dialect, DialectName, Generation, Job, Mcu, Note, Outbox, Refused, WorkerId, Workers,
};
use pinion_firmware::shutdown::Shutdown;
use pinion_firmware::time::{Clock, Ticks, TimeSource, Timing};
use pinion_linux::clock::Monotonic;
use pinion_protocol::vlq::{Reader, Writer};
use pinion_testbench::board::{Bench, FakeBoard};

/// 40 kbaud.
const BIT: Ticks = Ticks::from_us(25);
/// How many messages of each kind the worker exchanges.
const MESSAGES: u32 = 1000;
/// How long the core runs timers for bits.
const CORE_RUNS: Duration = Duration::from_secs(3);
/// klippy's bytes to read a register (`_encode_read(0xf5, 0, 2)` of tmc_uart.py), and a reply.
const MESSAGE: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
const REPLY: [u8; 10] = [0x0a, 0xfa, 0x4f, 0x20, 0x80, 0x00, 0x02, 0xe8, 0x20, 0xf1];
/// Edges of the message, and those back to idle.
const EDGES: usize = 16;
/// Time from the last edge of a message to its reply: the end of its last byte, eight bits and some.
const REPLY_AFTER: i64 = 20 * BIT.0 as i64 + 333;

fn bit_of(bytes: &[u8], place: usize) -> bool {
    bytes.get(place / 8).is_none_or(|byte| byte >> (place % 8) & 1 != 0)
}

/// A wire whose other end replies a while after the last edge. It records when each edge came.
struct Wire {
    clock: Monotonic,
    edges: Arc<Mutex<Vec<(Clock, bool)>>>,
}

impl Line for Wire {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.edges.lock().unwrap().push((self.clock.now(), level));
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        let last = self.edges.lock().unwrap().last().map_or(Clock::EPOCH, |(at, _)| *at);
        let into = self.clock.now().since(last) - REPLY_AFTER;
        Ok(into < 0 || bit_of(&REPLY, (into / i64::from(BIT.0)) as usize))
    }

    fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
        Ok(())
    }
}

/// The bench's board. Each of its lines is the wire.
struct Wires {
    rest: FakeBoard,
    clock: Monotonic,
    edges: Arc<Mutex<Vec<(Clock, bool)>>>,
}

impl Board for Wires {
    fn describe(&self) -> String {
        self.rest.describe()
    }
    fn pins(&self) -> Vec<Range> {
        self.rest.pins()
    }
    fn spi_buses(&self) -> Vec<Range> {
        self.rest.spi_buses()
    }
    fn line(&mut self, _: Pin, _: Direction) -> Result<ClaimedLine, Shutdown> {
        let line = Wire { clock: self.clock, edges: self.edges.clone() };
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on: None })
    }
    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        self.rest.adc(pin)
    }
    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.rest.spi(config)
    }
    fn i2c_buses(&self) -> Vec<Range> {
        self.rest.i2c_buses()
    }
    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.rest.i2c(config)
    }
    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        self.rest.pwm(config)
    }
    fn reset(&mut self) {
        self.rest.reset();
    }
}

/// One worker, with the priority of Pinion's workers.
struct Worker {
    jobs: Sender<Job>,
    done: Mutex<Receiver<Completion>>,
    waiting: Mutex<Option<Completion>>,
}

impl Worker {
    fn start(clock: Monotonic) -> Worker {
        let (jobs, inbox) = mpsc::channel::<Job>();
        let (outbox, done) = mpsc::channel();
        thread::spawn(move || {
            realtime::enter(Role::Worker);
            for Job { oid, mut parcel, holds } in inbox {
                let began = clock.now();
                parcel.run();
                let _ = outbox.send(Completion { oid, parcel, holds, began, ended: clock.now() });
            }
        });
        Worker { jobs, done: Mutex::new(done), waiting: Mutex::new(None) }
    }
}

impl Workers for Worker {
    fn start(&mut self, _: &str) -> Result<WorkerId, Shutdown> {
        Ok(WorkerId(0))
    }
    fn submit(&mut self, _: WorkerId, job: Job) -> Result<(), Refused> {
        self.jobs.send(job).map_err(|error| panic!("the worker ended: {error}"))
    }
    fn completion(&mut self) -> Option<Completion> {
        self.waiting.lock().unwrap().take()
    }
    fn has_completion(&self) -> bool {
        let mut waiting = self.waiting.lock().unwrap();
        if waiting.is_none() {
            *waiting = self.done.lock().unwrap().recv_timeout(Duration::from_millis(1)).ok();
        }
        waiting.is_some()
    }
    fn reset(&mut self) {}
}

/// The UART's last response.
#[derive(Clone)]
struct Heard {
    id: u32,
    last: Arc<Mutex<Option<Vec<u8>>>>,
}

impl Outbox for Heard {
    fn send(&mut self, payload: &[u8]) {
        if Reader::new(payload).int() == Ok(self.id) {
            *self.last.lock().unwrap() = Some(payload.to_vec());
        }
    }
    fn note(&mut self, note: Note<'_>) {
        assert!(!matches!(note, Note::Shutdown(_)), "{note:?}");
    }
}

/// An MCU with one TMC UART.
struct Uart {
    mcu: Mcu,
    dialect: Arc<Dialect>,
    edges: Arc<Mutex<Vec<(Clock, bool)>>>,
    heard: Heard,
}

impl Uart {
    fn new(clock: Monotonic) -> Uart {
        let edges = Arc::new(Mutex::new(Vec::with_capacity(100)));
        let bench = Bench::new(pinion_firmware::time::VirtualClock::at(Clock::EPOCH), Clock::EPOCH);
        let board = Wires { rest: FakeBoard(bench), clock, edges: edges.clone() };
        let dialect = Dialect::new(&FIRMWARE, &board, DialectName::Of(Generation::Master));
        let dialect = Arc::new(dialect.expect("a dialect"));
        let id = dialect.dictionary().responses["tmcuart_response oid=%c read=%*s"].as_i64().unwrap_or(0) as u32;
        let heard = Heard { id, last: Arc::default() };
        let worker = Box::new(Worker::start(clock));
        let timing = Timing::of(Arc::new(clock));
        let mcu = Mcu::new(dialect.clone(), Box::new(board), timing, worker, Box::new(heard.clone()));
        let mut uart = Uart { mcu, dialect, edges, heard };
        uart.run("allocate_oids count=%c", &[1], None);
        let config = "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u";
        uart.run(config, &[0, 1, 0, 2, BIT.0], None);
        uart.run("finalize_config crc=%u", &[1], None);
        uart
    }

    fn run(&mut self, format: &str, before: &[u32], bytes: Option<(&[u8], u32)>) {
        let mut command = Writer::default();
        command.int(self.dialect.command_id(format).expect("a command"));
        before.iter().for_each(|int| command.int(*int));
        if let Some((bytes, behind)) = bytes {
            command.string(bytes);
            command.int(behind);
        }
        self.mcu.execute(&mut Reader::new(command.payload().expect("it fits")));
    }

    /// Sends the message, and reads a reply of this length. Returns the edges, and whether the reply came whole.
    fn exchange(&mut self, read: usize) -> (Vec<(Clock, bool)>, bool) {
        self.edges.lock().unwrap().clear();
        *self.heard.last.lock().unwrap() = None;
        self.run("tmcuart_send oid=%c write=%*s read=%c", &[0], Some((&MESSAGE, read as u32)));
        loop {
            self.mcu.run_timers();
            if self.mcu.has_completion() {
                self.mcu.run_workers();
            }
            if let Some(response) = &*self.heard.last.lock().unwrap() {
                return (self.edges.lock().unwrap().clone(), response.ends_with(&REPLY));
            }
        }
    }
}

/// The results of the core.
struct Core {
    steps: Lateness,
    bits: Lateness,
    /// Messages of 120 bits, and how many of them had no bit that was late by half a bit.
    messages: [u64; 2],
}

/// Runs `steppers` steppers of 10,000 steps a second each as the core runs them. Each step takes 2 us. With `with_bits`
/// there is a timer for each bit too, as in the firmware.
fn core(clock: Monotonic, steppers: u32, with_bits: bool, end: &AtomicBool) -> Core {
    let scheduling = realtime::enter(Role::Core);
    let processors = Processors::new(None).expect("the processors");
    let mut waiter = Waiter::new(Arc::new(clock), MarginLimits::default(), scheduling, processors);
    let mut core = Core { steps: Lateness::default(), bits: Lateness::default(), messages: [0; 2] };
    let mut good = true;
    let start = clock.now() + Ticks::from_ms(1);
    // Due time, interval, whether it is a bit.
    let stepper = |n: u32| (start + Ticks::from_us(17 * n), Ticks::from_us(100), false);
    let mut timers: Vec<(Clock, Ticks, bool)> = (0..steppers).map(stepper).collect();
    timers.extend(with_bits.then_some((start, BIT, true)));
    while !end.load(Ordering::Relaxed) {
        let Some((at, every, is_bit)) = timers.iter_mut().min_by_key(|(at, ..)| *at) else { break };
        if clock.now() < *at {
            waiter.wait(*at, Some(*at), |_| false);
        }
        let now = clock.now();
        let late = now.since(*at);
        if *is_bit {
            core.bits.record(late);
            good &= late < i64::from(BIT.0 / 2);
            if core.bits.samples().is_multiple_of(120) {
                core.messages = [core.messages[0] + 1, core.messages[1] + u64::from(good)];
                good = true;
            }
        } else {
            core.steps.record(late);
        }
        clock.spin_until(now + Ticks::from_us(2));
        waiter.ran(clock.now());
        *at = *at + *every;
    }
    core
}

/// How late the edges were, and how many messages and replies arrived whole.
fn worker(clock: Monotonic) -> (Lateness, u32, u32) {
    let mut uart = Uart::new(clock);
    let (mut late, mut sent, mut read) = (Lateness::default(), 0, 0);
    for _ in 0..MESSAGES {
        let (edges, _) = uart.exchange(0);
        let edges = &edges[1..=EDGES];
        let start = edges[0].0;
        // The bits that a driver reads. It measures the length of a bit, and looks at the middle of each.
        let level = |at: Clock| edges.iter().rev().find(|(from, _)| *from <= at).is_none_or(|(_, level)| *level);
        let bit = edges[4].0.since(start) / 4;
        let middle = |n: usize| start + Ticks((bit * n as i64 + bit / 2) as u32);
        sent += u32::from((0..40).all(|n| level(middle(n)) == bit_of(&MESSAGE, n)));
        let nominal = (1..40).filter(|n| bit_of(&MESSAGE, *n) != bit_of(&MESSAGE, n - 1));
        for (n, (at, _)) in nominal.zip(&edges[1..]) {
            late.record((at.since(start) - i64::from(BIT.0) * n as i64).abs());
        }
        read += u32::from(uart.exchange(REPLY.len()).1);
        thread::sleep(Duration::from_millis(2));
    }
    (late, sent, read)
}

fn main() {
    let clock = Monotonic::start();
    for steppers in [0, 4] {
        let end = AtomicBool::new(false);
        thread::scope(|scope| {
            let beside = scope.spawn(|| core(clock, steppers, false, &end));
            let (late, sent, read) = worker(clock);
            end.store(true, Ordering::Relaxed);
            println!("worker, {steppers} steppers in the core: edges {late}");
            println!("  of {MESSAGES} messages {sent} arrive whole, of {MESSAGES} replies {read}");
            if let Ok(core) = beside.join() {
                println!("  steps {}", core.steps);
            }
        });
    }
    for steppers in [0, 4] {
        let end = AtomicBool::new(false);
        thread::scope(|scope| {
            let timers = scope.spawn(|| core(clock, steppers, true, &end));
            thread::sleep(CORE_RUNS);
            end.store(true, Ordering::Relaxed);
            if let Ok(Core { steps, bits, messages: [messages, good] }) = timers.join() {
                println!("core timers, {steppers} steppers: bits {bits}");
                println!("  of {messages} times 120 bits {good} without a bit late by half of one");
                println!("  steps {steps}");
            }
        });
    }
}
