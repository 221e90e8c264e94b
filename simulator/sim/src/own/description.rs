// SPDX-License-Identifier: GPL-3.0-or-later
//! A description while it is made.

use std::collections::{BTreeMap, HashSet};

use toml::{Table, Value};

/// A table of the description.
#[derive(Default)]
pub(super) struct Entry(pub(super) Table);

impl Entry {
    /// A part of this kind.
    pub(super) fn of_kind(kind: &str) -> Entry {
        Entry::default().set("kind", kind)
    }

    pub(super) fn set(mut self, key: &str, value: impl Into<Value>) -> Entry {
        self.0.insert(key.to_owned(), value.into());
        self
    }

    pub(super) fn set_if(self, key: &str, value: Option<impl Into<Value>>) -> Entry {
        match value {
            Some(value) => self.set(key, value),
            None => self,
        }
    }

    /// A list of numbers.
    pub(super) fn numbers(self, key: &str, numbers: impl IntoIterator<Item = f64>) -> Entry {
        self.set(key, list(numbers))
    }

    /// A list of lists of numbers.
    pub(super) fn rows<const N: usize>(self, key: &str, rows: impl IntoIterator<Item = [f64; N]>) -> Entry {
        self.set(key, rows.into_iter().map(list).collect::<Vec<Value>>())
    }
}

fn list(numbers: impl IntoIterator<Item = f64>) -> Value {
    numbers.into_iter().map(Value::from).collect::<Vec<Value>>().into()
}

/// The tables of a description, and the names that they have.
#[derive(Default)]
pub(super) struct Description {
    root: Table,
    names: HashSet<(String, String)>,
    /// By their data lines, or by their names.
    buses: BTreeMap<String, String>,
    /// The addresses on I2C buses that have a chip.
    chips: HashSet<(String, i64)>,
    /// The motors that have a driver.
    driven: HashSet<String>,
}

impl Description {
    /// Adds a `[[kind]]`.
    pub(super) fn add(&mut self, kind: &str, entry: Entry) {
        let tables = self.root.entry(kind).or_insert_with(|| Value::Array(Vec::new()));
        if let Value::Array(tables) = tables {
            tables.push(entry.0.into());
        }
    }

    /// Sets a `[kind]`.
    pub(super) fn set(&mut self, kind: &str, entry: Entry) {
        self.root.insert(kind.to_owned(), entry.0.into());
    }

    /// A name that no other entry of this kind has.
    pub(super) fn name(&mut self, kind: &str, wanted: &str) -> String {
        let plain = |c: char| if c.is_ascii_alphanumeric() || "_-.".contains(c) { c } else { '_' };
        let wanted: String = wanted.chars().map(plain).collect();
        let mut names = std::iter::once(wanted.clone()).chain((2..).map(|n| format!("{wanted}-{n}")));
        let free = names.find(|name| !name.is_empty() && self.names.insert((kind.to_owned(), name.clone())));
        free.unwrap_or(wanted)
    }

    /// The bus with this key; `make` describes it if it is new.
    pub(super) fn bus(&mut self, kind: &str, key: &str, make: impl FnOnce() -> Entry) -> String {
        if let Some(name) = self.buses.get(&format!("{kind} {key}")) {
            return name.clone();
        }
        let entry = make();
        let name = entry.0.get("name").and_then(Value::as_str).unwrap_or(key).to_owned();
        self.buses.insert(format!("{kind} {key}"), name.clone());
        self.add(kind, entry);
        name
    }

    /// Whether no other section has the chip at this address. Two may read one chip.
    pub(super) fn is_new_chip(&mut self, bus: &str, address: i64) -> bool {
        self.chips.insert((bus.to_owned(), address))
    }

    /// Whether no other section has the driver of this motor.
    pub(super) fn is_new_driver(&mut self, axis: &str) -> bool {
        self.driven.insert(axis.to_owned())
    }

    pub(super) fn into_table(self) -> Table {
        self.root
    }
}
