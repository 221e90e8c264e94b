// SPDX-License-Identifier: GPL-3.0-or-later
//! The ids of all messages, and the dictionary that gives them to the host.

use std::collections::HashMap;
use std::io;

use serde_json::{Value, json};

use crate::board::{Board, Range};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_protocol::dictionary::{Dictionary, IDENTIFY_ID, IDENTIFY_RESPONSE_ID};
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::Reader;

use super::command::{Command, ConstantValue, Feature, Handler};
use super::{DialectName, Dialects, Wire, base, since};

/// The remedy for a host with another dictionary.
pub(super) const READ_ANEW: &str = "restart the host so that it reads the dictionary anew";

/// A command of the dialect, found by its id.
pub(super) struct Entry {
    pub(super) format: &'static str,
    pub(super) handler: Handler,
    pub(super) in_shutdown: bool,
    pub(super) joins: bool,
    /// Whether it is the MCU's own command, with the same id in every dialect.
    pub(super) is_own: bool,
    conversions: Box<[Conversion]>,
}

impl Entry {
    fn new(command: &Command, is_own: bool) -> io::Result<Entry> {
        let conversions = format::parameters(command.format)
            .ok_or_else(|| io::Error::other(format!("\"{}\" is no format", command.format)))?;
        Ok(Entry {
            format: command.format,
            handler: command.handler,
            in_shutdown: command.in_shutdown,
            joins: command.joins,
            is_own,
            conversions: conversions.into_iter().map(|(_, conversion)| conversion).collect(),
        })
    }

    /// Reads past the parameters without running the command.
    pub(super) fn skip(&self, reader: &mut Reader<'_>) -> Result<(), Shutdown> {
        for conversion in &self.conversions {
            conversion.skip(reader)?;
        }
        Ok(())
    }
}

/// The ids that take one byte on the wire (docs/Protocol.md, "Variable length quantities").
const SHORT_IDS: std::ops::Range<i32> = -32..96;

/// The ids in the order in which messages get them. Ids of one byte come first, after the two that every host knows.
fn ids() -> impl Iterator<Item = i32> {
    (IDENTIFY_ID + 1..SHORT_IDS.end).chain(SHORT_IDS.start..IDENTIFY_RESPONSE_ID).chain(SHORT_IDS.end..)
}

/// An id's place in the list of all ids.
fn place(id: u32) -> usize {
    (id as i32).wrapping_sub(SHORT_IDS.start) as u32 as usize
}

/// All features' entries of one kind.
fn all<'a, T>(
    features: &'a [Feature],
    of: fn(&'a Feature) -> &'static [T],
) -> impl Iterator<Item = &'static T> + Clone {
    features.iter().flat_map(of)
}

/// The forms of one kind that a dialect has.
struct Choice<T: 'static> {
    /// The name of a form, and the hosts that use it.
    facts: fn(&'static T) -> (&'static str, Dialects),
    /// Maps each name to the part of the dialect whose form it uses.
    chosen: HashMap<&'static str, DialectName>,
}

impl<T> Choice<T> {
    fn new(
        dialect: &DialectName,
        forms: impl Iterator<Item = &'static T> + Clone,
        facts: fn(&'static T) -> (&'static str, Dialects),
    ) -> Choice<T> {
        let mut chosen = HashMap::new();
        for part in dialect.parts() {
            for (name, _) in forms.clone().map(facts).filter(|(_, takers)| takers.contains(*part)) {
                chosen.entry(name).or_insert(*part);
            }
        }
        Choice { facts, chosen }
    }

    fn has(&self, form: &'static T) -> bool {
        let (name, takers) = (self.facts)(form);
        self.chosen.get(name).is_some_and(|part| takers.contains(*part))
    }
}

/// The features of an MCU, and the facts about the program in its dictionary.
pub struct Firmware {
    /// The features. The MCU's own feature comes first.
    pub features: &'static [Feature],
    /// The program's name.
    pub app: &'static str,
    /// The program's version.
    pub version: &'static str,
    /// The tools that built the program.
    pub build_versions: &'static str,
    /// The program's license.
    pub license: &'static str,
    /// The wire that its host is on.
    pub wire: Wire,
}

