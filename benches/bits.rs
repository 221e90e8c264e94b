// SPDX-License-Identifier: GPL-3.0-or-later
//! Measures how well a worker times bits on lines on this computer: TMC UARTs at 40 kbaud, and WS2812 LEDs. The core
//! times a UART's bits too, with a timer for each bit, as the firmware does. All run alone, and beside steppers of
//! 10,000 steps a second.
//!
//! A line is a word of memory here, as registers would be. Another thread watches the line of the LEDs.

use std::any::Any;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use pinion_firmware::board::{ClaimedLine, Direction, Line, Pin};
use pinion_firmware::lateness::Lateness;
use pinion_firmware::mcu::{Devices, Dialect, DialectName, Finished, Mcu, Note, Outbox, SentJob, WorkerId, Workers};
use pinion_firmware::shutdown::Shutdown;
use pinion_firmware::time::{Clock, Ticks, TimeSource, Timing};
use pinion_linux::clock::{Monotonic, monotonic, watch_tick};
use pinion_protocol::vlq::{Reader, Writer};
use pinion_runtime::FIRMWARE;
use pinion_runtime::realtime::{self, Processors, Role};
use pinion_runtime::wakeup::{MarginLimits, Waiter};
use pinion_testbench::board::{Bench, FakeBoard, PlainBoard};

/// 40 kbaud.
const BIT: Ticks = Ticks::from_us(25);
/// How many messages of each kind the worker exchanges.
const MESSAGES: u32 = 1000;
/// How long the core runs timers for bits.
const CORE_RUNS: Duration = Duration::from_secs(3);
/// klippy's bytes to read a register (`_encode_read(0xf5, 0, 2)` of tmc_uart.py), and a reply.
const MESSAGE: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
/// A message that writes a register: eight bytes (`_encode_write`).
const WRITE: [u8; 8] = [0xf5, 0x00, 0x90, 0x00, 0x06, 0x1a, 0x08, 0x3c];
const REPLY: [u8; 10] = [0x0a, 0xfa, 0x4f, 0x20, 0x80, 0x00, 0x02, 0xe8, 0x20, 0xf1];
/// Time from the last edge of a message to its reply: the end of its last byte, eight bits and some.
const REPLY_AFTER: i64 = 20 * BIT.0 as i64 + 333;

/// The colors of eight LEDs.
const COLORS: [u8; 24] = [
    0x00, 0xff, 0xa5, 0x5a, 0x01, 0x80, 0x00, 0x00, 0x00, 0x10, 0x20, 0x40, 0x00, 0xff, 0xa5, 0x5a, 0x01, 0x80, 0x00,
    0x00, 0x00, 0x10, 0x20, 0x41,
];
/// How many frames the LEDs get.
const FRAMES: u32 = 1000;
/// Shortest look away in which two edges may be hidden: each is 200 ns from the next, and another processor sees it some
/// 100 ns earlier or later.
const HIDES: Duration = Duration::from_nanos(100);
/// How long the line of the LEDs is low between two frames, at least.
const QUIET: Duration = Duration::from_micros(100);

/// The bits of these bytes on the wire, as klippy sends them: the lowest bit of the first byte is the first.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let bits = bytes.iter().flat_map(|byte| (0..10).map(move |n| (u16::from(*byte) << 1 | 0x200) >> n & 1));
    let bits: Vec<u16> = bits.collect();
    bits.chunks(8).map(|byte| byte.iter().rev().fold(0, |value, bit| value << 1 | *bit as u8)).collect()
}

fn bit_of(bytes: &[u8], place: usize) -> bool {
    bytes.get(place / 8).is_none_or(|byte| byte >> (place % 8) & 1 != 0)
}

