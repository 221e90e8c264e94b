// SPDX-License-Identifier: GPL-3.0-or-later
//! The status of a running Pinion: the document on its socket.
//!
//! The server fills it in (`runtime/status`). `pinion status` reads it, and prints it as a page, as JSON
//! or as metrics (`cli/status`). The field names are the keys of the JSON. Other programs rely on them, so no
//! field is renamed, moved or removed. Add a field with `#[serde(default)]`: a running Pinion may be older
//! than the command that asks it.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Version of the document's form. A new field does not change it.
pub const FORM: u32 = 1;

/// The status of a running Pinion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// [`FORM`].
    pub form: u32,
    /// Version of the build (`PINION_VERSION`).
    pub version: String,
    /// The process.
    pub pid: u32,
    /// Seconds since its start.
    pub uptime_s: f64,
    /// The symbolic link that the host opens.
    pub link: String,
    /// The pty behind the link.
    pub terminal: String,
    /// Description of the board.
    pub board: String,
    /// The MCU's.
    pub state: State,
    /// The process at the other end.
    pub host: Host,
    /// The process that watches this one.
    pub guardian: Guardian,
    /// The flight recorder. An older Pinion has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorder: Option<RecorderStatus>,
    /// `None` if the core has not answered in time. Then `state` is [`State::Unknown`].
    #[serde(flatten)]
    pub mcu: Option<McuStatus>,
}

/// The flight recorder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecorderStatus {
    /// Highest number of bytes of memory that it takes.
    pub bytes: usize,
    /// The folder that takes the traces; `None` if none are kept.
    pub folder: Option<String>,
}

/// State of the MCU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// The core has not answered in time.
    Unknown,
    /// No host has begun to configure it.
    Waiting,
    /// A host has begun to configure it.
    Configuring,
    /// A host has configured it.
    Configured,
    /// It is shut down.
    Shutdown,
}

impl State {
    /// All states.
    pub const ALL: [State; 5] =
        [State::Unknown, State::Waiting, State::Configuring, State::Configured, State::Shutdown];

    /// Its name in the document.
    pub fn name(self) -> &'static str {
        match self {
            State::Unknown => "unknown",
            State::Waiting => "waiting",
            State::Configuring => "configuring",
            State::Configured => "configured",
            State::Shutdown => "shutdown",
        }
    }
}

/// The host that has the terminal open.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Host {
    /// Whether a host has the terminal open.
    pub attached: bool,
    /// Its process, if it was found.
    pub pid: Option<u32>,
    /// Whether this process is the host for certain.
    pub sure: Option<bool>,
    /// The checkout that it runs from, if it is a klippy whose sources can be read.
    pub checkout: Option<String>,
    /// The checkout's commit.
    pub commit: Option<String>,
}

/// The process that drives the outputs to their shutdown values if this Pinion dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Guardian {
    /// Whether there is one.
    pub present: bool,
    /// Its process.
    pub pid: Option<u32>,
}

/// The MCU's part, from the core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct McuStatus {
    /// Present in [`State::Shutdown`].
    pub shutdown: Option<Stop>,
    /// The output that is not at its shutdown value yet.
    pub owes: Option<String>,
    /// Name of the dialect in use.
    pub dialect: Option<String>,
    /// All lines in use.
    pub lines: Vec<Line>,
    /// All objects, in the order of their numbers.
    pub objects: Vec<Object>,
    /// How late timers ran.
    pub lateness: Lateness,
    /// How full the queues are.
    pub queues: Queues,
}

/// Why and when the MCU shut down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stop {
    /// Klipper's text, which the host gets.
    pub reason: String,
    /// Cause and remedy, as the log has them.
    pub detail: String,
    /// Seconds since then.
    pub ago_s: f64,
}

/// A GPIO line in use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Line {
    /// Name of the pin.
    pub pin: String,
    /// Its purpose.
    #[serde(rename = "use")]
    pub use_: Use,
    /// 0 or 1, as last driven or sampled; `None` before the first sample.
    pub level: Option<u8>,
    /// Whether it is written and read through the chip's registers. Absent if it is not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub fast: bool,
    /// Transfers of its chip, if it is a line of an expander.
    pub bus: Option<BusCounts>,
}

