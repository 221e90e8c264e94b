// SPDX-License-Identifier: GPL-3.0-or-later
//! Hosts of each month since November 2022, with the entries of their own linux firmware.
//!
//! `tests/dictionaries/months.json` has them, and `scripts/add-month` adds a host. An entry is a kind and a format or a
//! name, such as `command get_clock` or `constant MCU=linux`.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use pinion_firmware::mcu::{Dialect, Entry, Forms, Item};
use pinion_protocol::format;
use serde_json::Value;

use crate::rig::Rig;

/// Hosts before this day know only ids of one byte.
const LONG_IDS: &str = "2024-06-10";

/// A host.
pub struct Host {
    /// `klipper` or `kalico`.
    pub repository: &'static str,
    /// Its date and its commit.
    pub name: String,
    /// The entries of its own firmware.
    pub entries: BTreeSet<String>,
}

/// All hosts.
pub fn hosts() -> Vec<Host> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dictionaries/months.json");
    let months: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
    ["klipper", "kalico"].into_iter().flat_map(|repository| hosts_of(repository, &months[repository])).collect()
}

fn hosts_of(repository: &'static str, months: &Value) -> Vec<Host> {
    let names = months["hosts"].as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned());
    let host = |name| Host { repository, name, entries: BTreeSet::new() };
    let mut hosts: Vec<Host> = names.map(host).collect();
    for (entry, ranges) in months["entries"].as_object().unwrap() {
        for range in ranges.as_str().unwrap().split(',') {
            let (first, last) = range.split_once('-').unwrap();
            let (first, last): (usize, usize) = (first.parse().unwrap(), last.parse().unwrap());
            hosts[first..=last].iter_mut().for_each(|host| {
                host.entries.insert(entry.clone());
            });
        }
    }
    hosts
}

impl Host {
    /// Whether its firmware has an entry. Of a constant only the name counts.
    pub fn has(&self, entry: &Entry) -> bool {
        let kind = match entry.item {
            Item::Command(_) => "command",
            Item::Response(_) => "response",
            Item::Constant(_) => "constant",
            Item::Enumeration(_) => "enumeration",
        };
        let written = format!("{kind} {}", entry.text);
        match kind {
            "constant" => self.entries.iter().any(|entry| entry.split('=').next() == Some(&written)),
            _ => self.entries.contains(&written),
        }
    }

    /// Asserts that an MCU of these forms has each entry of the host's firmware, no second form of a name, and ids that
    /// the host can read. Returns the constants and enumerations that the firmware does not have.
    pub fn check(&self, forms: Forms) -> Vec<String> {
        let Host { repository, name: host, entries } = self;
        let rig = Rig::of(forms);
        let served = entries_in(rig.dialect());
        let missing: Vec<&String> = entries.iter().filter(|entry| !served.contains(*entry)).collect();
        assert!(missing.is_empty(), "{repository} {host} does not get {missing:?}");
        let is_message = |entry: &str| entry.starts_with("command ") || entry.starts_with("response ");
        let name_of = |entry: &str| format::name(entry.split_once(' ').unwrap().1).to_owned();
        let messages = entries.iter().filter(|entry| is_message(entry));
        let names: BTreeSet<String> = messages.map(|entry| name_of(entry)).collect();
        let (extra, others): (Vec<String>, Vec<String>) =
            served.into_iter().filter(|entry| !entries.contains(entry)).partition(|entry| !is_message(entry));
        let second: Vec<&String> = others.iter().filter(|entry| names.contains(&name_of(entry))).collect();
        assert!(second.is_empty(), "{repository} {host} also gets {second:?}");
        let dictionary = rig.dictionary();
        let ids = || dictionary.commands.iter().chain(&dictionary.responses).map(|(format, id)| (format, id.as_i64()));
        if host.as_str() < LONG_IDS {
            let long: Vec<_> = ids().filter(|(_, id)| id.is_none_or(|id| !(-32..96).contains(&id))).collect();
            assert!(long.is_empty(), "{repository} {host}: {long:?}");
        }
        for name in ["queue_step", "set_next_step_dir", "trsync_set_timeout", "trsync_trigger", "trsync_state"] {
            let (_, id) = ids().find(|(format, _)| format::name(format) == name).unwrap();
            assert!(id >= Some(0), "{repository} {host}: klippy's C code reads the id of {name} as unsigned");
        }
        extra
    }
}

/// The entries of a dictionary, without those that only Pinion has and those of all programs.
fn entries_in(dialect: &Dialect) -> BTreeSet<String> {
    let dictionary = dialect.dictionary();
    let commands = dictionary.commands.keys().map(|format| format!("command {format}"));
    let responses = dictionary.responses.keys().map(|format| format!("response {format}"));
    let constants = dictionary.config.iter().map(|(name, value)| match value.as_str() {
        Some(text) => format!("constant {name}={text}"),
        None => format!("constant {name}={value}"),
    });
    let enumerations = dictionary.enumerations.keys().map(|name| format!("enumeration {name}"));
    let own = ["constant RECEIVE_WINDOW=2048", "enumeration static_string_id"];
    let all = commands.chain(responses).chain(constants).chain(enumerations);
    all.filter(|entry| !own.contains(&entry.as_str())).collect()
}
