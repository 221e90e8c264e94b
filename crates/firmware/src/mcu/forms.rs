// SPDX-License-Identifier: GPL-3.0-or-later
//! The choice of the forms that a dictionary has: one for each name.
//!
//! A host gets the form that it looks up. If it looks up several forms of a name, it gets the newest of them. If it
//! looks up none, it gets the newest of all: its sources may not say everything.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::mem::{Discriminant, discriminant};

use pinion_protocol::format;

use super::{Command, Constant, DialectName, Enumeration, Feature, Form};

/// The hosts that use an entry of the dictionary.
#[derive(Clone, Copy)]
pub struct Hosts {
    dialects: &'static [DialectName],
    with: Option<&'static str>,
    unless: Option<&'static str>,
}

impl Hosts {
    /// Every host.
    pub const ALL: Hosts = Hosts { dialects: &DialectName::OF_HOSTS, with: None, unless: None };

    /// The hosts that look it up, and the hosts of these dialects.
    pub const fn of(dialects: &'static [DialectName]) -> Hosts {
        Hosts { dialects, with: None, unless: None }
    }

    /// Also the hosts that look up this format. They name no parameters of this entry.
    pub const fn with(self, format: &'static str) -> Hosts {
        Hosts { with: Some(format), ..self }
    }

    /// Not the hosts that look up this format. They prefer the older message if it exists.
    pub const fn unless(self, format: &'static str) -> Hosts {
        Hosts { unless: Some(format), ..self }
    }
}

/// A part of the dictionary.
#[derive(Clone, Copy)]
pub enum Item {
    /// A message to the host.
    Response(&'static Form),
    /// A command that the host may send.
    Command(&'static Command),
    /// A constant.
    Constant(&'static Constant),
    /// An enumeration.
    Enumeration(&'static Enumeration),
}

/// An entry of the dictionary: a form of a message, a constant or an enumeration.
pub struct Entry {
    /// Its kind.
    pub item: Item,
    /// Its name.
    pub name: &'static str,
    /// The format of a message, or the name.
    pub text: &'static str,
    /// The feature that has it, by its place in the list.
    pub feature: usize,
    hosts: Hosts,
}

impl Entry {
    fn new(item: Item, feature: usize) -> Entry {
        let (text, hosts) = match item {
            Item::Response(form) => (form.format, form.hosts),
            Item::Command(command) => (command.format, command.hosts),
            Item::Constant(constant) => (constant.name, constant.hosts),
            Item::Enumeration(enumeration) => (enumeration.name, enumeration.hosts),
        };
        Entry { item, name: format::name(text), text, feature, hosts }
    }

    /// Whether it is a command or a response.
    pub fn is_message(&self) -> bool {
        matches!(self.item, Item::Response(_) | Item::Command(_))
    }

    /// The key of the entry. A dictionary has each key once.
    fn key(&self) -> (Discriminant<Item>, &'static str) {
        (discriminant(&self.item), self.name)
    }

    /// The format of the message that replaces this one, if any.
    pub fn replaced_by(&self) -> Option<&'static str> {
        self.hosts.unless
    }
}

/// All entries of the features, in the features' order. Older forms of a name come before newer ones.
pub fn entries(features: &'static [Feature]) -> Vec<Entry> {
    let of_feature = |(place, feature): (usize, &'static Feature)| {
        let responses = feature.responses.iter().map(Item::Response);
        let messages = responses.chain(feature.commands.iter().map(Item::Command));
        let names = feature.constants.iter().map(Item::Constant);
        let names = names.chain(feature.enumerations.iter().map(Item::Enumeration));
        messages.chain(names).map(move |item| Entry::new(item, place))
    };
    features.iter().enumerate().flat_map(of_feature).collect()
}

/// The forms that a host looks up, by their places in the list of all [`entries`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HostForms(BTreeSet<u16>);

impl HostForms {
    /// The entries that a host looks up.
    pub fn new(entries: &[Entry], looks_up: impl Fn(&Entry) -> bool) -> HostForms {
        (0..).zip(entries).filter(|(_, entry)| looks_up(entry)).map(|(place, _)| place).collect()
    }

    /// Their places.
    pub fn places(&self) -> impl Iterator<Item = u16> {
        self.0.iter().copied()
    }
}

impl FromIterator<u16> for HostForms {
    fn from_iter<T: IntoIterator<Item = u16>>(places: T) -> HostForms {
        HostForms(places.into_iter().collect())
    }
}

/// Decides which forms a dictionary has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Forms {
    /// The forms of a dialect, for a host whose sources cannot be read.
    Dialect(DialectName),
    /// The forms that a host looks up.
    Host(HostForms),
}

impl From<DialectName> for Forms {
    fn from(name: DialectName) -> Forms {
        Forms::Dialect(name)
    }
}

impl Forms {
    /// The name of the dialect, or `host`: the host's own forms.
    pub fn label(&self) -> &'static str {
        match self {
            Forms::Dialect(name) => name.name(),
            Forms::Host(_) => "host",
        }
    }

    /// The part of each entry, in the order of the entries. Of each name and kind, one entry is not [`Part::Left`] at
    /// most.
    pub fn parts(&self, entries: &[Entry]) -> Vec<Part> {
        match self {
            Forms::Dialect(name) => of_dialect(*name, entries),
            Forms::Host(forms) => of_host(forms, entries),
        }
    }
}

/// An entry's part in a dictionary.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The dictionary does not have it.
    Left,
    /// The host looks it up, or all hosts have it.
    Needed,
    /// The host does not look up its name, and not every dialect has it. The dictionary has it if there is room.
    Spare,
}

fn of_dialect(name: DialectName, entries: &[Entry]) -> Vec<Part> {
    // Maps each name to the dialect whose form it gets.
    let mut chosen = HashMap::new();
    for part in name.parts() {
        for entry in entries.iter().filter(|entry| entry.hosts.dialects.contains(part)) {
            chosen.entry(entry.key()).or_insert(*part);
        }
    }
    let part = |entry: &Entry| match chosen.get(&entry.key()) {
        Some(dialect) if entry.hosts.dialects.contains(dialect) => Part::Needed,
        _ => Part::Left,
    };
    entries.iter().map(part).collect()
}

fn of_host(forms: &HostForms, entries: &[Entry]) -> Vec<Part> {
    let looked_up: HashSet<&str> =
        forms.0.iter().filter_map(|place| Some(entries.get(usize::from(*place))?.text)).collect();
    let is_replaced = |entry: &Entry| entry.hosts.unless.is_some_and(|format| looked_up.contains(format));
    // Of each name: whether the best entry is looked up, its place, and its part.
    let mut chosen: HashMap<_, (bool, usize, Part)> = HashMap::new();
    for (place, entry) in entries.iter().enumerate().filter(|(_, entry)| !is_replaced(entry)) {
        let is_looked_up =
            looked_up.contains(entry.text) || entry.hosts.with.is_some_and(|format| looked_up.contains(format));
        let is_everybodys = entry.hosts.dialects.len() == DialectName::OF_HOSTS.len();
        // A constant is a promise, so only hosts that know it get it.
        if !is_looked_up && !is_everybodys && !entry.is_message() {
            continue;
        }
        let part = if is_looked_up || is_everybodys { Part::Needed } else { Part::Spare };
        let best = chosen.entry(entry.key()).or_insert((is_looked_up, place, part));
        *best = (*best).max((is_looked_up, place, part));
    }
    let mut parts = vec![Part::Left; entries.len()];
    for (_, place, part) in chosen.into_values() {
        parts[place] = part;
    }
    parts
}
