// SPDX-License-Identifier: GPL-3.0-or-later
//! Asks Moonraker, the server beside klippy, whether a print runs, and has it restart klippy and run a command.
//!
//! A request is one connection of HTTP/1.0, so its answer ends with the connection. No library does less than this.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

/// How long Moonraker may take to accept a connection. It runs on this computer.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// How long an answer may take. A restart answers at once, and a measurement after some seconds.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);
/// How long klippy may take to start. After 90 s it says itself which MCU does not answer.
const START_TIMEOUT: Duration = Duration::from_secs(120);
/// Longest answer that is read. The console's last lines have some kilobytes.
const ANSWER_MAX: u64 = 4 << 20;
/// How often klippy's state is asked while it starts.
const POLL: Duration = Duration::from_millis(100);
/// How long Moonraker may take from its start until it knows klippy's requests.
const REGISTER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long klippy may take until it has left its old state.
pub(super) const LEAVE_TIMEOUT: Duration = Duration::from_secs(3);

/// A command or a section's name in a URL.
fn encoded(text: &str) -> String {
    text.replace(' ', "%20").replace('"', "%22")
}

/// A Moonraker.
pub(super) struct Moonraker<'a>(pub(super) &'a str);

/// The state of the host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Host {
    /// A print runs or is paused.
    Prints,
    /// No print runs.
    Rests,
    /// Moonraker does not say: why.
    Unknown(String),
}

