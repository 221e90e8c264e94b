// SPDX-License-Identifier: GPL-3.0-or-later
//! A session with a micro-controller: its dictionary, commands and responses by name, and its
//! clock.

#![forbid(unsafe_code)]

use std::collections::{HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::{Map, Value as Json};

use super::Error;
use super::serial::{Link, Received};
use crate::time::Clock;
use crate::wire::dictionary::{Dictionary, IDENTIFY_ID, IDENTIFY_RESPONSE_ID};
use crate::wire::format::{self, Conversion};
use crate::wire::vlq::{Reader, Writer};

/// How long a query waits for its response.
pub const QUERY_TIMEOUT: Duration = Duration::from_secs(5);
/// After this time a query is sent again: a response that was lost is not repeated by itself.
const RETRY: Duration = Duration::from_millis(500);
/// How long reading the dictionary may take in all.
const IDENTIFY_TIMEOUT: Duration = Duration::from_secs(15);
const IDENTIFY_CHUNK: u8 = 40;
/// A dictionary is a few kilobytes; what goes beyond this is none.
const IDENTIFY_MAX: usize = 128 * 1024;
/// Responses kept for those who may ask for them; the oldest go first.
const INBOX_MAX: usize = 65_536;
/// The age at which the clock's estimate is renewed.
const CLOCK_AGE: Duration = Duration::from_millis(500);

/// A value given for a command's parameter.
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

/// A value that came in a response.
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
    /// The response's name; `#unknown` for one that the dictionary does not have.
    pub name: String,
    /// When it was read.
    pub at: Instant,
    fields: Vec<(String, Value)>,
}

impl Params {
    /// The parameter's value, if there is such a parameter.
    pub fn get(&self, parameter: &str) -> Option<&Value> {
        self.fields.iter().find_map(|(name, value)| (name == parameter).then_some(value))
    }

    /// A number. Fails if the response has no such number.
    pub fn int(&self, parameter: &str) -> Result<i64, Error> {
        match self.get(parameter) {
            Some(Value::Int(value)) => Ok(*value),
            _ => Err(self.lacks("number", parameter)),
        }
    }

    /// A 32-bit number, such as a clock. Fails if the response has no such number.
    pub fn u32(&self, parameter: &str) -> Result<u32, Error> {
        Ok(self.int(parameter)? as u32)
    }

    /// A number that means yes or no. Fails if the response has no such number.
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

    /// A name of an enumeration; a number that has none reads `?N`.
    pub fn text(&self, parameter: &str) -> Result<String, Error> {
        match self.get(parameter) {
            Some(Value::Name(value)) => Ok(value.clone()),
            Some(Value::Int(value)) => Ok(format!("?{value}")),
            _ => Err(self.lacks("name", parameter)),
        }
    }

