// SPDX-License-Identifier: GPL-3.0-or-later
//! An MCU under any commands of a host, while its board fails now and then. Bytes choose what happens, so that both a
//! property test and a fuzzer can.
//!
//! The commands come from the dictionary, so a new feature is covered as soon as it is listed. Each command is tried
//! once for each dialect of hosts, to find arguments that it accepts ([`Book`]). A trial then sends accepted
//! arguments and changes some of them. What must hold:
//!
//! - Nothing panics. Every response has the form of the dictionary.
//! - A stopped MCU has its outputs at their shutdown values, and makes no steps.
//! - Commands are held for no longer than the limit. A number of jobs and moves is never exceeded.
//! - A configured MCU that works as it should allocates nothing.
//! - Whatever happened, a reset and a configuration make it work again.

#![forbid(unsafe_code)]

use std::collections::{HashMap, HashSet};
use std::ops::AddAssign;
use std::sync::{Arc, OnceLock};

use pinion_firmware::mcu::{Dialect, DialectName, Snapshot};
use pinion_firmware::time::{CLOCK_FREQ, Ticks};
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::{Reader, Writer};

use crate::board::{ANALOG, GPIOS, MOSI, PWM, SPI_CHIPS};
use crate::dice::Dice;
use crate::memory;
use crate::rig::Rig;

/// Commands that always stop a running MCU, for all hosts or for some.
const STOPS: &[&str] = &[
    "emergency_stop",
    "config_reset",
    "clear_shutdown",
    "debug_read",
    "debug_write",
    "allocate_oids",
    "finalize_config",
];

/// Values at which something might break.
#[rustfmt::skip]
const EXTREMES: &[u32] = &[
    0, 1, u32::MAX, 2, 7, 8, 15, 16, 48, 49, 63, 64, 127, 128, 255, 256, 4096, 4097, 32767, 32768, 65535, 65536,
    (1 << 31) - 1, 1 << 31, (1 << 31) + 1, u32::MAX - 1,
];
/// Pins of every kind, also of an expander, and numbers that might break something.
#[rustfmt::skip]
const PINS: &[u32] = &[
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24,
    EXPANDED, EXPANDED + 1, EXPANDED + 2, EXPANDED + 3, ANALOG, ANALOG + 1, ANALOG + 2, PWM, PWM + 1, MOSI, MOSI + 1,
    SPI_CHIPS, SPI_CHIPS + 1, 300, 255, u32::MAX,
];
/// Spans that a worker waits for between two edges. They are short here: the bench runs a job to its end at once
/// and cannot interrupt it, as a stop does.
const PACED: &[&str] = &["delay_ticks", "sync_delay_ticks", "cmd_delay_ticks", "pulse_ticks", "bit_time"];
const PACED_TICKS: u32 = 500;
/// The first line of the expander.
const EXPANDED: u32 = 280;
const EXPANDED_LINES: u32 = 8;
/// How long an input is low, in ticks. On some pins it is up to 13 times as long. It is short, because a bus on lines
/// polls a clock that is low each microsecond, for 100 ms.
const LOW: u64 = 777;
/// A thermometer on the bench.
const SERIAL: &[u8] = b"28";
/// Number of oids in a configuration.
const OIDS: u8 = 100;
/// Number of objects for each command that creates one.
const OBJECTS_OF_A_KIND: usize = 2;
/// Highest number of jobs on their way. No object has more than 32 boxes for them, except PCA9685, which has one for
/// each output.
const JOBS_MAX: usize = 1024;
/// Highest number of parameters that a command has.
const PARAMETERS_MAX: usize = 9;
/// Highest number of actions in a trial.
const ACTIONS_MAX: u32 = 120;
/// The answer of an MCU that is configured, and runs.
const CONFIGURED: &str = "config is_config=1 crc=7 is_shutdown=0 move_count=1024";

/// An argument that can be sent at any time.
#[derive(Clone, Debug)]
enum Value {
    Number(u32),
    /// A time, in ticks from now.
    Soon(u32),
    Bytes(Vec<u8>),
}