/// The use of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Use {
    /// The line is driven.
    Output,
    /// The line is read.
    Input,
    /// The line is pulled low or released.
    #[serde(rename = "open drain")]
    OpenDrain,
}

impl Use {
    /// Its name in the document.
    pub fn name(self) -> &'static str {
        match self {
            Use::Output => "output",
            Use::Input => "input",
            Use::OpenDrain => "open drain",
        }
    }
}

/// An object that the host configured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// The host's number for it; `None` for lines that belong to no object.
    pub oid: Option<u8>,
    /// Its name for people.
    pub kind: String,
    /// Name of its pin.
    pub pin: Option<String>,
    /// How many changes or moves it has queued.
    pub queued: usize,
    /// Its value now, if it has one.
    pub value: Option<Present>,
    /// Its device fails, and its last answers are repeated.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub repeats: bool,
    /// Transfers to its chip, if it has one on a bus.
    pub bus: Option<BusCounts>,
}

/// Present value of an object.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Present {
    /// Last sample of an ADC, 0 to 1.
    Adc(f64),
    /// Share of each period that a PWM output is on, 0 to 1.
    Duty(f64),
    /// Position of a stepper in steps.
    Steps(i32),
}

/// Transfers since the device was configured. The counts wrap around.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BusCounts {
    /// All transfers.
    pub transfers: u32,
    /// Failed transfers.
    pub errors: u32,
    /// Failed transfers that were retried.
    pub retries: u32,
}

/// How late timers ran since the start, in microseconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lateness {
    /// How many timers ran.
    pub timers: u64,
    /// Half of the timers were at most this late.
    pub p50_us: f64,
    /// 99 of 100.
    pub p99_us: f64,
    /// 999 of 1000.
    pub p999_us: f64,
    /// All.
    pub max_us: f64,
    /// How early the core wakes for a timer.
    pub margin_us: f64,
    /// Largest value and count of each bucket that holds timers.
    pub buckets_us: Vec<(f64, u64)>,
}

/// The queues.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Queues {
    /// The moves that wait for their steppers and outputs.
    pub moves: MoveQueue,
    /// The commands that wait for the core.
    pub commands: CommandQueue,
    /// The jobs that wait for each bus.
    pub workers: Vec<WorkerQueue>,
}

/// The move queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MoveQueue {
    /// Moves in it.
    pub waiting: u16,
    /// Moves that it can hold.
    pub size: u16,
}

/// Blocks of commands that wait for the core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandQueue {
    /// Blocks in it.
    pub waiting: usize,
    /// Blocks that it can hold.
    pub size: usize,
    /// Whether they wait for a bus.
    pub held: bool,
}

/// Jobs that wait for a bus.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerQueue {
    /// Name of the bus.
    pub name: String,
    /// Jobs in it.
    pub waiting: usize,
}

/// Reads a document. Returns the status, and the paths of the fields in it that this version does not know.
///
/// # Errors
///
/// It is not JSON, or a field is missing or has another type. The error names the field.
pub fn read(document: &[u8]) -> serde_json::Result<(Status, Vec<String>)> {
    let sent: Value = serde_json::from_slice(document)?;
    let status = Status::deserialize(&sent)?;
    if status.mcu.is_none() && status.state != State::Unknown {
        // serde makes `None` of a flattened struct that it cannot read. This gives the reason.
        McuStatus::deserialize(&sent)?;
    }
    let mut unknown = Vec::new();
    list_unknown(&sent, &serde_json::to_value(&status)?, "", &mut unknown);
    Ok((status, unknown))
}