impl Moonraker<'_> {
    /// The present state of the host.
    pub(super) fn host(&self) -> Host {
        let end = Instant::now() + REGISTER_TIMEOUT;
        let answer = loop {
            match self.ask("GET", "/printer/objects/query?print_stats&idle_timeout") {
                Ok(answer) => break answer,
                // Moonraker's answer while klippy is not connected: nothing prints.
                Err(Refused { status: Some(503), .. }) => return Host::Rests,
                // It has just started, and does not know klippy's requests yet.
                Err(Refused { status: Some(404), .. }) if Instant::now() < end => thread::sleep(POLL),
                Err(Refused { why, .. }) => return Host::Unknown(why),
            }
        };
        let status = &answer["result"]["status"];
        let is = |object: &str, states: &[&str]| {
            status[object]["state"].as_str().is_some_and(|state| states.contains(&state))
        };
        match is("print_stats", &["printing", "paused"]) || is("idle_timeout", &["Printing"]) {
            true => Host::Prints,
            false if status.is_object() => Host::Rests,
            false => Host::Unknown("Moonraker's answer has no status".into()),
        }
    }

    /// Restarts klippy with its MCUs, and waits until it is ready. It leaves its old state within `leave_timeout`.
    ///
    /// # Errors
    ///
    /// One line: Moonraker's or klippy's own words.
    pub(super) fn restart(&self, leave_timeout: Duration) -> Result<(), String> {
        self.ask("POST", "/printer/firmware_restart").map_err(|refused| refused.why)?;
        let asked = Instant::now();
        let mut was_away = false;
        loop {
            thread::sleep(POLL);
            let info = self.ask("GET", "/printer/info");
            let state = info.as_ref().map_or("", |info| info["result"]["state"].as_str().unwrap_or_default());
            was_away |= !["ready", "error", "shutdown"].contains(&state);
            // The first answers may still be from before the restart.
            let is_new = was_away || asked.elapsed() >= leave_timeout;
            match state {
                "ready" if is_new => return Ok(()),
                "error" | "shutdown" if is_new => {
                    let message = info.as_ref().ok().and_then(|info| info["result"]["state_message"].as_str());
                    let message = message.and_then(|message| message.lines().next()).unwrap_or("see klippy.log");
                    return Err(format!("klippy says: {message}"));
                }
                _ if asked.elapsed() < START_TIMEOUT => {}
                _ => return Err("klippy is not ready after two minutes: see klippy.log".into()),
            }
        }
    }

    /// Runs a command, and returns what klippy has answered.
    ///
    /// # Errors
    ///
    /// One line: Moonraker's or klippy's own words.
    pub(super) fn run(&self, command: &str) -> Result<Vec<String>, String> {
        let lines = |store: &Value| -> Vec<(f64, String)> {
            let entries = store["result"]["gcode_store"].as_array().into_iter().flatten();
            let answers = entries.filter(|entry| entry["type"] == "response");
            let time = |entry: &Value| entry["time"].as_f64().unwrap_or(0.0);
            answers.filter_map(|entry| Some((time(entry), entry["message"].as_str()?.to_owned()))).collect()
        };
        let stored = || self.ask("GET", "/server/gcode_store?count=50").map(|store| lines(&store));
        let before = stored().map_err(|refused| refused.why)?;
        let run = format!("/printer/gcode/script?script={}", encoded(command));
        self.ask("POST", &run).map_err(|refused| refused.why)?;
        let after = stored().map_err(|refused| refused.why)?;
        Ok(after.into_iter().filter(|line| !before.contains(line)).map(|(_, line)| line).collect())
    }

    /// A number that klippy reports of a section, such as a sensor's temperature.
    ///
    /// # Errors
    ///
    /// One line: Moonraker's words, or there is none.
    pub(super) fn value(&self, section: &str, key: &str) -> Result<f64, String> {
        let query = format!("/printer/objects/query?{}", encoded(section));
        let answer = self.ask("GET", &query).map_err(|refused| refused.why)?;
        let value = answer["result"]["status"][section][key].as_f64();
        value.ok_or_else(|| format!("klippy has no {key} of [{section}]"))
    }

    fn ask(&self, method: &str, path: &str) -> Result<Value, Refused> {
        let unreachable = |error: io::Error| Refused {
            status: None,
            why: format!("Moonraker at {} does not answer: {error}", self.0),
        };
        let (status, body) = self.exchange(method, path).map_err(unreachable)?;
        let answer: Value = serde_json::from_slice(&body).unwrap_or_default();
        if status == 200 {
            return Ok(answer);
        }
        let message = answer["error"]["message"].as_str().unwrap_or_default();
        let message = message.lines().next().unwrap_or_default();
        Err(Refused { status: Some(status), why: format!("Moonraker refuses ({status}): {message}") })
    }

    fn exchange(&self, method: &str, path: &str) -> io::Result<(u16, Vec<u8>)> {
        // A name may have an address of IPv6 first, where Moonraker does not listen.
        let connect = |found: io::Result<TcpStream>, address| {
            found.or_else(|_| TcpStream::connect_timeout(&address, CONNECT_TIMEOUT))
        };
        let mut stream = self.0.to_socket_addrs()?.fold(Err(io::ErrorKind::AddrNotAvailable.into()), connect)?;
        stream.set_write_timeout(Some(ANSWER_TIMEOUT))?;
        write!(stream, "{method} {path} HTTP/1.0\r\nHost: {}\r\nContent-Length: 0\r\n\r\n", self.0)?;
        let end = Instant::now() + ANSWER_TIMEOUT;
        let mut answer = Vec::new();
        let mut bytes = [0; 8192];
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || answer.len() as u64 > ANSWER_MAX {
                return Err(io::ErrorKind::TimedOut.into());
            }
            stream.set_read_timeout(Some(left))?;
            match stream.read(&mut bytes) {
                Ok(0) => break,
                Ok(count) => answer.extend_from_slice(&bytes[..count]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        parsed(&answer).ok_or_else(|| io::Error::other("the answer is not HTTP"))
    }
}

/// Why Moonraker has not done it.
struct Refused {
    /// The HTTP status, if it has answered.
    status: Option<u16>,
    why: String,
}

/// The status and the body of an answer.
fn parsed(answer: &[u8]) -> Option<(u16, Vec<u8>)> {
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n")?;
    let head = std::str::from_utf8(&answer[..end]).ok()?;
    let status = head.strip_prefix("HTTP/1.")?.split(' ').nth(1)?.parse().ok()?;
    Some((status, answer[end + 4..].to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;

    /// A server that answers each request with the next of these, and returns the requests.
    fn served(answers: Vec<&'static str>, work: impl FnOnce(Moonraker<'_>)) -> Vec<String> {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let server = thread::spawn(move || {
            let mut requests = Vec::new();
            for answer in answers {
                let (mut stream, _) = listener.accept().unwrap();
                let mut request = Vec::new();
                while !request.ends_with(b"\r\n\r\n") {
                    let mut byte = [0];
                    stream.read_exact(&mut byte).unwrap();
                    request.push(byte[0]);
                }
                stream.write_all(answer.as_bytes()).unwrap();
                let text = String::from_utf8(request).unwrap();
                requests.push(text.lines().next().unwrap().trim_end_matches(" HTTP/1.0").to_owned());
            }
            requests
        });
        work(Moonraker(&address));
        server.join().unwrap()
    }

    const OK: &str = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n\r\n{\"result\": \"ok\"}";

    #[test]
    fn a_print_is_known_and_silence_is_no_rest() {
        for (answer, host) in [
            (
                "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{\"print_stats\":{\"state\":\"printing\"}}}}",
                Host::Prints,
            ),
            ("HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{\"print_stats\":{\"state\":\"paused\"}}}}", Host::Prints),
            (
                "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{\"idle_timeout\":{\"state\":\"Printing\"}}}}",
                Host::Prints,
            ),
            ("HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{\"print_stats\":{\"state\":\"standby\"}}}}", Host::Rests),
            ("HTTP/1.1 503 x\r\n\r\n{\"error\":{\"message\":\"Klippy Host not connected\"}}", Host::Rests),
            ("HTTP/1.1 200 OK\r\n\r\n[]", Host::Unknown("Moonraker's answer has no status".into())),
            (
                "HTTP/1.1 401 x\r\n\r\n{\"error\":{\"message\":\"Unauthorized\"}}",
                Host::Unknown("Moonraker refuses (401): Unauthorized".into()),
            ),
        ] {
            let requests = served(vec![answer], |moonraker| assert_eq!(moonraker.host(), host));
            assert_eq!(requests, ["GET /printer/objects/query?print_stats&idle_timeout"]);
        }
        let unknown = "HTTP/1.1 404 x\r\n\r\n{\"error\":{\"message\":\"Not Found\"}}";
        let rests = "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{}}}";
        served(vec![unknown, rests], |moonraker| assert_eq!(moonraker.host(), Host::Rests));
        served(vec!["SSH-2.0\r\n"], |moonraker| assert!(matches!(moonraker.host(), Host::Unknown(_))));
        assert!(matches!(Moonraker("127.0.0.1:1").host(), Host::Unknown(_)));
        assert!(matches!(Moonraker("nonsense").host(), Host::Unknown(_)));
    }

    #[test]
    fn a_command_s_answer_is_what_is_new_in_the_console() {
        let old = "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"gcode_store\":[{\"time\":1.0,\"type\":\"response\",\"message\":\"old\"}]}}";
        let new = "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"gcode_store\":[{\"time\":1.0,\"type\":\"response\",\"message\":\"old\"},\
                   {\"time\":2.0,\"type\":\"command\",\"message\":\"X\"},{\"time\":3.0,\"type\":\"response\",\"message\":\"new\"}]}}";
        let requests = served(vec![old, OK, new], |moonraker| assert_eq!(moonraker.run("X"), Ok(vec!["new".into()])));
        assert_eq!(requests[1], "POST /printer/gcode/script?script=X");
        let refused = "HTTP/1.1 400 x\r\n\r\n{\"error\":{\"message\":\"Invalid adxl345 id (got 0 vs e5).\\nmore\"}}";
        served(vec![old, refused], |moonraker| {
            assert_eq!(moonraker.run("X").unwrap_err(), "Moonraker refuses (400): Invalid adxl345 id (got 0 vs e5).");
        });
    }

    #[test]
    fn a_restart_ends_when_klippy_is_ready_or_says_why_not() {
        let info = |state: &str| {
            let text = format!(
                "HTTP/1.1 200 OK\r\n\r\n{{\"result\":{{\"state\":\"{state}\",\"state_message\":\"Option 'x'\\nmore\"}}}}"
            );
            &*text.leak()
        };
        // A busy computer may take longer than klippy for a few answers.
        let restart = |moonraker: Moonraker<'_>| moonraker.restart(Duration::from_secs(60));
        served(vec![OK, info("startup"), info("ready")], |moonraker| assert_eq!(restart(moonraker), Ok(())));
        // The first answers are those of before.
        served(vec![OK, info("error"), info("ready"), info("startup"), info("error")], |moonraker| {
            assert_eq!(restart(moonraker), Err("klippy says: Option 'x'".into()));
        });
    }

    #[test]
    fn a_temperature_has_a_section() {
        let answer =
            "HTTP/1.1 200 OK\r\n\r\n{\"result\":{\"status\":{\"temperature_sensor a\":{\"temperature\":21.5}}}}";
        let requests = served(vec![answer], |moonraker| {
            assert_eq!(moonraker.value("temperature_sensor a", "temperature"), Ok(21.5))
        });
        assert_eq!(requests, ["GET /printer/objects/query?temperature_sensor%20a"]);
    }
}