/// A wire whose other end replies a while after the last edge. It records when each edge came.
struct Wire {
    clock: Arc<dyn TimeSource>,
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

/// A line that is written through registers.
struct Fast(Arc<AtomicU32>);

impl Line for Fast {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        // The processor does not wait until others see it. Some see a pulse that is up to 200 ns shorter or longer.
        self.0.store(level.into(), Ordering::Release);
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        Ok(self.0.load(Ordering::Acquire) != 0)
    }

    fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
        Ok(())
    }

    fn is_fast(&self) -> bool {
        true
    }
}

/// An HX711 on two lines that are written through registers: a sample every 12.5 ms, of ones only. It records how long
/// its clock was high.
///
/// A thread may be interrupted between a look at the time and its edge. So the time is read before and after each edge,
/// and each pulse has a shortest and a longest length.
#[derive(Default)]
struct LoadCell {
    is_high: AtomicBool,
    /// Before and after the clock rose, in nanoseconds; 0 if not known yet.
    rises: AtomicU64,
    risen: AtomicU64,
    /// The sample that was read last, by its number.
    read: AtomicU64,
    shortest: Lengths,
    longest: Lengths,
}

/// Pulses over 50 us, which is the limit of the data sheet (T3), and over 60 us, which switches the chip off.
#[derive(Default)]
struct Lengths {
    pulses: AtomicU64,
    long: [AtomicU64; 2],
    longest_ns: AtomicU64,
}

impl Lengths {
    fn add(&self, ns: u64) {
        self.pulses.fetch_add(1, Ordering::Relaxed);
        self.longest_ns.fetch_max(ns, Ordering::Relaxed);
        for (count, limit) in self.long.iter().zip([50_000, 60_000]) {
            count.fetch_add(u64::from(ns > limit), Ordering::Relaxed);
        }
    }
}

impl std::fmt::Display for Lengths {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let load = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let Lengths { long: [over_50, over_60], longest_ns, .. } = self;
        let longest_us = load(longest_ns) as f64 / 1e3;
        write!(f, "{} over 50 us, {} over 60 us, at most {longest_us} us", load(over_50), load(over_60))
    }
}

/// Nanoseconds between two samples.
const SAMPLE_NS: u64 = 12_500_000;

fn now_ns() -> u64 {
    monotonic().as_nanos() as u64
}

/// The clock of the load cell, or its data.
struct CellLine {
    cell: Arc<LoadCell>,
    is_clock: bool,
}

impl Line for CellLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        let cell = &self.cell;
        if level {
            cell.risen.store(0, Ordering::Release);
            cell.rises.store(now_ns(), Ordering::Release);
            cell.is_high.store(true, Ordering::Release);
            cell.risen.store(now_ns(), Ordering::Release);
            return Ok(());
        }
        let falls = now_ns();
        // The first one that lowers it ends the pulse.
        if cell.is_high.swap(false, Ordering::AcqRel) {
            let (rises, risen) = (cell.rises.load(Ordering::Acquire), cell.risen.load(Ordering::Acquire));
            let fallen = now_ns();
            cell.read.store(fallen / SAMPLE_NS, Ordering::Relaxed);
            cell.longest.add(fallen - rises);
            cell.shortest.add(if risen == 0 { 0 } else { falls.saturating_sub(risen) });
        }
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        match self.is_clock {
            true => Ok(self.cell.is_high.load(Ordering::Acquire)),
            false => Ok(self.cell.read.load(Ordering::Relaxed) == now_ns() / SAMPLE_NS),
        }
    }

    fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
        Ok(())
    }

    fn is_fast(&self) -> bool {
        true
    }
}

/// The pin of the LEDs.
const LEDS: Pin = Pin(9);
/// The data and the clock of the load cell.
const DOUT: Pin = Pin(10);
const SCLK: Pin = Pin(11);

/// Workers, with the priority of Pinion's workers.
struct Threads {
    clock: Arc<dyn TimeSource>,
    are_parallel: bool,
    /// By the names of their buses.
    workers: Vec<(String, Sender<Message>, usize)>,
    outbox: Sender<Finished>,
    done: Mutex<Receiver<Finished>>,
    waiting: Mutex<Option<Finished>>,
}

