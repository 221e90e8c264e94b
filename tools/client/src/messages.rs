// SPDX-License-Identifier: GPL-3.0-or-later
//! Commands and responses by their names in a data dictionary.

use std::collections::HashMap;
use std::time::Instant;

use serde_json::{Map, Value as Json};

use super::Error;
use super::serial::Received;
use pinion_protocol::clock::Clock;
use pinion_protocol::dictionary::Dictionary;
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::{Reader, Writer};

/// Most memory for the names of an enumeration that are listed. A few bytes of a dictionary can stand for many names.
const NAMES_BYTES: usize = 1 << 20;

/// An argument for a command's parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arg<'a> {
    /// A number, -2^31 to 2^32 - 1.
    Int(i64),
    /// A name of an enumeration (a pin, a bus).
    Name(&'a str),
    /// A byte string.
    Bytes(&'a [u8]),
}

macro_rules! arg_from_integers {
    ($($t:ty),*) => {$(
        impl From<$t> for Arg<'_> {
            fn from(value: $t) -> Self {
                Arg::Int(i64::from(value))
            }
        }
    )*};
}
arg_from_integers!(bool, u8, u16, u32, i16, i32, i64);

impl From<Clock> for Arg<'_> {
    fn from(clock: Clock) -> Self {
        Arg::Int(i64::from(clock.wire()))
    }
}

impl<'a> From<&'a str> for Arg<'a> {
    fn from(name: &'a str) -> Self {
        Arg::Name(name)
    }
}

impl<'a> From<&'a [u8]> for Arg<'a> {
    fn from(bytes: &'a [u8]) -> Self {
        Arg::Bytes(bytes)
    }
}

/// A value in a response.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Value {
    /// A number.
    Int(i64),
    /// A name of an enumeration.
    Name(String),
    /// A byte string.
    Bytes(Vec<u8>),
}

/// A response: its name and parameters.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Params {
    /// The response's name; `#unknown` for a response that is not in the dictionary.
    pub name: String,
    /// When it was read.
    pub at: Instant,
    fields: Vec<(String, Value)>,
}

impl Params {
    /// The parameter's value; `None` if there is no such parameter.
    pub fn get(&self, parameter: &str) -> Option<&Value> {
        self.fields.iter().find_map(|(name, value)| (name == parameter).then_some(value))
    }

    /// The parameters in their order.
    pub(super) fn fields(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.fields.iter().map(|(name, value)| (name.as_str(), value))
    }

    /// A number. Fails if the response has no such number.
    pub fn int(&self, parameter: &str) -> Result<i64, Error> {
        match self.get(parameter) {
            Some(Value::Int(value)) => Ok(*value),
            _ => Err(self.lacks("number", parameter)),
        }
    }

    /// A 32-bit number, for example a clock. Fails if the response has no such number.
    pub fn u32(&self, parameter: &str) -> Result<u32, Error> {
        Ok(self.int(parameter)? as u32)
    }

    /// A number that means true or false. Fails if the response has no such number.
    pub fn flag(&self, parameter: &str) -> Result<bool, Error> {
        Ok(self.int(parameter)? != 0)
    }

    /// A byte string. Fails if the response has no such string.
    pub fn bytes(&self, parameter: &str) -> Result<&[u8], Error> {
        match self.get(parameter) {
            Some(Value::Bytes(value)) => Ok(value),
            _ => Err(self.lacks("byte string", parameter)),
        }
    }

    /// A name of an enumeration; `?N` for a number without a name.
    pub fn text(&self, parameter: &str) -> Result<String, Error> {
        match self.get(parameter) {
            Some(Value::Name(value)) => Ok(value.clone()),
            Some(Value::Int(value)) => Ok(format!("?{value}")),
            _ => Err(self.lacks("name", parameter)),
        }
    }

    pub(super) fn is(&self, name: &str, oid: Option<u8>) -> bool {
        self.name == name && oid.is_none_or(|oid| self.get("oid") == Some(&Value::Int(i64::from(oid))))
    }