/// A command of the dictionary.
struct Form {
    format: String,
    id: u32,
    parameters: Vec<(String, Conversion)>,
}

impl Form {
    fn name(&self) -> &str {
        format::name(&self.format)
    }

    fn configures(&self) -> bool {
        self.name().starts_with("config_") && self.name() != "config_reset"
    }

    /// The message, without the bytes that do not fit.
    fn encode(&self, rig: &Rig, values: &[Value]) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.int(self.id);
        // An integer takes at most five bytes, the length of a string one.
        let sizes = self.parameters.iter().map(|(_, conversion)| if *conversion == Conversion::Bytes { 1 } else { 5 });
        let mut room = PAYLOAD_MAX - 2 - sizes.sum::<usize>().min(PAYLOAD_MAX - 2);
        for (value, (name, _)) in values.iter().zip(&self.parameters) {
            match value {
                Value::Number(number) if PACED.contains(&name.as_str()) => writer.int(*number % PACED_TICKS),
                Value::Number(number) if name == "rate" => writer.int((*number).max(CLOCK_FREQ / PACED_TICKS)),
                Value::Number(number) => writer.int(*number),
                Value::Soon(ticks) => writer.int(rig.wire_clock().wrapping_add(*ticks)),
                Value::Bytes(bytes) => {
                    let len = bytes.len().min(room);
                    room -= len;
                    writer.string(&bytes[..len]);
                }
            }
        }
        writer.payload().unwrap().to_vec()
    }

    /// The pins in its arguments.
    fn pins<'a>(&'a self, values: &'a [Value]) -> impl Iterator<Item = u32> + 'a {
        self.parameters.iter().zip(values).filter_map(|((name, _), value)| match value {
            Value::Number(number) if is_pin(name) => Some(*number),
            _ => None,
        })
    }

    fn argument(&self, values: &[Value], name: &str) -> Option<u32> {
        let place = self.parameters.iter().position(|(parameter, _)| parameter == name)?;
        match values[place] {
            Value::Number(number) => Some(number),
            _ => None,
        }
    }
}

fn is_pin(parameter: &str) -> bool {
    parameter == "pin" || parameter.ends_with("_pin")
}

/// A command with its arguments.
type Call = (usize, Vec<Value>);

/// The commands of a dialect.
struct Book {
    name: DialectName,
    dialect: Arc<Dialect>,
    forms: Vec<Form>,
    /// The commands of a whole configuration.
    setup: Vec<Call>,
    /// Arguments that each command accepts during configuration (`before`) and after it (`after`).
    before: Vec<Vec<Vec<Value>>>,
    after: Vec<Vec<Vec<Value>>>,
    /// The parameters of each response, by its id.
    responses: HashMap<u32, Vec<Conversion>>,
    /// Pairs of a command and an oid whose object has another kind.
    wrong: HashSet<(usize, u32)>,
}

/// In the order of [`DialectName::OF_HOSTS`].
static BOOKS: [OnceLock<Book>; DialectName::OF_HOSTS.len()] = [const { OnceLock::new() }; DialectName::OF_HOSTS.len()];

fn book(which: usize) -> &'static Book {
    let which = which % BOOKS.len();
    BOOKS[which].get_or_init(|| Book::of(DialectName::OF_HOSTS[which]))
}

/// The commands that were accepted with no arguments that were tried, with their dialects. The trials do not test
/// them.
pub fn commands_without_arguments() -> Vec<String> {
    let books = (0..BOOKS.len()).map(book);
    books.flat_map(|book| book.without_arguments().map(|form| format!("{}: {}", book.name, form.format))).collect()
}

