// SPDX-License-Identifier: GPL-3.0-or-later
//! The status of a running Pinion: the document on its socket.
//!
//! The server fills it in (`runtime/status`). `pinion status` reads it, and prints it as a page, as JSON
//! or as metrics (`cli/status`). The field names are the keys of the JSON. Other programs rely on them, so no
//! field is renamed, moved or removed. Add a field with `#[serde(default)]`: a running Pinion may be older
//! than the command that asks it.

#![forbid(unsafe_code)]

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Version of the document's form. A new field does not change it.
pub(crate) const FORM: u32 = 1;

/// The status of a running Pinion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Status {
    /// [`FORM`].
    pub(crate) form: u32,
    /// Version of the build (`PINION_VERSION`).
    pub(crate) version: String,
    /// The process.
    pub(crate) pid: u32,
    pub(crate) uptime_s: f64,
    /// The symbolic link that the host opens.
    pub(crate) link: String,
    /// The pty behind the link.
    pub(crate) terminal: String,
    /// Description of the board.
    pub(crate) board: String,
    pub(crate) state: State,
    pub(crate) host: Host,
    pub(crate) guardian: Guardian,
    /// The flight recorder. An older Pinion has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) recorder: Option<Recorder>,
    /// `None` if the core has not answered in time. Then `state` is [`State::Unknown`].
    #[serde(flatten)]
    pub(crate) mcu: Option<McuStatus>,
}

/// The flight recorder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Recorder {
    /// Highest number of bytes of memory that it takes.
    pub(crate) bytes: usize,
    /// The folder that takes the traces; `None` if none are kept.
    pub(crate) folder: Option<String>,
}

/// State of the MCU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum State {
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
    pub(crate) const ALL: [State; 5] =
        [State::Unknown, State::Waiting, State::Configuring, State::Configured, State::Shutdown];

    /// Its name in the document.
    pub(crate) fn name(self) -> &'static str {
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
pub(crate) struct Host {
    /// Whether a host has the terminal open.
    pub(crate) attached: bool,
    /// Its process, if it was found.
    pub(crate) pid: Option<u32>,
    /// Whether this process is the host for certain.
    pub(crate) sure: Option<bool>,
    /// The checkout that it runs from, if it is a klippy whose sources can be read.
    pub(crate) checkout: Option<String>,
    /// The checkout's commit.
    pub(crate) commit: Option<String>,
}

/// The process that drives the outputs to their shutdown values if this Pinion dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Guardian {
    pub(crate) present: bool,
    pub(crate) pid: Option<u32>,
}

/// The MCU's part, from the core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct McuStatus {
    /// Present in [`State::Shutdown`].
    pub(crate) shutdown: Option<Stop>,
    /// The output that is not at its shutdown value yet.
    pub(crate) owes: Option<String>,
    /// Name of the dialect in use.
    pub(crate) dialect: Option<String>,
    pub(crate) lines: Vec<Line>,
    pub(crate) objects: Vec<Object>,
    pub(crate) lateness: Lateness,
    pub(crate) queues: Queues,
}

/// Why and when the MCU shut down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stop {
    /// The firmware's text, which the host gets.
    pub(crate) reason: String,
    /// Cause and remedy, as the log has them.
    pub(crate) detail: String,
    pub(crate) ago_s: f64,
}

/// A GPIO line in use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Line {
    /// Name of the pin.
    pub(crate) pin: String,
    #[serde(rename = "use")]
    pub(crate) use_: Use,
    /// 0 or 1, as last driven or sampled; `None` before the first sample.
    pub(crate) level: Option<u8>,
    /// Whether it is written and read through the chip's registers. Absent if it is not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) fast: bool,
    /// Transfers of its chip, if it is a line of an expander.
    pub(crate) bus: Option<BusCounts>,
}

/// The use of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Use {
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
    pub(crate) fn name(self) -> &'static str {
        match self {
            Use::Output => "output",
            Use::Input => "input",
            Use::OpenDrain => "open drain",
        }
    }
}

/// An object that the host configured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Object {
    /// The host's number for it; `None` for lines that belong to no object.
    pub(crate) oid: Option<u8>,
    /// Its name for people.
    pub(crate) kind: String,
    /// Name of its pin.
    pub(crate) pin: Option<String>,
    /// How many changes or moves it has queued.
    pub(crate) queued: usize,
    pub(crate) value: Option<Present>,
    /// Transfers to its chip, if it has one on a bus.
    pub(crate) bus: Option<BusCounts>,
}

/// Present value of an object.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Present {
    /// Last sample of an ADC, 0 to 1.
    Adc(f64),
    /// Share of each period that a PWM output is on, 0 to 1.
    Duty(f64),
    /// Position of a stepper in steps.
    Steps(i32),
}

/// Transfers since the device was configured. The counts wrap around.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct BusCounts {
    /// All transfers.
    pub(crate) transfers: u32,
    /// Failed transfers.
    pub(crate) errors: u32,
    /// Failed transfers that were retried.
    pub(crate) retries: u32,
}

/// How late timers ran since the start, in microseconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Lateness {
    /// How many timers ran.
    pub(crate) timers: u64,
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    pub(crate) p999_us: f64,
    pub(crate) max_us: f64,
    /// How early the core wakes for a timer.
    pub(crate) margin_us: f64,
    /// Largest value and count of each bucket that holds timers.
    pub(crate) buckets_us: Vec<(f64, u64)>,
}

/// The queues.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Queues {
    pub(crate) moves: MoveQueue,
    pub(crate) commands: CommandQueue,
    pub(crate) workers: Vec<WorkerQueue>,
}

/// The move queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct MoveQueue {
    pub(crate) waiting: u16,
    pub(crate) size: u16,
}

/// Blocks of commands that wait for the core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct CommandQueue {
    pub(crate) waiting: usize,
    pub(crate) size: usize,
    /// Whether they wait for a bus.
    pub(crate) held: bool,
}

/// Jobs that wait for a bus.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct WorkerQueue {
    /// Name of the bus.
    pub(crate) name: String,
    pub(crate) waiting: usize,
}

/// Reads a document. Returns the status, and the paths of the fields in it that this version does not know.
///
/// # Errors
///
/// It is not JSON, or a field is missing or has another type. The error names the field.
pub(crate) fn read(document: &[u8]) -> serde_json::Result<(Status, Vec<String>)> {
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
            let mut told = unknown.split_off(before);
            told.sort();
            told.dedup();
            unknown.append(&mut told);
        }
        _ => {}
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use serde_json::json;

    /// The status of a Pinion 0.1.0, recorded before the status was a type.
    const RECORDED: &str = include_str!("status/recorded.json");

    pub(crate) fn recorded() -> Status {
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