    fn lacks(&self, kind: &str, parameter: &str) -> Error {
        Error::Message { message: self.name.clone(), why: format!("the response has no {kind} `{parameter}`") }
    }
}

#[derive(Clone, Debug)]
struct Parameter {
    name: String,
    conversion: Conversion,
    /// The enumeration with names for the parameter's values, if there is one.
    enumeration: Option<usize>,
}

#[derive(Clone, Debug)]
struct Message {
    name: String,
    id: i32,
    parameters: Vec<Parameter>,
}

#[derive(Clone, Debug, Default)]
struct Enumeration {
    name: String,
    values: HashMap<String, u32>,
    names: HashMap<u32, String>,
    /// (the name without its number, first number, first value, count)
    runs: Vec<(String, u32, u32, u32)>,
}

impl Enumeration {
    fn new(name: &str, entries: &Map<String, Json>) -> Enumeration {
        let mut this = Enumeration { name: name.to_owned(), ..Enumeration::default() };
        let number = |json: &Json| json.as_i64().map(|value| value as u32);
        for (name, entry) in entries {
            if let Some(value) = number(entry) {
                this.values.insert(name.clone(), value);
                this.names.entry(value).or_insert_with(|| name.clone());
            } else if let Some([first, count]) = entry.as_array().map(Vec::as_slice) {
                let root = name.trim_end_matches(|c: char| c.is_ascii_digit());
                let start = name[root.len()..].parse().unwrap_or(0);
                if let (Some(first), Some(count)) = (number(first), number(count)) {
                    this.runs.push((root.to_owned(), start, first, count));
                }
            }
        }
        this
    }

    fn value(&self, name: &str) -> Option<u32> {
        if let Some(value) = self.values.get(name) {
            return Some(*value);
        }
        let root = name.trim_end_matches(|c: char| c.is_ascii_digit());
        let digits = &name[root.len()..];
        let number: u32 = digits.parse().ok()?;
        if number.to_string() != digits {
            return None;
        }
        self.runs.iter().find_map(|(run, start, first, count)| {
            let at = number.checked_sub(*start)?;
            (run == root && at < *count).then(|| first.wrapping_add(at))
        })
    }

    /// The names, sorted: as many as [`NAMES_BYTES`] have room for.
    fn all(&self) -> Vec<String> {
        let runs = self.runs.iter().flat_map(|(root, start, _, count)| {
            (0..*count).map(move |at| format!("{root}{}", u64::from(*start) + u64::from(at)))
        });
        let mut room = NAMES_BYTES;
        let has_room = |name: &String| {
            let left = room.checked_sub(size_of::<String>() + name.len());
            room = left.unwrap_or(0);
            left.is_some()
        };
        let mut names: Vec<String> = self.values.keys().cloned().chain(runs).take_while(has_room).collect();
        names.sort();
        names
    }

    fn name_of(&self, value: u32) -> Option<String> {
        if let Some(name) = self.names.get(&value) {
            return Some(name.clone());
        }
        self.runs.iter().find_map(|(root, start, first, count)| {
            let at = value.wrapping_sub(*first);
            (at < *count).then(|| format!("{root}{}", u64::from(*start) + u64::from(at)))
        })
    }
}

/// The commands and responses of a dictionary, prepared for encoding and decoding.
#[derive(Clone, Debug, Default)]
pub struct Messages {
    commands: HashMap<String, Message>,
    responses: HashMap<i32, Message>,
    enumerations: Vec<Enumeration>,
}

impl Messages {
    /// Prepares a dictionary. Messages with an invalid format are omitted.
    pub fn new(dictionary: &Dictionary) -> Messages {
        let enumerations: Vec<_> = dictionary
            .enumerations
            .iter()
            .filter_map(|(name, entries)| Some(Enumeration::new(name, entries.as_object()?)))
            .collect();
        let message = |(text, id): (&String, &Json)| {
            let parameters = format::parameters(text)?
                .into_iter()
                .map(|(name, conversion)| Parameter {
                    name: name.to_owned(),
                    conversion,
                    enumeration: enumerations.iter().position(|e| names_values_of(&e.name, name)),
                })
                .collect();
            Some(Message { name: format::name(text).to_owned(), id: i32::try_from(id.as_i64()?).ok()?, parameters })
        };
        let commands = dictionary.commands.iter().filter_map(message);
        let responses = dictionary.responses.iter().filter_map(message);
        Messages {
            commands: commands.map(|m| (m.name.clone(), m)).collect(),
            responses: responses.map(|m| (m.id, m)).collect(),
            enumerations,
        }
    }