impl Book {
    fn of(name: DialectName) -> Book {
        // To compress a dictionary takes milliseconds: it is done once.
        let dialect = Rig::of(name).mcu.dialect().clone();
        let rig = bench(&dialect);
        let forms = rig.dictionary().commands.iter().map(|(format, id)| Form {
            format: format.clone(),
            id: id.as_i64().unwrap() as u32,
            parameters: format::parameters(format).unwrap().into_iter().map(|(name, c)| (name.to_owned(), c)).collect(),
        });
        let forms: Vec<Form> = forms.collect();
        let none = || vec![Vec::new(); forms.len()];
        let (before, after, wrong) = (none(), none(), HashSet::new());
        let conversions = |format: &str| format::parameters(format).unwrap().into_iter().map(|(_, c)| c).collect();
        let responses = rig.dictionary().responses.iter();
        let responses = responses.map(|(format, id)| (id.as_i64().unwrap() as u32, conversions(format))).collect();
        let mut book = Book { name, dialect, before, after, responses, wrong, setup: Vec::new(), forms };
        let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
        book.find_setup(&mut dice);
        book.find_calls(&mut dice);
        book
    }

    fn without_arguments(&self) -> impl Iterator<Item = &Form> {
        let tried = self.forms.iter().zip(self.before.iter().zip(&self.after));
        let unknown =
            tried.filter(|(form, (before, after))| before.is_empty() && (form.configures() || after.is_empty()));
        unknown.map(|(form, _)| form).filter(|form| !STOPS.contains(&form.name()))
    }

    /// The oids of objects that commands with `word` in their names configure; all oids if there are none.
    fn oids(&self, word: &str) -> Vec<u32> {
        let oid = |(form, values): &Call| self.forms[*form].argument(values, "oid");
        let named = |(form, _): &&Call| self.forms[*form].name().contains(word);
        let objects = || self.setup.iter().filter(|(form, _)| self.forms[*form].configures());
        let oids: Vec<u32> = objects().filter(named).filter_map(oid).collect();
        if oids.is_empty() { objects().filter_map(oid).collect() } else { oids }
    }

    fn guess(&self, dice: &mut Dice, which: usize, new_oid: u32) -> Vec<Value> {
        let form = &self.forms[which];
        let guess = |(name, conversion): &(String, Conversion)| match (name.as_str(), conversion) {
            ("serial", _) => Value::Bytes(SERIAL.into()),
            (_, Conversion::Bytes) => Value::Bytes((0..dice.below(8)).map(|_| dice.roll() as u8).collect()),
            ("oid", _) if form.configures() => Value::Number(new_oid),
            ("oid", _) => {
                let mut oids = self.oids("config_");
                oids.retain(|oid| !self.wrong.contains(&(which, *oid)));
                Value::Number(if oids.is_empty() { new_oid } else { dice.of(&oids) })
            }
            (name, _) if name.ends_with("_oid") => Value::Number(dice.of(&self.oids(name.trim_end_matches("_oid")))),
            (name, _) if is_pin(name) && dice.below(2) == 0 => Value::Number(dice.roll() % GPIOS),
            (name, _) if is_pin(name) => Value::Number(dice.of(PINS)),
            // Without a button, no button can be added.
            ("button_count", _) => Value::Number(1 + dice.roll() % 8),
            ("pos", _) => Value::Number(dice.roll() % 2),
            (name, _) if name.ends_with("clock") => Value::Soon(dice.roll() % 100_000),
            _ => Value::Number(match dice.below(4) {
                0 | 1 => dice.roll() % 5,
                2 => dice.roll() % 100_000,
                _ => dice.of(EXTREMES),
            }),
        };
        form.parameters.iter().map(guess).collect()
    }

    /// Tries a command with random arguments, until it accepts them or has refused `tries` times.
    fn find(
        &mut self,
        dice: &mut Dice,
        rig: &mut Rig,
        form: usize,
        new_oid: u32,
        mut tries: u32,
    ) -> Option<Vec<Value>> {
        while tries > 0 {
            let values = self.guess(dice, form, new_oid);
            let refused = try_out(rig, &self.forms[form], &values);
            let Some(refused) = refused else { return Some(values) };
            tries -= 1;
            // An oid of another kind is not tried again, and the attempt does not count.
            if let (Some(oid), true) = (self.forms[form].argument(&values, "oid"), refused.contains("Invalid oid type"))
            {
                tries += u32::from(self.wrong.insert((form, oid)));
            }
        }
        None
    }