/// Lists the paths of the fields that were sent and are not known.
fn list_unknown(sent: &Value, known: &Value, path: &str, unknown: &mut Vec<String>) {
    match (sent, known) {
        (Value::Object(sent), Value::Object(known)) => {
            for (key, value) in sent {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                match known.get(key) {
                    Some(known) => list_unknown(value, known, &path, unknown),
                    None => unknown.push(path),
                }
            }
        }
        // The elements of a list are alike: each field is listed once.
        (Value::Array(sent), Value::Array(known)) => {
            let before = unknown.len();
            sent.iter().zip(known).for_each(|(sent, known)| list_unknown(sent, known, path, unknown));
            let mut unshown = unknown.split_off(before);
            unshown.sort();
            unshown.dedup();
            unknown.append(&mut unshown);
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// The status of a Pinion 0.1.0, recorded before the status was a type.
    const RECORDED: &str = include_str!("recorded.json");

    fn recorded() -> Status {
        read(RECORDED.as_bytes()).unwrap().0
    }

    #[test]
    fn a_document_of_before_is_read_whole_and_written_the_same() {
        let sent: Value = serde_json::from_str(RECORDED).unwrap();
        let (status, unknown) = read(RECORDED.as_bytes()).unwrap();
        assert_eq!(unknown, [""; 0]);
        assert_eq!(serde_json::to_value(&status).unwrap(), sent);
        // Keys in the same order, numbers in the same form.
        assert_eq!(serde_json::to_string(&status).unwrap(), sent.to_string());
        assert!(status.mcu.is_some());
    }

    #[test]
    fn a_core_that_did_not_answer_leaves_its_part_out() {
        let status = Status { state: State::Unknown, mcu: None, ..recorded() };
        let document = serde_json::to_string(&status).unwrap();
        assert!(document.contains("\"state\":\"unknown\"") && !document.contains("lines"), "{document}");
        assert_eq!(read(document.as_bytes()).unwrap(), (status, vec![]));
    }

    #[test]
    fn names_are_those_of_the_document() {
        for state in State::ALL {
            assert_eq!(json!(state), state.name());
        }
        for use_ in [Use::Output, Use::Input, Use::OpenDrain] {
            assert_eq!(json!(use_), use_.name());
        }
    }

    /// Every object in a document, by its path.
    fn objects(value: &Value, path: &str, found: &mut Vec<String>) {
        if value.is_object() {
            found.push(path.to_owned());
        }
        let children: Vec<(String, &Value)> = match value {
            Value::Object(fields) => fields.iter().map(|(key, value)| (key.clone(), value)).collect(),
            Value::Array(items) => items.iter().enumerate().map(|(n, value)| (n.to_string(), value)).collect(),
            _ => vec![],
        };
        children.iter().for_each(|(key, value)| objects(value, &format!("{path}/{key}"), found));
    }

    #[test]
    fn a_field_that_is_missing_or_of_another_type_is_named() {
        let sent: Value = serde_json::from_str(RECORDED).unwrap();
        let mut paths = Vec::new();
        objects(&sent, "", &mut paths);
        for path in paths {
            for (key, value) in sent.pointer(&path).and_then(Value::as_object).unwrap() {
                let without = |document: &mut Value| {
                    document.pointer_mut(&path).unwrap().as_object_mut().unwrap().shift_remove(key)
                };
                let mut renamed = sent.clone();
                without(&mut renamed);
                renamed.pointer_mut(&path).unwrap()["typo"] = value.clone();
                match read(renamed.to_string().as_bytes()) {
                    // An object's value has one of three names.
                    Err(error) if path.ends_with("/value") => assert!(error.to_string().contains("typo"), "{error}"),
                    Err(error) => assert!(error.to_string().contains(&format!("missing field `{key}`")), "{error}"),
                    Ok((_, unknown)) => assert!(unknown.iter().any(|path| path.ends_with("typo")), "{path} {key}"),
                }
                let mut wrong = sent.clone();
                wrong.pointer_mut(&path).unwrap()[key] = json!([["no field is of this type"]]);
                assert!(read(wrong.to_string().as_bytes()).is_err(), "{path} {key}");
            }
        }
    }

    #[test]
    fn a_field_that_is_not_known_is_named_once() {
        let mut sent: Value = serde_json::from_str(RECORDED).unwrap();
        sent["colour"] = json!("red");
        sent["host"]["user"] = json!({ "name": "pi" });
        sent["lines"].as_array_mut().unwrap().iter_mut().for_each(|line| line["bias"] = json!("up"));
        let (status, mut unknown) = read(sent.to_string().as_bytes()).unwrap();
        unknown.sort();
        assert_eq!((status, unknown), (recorded(), ["colour", "host.user", "lines.bias"].map(str::to_owned).to_vec()));
    }
}