    /// Whether there is such a command.
    pub(super) fn has_command(&self, name: &str) -> bool {
        self.commands.contains_key(name)
    }

    /// Whether there is a command with this name and this parameter.
    pub fn has_parameter(&self, command: &str, parameter: &str) -> bool {
        self.commands.get(command).is_some_and(|m| m.parameters.iter().any(|p| p.name == parameter))
    }

    /// The names that a parameter accepts, sorted; empty if it accepts no names.
    pub(super) fn names(&self, parameter: &str) -> Vec<String> {
        let enumeration = self.enumerations.iter().find(|enumeration| names_values_of(&enumeration.name, parameter));
        enumeration.map_or_else(Vec::new, Enumeration::all)
    }

    /// The bytes of a command. Fails if the dictionary has no such command, or if a value does not fit. Also fails if
    /// the parameters are not exactly the command's own.
    pub fn encode(&self, command: &str, args: &[(&str, Arg<'_>)]) -> Result<Vec<u8>, Error> {
        let wrong = |why: String| Error::Message { message: command.to_owned(), why };
        let message = self.commands.get(command).ok_or_else(|| wrong("the MCU has no such command".to_owned()))?;
        if let Some((name, _)) = args.iter().find(|(name, _)| message.parameters.iter().all(|p| p.name != *name)) {
            return Err(wrong(format!("there is no parameter `{name}`")));
        }
        let mut writer = Writer::default();
        writer.int(message.id as u32);
        for parameter in &message.parameters {
            let (_, arg) = args
                .iter()
                .find(|(name, _)| *name == parameter.name)
                .ok_or_else(|| wrong(format!("parameter `{}` is missing", parameter.name)))?;
            let bytes = parameter.conversion == Conversion::Bytes;
            match *arg {
                Arg::Bytes(value) if bytes => writer.string(value),
                Arg::Int(value) if !bytes => {
                    if value < i64::from(i32::MIN) || value > i64::from(u32::MAX) {
                        return Err(wrong(format!("{}={value} does not fit 32 bits", parameter.name)));
                    }
                    writer.int(value as u32);
                }
                Arg::Name(name) if !bytes => {
                    let enumeration = parameter.enumeration.and_then(|index| self.enumerations.get(index));
                    let value = enumeration
                        .and_then(|e| e.value(name))
                        .ok_or_else(|| wrong(format!("`{name}` is not a value of {}", parameter.name)))?;
                    writer.int(value);
                }
                _ => {
                    return Err(wrong(format!(
                        "{} takes {}",
                        parameter.name,
                        if bytes { "a byte string" } else { "a number" }
                    )));
                }
            }
        }
        match writer.payload() {
            Some(payload) => Ok(payload.to_vec()),
            None => Err(wrong("its parameters do not fit a block".to_owned())),
        }
    }

    /// The bytes of a command in klippy's notation, `config_stepper oid=0 step_pin=gpio17 ...`. Byte strings are
    /// hexadecimal digits. Fails as [`Messages::encode`] does.
    pub fn encode_line(&self, line: &str) -> Result<Vec<u8>, Error> {
        let mut words = line.split_ascii_whitespace();
        let command = words.next().unwrap_or_default();
        let wrong = |why: String| Error::Message { message: command.to_owned(), why };
        let parameters = self.commands.get(command).map(|m| &m.parameters);
        let mut strings = Vec::new();
        let mut pairs = Vec::new();
        for word in words {
            let (name, value) = word.split_once('=').ok_or_else(|| wrong(format!("`{word}` is not name=value")))?;
            let parameter = parameters.and_then(|all| all.iter().find(|p| p.name == name));
            if parameter.is_some_and(|p| p.conversion == Conversion::Bytes) {
                let bytes = from_hex(value).ok_or_else(|| wrong(format!("{word} is not hexadecimal digits")))?;
                strings.push((name, bytes));
            } else {
                pairs.push((name, integer(value).map_or(Arg::Name(value), Arg::Int)));
            }
        }
        pairs.extend(strings.iter().map(|(name, bytes)| (*name, Arg::Bytes(bytes))));
        self.encode(command, &pairs)
    }

    /// Takes the responses from a payload. From the first unknown response on, the rest of the payload becomes one
    /// response `#unknown` with the rest as `data`.
    pub fn decode(&self, received: &Received) -> Vec<Params> {
        let mut reader = Reader::new(&received.payload);
        let mut responses = Vec::new();
        while !reader.is_empty() {
            let rest = reader.rest();
            match self.decode_one(&mut reader) {
                Some((name, fields)) => responses.push(Params { name, at: received.at, fields }),
                None => {
                    responses.push(Params {
                        name: "#unknown".to_owned(),
                        at: received.at,
                        fields: vec![("data".to_owned(), Value::Bytes(rest.to_vec()))],
                    });
                    break;
                }
            }
        }
        responses
    }

    fn decode_one(&self, reader: &mut Reader<'_>) -> Option<(String, Vec<(String, Value)>)> {
        let message = self.responses.get(&(reader.int().ok()? as i32))?;
        let mut fields = Vec::with_capacity(message.parameters.len());
        for parameter in &message.parameters {
            let value = match parameter.conversion {
                Conversion::Bytes => Value::Bytes(reader.bytes().ok()?.to_vec()),
                Conversion::I32 | Conversion::I16 => Value::Int(i64::from(reader.int().ok()? as i32)),
                _ => {
                    let value = reader.int().ok()?;
                    parameter
                        .enumeration
                        .and_then(|index| self.enumerations.get(index)?.name_of(value))
                        .map_or(Value::Int(i64::from(value)), Value::Name)
                }
            };
            fields.push((parameter.name.clone(), value));
        }
        Some((message.name.clone(), fields))
    }
}

/// Whether an enumeration names the values of a parameter: `pin` names those of `pin` and of `step_pin`.
fn names_values_of(enumeration: &str, parameter: &str) -> bool {
    parameter.strip_suffix(enumeration).is_some_and(|front| front.is_empty() || front.ends_with('_'))
}

fn integer(text: &str) -> Option<i64> {
    match text.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

fn from_hex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.chars().map(|c| c.to_digit(16).map(|digit| digit as u8)).collect::<Option<_>>()?;
    if !digits.len().is_multiple_of(2) {
        return None;
    }
    Some(digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::super::fake;
    use super::*;

    fn received(payload: &[u8]) -> Received {
        Received { payload: payload.to_vec(), at: Instant::now() }
    }

    #[test]
    fn pins_are_named_singly_and_in_runs() {
        let messages = Messages::new(&fake::dictionary());
        let encode = |pin: &str| {
            messages
                .encode("config_endstop", &[("oid", 0.into()), ("pin", pin.into()), ("pull_up", (-1i8 as i32).into())])
        };
        // config_endstop has the id 5. -1 is one byte.
        assert_eq!(encode("gpio17").unwrap(), [5, 0, 17, 0x7f]);
        assert_eq!(encode("gpiochip1/gpio2").unwrap(), [5, 0, 0x82, 0x22, 0x7f]);
        assert_eq!(encode("GPIO17").unwrap(), [5, 0, 17, 0x7f]);
        for wrong in ["gpio288", "gpio017", "gpio", "gpio-1", "gpio99999999999", "17x", ""] {
            let error = encode(wrong).unwrap_err().to_string();
            assert!(error.contains("is not a value of pin"), "{error}");
        }
        assert_eq!(
            messages.encode_line("config_endstop oid=0 pin=gpio17 pull_up=-1").unwrap(),
            encode("gpio17").unwrap()
        );
    }

    #[test]
    fn a_command_that_does_not_fit_is_refused() {
        let messages = Messages::new(&fake::dictionary());
        let refused = |line: &str| messages.encode_line(line).unwrap_err().to_string();
        assert!(refused("no_such").starts_with("no_such: the MCU has no such command"));
        assert!(refused("").contains("no such command"));
        assert!(refused("get_clock oid=1").contains("no parameter `oid`"));
        assert!(refused("config_endstop oid=1").contains("`pin` is missing"));
        assert!(refused("config_endstop oid").contains("not name=value"));
        assert!(refused("debug_ping data=0g").contains("not hexadecimal"));
        assert!(refused("debug_ping data=012").contains("not hexadecimal"));
        assert!(refused(&format!("debug_ping data={}", "00".repeat(60))).contains("do not fit a block"));
        assert!(refused("config_endstop oid=4294967296 pin=1 pull_up=0").contains("32 bits"));
        assert_eq!(messages.encode_line("debug_ping data=0aFF").unwrap(), [6, 2, 0x0a, 0xff]);
    }

    #[test]
    fn responses_are_decoded_by_name() {
        let messages = Messages::new(&fake::dictionary());
        let all = messages.decode(&received(&[70, 0x7f, 0x81, 0x00, 71, 3, 1, 2, 3]));
        assert_eq!(all[0].name, "stepper_position");
        assert_eq!((all[0].int("oid").unwrap(), all[0].int("pos").unwrap()), (0xffff_ffff, 128));
        assert_eq!(all[1].bytes("data").unwrap(), [1, 2, 3]);
        let unknown = messages.decode(&received(&[99, 1]));
        assert_eq!((unknown[0].name.as_str(), unknown[0].bytes("data").unwrap()), ("#unknown", &[99, 1][..]));
        let cut = messages.decode(&received(&[71, 9, 1]));
        assert_eq!(cut[0].name, "#unknown");
    }

    proptest! {
        #[test]
        fn any_payload_is_decoded_without_a_panic(payload: Vec<u8>) {
            Messages::new(&fake::dictionary()).decode(&received(&payload));
        }

        #[test]
        fn runs_name_every_value_once(first: u32, count in 1u32..1000, start in 0u32..100, at in 0u32..1000) {
            let entries = json!({ format!("pin{start}"): [first, count] });
            let runs = Enumeration::new("pin", entries.as_object().unwrap());
            let name = format!("pin{}", start + at);
            let value = first.wrapping_add(at);
            prop_assert_eq!(runs.value(&name), (at < count).then_some(value));
            prop_assert_eq!(runs.name_of(value), (at < count).then_some(name));
        }
    }

    #[test]
    fn the_names_of_a_dictionary_without_end_take_bounded_memory() {
        let mut runs = Map::new();
        for run in 0..2000 {
            runs.insert(format!("{run}{}", "x".repeat(1000)), json!([0, u32::MAX]));
        }
        let names = Enumeration::new("pin", &runs).all();
        let bytes: usize = names.iter().map(|name| size_of::<String>() + name.len()).sum();
        assert!(names.len() > 900 && bytes <= NAMES_BYTES, "{} names, {bytes} bytes", names.len());
        // The widest real chips have some hundred lines.
        let chips = json!({ "gpio0": [0, 288], "gpiochip1/gpio0": [288, 5000], "led": 9000 });
        assert_eq!(Enumeration::new("pin", chips.as_object().unwrap()).all().len(), 5289);
    }

    #[test]
    fn a_dictionary_of_nonsense_is_no_dictionary_but_no_panic() {
        let mut dictionary = fake::dictionary();
        dictionary.enumerations = json!({"pin": {"a": [1], "b9999999999": [-1, -5], "c": "x", "d": null}, "e": 3})
            .as_object()
            .unwrap()
            .clone();
        dictionary.commands =
            json!({"": 1, "x y": 2, "z q=%c": "three", "w pin=%c": 99999999999i64}).as_object().unwrap().clone();
        let messages = Messages::new(&dictionary);
        assert!(messages.has_command("") && !messages.has_command("x") && !messages.has_command("w"));
    }
}