    /// Tries every command during the configuration of an MCU.
    fn find_setup(&mut self, dice: &mut Dice) {
        let mut rig = bench(&self.dialect);
        rig.send(&format!("allocate_oids count={OIDS}"));
        let mut new_oid = 0;
        // Sensors need their buses, so they succeed in the second round.
        for _ in 0..OBJECTS_OF_A_KIND {
            for form in 0..self.forms.len() {
                if STOPS.contains(&self.forms[form].name()) {
                    continue;
                }
                let configures = self.forms[form].configures();
                let tries = if configures { 300 } else { 30 };
                let Some(values) = self.find(dice, &mut rig, form, new_oid, tries) else { continue };
                if configures {
                    new_oid += 1;
                    self.setup.push((form, values.clone()));
                }
                self.before[form].push(values);
            }
        }
    }

    /// Tries every command on a configured MCU. Commands that belong to its configuration are added to `setup`.
    fn find_calls(&mut self, dice: &mut Dice) {
        const WANTED: usize = 4;
        for (with_buses, tries) in [(false, 30), (true, 100)] {
            self.wrong.clear();
            let mut rig = bench(&self.dialect);
            self.set_up(&mut rig);
            for form in 0..self.forms.len() {
                if STOPS.contains(&self.forms[form].name()) || self.forms[form].configures() {
                    continue;
                }
                while self.after[form].len() < WANTED
                    && let Some(values) = self.find(dice, &mut rig, form, 0, tries)
                {
                    self.after[form].push(values);
                }
            }
            if !with_buses {
                let mut calls: Vec<Call> = Vec::new();
                for (form, values) in self.before.iter().enumerate() {
                    if self.after[form].is_empty() && !self.forms[form].configures() {
                        calls.extend(values.iter().map(|values| (form, values.clone())));
                    }
                }
                // Buses on GPIO lines come first, because no I2C chip answers there.
                calls.sort_by_key(|(form, values)| self.forms[*form].pins(values).next().is_none());
                self.setup.extend(calls);
            }
        }
    }

    /// Configures an MCU, as far as it accepts the commands.
    fn set_up(&self, rig: &mut Rig) {
        rig.send(&format!("allocate_oids count={OIDS}"));
        for (form, values) in &self.setup {
            try_out(rig, &self.forms[*form], values);
        }
        rig.send("finalize_config crc=7");
        assert_eq!(rig.ask("get_config"), CONFIGURED);
    }
}

/// An MCU with devices that answer.
fn bench(dialect: &Arc<Dialect>) -> Rig {
    let rig = Rig::with_dialect(dialect.clone());
    for (bus, address) in (0..2).flat_map(|bus| (0..128).map(move |address| (bus, address))) {
        let mut count = address;
        rig.bench.plug_i2c(bus, address, move |_, _, read| {
            read.iter_mut().for_each(|byte| {
                count = count.wrapping_mul(5).wrapping_add(77);
                *byte = count;
            });
            Ok(())
        });
    }
    for channel in 0..3 {
        rig.bench.script_adc(ANALOG + channel, &[1000, 2000, 60_000, 0, 7]);
    }
    for pin in PINS {
        let low = LOW * u64::from(pin % 13 + 1);
        let changes: Vec<_> = (0..50).flat_map(|n| [(n * 100 * low, 0), ((n * 100 + 1) * low, 1)]).collect();
        rig.bench.script_input(*pin, &changes);
    }
    for pin in (0..GPIOS).filter(|pin| !PINS.contains(pin)) {
        rig.bench.script_input(pin, &[(0, 1)]);
    }
    rig.bench.script_ds18b20("28", &[Some(20_000), Some(-5000), Some(85_000)]);
    rig.bench.state().sleeping.extend(EXPANDED..EXPANDED + EXPANDED_LINES);
    rig
}

/// Shortest turn of the MCU: events that come faster make it late.
const TURN: Ticks = Ticks::from_us(20);

/// Lets the MCU run while `goes_on` is true. Returns how often it allocated or freed memory.
fn pass(rig: &mut Rig, mut goes_on: impl FnMut(&Rig) -> bool) -> u64 {
    let mut allocations = 0;
    while goes_on(rig) {
        let now = rig.mcu.now();
        let mut next = None;
        allocations += memory::allocations(|| next = rig.turn());
        if goes_on(rig) {
            rig.jump(next.map_or(now + TURN, |next| next.max(now + TURN)));
        }
    }
    allocations
}