impl Threads {
    fn new(clock: Arc<dyn TimeSource>, are_parallel: bool) -> Threads {
        let (outbox, done) = mpsc::channel();
        Threads { clock, are_parallel, workers: Vec::new(), outbox, done: Mutex::new(done), waiting: Mutex::new(None) }
    }
}

/// To a worker.
enum Message {
    Device(Box<dyn Any + Send>),
    Job(SentJob),
}

impl Workers for Threads {
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        if let Some(worker) = self.workers.iter().position(|(name, ..)| name == bus) {
            return Ok(WorkerId(worker));
        }
        let (jobs, inbox) = mpsc::channel::<Message>();
        let (clock, outbox) = (self.clock.clone(), self.outbox.clone());
        thread::spawn(move || {
            realtime::enter(Role::Worker);
            let mut devices = Devices::default();
            for message in inbox {
                let mut job = match message {
                    Message::Device(device) => {
                        devices.add(device);
                        continue;
                    }
                    Message::Job(job) => job,
                };
                let began = clock.now();
                job.run(&mut devices);
                let _ = outbox.send(Finished { job, began, ended: clock.now() });
            }
        });
        self.workers.push((bus.into(), jobs, 0));
        Ok(WorkerId(self.workers.len() - 1))
    }
    fn give(&mut self, WorkerId(worker): WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown> {
        let (_, jobs, devices) = &mut self.workers[worker];
        let _ = jobs.send(Message::Device(device));
        *devices += 1;
        Ok(*devices - 1)
    }
    fn are_parallel(&self) -> bool {
        self.are_parallel
    }
    fn submit(&mut self, WorkerId(worker): WorkerId, job: SentJob) -> Result<(), (SentJob, Shutdown)> {
        self.workers[worker].1.send(Message::Job(job)).map_err(|error| panic!("the worker ended: {error}"))
    }
    fn completion(&mut self) -> Option<Finished> {
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

/// The last response of the UART or the LEDs.
#[derive(Clone)]
struct Heard {
    ids: [u32; 2],
    last: Arc<Mutex<Option<Vec<u8>>>>,
}

impl Outbox for Heard {
    fn send(&mut self, payload: &[u8]) {
        if Reader::new(payload).int().is_ok_and(|id| self.ids.contains(&id)) {
            *self.last.lock().unwrap() = Some(payload.to_vec());
        }
    }
    fn note(&mut self, note: Note<'_>) {
        assert!(!matches!(note, Note::Shutdown(_)), "{note:?}");
    }
}

#[derive(PartialEq)]
enum Reply {
    Whole,
    None,
    Wrong,
}

/// The messages that a driver takes from these edges, as its data sheet says (TMC2209, section 4.1): it takes the
/// length of a bit from the sync nibble, and counts the bits of each byte from its start bit. A pause of 63 bits ends a
/// message that is not whole. Bits are read in their middle.
fn messages(edges: &[(Clock, bool)]) -> Vec<Vec<bool>> {
    let level = |at: Clock| edges.iter().rev().find(|(from, _)| *from <= at).is_none_or(|(_, level)| *level);
    let edge = |from: Clock, to: bool| edges.iter().map(|(at, _)| *at).find(|at| *at >= from && level(*at) == to);
    let pause = |from: Clock, to: Clock| to.since(from) > 63 * i64::from(BIT.0);
    let mut messages: Vec<Vec<bool>> = vec![];
    let (mut bit, mut last) = (BIT.0, None::<Clock>);
    let mut next = edges.first().and_then(|(at, _)| edge(*at, false));
    'bytes: while let Some(start) = next {
        if last.is_none_or(|last| pause(last, start)) {
            messages.push(vec![]);
            let mut end = start;
            for to in [true, false, true, false] {
                let Some(at) = edge(end, to) else { break 'bytes };
                if pause(end, at) {
                    (next, last) = (edge(at, false), None);
                    continue 'bytes;
                }
                end = at;
            }
            bit = (end.since(start) / 4) as u32;
        }
        let middle = |n: u32| start + Ticks(bit * n + bit / 2);
        if let Some(message) = messages.last_mut() {
            message.extend((0..10).map(|n| level(middle(n))));
        }
        last = Some(start);
        next = edge(middle(9), false);
    }
    messages
}

/// An MCU with one TMC UART and one chain of LEDs.
struct Printer {
    mcu: Mcu,
    dialect: Arc<Dialect>,
    edges: Arc<Mutex<Vec<(Clock, bool)>>>,
    leds: Arc<AtomicU32>,
    cell: Arc<LoadCell>,
    heard: Heard,
}

impl Printer {
    fn new(clock: Arc<dyn TimeSource>, has_parallel_workers: bool) -> Printer {
        let edges = Arc::new(Mutex::new(Vec::with_capacity(100)));
        let bench = Bench::new(pinion_firmware::time::VirtualClock::at(Clock::EPOCH), Clock::EPOCH);
        let leds = Arc::new(AtomicU32::new(0));
        let cell = Arc::new(LoadCell::default());
        // Each line is the wire, except those of the LEDs and of the load cell.
        let (wire_edges, wire_clock, led_line, cell_line) = (edges.clone(), clock.clone(), leds.clone(), cell.clone());
        let board = PlainBoard(FakeBoard(bench), move |_: &mut FakeBoard, pin, _| {
            let line: Arc<dyn Line> = match pin {
                LEDS => Arc::new(Fast(led_line.clone())),
                DOUT | SCLK => Arc::new(CellLine { cell: cell_line.clone(), is_clock: pin == SCLK }),
                _ => Arc::new(Wire { clock: wire_clock.clone(), edges: wire_edges.clone() }),
            };
            Ok(ClaimedLine { line, sleeps_on: None })
        });
        let dialect = Dialect::new(&FIRMWARE, &board, DialectName::Master);
        let dialect = Arc::new(dialect.expect("a dialect"));
        let id = |format: &str| dialect.dictionary().responses[format].as_i64().unwrap_or(0) as u32;
        let ids = [id("tmcuart_response oid=%c read=%*s"), id("neopixel_result oid=%c success=%c")];
        let heard = Heard { ids, last: Arc::default() };
        let worker = Box::new(Threads::new(clock.clone(), has_parallel_workers));
        let timing = Timing::of(clock);
        let mcu = Mcu::new(dialect.clone(), Box::new(board), timing, worker, Box::new(heard.clone()));
        let mut printer = Printer { mcu, dialect, edges, leds, cell, heard };
        printer.run("allocate_oids count=%c", &[3], None);
        let config = "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u";
        printer.run(config, &[0, 1, 0, 2, BIT.0], None);
        let config = "config_neopixel oid=%c pin=%u data_size=%hu bit_max_ticks=%u reset_min_ticks=%u";
        printer.run(config, &[1, LEDS.0, COLORS.len() as u32, 200, 2500], None);
        let config = "config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u";
        printer.run(config, &[2, 1, DOUT.0, SCLK.0], None);
        printer.run("finalize_config crc=%u", &[1], None);
        let (first, rest) = COLORS.split_at(COLORS.len() / 2);
        for (pos, data) in [(0, first), (first.len(), rest)] {
            printer.run("neopixel_update oid=%c pos=%hu data=%*s", &[1, pos as u32], Some((data, &[])));
        }
        printer
    }

    /// Runs a command with these numbers, bytes, and numbers behind the bytes.
    fn run(&mut self, format: &str, before: &[u32], bytes: Option<(&[u8], &[u32])>) {
        let mut command = Writer::default();
        command.int(self.dialect.command_id(format).expect("a command"));
        before.iter().for_each(|int| command.int(*int));
        if let Some((bytes, behind)) = bytes {
            command.string(bytes);
            behind.iter().for_each(|int| command.int(*int));
        }
        self.mcu.execute(&mut Reader::new(command.payload().expect("it fits")));
    }

    /// Sends a message, and reads a reply of this length. Returns the edges, and the reply: whole, none or wrong.
    fn exchange(&mut self, message: &[u8], read: usize) -> (Vec<(Clock, bool)>, Reply) {
        self.edges.lock().unwrap().clear();
        self.run("tmcuart_send oid=%c write=%*s read=%c", &[0], Some((message, &[read as u32])));
        let response = self.response();
        let reply = match (response.ends_with(&REPLY), response.ends_with(&[0])) {
            (true, _) => Reply::Whole,
            (false, true) => Reply::None,
            (false, false) => Reply::Wrong,
        };
        (self.edges.lock().unwrap().clone(), reply)
    }

    /// Sends the colors. Returns whether the frame was whole, as Pinion says.
    fn light(&mut self) -> bool {
        self.run("neopixel_send oid=%c", &[1], None);
        self.response().ends_with(&[1])
    }

    /// Runs the MCU until its response to the last command.
    fn response(&mut self) -> Vec<u8> {
        loop {
            self.mcu.run_timers();
            if self.mcu.has_completion() {
                self.mcu.run_workers();
            }
            if let Some(response) = self.heard.last.lock().unwrap().take() {
                return response;
            }
        }
    }
}

/// An edge of the LEDs' line: the new level, the last look at the old level, the first look at the new one.
type Seen = (bool, Duration, Duration);

/// The edges of a frame, and the longest time between two looks.
#[derive(Default)]
struct Burst(Vec<Seen>, Duration);

/// Watches the line of the LEDs until `end`. `seen` receives each frame when the line is quiet.
fn watch(leds: &AtomicU32, end: &AtomicBool, seen: &Mutex<Vec<Burst>>) {
    let mut burst = Burst::default();
    let (mut was, mut last) = (false, monotonic());
    while !end.load(Ordering::Relaxed) {
        let level = leds.load(Ordering::Acquire) != 0;
        let now = monotonic();
        if !burst.0.is_empty() {
            burst.1 = burst.1.max(now - last);
        }
        if level != was {
            burst.0.push((level, last, now));
        } else if burst.0.last().is_some_and(|(.., at)| now - *at > QUIET) {
            seen.lock().unwrap().push(std::mem::take(&mut burst));
        }
        (was, last) = (level, now);
    }
}

/// Whether a chain of LEDs understands a frame, by the limits that the firmware's src/neopixel.c names. An edge is
/// somewhere between two looks: false only if a time was surely wrong. `None` if the watching thread looked away, and
/// has not seen all edges.
fn understood(Burst(edges, away): &Burst) -> Option<bool> {
    let ns = |from: Duration, to: Duration| to.as_nanos() as i64 - from.as_nanos() as i64;
    let bits = COLORS.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1));
    if edges.len() != 16 * COLORS.len() {
        return (*away <= HIDES).then_some(false);
    }
    Some(edges.chunks(2).zip(bits).enumerate().all(|(n, (pulse, one))| {
        let [(true, rises, risen), (false, falls, fallen)] = pulse else { return false };
        let high = if one { ns(*rises, *fallen) >= 650 } else { ns(*risen, *falls) <= 500 };
        high && edges.get(2 * n + 2).is_none_or(|(_, next, _)| ns(*risen, *next) <= 5000)
    }))
}