/// The messages that a host and the MCU may exchange, by their ids.
pub struct Dialect {
    name: DialectName,
    wire: Wire,
    /// Indexed by the [`place`] of the id.
    commands: Vec<Option<Entry>>,
    /// Indexed by [`super::Response::INDEX`].
    response_ids: Vec<Option<u32>>,
    /// The id of `emergency_stop`. Each block is searched for it.
    emergency_stop: Option<u32>,
    /// Indexed by their number in the enumeration `static_string_id`.
    shutdowns: Vec<ShutdownReason>,
    dictionary: Dictionary,
    /// The dictionary as `identify` serves it.
    compressed: Vec<u8>,
}

impl Firmware {
    /// The entries of one kind of the features that it has on its wire.
    fn all<T>(&self, of: fn(&'static Feature) -> &'static [T]) -> impl Iterator<Item = &'static T> + Clone {
        self.features.iter().filter(|feature| (feature.is_on)(&self.wire)).flat_map(of)
    }
}

/// A dictionary that describes the program and has no messages yet.
fn head(firmware: &Firmware, name: &DialectName) -> Dictionary {
    let hosts = since(DialectName::V0_13);
    let is_named = name.parts().iter().any(|part| hosts.contains(*part));
    let named = |text: &str| if is_named { text.to_owned() } else { String::new() };
    Dictionary {
        app: named(firmware.app),
        build_versions: firmware.build_versions.into(),
        license: named(firmware.license),
        version: firmware.version.into(),
        ..Dictionary::default()
    }
}

/// The commands by the [`place`] of their ids, and the ids of the responses in the features' order.
type Numbered = (Vec<Option<Entry>>, Vec<Option<u32>>);

/// Gives ids to the messages of a dialect, and adds them to the dictionary.
fn number(firmware: &Firmware, name: &DialectName, dictionary: &mut Dictionary) -> io::Result<Numbered> {
    let features = firmware.features;
    let mut ids = ids();
    let mut next_id = || ids.next().ok_or_else(|| io::Error::other("there are more messages than ids"));
    let (mut commands, mut response_ids) = (Vec::new(), Vec::new());
    let responses =
        Choice::new(name, firmware.all(|feature| feature.responses), |form| (format::name(form.format), form.dialects));
    let taken = Choice::new(name, firmware.all(|feature| feature.commands), |command| {
        (format::name(command.format), command.dialects)
    });
    // The MCU's own messages have the same ids in every dialect. The MCU may get another dialect after its host has
    // read the dictionary. That host's `emergency_stop` must still work.
    let (base, others) = features.split_at(features.len().min(1));
    for (features, is_own) in [(base, true), (others, false)] {
        // Responses first: their data fills a block to the last byte, so their ids must be short.
        for form in all(features, |feature| feature.responses) {
            if !responses.has(form) {
                response_ids.push(None);
                continue;
            }
            let id = match format::name(form.format) {
                "identify_response" => IDENTIFY_RESPONSE_ID,
                _ => next_id()?,
            };
            response_ids.push(Some(id as u32));
            dictionary.responses.insert(form.format.into(), json!(id));
        }
        for command in all(features, |feature| feature.commands).filter(|command| taken.has(command)) {
            let id = match format::name(command.format) {
                "identify" => IDENTIFY_ID,
                _ => next_id()?,
            };
            let place = place(id as u32);
            if commands.len() <= place {
                commands.resize_with(place + 1, || None);
            }
            commands[place] = Some(Entry::new(command, is_own)?);
            dictionary.commands.insert(command.format.into(), json!(id));
        }
    }
    Ok((commands, response_ids))
}

/// Adds the constants and enumerations of a dialect to the dictionary.
fn publish_names(firmware: &Firmware, name: &DialectName, board: &dyn Board, dictionary: &mut Dictionary) {
    let constants = firmware.all(|feature| feature.constants);
    let had = Choice::new(name, constants.clone(), |constant| (constant.name, constant.dialects));
    for constant in constants.filter(|constant| had.has(constant)) {
        let value = match constant.value {
            ConstantValue::Number(number) => json!(number),
            ConstantValue::Text(text) => json!(text),
        };
        dictionary.config.insert(constant.name.into(), value);
    }
    if let Some((name, value)) = firmware.wire.rate() {
        dictionary.config.insert(name.into(), json!(value));
    }
    dictionary.config.extend(board.constants());
    let enumerations = firmware.all(|feature| feature.enumerations);
    let had = Choice::new(name, enumerations.clone(), |enumeration| (enumeration.name, enumeration.dialects));
    for enumeration in enumerations.filter(|enumeration| had.has(enumeration)) {
        let values = names((enumeration.values)(board));
        dictionary.enumerations.insert(enumeration.name.into(), Value::Object(values));
    }
}