/// Lets the MCU run up to `ticks`, or for `turns` turns.
fn pass_until(rig: &mut Rig, ticks: u64, turns: u32) -> u64 {
    let mut left = 2 * turns;
    pass(rig, |rig| {
        left = left.saturating_sub(1);
        left > 0 && rig.now() < ticks
    })
}

/// Runs a command to the end of its job. Returns how often the MCU allocated or freed memory.
fn run(rig: &mut Rig, payload: &[u8]) -> u64 {
    let (mut reader, mut allocations) = (Reader::new(payload), 0);
    while !reader.is_empty() {
        allocations += memory::allocations(|| rig.mcu.execute(&mut reader));
        // Commands wait for a bus for at most five seconds.
        let limit = rig.now() + 6 * u64::from(CLOCK_FREQ);
        allocations += pass(rig, |rig| {
            assert!(rig.now() < limit, "commands are held for too long");
            rig.mcu.is_held()
        });
    }
    allocations
}

/// The same for a command as text.
fn say(rig: &mut Rig, command: &str) {
    let payload = rig.encode(command);
    run(rig, &payload);
}

/// The shutdown text if the command stops the MCU, else `None`. It ends all activity that the command began.
fn try_out(rig: &mut Rig, form: &Form, values: &[Value]) -> Option<String> {
    let payload = form.encode(rig, values);
    run(rig, &payload);
    let end = rig.now() + 100_000;
    pass_until(rig, end, if rig.mcu.is_shutdown() { 0 } else { 20 });
    let refused = rig.mcu.is_shutdown().then(|| rig.shutdown().unwrap_or_default());
    if refused.is_none() {
        say(rig, "emergency_stop");
    }
    settle(rig);
    say(rig, "clear_shutdown");
    rig.forget_responses();
    rig.notes();
    rig.bench.forget();
    refused
}

/// Waits until the outputs are at their shutdown values.
fn settle(rig: &mut Rig) {
    let limit = rig.now() + u64::from(CLOCK_FREQ);
    pass(rig, |rig| {
        assert!(rig.now() < limit, "{:?} is not at its shutdown value", rig.mcu.pending_value());
        rig.mcu.has_pending_values()
    });
}

/// An action and what belongs to it.
#[derive(Clone, Debug)]
enum Action {
    /// A command: its index, the index of arguments that it accepts, and the changes to them.
    Send(usize, usize, Vec<Option<Change>>),
    Turns(u32),
    Stall(u64),
    Stop,
    /// A pin or the chips of a bus fail until everything is repaired.
    Break(u32),
    Mend,
}

#[derive(Clone, Debug)]
enum Change {
    Extreme(u32),
    Small(u32),
    Any(u32),
    Pin(u32),
    Bytes(u8, usize),
}

/// The next step after the MCU has stopped.
#[derive(Clone, Copy, Debug)]
enum Recovery {
    Nothing,
    Clear,
    /// A reset; the next commands configure the MCU.
    Reset,
    Configure,
}

/// Bytes that choose what happens. When they are used up, they are zeros.
struct Choices<'a>(&'a [u8]);

