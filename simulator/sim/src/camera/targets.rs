// SPDX-License-Identifier: GPL-3.0-or-later
//! The temperatures that the host wants. An MCU does not know them: it only switches heaters. klippy's API server does.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::own_status::OwnStatus;
use pinion_runtime::klippy::process;

/// Time between two questions.
const PERIOD: Duration = Duration::from_secs(1);
/// Time limit for an answer.
const ANSWER_TIME: Duration = Duration::from_secs(2);
/// Longest answer, in bytes.
const ANSWER_MAX: usize = 64 * 1024;
/// klippy's end of a message.
const END: u8 = 3;
/// The sections of printer.cfg that may have a heater or a fan with a target, in front of its name.
const SECTIONS: [&str; 3] = ["", "heater_generic ", "temperature_fan "];

/// The targets by the heaters' names, a moment ago.
#[derive(Clone, Default)]
pub(super) struct Targets(Arc<Mutex<BTreeMap<String, f64>>>);

impl Targets {
    /// Asks the host of this MCU from now on, if it has an API server.
    pub(super) fn start(own: OwnStatus, heaters: Vec<String>) -> io::Result<Targets> {
        let targets = Targets::default();
        let known = targets.clone();
        thread::Builder::new().name("camera targets".into()).spawn(move || {
            // klippy logs each connection, so one is kept.
            let mut api: Option<(u32, UnixStream)> = None;
            loop {
                let host = own.host();
                api = api.filter(|(pid, _)| Some(*pid) == host).or_else(|| Some((host?, connect(host?)?)));
                let asked = api.as_ref().map(|(_, socket)| ask(socket, &heaters));
                let found = asked.transpose().unwrap_or_else(|error| {
                    log::debug!("klippy's API server: {error}");
                    api = None;
                    None
                });
                *known.0.lock().unwrap_or_else(PoisonError::into_inner) = found.unwrap_or_default();
                thread::sleep(PERIOD);
            }
        })?;
        Ok(targets)
    }

    /// The target of a heater; `None` if it is unknown, or the heater is off.
    pub(super) fn of(&self, heater: &str) -> Option<f64> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(heater).copied()
    }
}

/// The API server of this process, if it is klippy with one.
fn connect(pid: u32) -> Option<UnixStream> {
    let proc = Path::new("/proc");
    let path = process::of(proc, pid)?.klippy_api(proc)?;
    pinion_runtime::status::connect(&path).ok().filter(|socket| socket.set_nonblocking(false).is_ok())
}

/// Asks klippy for the targets of these heaters.
fn ask(socket: &UnixStream, heaters: &[String]) -> io::Result<BTreeMap<String, f64>> {
    let names = heaters.iter().flat_map(|name| SECTIONS.map(|section| format!("{section}{name}")));
    let objects: BTreeMap<String, [&str; 1]> = names.map(|name| (name, ["target"])).collect();
    let question = json!({ "id": 1, "method": "objects/query", "params": { "objects": objects } });
    let mut message = question.to_string().into_bytes();
    message.push(END);
    let until = Instant::now() + ANSWER_TIME;
    socket.set_write_timeout(Some(ANSWER_TIME))?;
    let mut socket = socket;
    socket.write_all(&message)?;
    let (mut answer, mut piece) = (Vec::new(), [0; 4096]);
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() || answer.len() > ANSWER_MAX {
            return Err(io::ErrorKind::TimedOut.into());
        }
        socket.set_read_timeout(Some(left))?;
        match socket.read(&mut piece)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            read => answer.extend_from_slice(&piece[..read]),
        }
        if let Some(end) = answer.iter().position(|byte| *byte == END) {
            return Ok(targets(&answer[..end], heaters));
        }
    }
}

/// The targets in klippy's answer. klippy answers with an error while it is not ready.
fn targets(answer: &[u8], heaters: &[String]) -> BTreeMap<String, f64> {
    let answer: Value = serde_json::from_slice(answer).unwrap_or_default();
    let status = &answer["result"]["status"];
    let target = |name: &String| {
        let found = SECTIONS.iter().find_map(|section| status[format!("{section}{name}")]["target"].as_f64());
        Some((name.clone(), found.filter(|celsius| *celsius > 0.0)?))
    };
    heaters.iter().filter_map(target).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_found_in_each_section_and_none_is_made_up() {
        let heaters = ["extruder", "heater_bed", "chamber", "exhaust"].map(str::to_owned);
        let answer = br#"{"id":1,"result":{"eventtime":5.1,"status":{"extruder":{"target":210.0},
            "heater_bed":{"target":0.0},"chamber":{},"heater_generic chamber":{"target":45.5},
            "temperature_fan exhaust":{"target":null}}}}"#;
        let found = targets(answer, &heaters);
        assert_eq!(found, BTreeMap::from([("extruder".to_owned(), 210.0), ("chamber".to_owned(), 45.5)]));
        for other in [&b"{"[..], b"", b"[]", br#"{"id":1,"error":{"message":"not ready"}}"#] {
            assert!(targets(other, &heaters).is_empty());
        }
    }

    #[test]
    fn a_server_that_says_nothing_or_too_much_is_given_up() {
        let heaters = ["extruder".to_owned()];
        let (ours, mut server) = UnixStream::pair().unwrap();
        server.write_all(b"{\"id\":1,\"result\":{\"status\":{\"extruder\":{\"target\":60}}}}\x03").unwrap();
        assert_eq!(ask(&ours, &heaters).unwrap(), BTreeMap::from([("extruder".to_owned(), 60.0)]));
        server.write_all(&vec![b' '; ANSWER_MAX + 4096]).unwrap();
        assert!(ask(&ours, &heaters).is_err());
        drop(server);
        assert!(ask(&ours, &heaters).is_err());
    }
}
