// SPDX-License-Identifier: GPL-3.0-or-later
//! An MCU on a bench in virtual time. Tests send commands and read responses as text.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::Board;
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Dialect, DialectName, Firmware, Forms, Mcu, Note, Outbox, Wire};
use pinion_firmware::time::{Clock, Ticks, TimeSource, Timing, VirtualClock};
use pinion_protocol::dictionary::Dictionary;
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::{Reader, Writer};

use crate::board::{Bench, Edge, FakeBoard, FakeWorkers};
use crate::memory::uncounted;

/// The firmware of a rig's MCU.
pub const FIRMWARE: Firmware =
    Firmware { features: FEATURES, app: "Rig", version: "test", build_versions: "", license: "", wire: Wire::Terminal };

/// The tick at which a rig is created, unless a test sets another.
const ORIGIN: u64 = 10_000_000;

/// Size of the buffer for all responses. Benches measure the MCU, and not how the buffer grows.
const RESPONSE_BYTES: usize = 1 << 20;

#[derive(Clone)]
struct FakeOutbox {
    payloads: Arc<Mutex<Vec<u8>>>,
    notes: Arc<Mutex<Vec<String>>>,
}

impl Outbox for FakeOutbox {
    fn send(&mut self, payload: &[u8]) {
        let mut payloads = self.payloads.lock().unwrap();
        uncounted(|| {
            payloads.push(payload.len() as u8);
            payloads.extend_from_slice(payload);
        });
    }

    fn note(&mut self, note: Note<'_>) {
        let text = match note {
            Note::Shutdown(shutdown) => format!("shutdown: {shutdown}"),
            Note::Warning(shutdown) => format!("warning: {shutdown}"),
            Note::Device(warning) => format!("warning: {}", warning.trouble),
            Note::Trouble(shutdown) => format!("trouble: {shutdown}"),
            Note::Configured(kinds) => format!("configured: {kinds:?}"),
            Note::Safe(name) => format!("safe: {name}"),
            Note::Lateness(..) => return,
            Note::Reset => "reset".into(),
            Note::Renewed => "renewed".into(),
        };
        self.notes.lock().unwrap().push(text);
    }
}

/// An MCU on a bench. Times count from the rig's creation.
pub struct Rig {
    /// The MCU.
    pub mcu: Mcu,
    /// Its pins and buses.
    pub bench: Bench,
    origin: Clock,
    clock: VirtualClock,
    workers: FakeWorkers,
    outbox: FakeOutbox,
}

impl Default for Rig {
    fn default() -> Rig {
        Rig::new()
    }
}

impl Rig {
    /// An MCU that waits for its configuration.
    pub fn new() -> Rig {
        Rig::at(ORIGIN)
    }

    /// An MCU that is created at `start`.
    pub fn at(start: u64) -> Rig {
        Rig::on_board(start, FakeBoard)
    }

