// SPDX-License-Identifier: GPL-3.0-or-later
//! The computer with the simulated printer: the MCU in virtual time, and what a day in its life shows.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use pinion_client::messages::Messages;
use pinion_client::serial::Received;
use pinion_client::{Arg, Params};
use pinion_firmware::mcu::{Dialect, DialectName, Snapshot};
use pinion_model::{HeaterConfig, SimBoard, SimConfig, SimProbe, Thermistor};
use pinion_protocol::dictionary::Dictionary;
use pinion_testbench::dice::Dice;
use pinion_testbench::memory::{allocations, live_bytes};
use pinion_testbench::rig::{FIRMWARE, Rig};

use crate::board::{Faults, FaultyBoard};

/// Ticks in a second and in a millisecond.
pub const SECOND: u64 = 50_000_000;
pub const MS: u64 = SECOND / 1000;
/// How long before a wrap of its 32-bit clock the MCU is created.
const BEFORE_WRAP: u64 = 5 * SECOND;
/// How long a device on a worker takes to answer, in ticks.
const ANSWER_TICKS: u32 = 2000;
/// How many of the last events a failure shows.
const STORY: usize = 40;

/// The axes of the default printer, with their steps per millimeter.
pub const AXES: [(&str, f64); 4] = [("x", 80.0), ("y", 80.0), ("z", 400.0), ("extruder", 100.0)];

/// The parts of the day.
#[derive(Debug, Default)]
pub struct Tally {
    pub commands: u64,
    pub hosts: u64,
    pub steps: u64,
    pub homings: u64,
    /// Messages with accelerations.
    pub measurements: u64,
    /// How often every position was compared.
    pub comparisons: u64,
}

/// The MCU on the simulated printer, in virtual time.
pub struct Printer {
    pub rig: Rig,
    pub probe: SimProbe,
    /// The thermistor of each heater.
    pub thermistors: Vec<Thermistor>,
    pub faults: Arc<Faults>,
    pub dice: Dice,
    pub tally: Tally,
    pub snapshot: Snapshot,
    dialects: Vec<Arc<Dialect>>,
    messages: Messages,
    /// The memory of the host's own messages.
    host_bytes: i64,
    /// Whether the core may not allocate now.
    pub is_strict: bool,
    story: VecDeque<(u64, String)>,
    /// The seed and the length of the day, to repeat it.
    seed: u64,
    seconds: u64,
    /// The MCU's clock when the rig was created, in ticks.
    start: u64,
}

impl Drop for Printer {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for (at, event) in &self.story {
                eprintln!("{:12.6} s: {event}", *at as f64 / SECOND as f64);
            }
            eprintln!("repeat it: PINION_SOAK_SEED={} PINION_SOAK_SECONDS={}", self.seed, self.seconds);
        }
    }
}