impl Choices<'_> {
    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.byte())
    }

    fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    fn below(&mut self, end: u8) -> u8 {
        self.byte() % end
    }

    fn half(&mut self) -> u16 {
        u16::from_le_bytes(self.bytes())
    }

    fn word(&mut self) -> u32 {
        u32::from_le_bytes(self.bytes())
    }

    fn of<T: Copy>(&mut self, values: &[T]) -> T {
        values[usize::from(self.byte()) % values.len()]
    }

    fn action(&mut self) -> Action {
        match self.below(30) {
            0..20 => {
                let (which, call, count) = (self.half(), self.byte(), PARAMETERS_MAX);
                Action::Send(which.into(), call.into(), (0..count).map(|_| self.change()).collect())
            }
            20..26 => Action::Turns(1 + u32::from(self.below(39))),
            26 => Action::Stall(u64::from(self.word()) % 10_000_000),
            27 => Action::Stop,
            28 => Action::Break(self.of(PINS)),
            _ => Action::Mend,
        }
    }

    fn change(&mut self) -> Option<Change> {
        if self.below(6) != 1 {
            return None;
        }
        Some(match self.below(11) {
            0..4 => Change::Extreme(self.of(EXTREMES)),
            4..7 => Change::Small(self.below(10).into()),
            7 => Change::Any(self.word()),
            8 => Change::Pin(self.of(PINS)),
            _ => Change::Bytes(self.byte(), usize::from(self.byte()) % (PAYLOAD_MAX + 1)),
        })
    }

    fn recovery(&mut self) -> Recovery {
        match self.below(12) {
            0 | 1 => Recovery::Nothing,
            2..8 => Recovery::Clear,
            8 => Recovery::Reset,
            _ => Recovery::Configure,
        }
    }
}

/// Counts of events in trials.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Commands that were sent to a running MCU.
    pub sent: u64,
    /// How many of them the MCU accepted.
    pub accepted: u64,
    /// How often an output of a stopped MCU was checked.
    pub outputs: u64,
    /// Actions of a configured MCU in which no allocation was allowed.
    pub frugal: u64,
}

impl AddAssign for Tally {
    fn add_assign(&mut self, other: Tally) {
        self.sent += other.sent;
        self.accepted += other.accepted;
        self.outputs += other.outputs;
        self.frugal += other.frugal;
    }
}

/// Lets a host and a board do what `bytes` choose.
///
/// # Panics
///
/// Something does not hold. The commands of the last configuration are printed.
pub fn play(bytes: &[u8]) -> Tally {
    let mut choices = Choices(bytes);
    let book = book(choices.byte().into());
    let mut trial = Trial::new(book, u32::from(choices.half()) % 50_000);
    for _ in 0..ACTIONS_MAX {
        if choices.0.is_empty() {
            break;
        }
        if trial.rig.mcu.is_shutdown() {
            trial.recover(choices.recovery());
        }
        trial.act(&choices.action());
        trial.look();
    }
    // All objects would take longer than all before. Many trials configure them again, after a stop.
    trial.reset();
    trial.rig.send(&format!("allocate_oids count={OIDS}"));
    trial.finalize();
    trial.tally
}

/// An MCU under test, and the known facts about its outputs.
struct Trial<'a> {
    book: &'a Book,
    rig: Rig,
    finalized: bool,
    /// How often each pin was in an argument.
    named: HashMap<u32, u32>,
    /// Digital outputs with their levels in a stopped MCU.
    outputs: HashMap<u32, bool>,
    /// Step lines of steppers. They do not change in a stopped MCU.
    step_pins: HashSet<u32>,
    /// Whether the MCU was stopped after the last action, with its outputs at their shutdown values.
    stopped: bool,
    /// The commands since the last configuration, to print if the trial fails.
    story: Vec<String>,
    /// How often the MCU allocated or freed memory in the present action.
    allocated: u64,
    /// How many calls of devices had failed after the last action.
    failed: u64,
    tally: Tally,
    snapshot: Snapshot,
}

impl Drop for Trial<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}, after a configuration:\n{}", self.book.name, self.story.join("\n"));
        }
    }
}

