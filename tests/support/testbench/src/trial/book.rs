// SPDX-License-Identifier: GPL-3.0-or-later
//! Arguments that each command of a dialect accepts, found by trying.

#![forbid(unsafe_code)]

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, OnceLock};

use pinion_firmware::mcu::{Dialect, DialectName};
use pinion_protocol::format::{self, Conversion};

use super::bench::{bench, try_out};
use super::form::{EXTREMES, Form, PINS, Value, is_pin};
use crate::board::GPIOS;
use crate::dice::Dice;
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
/// A thermometer on the bench.
const SERIAL: &[u8] = b"28";
/// Number of oids in a configuration.
pub(super) const OIDS: u8 = 100;
/// Number of objects for each command that creates one.
const OBJECTS_OF_A_KIND: usize = 2;
/// The answer of an MCU that is configured, and runs.
pub(super) const CONFIGURED: &str = "config is_config=1 crc=7 is_shutdown=0 move_count=1024";

/// A command with its arguments.
pub(super) type Call = (usize, Vec<Value>);

/// The commands of a dialect.
pub(super) struct Book {
    pub(super) name: DialectName,
    pub(super) dialect: Arc<Dialect>,
    pub(super) forms: Vec<Form>,
    /// The commands of a whole configuration.
    pub(super) setup: Vec<Call>,
    /// Arguments that each command accepts during configuration (`before`) and after it (`after`).
    pub(super) before: Vec<Vec<Vec<Value>>>,
    pub(super) after: Vec<Vec<Vec<Value>>>,
    /// The parameters of each response, by its id.
    pub(super) responses: HashMap<u32, Vec<Conversion>>,
    /// Pairs of a command and an oid whose object has another kind.
    pub(super) wrong: HashSet<(usize, u32)>,
}

/// In the order of [`DialectName::OF_HOSTS`].
static BOOKS: [OnceLock<Book>; DialectName::OF_HOSTS.len()] = [const { OnceLock::new() }; DialectName::OF_HOSTS.len()];

pub(super) fn book(which: usize) -> &'static Book {
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

    pub(super) fn guess(&self, dice: &mut Dice, which: usize, new_oid: u32) -> Vec<Value> {
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
