// SPDX-License-Identifier: GPL-3.0-or-later
//! The ids of all messages, and the dictionary that gives them to the host.

use std::collections::HashSet;
use std::io;

use serde_json::{Map, Value, json};

use crate::board::{Board, Range};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_protocol::dictionary::{Dictionary, IDENTIFY_ID, IDENTIFY_RESPONSE_ID};
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::Reader;

use super::command::{Command, ConstantValue, Feature, Handler};
use super::forms::{Entry, Item, Part, entries};
use super::{DialectName, Forms, Wire, base};

/// The remedy for a host with another dictionary.
pub(super) const READ_AGAIN: &str = "restart the host, and it reads the dictionary again";

/// A command of the dialect, found by its id.
pub(super) struct Known {
    pub(super) format: &'static str,
    pub(super) handler: Handler,
    pub(super) in_shutdown: bool,
    pub(super) joins: bool,
    /// Whether it is the MCU's own command, with the same id in every dialect.
    pub(super) is_own: bool,
    conversions: Box<[Conversion]>,
}

impl Known {
    fn new(command: &Command, is_own: bool) -> io::Result<Known> {
        let conversions = format::parameters(command.format)
            .ok_or_else(|| io::Error::other(format!("\"{}\" is not a format", command.format)))?;
        Ok(Known {
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

/// The names that a board adds to a dictionary.
pub struct Names {
    /// The values of the enumerations, in the order of [`entries`]. Empty for other entries.
    values: Vec<Map<String, Value>>,
    constants: Vec<(String, Value)>,
}

impl Names {
    /// The present names of a board.
    pub fn of(firmware: &Firmware, board: &dyn Board) -> Names {
        let values = |entry: Entry| match entry.item {
            Item::Enumeration(enumeration) => numbers((enumeration.values)(board)),
            _ => Map::new(),
        };
        Names { values: entries(firmware.features).into_iter().map(values).collect(), constants: board.constants() }
    }
}

/// The messages that a host and the MCU may exchange, by their ids.
pub struct Dialect {
    forms: Forms,
    /// The formats of the messages that the host needs.
    needed: HashSet<&'static str>,
    wire: Wire,
    /// Indexed by the [`place`] of the id.
    commands: Vec<Option<Known>>,
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
    /// All entries, each with its part in the dictionary for these forms.
    fn choose(&self, forms: &Forms) -> Vec<(Entry, Part)> {
        let entries = entries(self.features);
        let parts = forms.parts(&entries);
        let is_on = |entry: &Entry| (self.features[entry.feature].is_on)(&self.wire);
        entries
            .into_iter()
            .zip(parts)
            .map(|(entry, part)| if is_on(&entry) { (entry, part) } else { (entry, Part::Left) })
            .collect()
    }
}

/// A dictionary that describes the program and has no messages yet.
fn head(firmware: &Firmware, forms: &Forms) -> Dictionary {
    let is_named = !matches!(forms, Forms::Dialect(DialectName::V0_11 | DialectName::V0_12));
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
type Numbered = (Vec<Option<Known>>, Vec<Option<u32>>);

/// Gives ids to the messages of a dictionary, and adds them to it.
fn number(chosen: &[(Entry, Part)], dictionary: &mut Dictionary) -> io::Result<Numbered> {
    let mut ids = ids();
    let mut next_id = || ids.next().ok_or_else(|| io::Error::other("there are more messages than ids"));
    let (mut commands, mut response_ids) = (Vec::new(), Vec::new());
    response_ids.resize(chosen.iter().filter(|(entry, _)| matches!(entry.item, Item::Response(_))).count(), None);
    // The MCU's own messages have the same ids in every dictionary. The MCU may get another dictionary after its host
    // has read one. That host's `emergency_stop` must still work. Hosts up to June 2024 know only ids of one byte, so
    // spare messages get no others.
    for (is_own, wanted) in [(true, Part::Needed), (false, Part::Needed), (false, Part::Spare)] {
        let here = |entry: &Entry, part: Part| (entry.feature == 0) == is_own && part == wanted;
        let mut spare_id =
            || next_id().map(|id| Some(id).filter(|id| wanted == Part::Needed || SHORT_IDS.contains(id)));
        // Responses first: their data fills a block to the last byte, so their ids must be short.
        let responses = chosen.iter().filter_map(|(entry, part)| match entry.item {
            Item::Response(form) => Some((entry, form, *part)),
            _ => None,
        });
        for (index, (_, form, _)) in responses.enumerate().filter(|(_, (entry, _, part))| here(entry, *part)) {
            let id = match format::name(form.format) {
                "identify_response" => Some(IDENTIFY_RESPONSE_ID),
                _ => spare_id()?,
            };
            let Some(id) = id else { break };
            response_ids[index] = Some(id as u32);
            dictionary.responses.insert(form.format.into(), json!(id));
        }
        for (entry, part) in chosen {
            let Item::Command(command) = entry.item else { continue };
            if !here(entry, *part) {
                continue;
            }
            let id = match entry.name {
                "identify" => Some(IDENTIFY_ID),
                _ => spare_id()?,
            };
            let Some(id) = id else { break };
            let place = place(id as u32);
            if commands.len() <= place {
                commands.resize_with(place + 1, || None);
            }
            commands[place] = Some(Known::new(command, is_own)?);
            dictionary.commands.insert(command.format.into(), json!(id));
        }
    }
    Ok((commands, response_ids))
}

/// Adds the constants and enumerations to the dictionary.
fn publish_names(chosen: &[(Entry, Part)], firmware: &Firmware, names: &Names, dictionary: &mut Dictionary) {
    for ((entry, _), values) in chosen.iter().zip(&names.values).filter(|((_, part), _)| *part == Part::Needed) {
        match entry.item {
            Item::Constant(constant) => {
                let value = match constant.value {
                    ConstantValue::Number(number) => json!(number),
                    ConstantValue::Text(text) => json!(text),
                };
                dictionary.config.insert(constant.name.into(), value);
            }
            Item::Enumeration(enumeration) => {
                dictionary.enumerations.insert(enumeration.name.into(), Value::Object(values.clone()));
            }
            Item::Command(_) | Item::Response(_) => {}
        }
    }
    if let Some((name, value)) = firmware.wire.rate() {
        dictionary.config.insert(name.into(), json!(value));
    }
    dictionary.config.extend(names.constants.iter().cloned());
}

impl Dialect {
    /// Gives ids to the messages of these forms, and makes the dictionary with the board's names.
    pub fn new(firmware: &Firmware, board: &dyn Board, forms: impl Into<Forms>) -> io::Result<Dialect> {
        Dialect::with_names(firmware, &Names::of(firmware, board), forms.into())
    }

    /// The same, with the board's names as they were.
    pub fn with_names(firmware: &Firmware, names: &Names, forms: Forms) -> io::Result<Dialect> {
        let chosen = firmware.choose(&forms);
        let mut dictionary = head(firmware, &forms);
        let (commands, response_ids) = number(&chosen, &mut dictionary)?;
        publish_names(&chosen, firmware, names, &mut dictionary);
        let needed = chosen.iter().filter(|(_, part)| *part == Part::Needed).map(|(entry, _)| entry.text).collect();
        let features = firmware.features.iter().filter(|feature| (feature.is_on)(&firmware.wire));
        let shutdowns: Vec<ShutdownReason> = features.flat_map(|feature| feature.shutdowns).copied().collect();
        let texts = shutdowns.iter().zip(0..).map(|(reason, id)| (reason.text().into(), json!(id)));
        dictionary.enumerations.insert("static_string_id".into(), Value::Object(texts.collect()));
        let compressed = dictionary.compress()?;
        let wire = firmware.wire.clone();
        let mut dialect = Dialect {
            forms,
            needed,
            wire,
            commands,
            response_ids,
            emergency_stop: None,
            shutdowns,
            dictionary,
            compressed,
        };
        dialect.emergency_stop = dialect.command_id(base::EMERGENCY_STOP.format);
        Ok(dialect)
    }

    /// The forms that it was made of.
    pub fn forms(&self) -> &Forms {
        &self.forms
    }

    /// The wire that its host is on.
    pub fn wire(&self) -> &Wire {
        &self.wire
    }

    /// Whether the host needs the message of this format. A spare message does not count: it decides no behavior.
    pub(super) fn needs(&self, format: &str) -> bool {
        self.needed.contains(format)
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
    pub(super) fn command(&self, id: u32) -> Result<&Known, Shutdown> {
        match self.commands.get(place(id)) {
            Some(Some(entry)) => Ok(entry),
            _ => {
                let cause = format!("the host sent command {}, which the dictionary does not have", id as i32);
                Err(Shutdown::because(reason::INVALID_COMMAND, cause).remedy(READ_AGAIN))
            }
        }
    }
}

fn numbers(ranges: Vec<Range>) -> Map<String, Value> {
    ranges
        .into_iter()
        .map(|range| match range.count {
            1 => (range.name, json!(range.first)),
            count => (range.name, json!([range.first, count])),
        })
        .collect()
}