impl Printer {
    pub fn new(seed: u64, seconds: u64) -> Printer {
        let faults = Faults::none();
        let start = (1 << 32) * (1 + seed % 7) - BEFORE_WRAP;
        let (mut probe, mut thermistors, mut dialects) = (None, Vec::new(), Vec::new());
        let rig = Rig::on_board(start, |bench| {
            let clock = bench.clock();
            bench.state().answer_ticks = ANSWER_TICKS;
            // The thermometer would wait for its conversion in real time.
            let printer = SimConfig::default_toml().replace("conversion_ms = 750", "conversion_ms = 0");
            let printer = SimConfig::parse(&printer, "the default printer").unwrap();
            thermistors = printer.heaters.iter().map(HeaterConfig::thermistor).collect::<Result<_, _>>().unwrap();
            let board = SimBoard::new(printer, Arc::new(clock.clone())).unwrap();
            probe = Some(board.probe());
            let dialect = |of: &DialectName| Arc::new(Dialect::new(&FIRMWARE, &board, *of).unwrap());
            dialects = DialectName::OF_HOSTS.iter().map(dialect).collect();
            FaultyBoard { board, faults: faults.clone(), clock }
        });
        let dice = Dice(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        Printer {
            rig,
            probe: probe.unwrap(),
            thermistors,
            faults,
            dice,
            tally: Tally::default(),
            snapshot: Snapshot::default(),
            dialects,
            messages: Messages::default(),
            host_bytes: 0,
            is_strict: false,
            story: VecDeque::with_capacity(STORY),
            seed,
            seconds,
            start,
        }
    }

    /// Notes an event, to show if the day fails.
    pub fn note(&mut self, event: impl Into<String>) {
        if self.story.len() == STORY {
            self.story.pop_front();
        }
        self.story.push_back((self.rig.now(), event.into()));
    }

    // ---- a host

    /// A host begins to talk to the MCU, in a dialect of its own. It reads its dictionary.
    pub fn meet(&mut self, dialect: usize) {
        let dialect = self.dialects[dialect].clone();
        self.note(format!("a host of {}", dialect.forms().label()));
        self.rig.mcu.speak(dialect.clone());
        self.messages = Messages::new(dialect.dictionary());
        let mut read = Vec::new();
        loop {
            let offset = read.len() as u32;
            let answer = self.ask("identify", &[("offset", offset.into()), ("count", 40.into())], "identify_response");
            assert_eq!(answer.u32("offset").unwrap(), offset);
            let piece = answer.bytes("data").unwrap();
            if piece.is_empty() {
                break;
            }
            read.extend_from_slice(piece);
        }
        assert_eq!(read, dialect.compressed());
        self.messages = Messages::default();
        let before = live_bytes();
        self.messages = Messages::new(&Dictionary::decompress(&read).unwrap());
        self.host_bytes = live_bytes() - before;
        self.tally.hosts += 1;
    }

    pub fn any_dialect(&mut self) -> usize {
        self.dice.below(DialectName::OF_HOSTS.len())
    }

    pub fn has_parameter(&self, command: &str, parameter: &str) -> bool {
        self.messages.has_parameter(command, parameter)
    }

    /// Sends a command.
    pub fn send(&mut self, command: &str, args: &[(&str, Arg<'_>)]) {
        let payload = self.messages.encode(command, args).unwrap();
        self.execute(command, &payload);
    }

    pub fn execute(&mut self, what: &str, payload: &[u8]) {
        let rig = &mut self.rig;
        let allocated = allocations(|| rig.execute(payload));
        self.tally.commands += 1;
        assert!(!self.is_strict || allocated == 0 || rig.mcu.is_shutdown(), "{what} allocates {allocated} times");
    }

    /// Sends a command and returns its answer.
    pub fn ask(&mut self, command: &str, args: &[(&str, Arg<'_>)], answer: &str) -> Params {
        self.send(command, args);
        let responses = self.responses();
        let found = responses.into_iter().rev().find(|response| response.name == answer);
        found.unwrap_or_else(|| panic!("no {answer} to {command}"))
    }

    /// The responses since the last call.
    pub fn responses(&mut self) -> Vec<Params> {
        let mut responses = Vec::new();
        let (messages, at) = (&self.messages, Instant::now());
        self.rig.each_response(|payload| {
            responses.extend(messages.decode(&Received { payload: payload.to_vec(), at }));
        });
        assert!(responses.iter().all(|response| response.name != "#unknown"), "{responses:?}");
        responses
    }

    // ---- time

    /// Lets the MCU run for this many ticks.
    pub fn pass(&mut self, ticks: u64) {
        let end = self.rig.now() + ticks;
        let rig = &mut self.rig;
        let allocated = allocations(|| rig.run_until(end));
        assert!(!self.is_strict || allocated == 0 || rig.mcu.is_shutdown(), "timers allocate {allocated} times");
    }

    /// A time as it goes over the wire.
    pub fn wire(&self, ticks: u64) -> u32 {
        (self.start + ticks) as u32
    }

    /// Checks that the MCU's clock of 64 bits is the bench's.
    pub fn compare_clocks(&mut self) {
        let uptime = self.ask("get_uptime", &[], "uptime");
        let ticks = u64::from(uptime.u32("high").unwrap()) << 32 | u64::from(uptime.u32("clock").unwrap());
        assert_eq!(ticks, self.start + self.rig.now());
    }

    // ---- what the printer shows

    /// The steps from zero at which an axis stands.
    pub fn steps_of(&self, axis: usize) -> i64 {
        let (name, steps_per_mm) = AXES[axis];
        (self.probe.axis(name).unwrap().position_mm * steps_per_mm).round() as i64
    }

    pub fn positions(&self) -> [i64; 4] {
        [0, 1, 2, 3].map(|axis| self.steps_of(axis))
    }

    /// Whether any heater has power.
    pub fn heats(&self) -> bool {
        self.probe.heaters().any(|heater| heater.on)
    }

    /// The memory of the MCU and its printer.
    pub fn bytes(&mut self) -> i64 {
        self.rig.notes();
        self.story.clear();
        live_bytes() - self.host_bytes
    }

    /// Fills the snapshot.
    pub fn look(&mut self) -> &Snapshot {
        self.snapshot.clear();
        while !self.rig.mcu.fill(&mut self.snapshot) {}
        &self.snapshot
    }
}