impl Dialect {
    /// Gives ids to the messages that hosts of this dialect use, and makes the dictionary with the board's names.
    pub fn new(firmware: &Firmware, board: &dyn Board, name: DialectName) -> io::Result<Dialect> {
        let mut dictionary = head(firmware, &name);
        let (commands, response_ids) = number(firmware, &name, &mut dictionary)?;
        publish_names(firmware, &name, board, &mut dictionary);
        let shutdowns: Vec<ShutdownReason> = firmware.all(|feature| feature.shutdowns).copied().collect();
        let texts = shutdowns.iter().zip(0..).map(|(reason, id)| (reason.text().into(), json!(id)));
        dictionary.enumerations.insert("static_string_id".into(), Value::Object(texts.collect()));
        let compressed = dictionary.compress()?;
        let wire = firmware.wire.clone();
        let mut dialect =
            Dialect { name, wire, commands, response_ids, emergency_stop: None, shutdowns, dictionary, compressed };
        dialect.emergency_stop = dialect.command_id(base::EMERGENCY_STOP.format);
        Ok(dialect)
    }

    /// Which dialect this is.
    pub fn name(&self) -> DialectName {
        self.name
    }

    /// The wire that its host is on.
    pub fn wire(&self) -> &Wire {
        &self.wire
    }

    /// Whether the MCU behaves as these hosts expect, where the form of a message does not say it.
    pub(super) fn serves(&self, hosts: Dialects) -> bool {
        self.name.parts().first().is_some_and(|part| hosts.contains(*part))
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// The dictionary as zlib-compressed JSON, as `identify` serves it.
    pub fn compressed(&self) -> &[u8] {
        &self.compressed
    }

    /// The id of the response of type `R`; `None` if the hosts of this dialect do not use it.
    #[inline]
    pub fn response_id<R: super::Response>(&self) -> Option<u32> {
        self.response_ids[R::INDEX]
    }

    /// The number of a shutdown text.
    pub(super) fn static_string_id(&self, reason: ShutdownReason) -> u16 {
        // Every reason is in the list: `shutdowns!` makes the list together with the constants.
        self.shutdowns.iter().position(|listed| *listed == reason).unwrap_or(0) as u16
    }

    /// The id of the command with this format.
    pub fn command_id(&self, format: &str) -> Option<u32> {
        self.dictionary.commands.get(format)?.as_i64().map(|id| id as u32)
    }

    /// Whether a block asks for an emergency stop.
    pub fn is_emergency(&self, payload: &[u8]) -> bool {
        self.emergency_stop.is_some_and(|id| self.contains(payload, id))
    }

    /// Whether a payload is one of the MCU's own responses. These mean the same in every dialect.
    pub fn is_own_response(&self, payload: &[u8]) -> bool {
        let id = Reader::new(payload).int().ok();
        let mut ids = self.response_ids.iter().enumerate();
        id.is_some() && ids.any(|(index, own)| base::is_own_response(index) && *own == id)
    }

    /// Whether a block's payload has the command with this id. The search ends at an unknown or incomplete command,
    /// because the MCU stops there.
    fn contains(&self, payload: &[u8], id: u32) -> bool {
        // The last byte of the id's encoding must occur in the payload. Usually it does not, and no command has to be
        // decoded.
        if !payload.contains(&(id as u8 & 0x7f)) {
            return false;
        }
        let mut reader = Reader::new(payload);
        while let Ok(found) = reader.int() {
            if found == id {
                return true;
            }
            let Ok(command) = self.command(found) else { return false };
            if command.skip(&mut reader).is_err() {
                return false;
            }
        }
        false
    }

    #[inline]
    pub(super) fn command(&self, id: u32) -> Result<&Entry, Shutdown> {
        match self.commands.get(place(id)) {
            Some(Some(entry)) => Ok(entry),
            _ => {
                let cause = format!("the host sent command {}, which the dictionary does not have", id as i32);
                Err(Shutdown::because(reason::INVALID_COMMAND, cause).remedy(READ_ANEW))
            }
        }
    }
}

fn names(ranges: Vec<Range>) -> serde_json::Map<String, Value> {
    ranges
        .into_iter()
        .map(|range| match range.count {
            1 => (range.name, json!(range.first)),
            count => (range.name, json!([range.first, count])),
        })
        .collect()
}