impl<'a> Trial<'a> {
    fn new(book: &'a Book, answer_ticks: u32) -> Trial<'a> {
        let rig = bench(&book.dialect);
        rig.bench.state().answer_ticks = answer_ticks;
        let (named, outputs, step_pins) = (HashMap::new(), HashMap::new(), HashSet::new());
        let (story, tally) = (Vec::new(), Tally::default());
        let (finalized, stopped, allocated, failed, snapshot) = (false, false, 0, 0, Snapshot::default());
        let mut trial = Trial {
            book,
            rig,
            finalized,
            named,
            outputs,
            step_pins,
            stopped,
            story,
            allocated,
            failed,
            tally,
            snapshot,
        };
        trial.configure();
        trial
    }

    fn configure(&mut self) {
        self.rig.send(&format!("allocate_oids count={OIDS}"));
        for (form, values) in &self.book.setup {
            self.send(*form, values);
            if self.rig.mcu.is_shutdown() {
                settle(&mut self.rig);
                say(&mut self.rig, "clear_shutdown");
            }
        }
        self.finalize();
        self.story.clear();
    }

    fn finalize(&mut self) {
        say(&mut self.rig, "finalize_config crc=7");
        self.finalized = true;
        self.rig.forget_responses();
        assert_eq!(self.rig.ask("get_config"), CONFIGURED);
    }

    /// Repairs all pins. Failing outputs prevent a reset of the MCU until the guardian ends the program.
    fn mend(&mut self) {
        self.rig.bench.state().broken.clear();
    }

    /// Makes the MCU forget everything.
    fn reset(&mut self) {
        self.mend();
        let now = self.rig.now();
        say(&mut self.rig, "emergency_stop");
        let pending = self.rig.mcu.pending_value().map(str::to_owned);
        say(&mut self.rig, "config_reset");
        let took = self.rig.now() - now;
        assert!(took < u64::from(CLOCK_FREQ), "a reset takes {took} ticks, for {pending:?}");
        self.named.clear();
        self.outputs.clear();
        self.step_pins.clear();
        self.finalized = false;
        self.rig.forget_responses();
        assert!(self.rig.ask("get_config").starts_with("config is_config=0 crc=0 is_shutdown=0 "));
    }

    /// Sends a command. Returns whether a running MCU accepted it; `None` for a stopped MCU.
    fn send(&mut self, form: usize, values: &[Value]) -> Option<bool> {
        let form = &self.book.forms[form];
        self.story.push(format!("@{}: {} {values:?}", self.rig.now(), form.format));
        let was_stopped = self.rig.mcu.is_shutdown();
        if form.name() == "config_reset" {
            self.mend();
        }
        let payload = form.encode(&self.rig, values);
        if !was_stopped {
            form.pins(values).for_each(|pin| *self.named.entry(pin).or_default() += 1);
        }
        self.allocated += run(&mut self.rig, &payload);
        if was_stopped {
            self.forget_if_reset(form);
            return None;
        }
        if self.rig.mcu.is_shutdown() {
            return Some(false);
        }
        match form.name() {
            "config_digital_out" => {
                let default = form.argument(values, "default_value").unwrap() != 0;
                self.outputs.extend(form.argument(values, "pin").map(|pin| (pin, default)));
            }
            "config_stepper" => self.step_pins.extend(form.argument(values, "step_pin")),
            "finalize_config" => self.finalized = true,
            _ => {}
        }
        Some(true)
    }

    fn forget_if_reset(&mut self, form: &Form) {
        if form.name() == "config_reset" {
            self.named.clear();
            self.outputs.clear();
            self.step_pins.clear();
            self.finalized = false;
        }
    }

    fn recover(&mut self, recovery: Recovery) {
        match recovery {
            Recovery::Nothing => return,
            Recovery::Clear => say(&mut self.rig, "clear_shutdown"),
            Recovery::Reset => {
                self.reset();
                self.rig.send(&format!("allocate_oids count={OIDS}"));
            }
            Recovery::Configure => {
                self.reset();
                self.configure();
            }
        }
        self.stopped = false;
        self.story.push(format!("@{}: {recovery:?}", self.rig.now()));
    }

    fn act(&mut self, action: &Action) {
        // Failures and stops are explained in words, which take memory. `buttons_add` claims a pin.
        let is_sound =
            |rig: &Rig| rig.mcu.is_running() && !rig.mcu.has_pending_values() && rig.bench.state().broken.is_empty();
        let mut is_frugal = is_sound(&self.rig);
        self.allocated = 0;
        if !matches!(action, Action::Send(..)) {
            self.story.push(format!("@{}: {action:?}", self.rig.now()));
        }
        match action {
            Action::Send(which, call, changes) => {
                let calls = if self.finalized { &self.book.after } else { &self.book.before };
                // Seven times out of eight, a command that is accepted now.
                let known: Vec<usize> = (0..calls.len()).filter(|form| !calls[*form].is_empty()).collect();
                let form = if call % 8 == 0 { which % calls.len() } else { known[which % known.len()] };
                let calls = if calls[form].is_empty() { &self.book.before[form] } else { &calls[form] };
                let values = match calls.len() {
                    0 => self.book.guess(&mut Dice(*call as u64), form, *call as u32 % 4),
                    len => calls[call % len].clone(),
                };
                let values: Vec<Value> = values.into_iter().zip(changes).map(changed).collect();
                is_frugal &= self.book.forms[form].name() != "buttons_add";
                if let Some(accepted) = self.send(form, &values) {
                    self.tally.sent += 1;
                    self.tally.accepted += u64::from(accepted);
                }
            }
            Action::Turns(turns) => self.allocated += pass_until(&mut self.rig, u64::MAX, *turns),
            Action::Stall(ticks) => self.rig.stall_until(self.rig.now() + ticks),
            Action::Stop => say(&mut self.rig, "emergency_stop"),
            Action::Break(pin) => drop(self.rig.bench.state().broken.insert(*pin)),
            Action::Mend => self.mend(),
        }
        let failures = self.failures();
        if is_frugal && is_sound(&self.rig) && failures == self.failed && self.rig.notes().is_empty() {
            assert_eq!(self.allocated, 0, "a configured MCU allocates");
            self.tally.frugal += 1;
        }
        self.failed = failures;
    }

    /// How many calls of its devices have failed.
    fn failures(&mut self) -> u64 {
        self.snapshot.clear();
        while !self.rig.mcu.fill(&mut self.snapshot) {}
        let Snapshot { lines, objects, .. } = &self.snapshot;
        let buses = lines.iter().filter_map(|line| line.bus).chain(objects.iter().filter_map(|object| object.bus));
        buses.map(|bus| u64::from(bus.errors)).sum()
    }

    /// Checks the outputs of a stopped MCU.
    fn look(&mut self) {
        let stopped = self.rig.mcu.is_shutdown();
        let broken = !self.rig.bench.state().broken.is_empty();
        if stopped && !broken {
            if !self.stopped {
                settle(&mut self.rig);
                self.rig.bench.forget();
            }
            // The last user of a shared line decides its level, so only lines with one user are checked.
            let alone = |pin: &u32| self.named.get(pin) == Some(&1);
            for (pin, default) in self.outputs.iter().filter(|(pin, _)| alone(pin)) {
                assert_eq!(self.rig.bench.level(*pin), *default, "pin {pin} of a stopped MCU");
                self.tally.outputs += 1;
            }
            for pin in self.step_pins.iter().filter(|pin| alone(pin)) {
                assert_eq!(self.rig.edges(*pin), [], "stepper pin {pin} of a stopped MCU");
            }
        }
        self.stopped = stopped && !broken;
        // Every response has the form of the dictionary.
        self.rig.each_response(|payload| {
            let mut reader = Reader::new(payload);
            let conversions = &self.book.responses[&reader.int().unwrap()];
            assert!(conversions.iter().all(|conversion| conversion.skip(&mut reader).is_ok()) && reader.is_empty());
        });
        self.rig.notes();
        self.rig.bench.forget();
        assert!(self.rig.jobs() <= JOBS_MAX, "{} jobs are under way", self.rig.jobs());
        let (moves, moves_max) = self.snapshot.moves;
        assert!(moves <= moves_max, "{moves} of {moves_max} moves are queued");
    }
}

fn changed((value, change): (Value, &Option<Change>)) -> Value {
    match (value, change) {
        (value, None) => value,
        (Value::Bytes(_), Some(Change::Bytes(byte, len))) => Value::Bytes(vec![*byte; *len]),
        (Value::Bytes(bytes), _) => Value::Bytes(bytes),
        (Value::Soon(_), Some(Change::Extreme(value))) => Value::Soon(*value),
        (Value::Soon(soon), Some(Change::Small(n))) => Value::Soon(soon * n),
        (_, Some(Change::Extreme(n) | Change::Small(n) | Change::Any(n) | Change::Pin(n))) => Value::Number(*n),
        (value, Some(Change::Bytes(..))) => value,
    }
}