/// Sends frames to the LEDs.
fn leds(clock: Monotonic) {
    let mut printer = Printer::new(Arc::new(clock), true);
    let (leds, end, seen) = (printer.leds.clone(), AtomicBool::new(false), Mutex::new(Vec::new()));
    let (mut whole, mut first, mut tries) = (0, 0, 0);
    // Of the whole frames: as seen from outside.
    let mut as_seen = [0; 3];
    thread::scope(|scope| {
        scope.spawn(|| {
            realtime::enter(Role::Worker);
            watch(&leds, &end, &seen);
        });
        for _ in 0..FRAMES {
            let is_whole = printer.light();
            thread::sleep(Duration::from_millis(2));
            let frames = std::mem::take(&mut *seen.lock().unwrap());
            tries += frames.len();
            whole += u32::from(is_whole);
            first += u32::from(is_whole && frames.len() == 1);
            if is_whole {
                let last = frames.last().and_then(understood);
                as_seen[last.map_or(2, |good| usize::from(!good))] += 1;
            }
        }
        end.store(true, Ordering::Relaxed);
    });
    let [good, bad, unknown] = as_seen;
    println!("  LEDs: of {FRAMES} frames {whole} whole, {first} at the first try; {tries} tries");
    println!(
        "  another thread saw {good} of the whole ones with all their times, {bad} without, and not all edges of {unknown}"
    );
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
    let mut waiter = Waiter::new(Arc::new(clock), Arc::default(), MarginLimits::default(), scheduling, processors);
    let mut core = Core { steps: Lateness::default(), bits: Lateness::default(), messages: [0; 2] };
    let mut good = true;
    let start = clock.now() + Ticks::from_ms(1);
    // Due time, interval, whether it is a bit.
    let stepper = |n: u32| (start + Ticks::from_us(17 * n), Ticks::from_us(100), false);
    let mut timers: Vec<(Clock, Ticks, bool)> = (0..steppers).map(stepper).collect();
    timers.extend(with_bits.then_some((start, BIT, true)));
    while !end.load(Ordering::Relaxed) {
        let Some((at, every, is_bit)) = timers.iter_mut().min_by_key(|(at, ..)| *at) else { break };
        let begin = clock.now();
        if begin < *at {
            waiter.wait(begin, *at, Some(*at), |_| false);
        }
        let now = clock.now();
        let late = Ticks::between(*at, now);
        if *is_bit {
            core.bits.record(late);
            good &= late.0 < BIT.0 / 2;
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

/// A clock that knows nothing of the kernel's ticks.
struct Tickless(Monotonic);

impl TimeSource for Tickless {
    fn now(&self) -> Clock {
        self.0.now()
    }
    fn instant_of(&self, monotonic: Duration) -> Clock {
        self.0.instant_of(monotonic)
    }
    fn duration_of(&self, clock: Clock) -> Duration {
        self.0.duration_of(clock)
    }
}

/// Looks at the clock on a processor that has nothing else to do, until `end`. Notes when it was interrupted: from and to.
fn stand_stills(clock: Monotonic, end: &AtomicBool, gaps: &Mutex<Vec<(Clock, Clock)>>) {
    let mut last = clock.now();
    while !end.load(Ordering::Relaxed) {
        let now = clock.now();
        if now.since(last) > i64::from(BIT.0 / 4) {
            gaps.lock().unwrap().push((last, now));
        }
        last = now;
    }
}

/// Outcomes of messages.
#[derive(Default)]
struct Counts {
    /// Messages that a driver did not understand at the first try while a processor without work was interrupted, too.
    still: usize,
    /// Messages that a driver understood at the first try, and in the end, and all tries.
    first: usize,
    last: usize,
    tries: usize,
    read: usize,
    none: usize,
    wrong: usize,
}

/// Exchanges messages that begin at any time, and between two ticks of the kernel, in turn. Prints how many arrived.
fn uart(clock: Monotonic) {
    let write = framed(&WRITE);
    let whole: Vec<bool> = (0..8 * write.len()).map(|n| bit_of(&write, n)).collect();
    let clocks: [Arc<dyn TimeSource>; 2] = [Arc::new(Tickless(clock)), Arc::new(clock)];
    let mut ways = clocks.map(|clock| (Printer::new(clock, true), Counts::default()));
    let (end, gaps) = (AtomicBool::new(false), Mutex::new(Vec::new()));
    thread::scope(|scope| {
        scope.spawn(|| {
            realtime::enter(Role::Worker);
            stand_stills(clock, &end, &gaps);
        });
        for n in 0..2 * MESSAGES {
            let (printer, counts) = &mut ways[n as usize % 2];
            let (edges, _) = printer.exchange(&write, 0);
            // Without the first write, which only warms up.
            let heard = messages(&edges[1..]);
            counts.tries += heard.len();
            if heard.first() == Some(&whole) {
                counts.first += 1;
            } else if let Some((from, _)) = edges.get(1) {
                let to = *from + Ticks(BIT.0 * whole.len() as u32);
                // The watching thread may have been interrupted until now.
                thread::sleep(Duration::from_millis(1));
                let is_within = |(last, now): &(Clock, Clock)| *last < to && *now > *from;
                counts.still += usize::from(gaps.lock().unwrap().iter().any(is_within));
            }
            counts.last += usize::from(heard.last() == Some(&whole));
            let count = match printer.exchange(&MESSAGE, REPLY.len()).1 {
                Reply::Whole => &mut counts.read,
                Reply::None => &mut counts.none,
                Reply::Wrong => &mut counts.wrong,
            };
            *count += 1;
            gaps.lock().unwrap().clear();
            thread::sleep(Duration::from_millis(2));
        }
        end.store(true, Ordering::Relaxed);
    });
    for ((_, counts), begins) in ways.iter().zip(["at any time", "between two ticks"]) {
        let Counts { still, first, last, tries, read, none, wrong } = counts;
        println!("  UART, {begins}: of {MESSAGES} messages {last} whole, {first} at the first try; {tries} tries");
        println!("  {still} first tries were spoilt while an idle processor stood still, too");
        println!("  of {MESSAGES} registers {read} read, {none} not, {wrong} wrong");
    }
}

/// Reads the load cell for a while, and prints how long its clock was high. A second worker watches the pulses, unless
/// one reads `alone`.
fn load_cell(clock: Monotonic, lasts: Duration, alone: bool) {
    let mut printer = Printer::new(Arc::new(clock), !alone);
    realtime::enter(Role::Core);
    printer.run("query_hx71x oid=%c rest_ticks=%u", &[2, Ticks::from_us(1250).0], None);
    let end = monotonic() + lasts;
    while monotonic() < end {
        printer.mcu.run_timers();
        if printer.mcu.has_completion() {
            printer.mcu.run_workers();
        }
        thread::sleep(Duration::from_micros(200));
    }
    let LoadCell { shortest, longest, .. } = &*printer.cell;
    let pulses = longest.pulses.load(Ordering::Relaxed);
    println!("HX711 for {} s: {pulses} pulses; surely {shortest}; possibly {longest}", lasts.as_secs());
}

fn main() {
    let watcher = watch_tick().expect("a thread");
    let _ = Monotonic::start().tick_after(Clock::EPOCH);
    watcher.join().expect("no panic");
    // `cargo bench -p pinion-benches --bench bits -- hx711 3600 [alone]`: only this, for so many seconds.
    let mut words = std::env::args().skip_while(|word| word != "hx711").skip(1);
    if let Some(seconds) = words.next().and_then(|word| word.parse().ok()) {
        return load_cell(
            Monotonic::start(),
            Duration::from_secs(seconds),
            words.next().is_some_and(|word| word == "alone"),
        );
    }
    // `-- uart`: without LEDs.
    let only_uart = std::env::args().any(|word| word == "uart");
    let clock = Monotonic::start();
    for steppers in [0, 3] {
        let end = AtomicBool::new(false);
        thread::scope(|scope| {
            let beside = scope.spawn(|| core(clock, steppers, false, &end));
            println!("worker, {steppers} steppers in the core:");
            if !only_uart {
                leds(clock);
            }
            uart(clock);
            end.store(true, Ordering::Relaxed);
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
