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

use pinion_firmware::mcu::Snapshot;
use pinion_firmware::time::CLOCK_FREQ;
use pinion_protocol::vlq::Reader;

use crate::dice::Dice;
use crate::rig::Rig;

mod bench;
mod book;
mod choices;
mod form;

use bench::{bench, pass_until, run, say, settle};
pub use book::commands_without_arguments;
use book::{Book, CONFIGURED, OIDS, book};
use choices::{Action, Change, Choices, Recovery};
use form::{Form, Value};

/// Highest number of jobs on their way. No object has more than 32 boxes for them, except PCA9685, which has one for
/// each output.
const JOBS_MAX: usize = 1024;
/// Highest number of actions in a trial.
const ACTIONS_MAX: u32 = 120;

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