    /// An MCU with another board than the bench's own.
    pub fn on_board<B: Board + 'static>(start: u64, board: impl FnOnce(Bench) -> B) -> Rig {
        Rig::that_speaks(DialectName::Master.into(), start, board)
    }

    /// An MCU with messages of these forms.
    pub fn of(forms: impl Into<Forms>) -> Rig {
        Rig::that_speaks(forms.into(), ORIGIN, FakeBoard)
    }

    /// An MCU with a dialect that was made before.
    pub fn with_dialect(dialect: Arc<Dialect>) -> Rig {
        Rig::made(ORIGIN, FakeBoard, |_| dialect)
    }

    fn that_speaks<B: Board + 'static>(forms: Forms, start: u64, board: impl FnOnce(Bench) -> B) -> Rig {
        Rig::made(start, board, |board| Arc::new(Dialect::new(&FIRMWARE, board, forms).unwrap()))
    }

    fn made<B: Board + 'static>(
        start: u64,
        board: impl FnOnce(Bench) -> B,
        dialect: impl FnOnce(&B) -> Arc<Dialect>,
    ) -> Rig {
        let origin = Clock::from_ticks(start);
        let clock = VirtualClock::at(origin);
        let bench = Bench::new(clock.clone(), origin);
        let board = board(bench.clone());
        let dialect = dialect(&board);
        let workers = FakeWorkers::new(bench.clone());
        let outbox =
            FakeOutbox { payloads: Arc::new(Mutex::new(Vec::with_capacity(RESPONSE_BYTES))), notes: Arc::default() };
        let mcu = Mcu::new(
            dialect,
            Box::new(board),
            Timing::of(Arc::new(clock.clone())),
            Box::new(workers.clone()),
            Box::new(outbox.clone()),
        );
        let rig = Rig { mcu, bench, origin, clock, workers, outbox };
        assert_eq!(rig.responses(), ["starting"]);
        rig
    }

    /// An MCU configured with these commands.
    pub fn configured(commands: &[&str]) -> Rig {
        let mut rig = Rig::new();
        rig.configure(commands);
        rig
    }

    /// As [`Rig::configured`], with devices that need `answer_ticks` on a worker.
    pub fn with_workers(answer_ticks: u32, commands: &[&str]) -> Rig {
        let mut rig = Rig::new();
        rig.bench.state().answer_ticks = answer_ticks;
        rig.configure(commands);
        rig
    }

    /// Configures the MCU with these commands.
    pub fn configure(&mut self, commands: &[&str]) {
        self.send("allocate_oids count=20");
        self.send_all(commands);
        self.send("finalize_config crc=7");
        assert_eq!(self.responses(), [""; 0], "{:?}", self.notes());
    }

    // ---- time

    /// Ticks since the rig's creation.
    pub fn now(&self) -> u64 {
        self.clock.now().since(self.origin) as u64
    }

    /// The time now, as it goes over the wire.
    pub fn wire_clock(&self) -> u32 {
        self.clock.now().wire()
    }

    /// How many jobs are on their way.
    pub fn jobs(&self) -> usize {
        self.workers.under_way()
    }

    fn instant(&self, ticks: u64) -> Clock {
        Clock::from_ticks(self.origin.ticks() + ticks)
    }

    /// Lets time pass without giving the MCU a turn.
    pub fn stall_until(&mut self, ticks: u64) {
        self.clock.set(self.instant(ticks));
    }

    /// Jumps to a time.
    #[inline]
    pub fn jump(&self, to: Clock) {
        self.clock.set(to);
    }

    /// Runs the MCU up to the time `ticks`, inclusive.
    pub fn run_until(&mut self, ticks: u64) {
        let end = self.instant(ticks);
        while let Some(next) = self.turn().filter(|next| *next <= end) {
            self.clock.set(next);
        }
        self.clock.set(end);
    }

    /// Lets the MCU run its due timers and jobs, for at most this many turns. A command may ask for events without end.
    pub fn run_turns(&mut self, turns: u32) {
        for _ in 0..turns {
            if let Some(next) = self.turn() {
                self.clock.set(next);
            }
        }
    }

    /// Runs the due timers and jobs, and returns the time of the next event.
    #[inline]
    pub fn turn(&mut self) -> Option<Clock> {
        self.mcu.run_timers();
        self.mcu.run_workers();
        let next = [self.mcu.next_timer(), self.workers.next_end()].into_iter().flatten().min()?;
        // An event that asks to run again in the past also takes some time.
        Some(if next <= self.mcu.last_read() { self.mcu.now() + Ticks::from_us(1) } else { next })
    }

    // ---- words

    /// Encodes a command, for example `queue_step oid=0 interval=1000 count=5 add=-3`. Bytes are in hexadecimal.
    /// `clock=@1000` is 1000 ticks after the rig's creation.
    pub fn encode(&self, command: &str) -> Vec<u8> {
        let mut words = command.split(' ');
        let name = words.next().unwrap();
        let given: Vec<(&str, &str)> = words.map(|word| word.split_once('=').unwrap()).collect();
        let dialect = self.mcu.heard();
        let format = dialect.dictionary().commands.keys().find(|format| format::name(format) == name);
        let format = format.unwrap_or_else(|| panic!("no command {name}"));
        let parameters = format::parameters(format).unwrap();
        assert_eq!(given.len(), parameters.len(), "{command} is no {format}");
        let mut writer = Writer::default();
        writer.int(dialect.command_id(format).unwrap());
        for (name, conversion) in parameters {
            let (_, value) = given.iter().find(|(given, _)| *given == name).unwrap_or_else(|| panic!("{format}"));
            match conversion {
                Conversion::Bytes => writer.string(&unhex(value)),
                _ => writer.int(self.number(value)),
            }
        }
        writer.payload().unwrap().to_vec()
    }

    fn number(&self, text: &str) -> u32 {
        match text.strip_prefix('@') {
            Some(ticks) => self.origin.wire().wrapping_add(ticks.parse::<i64>().unwrap() as u32),
            None => text.parse::<i64>().unwrap() as u32,
        }
    }

    /// Sends a command.
    pub fn send(&mut self, command: &str) {
        let payload = self.encode(command);
        self.execute(&payload);
    }

    /// Sends these commands in order.
    pub fn send_all(&mut self, commands: &[&str]) {
        commands.iter().for_each(|command| self.send(command));
    }

    /// Runs one command, and does not wait for the end of its job.
    pub fn begin(&mut self, command: &str) {
        let payload = self.encode(command);
        self.mcu.execute(&mut Reader::new(&payload));
    }

    /// Runs the commands of a block's payload. It waits for the end of each command's job, unless the next
    /// command joins it.
    #[inline]
    pub fn execute(&mut self, payload: &[u8]) {
        let mut reader = Reader::new(payload);
        while !reader.is_empty() {
            self.mcu.execute(&mut reader);
            while !self.mcu.may_run(reader.rest()) {
                let next = self.turn();
                self.clock.set(next.filter(|_| self.mcu.is_held()).unwrap_or(self.clock.now()));
            }
        }
    }

    /// Sends a command and returns its answer, the last response.
    pub fn ask(&mut self, command: &str) -> String {
        self.send(command);
        self.responses().pop().unwrap_or_default()
    }

    /// The responses since the last call as text, without `stats`, for example
    /// `shutdown clock=@5 static_string_id=Timer too close`.
    pub fn responses(&self) -> Vec<String> {
        let mut responses = self.everything();
        responses.retain(|response| !response.starts_with("stats"));
        responses
    }

    /// As [`Rig::responses`], with `stats`.
    pub fn everything(&self) -> Vec<String> {
        let mut responses = Vec::new();
        self.each_response(|payload| responses.push(self.decode(payload)));
        responses
    }

    /// Passes each response since the last call to `look`, as bytes of the wire.
    pub fn each_response(&self, mut look: impl FnMut(&[u8])) {
        let mut buffer = self.outbox.payloads.lock().unwrap();
        let mut payloads = &buffer[..];
        while let Some((len, rest)) = payloads.split_first() {
            let (payload, rest) = rest.split_at(usize::from(*len));
            look(payload);
            payloads = rest;
        }
        buffer.clear();
    }

    /// Forgets the responses so far.
    pub fn forget_responses(&self) {
        self.outbox.payloads.lock().unwrap().clear();
    }

    /// The MCU's notes for the log since the last call.
    pub fn notes(&self) -> Vec<String> {
        std::mem::take(&mut self.outbox.notes.lock().unwrap())
    }

    /// The text of the shutdown since the last call, if there was one. It panics if there were several.
    pub fn shutdown(&self) -> Option<String> {
        let mut responses = self.responses();
        responses.retain(|response| response.starts_with("shutdown "));
        assert!(responses.len() <= 1, "{responses:?}");
        responses.pop().map(|response| response.split_once("static_string_id=").unwrap().1.into())
    }

    /// Runs the MCU up to the time `ticks`, inclusive. These must be its responses since the last call.
    #[track_caller]
    pub fn sends_until(&mut self, ticks: u64, responses: &[&str]) {
        self.run_until(ticks);
        assert_eq!(self.responses(), responses, "until {ticks}");
    }

    /// Runs the MCU up to the time `ticks`, inclusive. By then it must have shut down with this text.
    #[track_caller]
    pub fn stops_by(&mut self, ticks: u64, text: &str) {
        self.run_until(ticks);
        assert_eq!(self.shutdown().as_deref(), Some(text), "by {ticks}");
    }

    /// Configures these objects. One of them must shut the MCU down with this text.
    #[track_caller]
    pub fn refuses(&mut self, objects: &[&str], text: &str) {
        self.send("allocate_oids count=20");
        self.send_all(objects);
        assert_eq!(self.shutdown().as_deref(), Some(text), "{objects:?}");
    }

    /// Sends a command that must shut the MCU down with this text.
    #[track_caller]
    pub fn stops_on(&mut self, command: &str, text: &str) {
        self.send(command);
        assert_eq!(self.shutdown().as_deref(), Some(text), "{command}");
    }

    /// The edges of an output so far.
    pub fn edges(&self, pin: u32) -> Vec<Edge> {
        self.bench.edges(pin)
    }

    /// The MCU's dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        self.dialect().dictionary()
    }

    /// The dialect that the MCU speaks.
    pub fn dialect(&self) -> &Dialect {
        self.mcu.dialect()
    }

    /// Gives the MCU another dialect. It may not use it before a reset.
    pub fn speak(&mut self, forms: impl Into<Forms>) {
        let dialect = Dialect::new(&FIRMWARE, &FakeBoard(self.bench.clone()), forms);
        self.mcu.speak(Arc::new(dialect.unwrap()));
    }

    fn decode(&self, payload: &[u8]) -> String {
        let mut reader = Reader::new(payload);
        let id = reader.int().unwrap();
        let is_it = |(_, value): &(&String, &serde_json::Value)| value.as_i64() == Some((id as i32).into());
        let (format, _) = self.dictionary().responses.iter().find(is_it).unwrap();
        let mut text = format::name(format).to_owned();
        for (name, conversion) in format::parameters(format).unwrap() {
            let value = match conversion {
                Conversion::Bytes => hex(reader.bytes().unwrap()),
                Conversion::I32 => (reader.int().unwrap() as i32).to_string(),
                _ if name.ends_with("clock") => {
                    let clock = Clock::widen(reader.int().unwrap(), self.clock.now());
                    format!("@{}", clock.since(self.origin))
                }
                _ if name == "static_string_id" => self.static_string(reader.int().unwrap()),
                _ => reader.int().unwrap().to_string(),
            };
            text += &format!(" {name}={value}");
        }
        assert!(reader.is_empty(), "{text} has more than its format says");
        text
    }

    fn static_string(&self, id: u32) -> String {
        let strings = self.dictionary().enumerations["static_string_id"].as_object().unwrap();
        strings.iter().find(|(_, value)| value.as_u64() == Some(id.into())).unwrap().0.clone()
    }
}

/// Bytes in hexadecimal, as in a rig's commands.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap()).collect()
}