    fn is(&self, name: &str, oid: Option<u8>) -> bool {
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
    /// Which enumeration names its values.
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

/// What can be said to a micro-controller, and what it answers: its dictionary, ready for use.
#[derive(Clone, Debug, Default)]
pub struct Messages {
    commands: HashMap<String, Message>,
    responses: HashMap<i32, Message>,
    enumerations: Vec<Enumeration>,
}

impl Messages {
    /// Prepares a dictionary. Messages whose format is none are left out.
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
    pub fn has_command(&self, name: &str) -> bool {
        self.commands.contains_key(name)
    }

    /// Whether there is such a command with such a parameter.
    pub fn has_parameter(&self, command: &str, parameter: &str) -> bool {
        self.commands.get(command).is_some_and(|m| m.parameters.iter().any(|p| p.name == parameter))
    }

    /// The bytes of a command. Fails if the dictionary has no such command, if the parameters
    /// are not exactly its own, or if a value does not fit.
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
                        .ok_or_else(|| wrong(format!("`{name}` is none of the names that {} takes", parameter.name)))?;
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

    /// The bytes of a command in klippy's notation, `config_stepper oid=0 step_pin=gpio17 ...`;
    /// byte strings stand as hexadecimal digits. Fails as [`Messages::encode`] does.
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

    /// Takes the responses out of a payload. What the dictionary does not know becomes one
    /// response `#unknown` with the rest of the payload as `data`.
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

/// `pin` names the values of `pin` and of `step_pin`.
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
    if digits.len() % 2 != 0 {
        return None;
    }
    Some(digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect())
}

/// A session with a micro-controller.
#[derive(Debug)]
pub struct Client {
    link: Link,
    /// Where to open the tty again after a reset that closed it.
    path: Option<PathBuf>,
    dictionary: Dictionary,
    messages: Messages,
    inbox: VecDeque<Params>,
    shutdown: Option<String>,
    frequency_hz: f64,
    clock: Clock,
    clock_at: Instant,
}

impl Client {
    /// Opens a tty, identifies the micro-controller and finds out its clock. Tries again until
    /// `timeout`: the program may still be starting.
    pub fn connect(path: &Path, timeout: Duration) -> Result<Client, Error> {
        let until = Instant::now() + timeout;
        loop {
            let rest = until.saturating_duration_since(Instant::now());
            let result = Link::open(path, rest.min(Duration::from_secs(1)))
                .and_then(|link| Client::start(link, Some(path.to_owned())));
            match result {
                Err(Error::Io { .. } | Error::Closed { .. } | Error::Timeout { .. })
                    if Instant::now() + Duration::from_millis(50) < until =>
                {
                    std::thread::sleep(Duration::from_millis(50));
                }
                result => return result,
            }
        }
    }

    /// Identifies the micro-controller at the other end of a link and finds out its clock.
    pub fn new(link: Link) -> Result<Client, Error> {
        Client::start(link, None)
    }

    fn start(link: Link, path: Option<PathBuf>) -> Result<Client, Error> {
        let mut client = Client {
            link,
            path,
            dictionary: Dictionary::default(),
            messages: Messages::new(&before_identify()),
            inbox: VecDeque::new(),
            shutdown: None,
            frequency_hz: 0.0,
            clock: Clock::EPOCH,
            clock_at: Instant::now(),
        };
        client.identify()?;
        let uptime = client.query("get_uptime", &[], "uptime", None)?;
        let ticks = u64::from(uptime.u32("high")?) << 32 | u64::from(uptime.u32("clock")?);
        client.clock = Clock::from_ticks(ticks);
        client.clock_at = uptime.at;
        client.estimate_clock(8)?;
        Ok(client)
    }

    fn identify(&mut self) -> Result<(), Error> {
        let mut data = Vec::new();
        let until = Instant::now() + IDENTIFY_TIMEOUT;
        loop {
            if Instant::now() >= until {
                return Err(Error::Timeout {
                    waiting_for: "end of the data dictionary".to_owned(),
                    after: IDENTIFY_TIMEOUT,
                });
            }
            let offset = data.len() as u32;
            let args = [("offset", offset.into()), ("count", IDENTIFY_CHUNK.into())];
            let response = self.query("identify", &args, "identify_response", None)?;
            if response.u32("offset")? != offset {
                continue;
            }
            let chunk = response.bytes("data")?;
            if chunk.is_empty() {
                break;
            }
            data.extend_from_slice(chunk);
            if data.len() > IDENTIFY_MAX {
                return Err(Error::Dictionary { why: format!("it has over {IDENTIFY_MAX} bytes") });
            }
        }
        self.dictionary =
            Dictionary::decompress(&data).map_err(|error| Error::Dictionary { why: error.to_string() })?;
        self.messages = Messages::new(&self.dictionary);
        self.frequency_hz = self.constant("CLOCK_FREQ")?;
        if self.frequency_hz < 1.0 || !self.frequency_hz.is_finite() {
            return Err(Error::Dictionary { why: format!("CLOCK_FREQ is {}", self.frequency_hz) });
        }
        if let Ok(window) = self.constant("RECEIVE_WINDOW") {
            self.link.set_window_bytes(window as usize);
        }
        Ok(())
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// The dictionary, ready for encoding.
    pub fn messages(&self) -> &Messages {
        &self.messages
    }

    /// A constant of the dictionary that is a number. Fails if there is none.
    pub fn constant(&self, name: &str) -> Result<f64, Error> {
        let value = self.dictionary.config.get(name);
        value
            .and_then(|json| json.as_f64().or_else(|| json.as_str()?.parse().ok()))
            .ok_or_else(|| Error::Dictionary { why: format!("it has no number {name}") })
    }

    /// Ticks of the micro-controller's clock in a second.
    pub fn frequency_hz(&self) -> f64 {
        self.frequency_hz
    }

    /// A time in ticks, rounded.
    pub fn ticks(&self, seconds: f64) -> u32 {
        (seconds * self.frequency_hz).round() as u32
    }

    /// The link beneath.
    pub fn link(&mut self) -> &mut Link {
        &mut self.link
    }

    /// Sends a command. Fails as [`Messages::encode`] and [`Link::send`] do.
    pub fn send(&mut self, command: &str, args: &[(&str, Arg<'_>)]) -> Result<(), Error> {
        let payload = self.messages.encode(command, args)?;
        self.link.send(&payload)
    }

    /// Sends a command in klippy's notation. Fails as [`Messages::encode`] and
    /// [`Link::send`] do.
    pub fn send_line(&mut self, line: &str) -> Result<(), Error> {
        let payload = self.messages.encode_line(line)?;
        self.link.send(&payload)
    }

    /// Sends encoded commands in order, as many to a block as fit.
    pub fn send_encoded(&mut self, commands: &[Vec<u8>]) -> Result<(), Error> {
        let mut block = Vec::new();
        for command in commands {
            if block.len() + command.len() > crate::wire::block::PAYLOAD_MAX && !block.is_empty() {
                self.link.send(&block)?;
                block.clear();
            }
            block.extend_from_slice(command);
        }
        if block.is_empty() {
            return Ok(());
        }
        self.link.send(&block)
    }

    /// Sends a command and waits for its response, of this `oid` if one is given; sends again
    /// if none comes. Fails with [`Error::Shutdown`] if the micro-controller shuts down
    /// meanwhile or refuses the command because it is shut down.
    pub fn query(
        &mut self,
        command: &str,
        args: &[(&str, Arg<'_>)],
        response: &str,
        oid: Option<u8>,
    ) -> Result<Params, Error> {
        let payload = self.messages.encode(command, args)?;
        self.inbox.retain(|params| !params.is(response, oid));
        let known = self.shutdown.take();
        let until = Instant::now() + QUERY_TIMEOUT;
        let result = self.ask(&payload, response, oid, until);
        if self.shutdown.is_none() {
            self.shutdown = known;
        }
        result?.ok_or_else(|| Error::Timeout {
            waiting_for: format!("`{response}` in answer to `{command}`"),
            after: QUERY_TIMEOUT,
        })
    }

    fn ask(
        &mut self,
        payload: &[u8],
        response: &str,
        oid: Option<u8>,
        until: Instant,
    ) -> Result<Option<Params>, Error> {
        while Instant::now() < until {
            self.link.send(payload)?;
            let again = until.min(Instant::now() + RETRY);
            if let Some(params) = self.wait(response, oid, again)? {
                return Ok(Some(params));
            }
        }
        Ok(None)
    }

    /// The oldest response of this name, and of this `oid` if one is given; waits for one,
    /// `None` if none comes in time. Fails with [`Error::Shutdown`] if the micro-controller
    /// is shut down.
    pub fn wait(&mut self, response: &str, oid: Option<u8>, until: Instant) -> Result<Option<Params>, Error> {
        loop {
            if let Some(params) = self.take(response, oid) {
                return Ok(Some(params));
            }
            self.check()?;
            match self.link.receive(until)? {
                // However much else comes in, the time is limited.
                Some(received) => self.file(&received),
                None => return Ok(None),
            }
            if Instant::now() >= until {
                return Ok(self.take(response, oid));
            }
        }
    }

    /// The oldest response of this name, and of this `oid` if one is given, among those that
    /// came in; waits for nothing.
    pub fn take(&mut self, response: &str, oid: Option<u8>) -> Option<Params> {
        let at = self.inbox.iter().position(|p| p.is(response, oid))?;
        self.inbox.remove(at)
    }

    /// Reads what comes in until then, for a later [`Client::take`]. Fails with
    /// [`Error::Shutdown`] if the micro-controller is shut down.
    pub fn listen(&mut self, until: Instant) -> Result<(), Error> {
        while let Some(received) = self.link.receive(until)? {
            self.file(&received);
            if Instant::now() >= until {
                break;
            }
        }
        self.check()
    }

    /// All responses that came in and that nobody took.
    pub fn drain(&mut self) -> Vec<Params> {
        self.inbox.drain(..).collect()
    }

    /// Fails with [`Error::Shutdown`] if the micro-controller said that it is shut down.
    pub fn check(&self) -> Result<(), Error> {
        match &self.shutdown {
            Some(reason) => Err(Error::Shutdown { reason: reason.clone() }),
            None => Ok(()),
        }
    }

    /// Waits until the micro-controller says that it is shut down, and why; `None` if it does
    /// not in time.
    pub fn wait_shutdown(&mut self, timeout: Duration) -> Result<Option<String>, Error> {
        let until = Instant::now() + timeout;
        while self.shutdown.is_none() {
            match self.link.receive(until)? {
                Some(received) => self.file(&received),
                None => break,
            }
            if Instant::now() >= until {
                break;
            }
        }
        Ok(self.shutdown.clone())
    }

    /// Forgets a shutdown that the micro-controller reported.
    pub(super) fn forget_shutdown(&mut self) {
        self.shutdown = None;
    }

    /// Opens the tty again and starts over; over a descriptor, only the dictionary and the
    /// clock are read again.
    pub(super) fn reconnect(&mut self, timeout: Duration) -> Result<(), Error> {
        match self.path.clone() {
            Some(path) => *self = Client::connect(&path, timeout)?,
            None => {
                self.forget_shutdown();
                self.inbox.clear();
                self.messages = Messages::new(&before_identify());
                self.identify()?;
                self.estimate_clock(8)?;
            }
        }
        Ok(())
    }

    fn file(&mut self, received: &Received) {
        for params in self.messages.decode(received) {
            if params.name == "shutdown" || params.name == "is_shutdown" {
                let reason = params.text("static_string_id").unwrap_or_default();
                self.shutdown = Some(reason);
            }
            if self.inbox.len() >= INBOX_MAX {
                self.inbox.pop_front();
            }
            self.inbox.push_back(params);
        }
    }

    /// Renews the clock's estimate: of several round trips the shortest counts.
    pub fn estimate_clock(&mut self, round_trips: u32) -> Result<(), Error> {
        let mut best: Option<(Duration, Instant, u32)> = None;
        for _ in 0..round_trips.max(1) {
            let sent = Instant::now();
            let response = self.query("get_clock", &[], "clock", None)?;
            let took = response.at.saturating_duration_since(sent);
            if best.is_none_or(|(least, ..)| took < least) {
                best = Some((took, sent + took / 2, response.u32("clock")?));
            }
        }
        if let Some((_, at, wire)) = best {
            self.clock = Clock::widen(wire, self.clock_at_instant(at));
            self.clock_at = at;
        }
        Ok(())
    }

    /// The micro-controller's clock at an instant of ours, as estimated.
    pub fn clock_at_instant(&self, at: Instant) -> Clock {
        let ticks = |span: Duration| (span.as_secs_f64() * self.frequency_hz) as i64;
        let since = match at.checked_duration_since(self.clock_at) {
            Some(span) => ticks(span),
            None => -ticks(self.clock_at.saturating_duration_since(at)),
        };
        Clock::from_ticks(self.clock.ticks().saturating_add_signed(since))
    }

    /// Our instant at which the micro-controller's clock shows `clock`, as estimated.
    pub fn instant_of(&self, clock: Clock) -> Instant {
        let seconds = clock.since(self.clock) as f64 / self.frequency_hz;
        let span = Duration::try_from_secs_f64(seconds.abs()).unwrap_or_default();
        let instant = if seconds < 0.0 { self.clock_at.checked_sub(span) } else { self.clock_at.checked_add(span) };
        instant.unwrap_or(self.clock_at)
    }

    /// The micro-controller's clock so many seconds from now. Renews an old estimate.
    pub fn clock_in(&mut self, seconds: f64) -> Result<Clock, Error> {
        if self.clock_at.elapsed() > CLOCK_AGE {
            self.estimate_clock(2)?;
        }
        let now = self.clock_at_instant(Instant::now()).ticks();
        let ahead = (seconds * self.frequency_hz) as i64;
        Ok(Clock::from_ticks(now.saturating_add_signed(ahead)))
    }

    /// The instant nearest to the present whose 32 bits are `wire`.
    pub fn widen(&self, wire: u32) -> Clock {
        Clock::widen(wire, self.clock_at_instant(Instant::now()))
    }
}

/// What a host knows before it has read a dictionary.
fn before_identify() -> Dictionary {
    let entry = |format: &str, id: i32| Map::from_iter([(format.to_owned(), Json::from(id))]);
    Dictionary {
        commands: entry("identify offset=%u count=%c", IDENTIFY_ID),
        responses: entry("identify_response offset=%u data=%.*s", IDENTIFY_RESPONSE_ID),
        ..Dictionary::default()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::super::fake::{self, Mcu};
    use super::*;

    fn received(payload: &[u8]) -> Received {
        Received { payload: payload.to_vec(), at: Instant::now() }
    }

    #[test]
    fn a_dictionary_is_read_and_a_query_answered() {
        let (peer, link) = Mcu::default().start();
        let mut client = Client::new(link).unwrap();
        assert_eq!(client.dictionary().version, "fake");
        assert_eq!(client.frequency_hz(), 50e6);
        let args = [("oid", 7u8.into())];
        let state = client.query("endstop_query_state", &args, "endstop_state", Some(7)).unwrap();
        assert_eq!(state.int("pin_value").unwrap(), 1);
        assert!(state.int("nothing").is_err());
        // The fake clock stands at 2^32 + 5.
        assert_eq!(client.widen(5).ticks() & 0xffff_ffff, 5);
        assert!(client.clock_in(0.0).unwrap().ticks() >= 1 << 32);
        drop(client);
        peer.join().unwrap();
    }

    #[test]
    fn a_shutdown_carries_the_firmware_s_text() {
        let (peer, link) = Mcu::default().start();
        let mut client = Client::new(link).unwrap();
        client.check().unwrap();
        let reason = client.emergency_stop().unwrap();
        assert_eq!(reason.as_deref(), Some("Command request"));
        let error = client.check().unwrap_err();
        assert!(error.to_string().starts_with("the MCU shut down: Command request;"), "{error}");
        assert!(client.wait("nothing", None, Instant::now()).is_err());
        drop(client);
        peer.join().unwrap();
    }

    #[test]
    fn pins_are_named_singly_and_in_runs() {
        let messages = Messages::new(&fake::dictionary());
        let encode = |pin: &str| {
            messages
                .encode("config_endstop", &[("oid", 0.into()), ("pin", pin.into()), ("pull_up", (-1i8 as i32).into())])
        };
        // config_endstop has the id 5; -1 is one byte.
        assert_eq!(encode("gpio17").unwrap(), [5, 0, 17, 0x7f]);
        assert_eq!(encode("gpiochip1/gpio2").unwrap(), [5, 0, 0x82, 0x22, 0x7f]);
        assert_eq!(encode("GPIO17").unwrap(), [5, 0, 17, 0x7f]);
        for wrong in ["gpio288", "gpio017", "gpio", "gpio-1", "gpio99999999999", "17x", ""] {
            let error = encode(wrong).unwrap_err().to_string();
            assert!(error.contains("none of the names that pin takes"), "{error}");
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
        let (peer, link) = Mcu::identifying(vec![1, 2, 3]).start();
        let error = Client::new(link).unwrap_err().to_string();
        assert!(error.starts_with("the MCU's data dictionary is unusable"), "{error}");
        peer.join().unwrap();
    }
}
