// SPDX-License-Identifier: GPL-3.0-or-later
//! A host with a text interface: lines of commands in, responses out (`pinion console`).

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use super::messages::{Messages, Value};
use super::{Client, Error, Params};
use pinion_protocol::clock::Clock;
use pinion_protocol::dictionary::Dictionary;
use pinion_protocol::format::{self, Conversion};

/// How often responses are printed during a `delay`.
const PRINT_PERIOD: Duration = Duration::from_millis(50);
/// Longest `delay`, in seconds.
const DELAY_MAX_S: f64 = 86_400.0;
/// Highest number of names of an enumeration that `help` prints.
const NAMES_SHOWN: usize = 40;

/// The console's own commands, with their help texts.
const OWN: &[(&str, &str)] = &[
    ("help", "help [COMMAND]: list the commands, or the parameters of a command"),
    ("delay", "delay SECONDS: wait, and print the responses that come"),
    ("reset", "reset: drop the configuration and start again, as FIRMWARE_RESTART does"),
    ("stats", "stats: turn the MCU's statistics on or off"),
    ("quit", "quit: end (also Ctrl-D)"),
];

/// The forms of a command's values in addition to those of the dictionary.
const VALUES: &str = "\
A number may be decimal, 0x hexadecimal, a name that the parameter takes, a time in ticks as 0.5s, 10ms or 20us,
or an instant as clock, clock+0.5s or clock-1ms, counted from now. Bytes are hexadecimal digits: data=00ff.";

/// Whether the console continues after a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// It continues.
    Line,
    /// The line ended it.
    End,
}

/// A console session.
#[derive(Debug)]
pub struct Console {
    client: Client,
    vocabulary: Vocabulary,
    shows_stats: bool,
    /// Whether the MCU has closed its terminal.
    gone: bool,
}

/// The words of a dictionary, for completion and help.
#[derive(Clone, Debug)]
pub struct Vocabulary {
    messages: Messages,
    /// The formats of the commands, by their names.
    commands: Vec<String>,
    responses: Vec<String>,
}

impl Console {
    /// A console for an MCU.
    pub fn new(client: Client) -> Console {
        Console {
            vocabulary: Vocabulary::new(client.dictionary(), client.messages()),
            client,
            shows_stats: false,
            gone: false,
        }
    }

    /// The words that the MCU understands.
    pub fn vocabulary(&self) -> &Vocabulary {
        &self.vocabulary
    }

    /// Whether the MCU has closed its terminal.
    pub fn is_gone(&self) -> bool {
        self.gone
    }

    /// One line about the MCU.
    pub fn greeting(&self) -> String {
        let dictionary = self.client.dictionary();
        format!(
            "{} {}: {} commands; help lists them",
            if dictionary.app.is_empty() { "a micro-controller" } else { &dictionary.app },
            dictionary.version,
            dictionary.commands.len()
        )
    }

    /// Executes a line, and prints the MCU's responses line by line. An empty line, or a line that begins with `#`,
    /// does nothing.
    ///
    /// # Errors
    ///
    /// An error in the line, or a shutdown of the MCU. Also a command that the stopped MCU refuses, or an MCU that no
    /// longer answers.
    pub fn line(&mut self, line: &str, print: &mut dyn FnMut(&str)) -> Result<Next, String> {
        let line = line.trim();
        let mut words = line.split_ascii_whitespace();
        let Some(command) = words.next().filter(|word| !word.starts_with('#')) else { return Ok(Next::Line) };
        let rest: Vec<&str> = words.collect();
        match (command, &rest[..]) {
            ("help", []) => self.vocabulary.overview().iter().for_each(|line| print(line)),
            ("help", [of]) => self.vocabulary.explain(of)?.iter().for_each(|line| print(line)),
            ("delay", [seconds]) => {
                let seconds = seconds.strip_suffix('s').unwrap_or(seconds).parse().ok();
                let seconds: f64 = seconds
                    .filter(|seconds| (0.0..=DELAY_MAX_S).contains(seconds))
                    .ok_or("delay: give seconds, such as 0.5")?;
                self.listen(Duration::from_secs_f64(seconds), print)?;
            }
            ("reset", []) => {
                self.client.reset().map_err(message)?;
                self.client.drain();
                self.vocabulary = Vocabulary::new(self.client.dictionary(), self.client.messages());
                print("the MCU waits for a new configuration");
            }
            ("stats", []) => self.shows_stats = !self.shows_stats,
            ("quit" | "exit", []) => return Ok(Next::End),
            _ if OWN.iter().any(|(name, _)| *name == command) => {
                return Err(OWN.iter().find(|(name, _)| *name == command).map_or("", |(_, help)| help).to_owned());
            }
            _ => self.send(command, &rest, print)?,
        }
        Ok(Next::Line)
    }

    fn send(&mut self, command: &str, rest: &[&str], print: &mut dyn FnMut(&str)) -> Result<(), String> {
        let format = self.vocabulary.command(command).ok_or_else(|| self.vocabulary.unknown(command))?.to_owned();
        let mut line = command.to_owned();
        for word in rest {
            line += " ";
            line += &self.resolve(&format, word)?;
        }
        let payload = self.client.messages().encode_line(&line).map_err(|error| match error {
            Error::Message { why, .. } => format!("{why}{} (it is {format})", self.vocabulary.hint(command, rest)),
            other => message(other),
        })?;
        let link = self.client.link();
        link.send(&payload).and_then(|()| link.settle()).map_err(message)?;
        let stopped = self.print_heard(Instant::now(), print)?;
        match stopped {
            Some(reason) if command != "emergency_stop" => Err(reason),
            _ => Ok(()),
        }
    }

    /// Prints the MCU's responses in this time.
    ///
    /// # Errors
    ///
    /// The MCU shut down, or is gone.
    pub fn listen(&mut self, span: Duration, print: &mut dyn FnMut(&str)) -> Result<(), String> {
        let until = Instant::now() + span;
        loop {
            let stopped = self.print_heard(until.min(Instant::now() + PRINT_PERIOD), print)?;
            if let Some(reason) = stopped {
                return Err(reason);
            }
            if Instant::now() >= until {
                return Ok(());
            }
        }
    }

    /// Prints the responses until this instant. Returns the text of a shutdown, if there was one.
    fn print_heard(&mut self, until: Instant, print: &mut dyn FnMut(&str)) -> Result<Option<String>, String> {
        let heard = self.client.hear(until).map_err(|error| {
            self.gone = matches!(error, Error::Closed { .. } | Error::Io { .. });
            message(error)
        })?;
        // A stopped MCU also answers queries, for example for the clock.
        self.client.forget_shutdown();
        let mut stopped = None;
        for response in heard {
            if response.name == "stats" && !self.shows_stats {
                continue;
            }
            print(&self.show(&response));
            let verb = match response.name.as_str() {
                "shutdown" => "shut down",
                "is_shutdown" => "is shut down and has not done it",
                _ => continue,
            };
            let reason = response.text("static_string_id").unwrap_or_default();
            stopped.get_or_insert(format!("the MCU {verb}: {reason} (look at its log, then type reset)"));
        }
        Ok(stopped)
    }

    /// A response with the time of its arrival on the MCU's clock, in seconds.
    fn show(&self, response: &Params) -> String {
        let at = self.client.clock_at_instant(response.at).since(Clock::EPOCH) as f64 / self.client.frequency_hz();
        let mut text = format!("[{at:12.6}] {}", response.name);
        for (name, value) in response.fields() {
            // Writing to a String cannot fail.
            let _ = match value {
                Value::Int(value) => write!(text, " {name}={value}"),
                Value::Name(value) => write!(text, " {name}={value}"),
                Value::Bytes(bytes) => {
                    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                    write!(text, " {name}={hex}")
                }
            };
        }
        text
    }

    /// A word of a command, with times and instants converted to ticks.
    fn resolve(&mut self, format: &str, word: &str) -> Result<String, String> {
        let Some((name, value)) = word.split_once('=') else { return Ok(word.to_owned()) };
        let is_number = format::parameters(format)
            .is_some_and(|all| all.iter().any(|(of, conversion)| *of == name && *conversion != Conversion::Bytes));
        if !is_number {
            return Ok(word.to_owned());
        }
        let instant = value.strip_prefix('@').unwrap_or(value);
        let ticks = if let Some(offset) = instant.strip_prefix("clock") {
            let seconds = match offset.strip_prefix('+') {
                _ if offset.is_empty() => Some(0.0),
                Some(later) => seconds(later),
                None => offset.strip_prefix('-').and_then(seconds).map(|earlier| -earlier),
            };
            let Some(seconds) = seconds else {
                return Err(format!("{word}: an instant is clock, clock+0.5s or clock-1ms"));
            };
            self.client.clock_in(seconds).map_err(message)?.wire()
        } else if let Some(seconds) = seconds(value) {
            let ticks = (seconds * self.client.frequency_hz()).round();
            if ticks > f64::from(u32::MAX) {
                return Err(format!("{word}: that does not fit 32 bits of ticks"));
            }
            ticks as u32
        } else {
            return Ok(word.to_owned());
        };
        Ok(format!("{name}={ticks}"))
    }
}

/// A time with its unit, in seconds.
fn seconds(text: &str) -> Option<f64> {
    let (number, unit) = [("ms", 1e-3), ("us", 1e-6), ("s", 1.0)]
        .into_iter()
        .find_map(|(unit, seconds)| Some((text.strip_suffix(unit)?, seconds)))?;
    let is_number = number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    number.parse::<f64>().ok().filter(|_| is_number).map(|number| number * unit)
}

fn message(error: Error) -> String {
    error.to_string()
}

impl Vocabulary {
    fn new(dictionary: &Dictionary, messages: &Messages) -> Vocabulary {
        let formats = |all: &serde_json::Map<String, serde_json::Value>| {
            let mut formats: Vec<String> = all.keys().cloned().collect();
            formats.sort();
            formats
        };
        Vocabulary {
            messages: messages.clone(),
            commands: formats(&dictionary.commands),
            responses: formats(&dictionary.responses),
        }
    }

    /// The format of a command.
    fn command(&self, name: &str) -> Option<&str> {
        self.commands.iter().map(String::as_str).find(|format| format::name(format) == name)
    }

    fn names(&self) -> impl Iterator<Item = &str> {
        OWN.iter().map(|(name, _)| *name).chain(self.commands.iter().map(|format| format::name(format)))
    }

    fn overview(&self) -> Vec<String> {
        let mut lines = vec!["The console's own:".to_owned()];
        lines.extend(OWN.iter().map(|(_, help)| format!("  {help}")));
        lines.push("The MCU's:".to_owned());
        lines.extend(self.commands.iter().map(|format| format!("  {format}")));
        lines.extend(VALUES.lines().map(str::to_owned));
        lines
    }

    fn explain(&self, name: &str) -> Result<Vec<String>, String> {
        if let Some((_, help)) = OWN.iter().find(|(own, _)| *own == name) {
            return Ok(vec![(*help).to_owned()]);
        }
        let response = || self.responses.iter().map(String::as_str).find(|format| format::name(format) == name);
        let Some(format) = self.command(name).or_else(response) else { return Err(self.unknown(name)) };
        let mut lines = vec![format.to_owned()];
        if self.command(name).is_none() {
            lines.push("  (a response)".to_owned());
        }
        for (parameter, conversion) in format::parameters(format).unwrap_or_default() {
            let range = match conversion {
                Conversion::U32 => "0 to 4294967295",
                Conversion::I32 => "-2147483648 to 2147483647",
                Conversion::U16 => "0 to 65535",
                Conversion::I16 => "-32768 to 32767",
                Conversion::Byte => "0 to 255",
                Conversion::Bytes => "hexadecimal digits",
            };
            let names = self.messages.names(parameter);
            let shown = match names.len() {
                0 => range.to_owned(),
                1..=NAMES_SHOWN => names.join(", "),
                count => format!("{}, ... ({count} names; Tab completes)", names[..NAMES_SHOWN].join(", ")),
            };
            lines.push(format!("  {parameter}: {shown}"));
        }
        Ok(lines)
    }

    /// The error for an unknown command, with the nearest name.
    fn unknown(&self, name: &str) -> String {
        let meant = nearest(name, self.names()).map_or(String::new(), |meant| format!("; did you mean {meant}?"));
        format!("there is no command {name}{meant}{}", if meant.is_empty() { "; help lists them" } else { "" })
    }

    /// The nearest name for a wrong parameter or value; empty if none is near.
    fn hint(&self, command: &str, words: &[&str]) -> String {
        let parameters = self.command(command).and_then(format::parameters).unwrap_or_default();
        let mut pairs = words.iter().filter_map(|word| word.split_once('='));
        let meant = pairs.find_map(|(parameter, value)| {
            if !parameters.iter().any(|(name, _)| *name == parameter) {
                return nearest(parameter, parameters.iter().map(|(name, _)| *name)).map(str::to_owned);
            }
            let names = self.messages.names(parameter);
            let is_wrong = value.parse::<i64>().is_err() && !names.iter().any(|name| name == value);
            nearest(value, names.iter().map(String::as_str)).filter(|_| is_wrong).map(str::to_owned)
        });
        meant.map_or(String::new(), |meant| format!("; did you mean {meant}?"))
    }

    /// The start of the last word of `line`, and its completions.
    pub fn complete(&self, line: &str) -> (usize, Vec<String>) {
        let start = line.rfind(' ').map_or(0, |space| space + 1);
        let (before, word) = line.split_at(start);
        let mut words = before.split_ascii_whitespace();
        let Some(command) = words.next() else {
            let begun = self.names().filter(|name| name.starts_with(word));
            return (start, begun.map(|name| self.whole(name)).collect());
        };
        if command == "help" {
            return (start, self.names().filter(|name| name.starts_with(word)).map(str::to_owned).collect());
        }
        let parameters = self.command(command).and_then(format::parameters).unwrap_or_default();
        match word.split_once('=') {
            Some((parameter, value)) if parameters.iter().any(|(name, _)| *name == parameter) => {
                let names = self.messages.names(parameter).into_iter().filter(|name| name.starts_with(value));
                (start + parameter.len() + 1, names.map(|name| name + " ").collect())
            }
            Some(_) => (start, Vec::new()),
            None => {
                let given: Vec<&str> = words.filter_map(|word| Some(word.split_once('=')?.0)).collect();
                let open = parameters.iter().map(|(name, _)| *name).filter(|name| !given.contains(name));
                (start, open.filter(|name| name.starts_with(word)).map(|name| format!("{name}=")).collect())
            }
        }
    }

    /// A command's name, with a space if parameters follow it.
    fn whole(&self, name: &str) -> String {
        let takes = match self.command(name) {
            Some(format) => format.contains('='),
            None => ["help", "delay"].contains(&name),
        };
        if takes { format!("{name} ") } else { name.to_owned() }
    }
}

/// The most similar word, if any word is similar.
fn nearest<'a>(word: &str, among: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let length = word.chars().count();
    let allowed = (length / 3).max(1);
    // No name is near a very long word. Comparing them would take seconds.
    among
        .filter(|other| other.chars().count().abs_diff(length) <= allowed)
        .map(|other| (strsim::levenshtein(word, other), other))
        .filter(|(far, _)| *far <= allowed)
        .min()
        .map(|(_, other)| other)
}

#[cfg(test)]
mod tests {
    use super::super::fake::FakeMcu;
    use super::*;

    fn console() -> (std::thread::JoinHandle<Vec<Vec<u8>>>, Console) {
        let (peer, link) = FakeMcu::default().start();
        (peer, Console::new(Client::new(link).unwrap()))
    }

    fn say(console: &mut Console, line: &str) -> Result<Vec<String>, String> {
        let mut out = Vec::new();
        console.line(line, &mut |text| out.push(text.to_owned())).map(|_| out)
    }

    #[test]
    fn a_response_is_printed_with_its_time() {
        let (peer, mut console) = console();
        let said = say(&mut console, "endstop_query_state oid=7").unwrap();
        let [line] = &said[..] else { panic!("{said:?}") };
        assert!(
            line.starts_with('[') && line.ends_with("] endstop_state oid=7 homing=0 next_clock=0 pin_value=1"),
            "{line}"
        );
        assert_eq!(say(&mut console, "  # a comment"), Ok(vec![]));
        assert_eq!(console.line("quit", &mut |_| {}), Ok(Next::End));
        drop(console);
        peer.join().unwrap();
    }

    #[test]
    fn times_and_instants_become_ticks() {
        let (peer, mut console) = console();
        let format = "queue x=%u data=%*s";
        let mut resolve = |word: &str| console.resolve(format, word);
        assert_eq!(resolve("x=0.5s").unwrap(), "x=25000000");
        assert_eq!(resolve("x=10ms").unwrap(), "x=500000");
        assert_eq!(resolve("x=2us").unwrap(), "x=100");
        for as_it_is in ["x=12", "x=gpio17", "data=0a5s", "y=1s", "x", "x=infs"] {
            assert_eq!(resolve(as_it_is).unwrap(), as_it_is);
        }
        let clock = |word: String| word.strip_prefix("x=").unwrap().parse::<u32>().unwrap();
        let (now, later) = (clock(resolve("x=@clock").unwrap()), clock(resolve("x=clock+10s").unwrap()));
        let ahead = later.wrapping_sub(now);
        // An estimate gets at most half a second old, and the next one may be behind it by as much.
        assert!((474_000_000..2_000_000_000).contains(&ahead), "{ahead}");
        assert!(resolve("x=clock+1").unwrap_err().contains("clock+0.5s"));
        assert!(resolve("x=100s").unwrap_err().contains("32 bits"));
        drop(console);
        peer.join().unwrap();
    }

    #[test]
    fn mistakes_are_reported_with_a_likely_meaning() {
        let (peer, mut console) = console();
        let mut wrong = |line: &str| say(&mut console, line).unwrap_err();
        assert_eq!(wrong("get_clok"), "there is no command get_clok; did you mean get_clock?");
        assert_eq!(wrong("xyzzy"), "there is no command xyzzy; help lists them");
        let format = "config_endstop oid=%c pin=%c pull_up=%c";
        assert_eq!(wrong("config_endstop oid=1"), format!("parameter `pin` is missing (it is {format})"));
        let pin = wrong("config_endstop oid=1 pin=GPIO18 pull_up=1");
        assert!(pin.contains("`GPIO18` is not a value of pin; did you mean GPIO17?"), "{pin}");
        assert!(wrong("config_endstop oid=1 pim=GPIO17 pull_up=1").contains("did you mean pin?"));
        assert!(wrong("delay").starts_with("delay SECONDS") && wrong("delay soon").contains("such as 0.5"));
        drop(console);
        peer.join().unwrap();
    }

    #[test]
    fn a_shutdown_is_an_error_but_where_it_was_asked_for() {
        let (peer, mut console) = console();
        let said = say(&mut console, "emergency_stop").unwrap();
        assert!(said[0].ends_with("static_string_id=Command request"), "{said:?}");
        // The clock is still available.
        console.client.clock_in(0.0).unwrap();
        drop(console);
        peer.join().unwrap();
    }

    #[test]
    fn words_are_completed_as_far_as_the_dictionary_goes() {
        let (peer, console) = console();
        let complete = |line: &str| console.vocabulary.complete(line);
        assert_eq!(complete("config_e"), (0, vec!["config_endstop ".to_owned()]));
        assert_eq!(complete("get_u"), (0, vec!["get_uptime".to_owned()]));
        assert_eq!(complete("config_endstop oid=1 pi"), (21, vec!["pin=".to_owned()]));
        assert_eq!(complete("config_endstop oid=1 pin=GPIO"), (25, vec!["GPIO17 ".to_owned()]));
        assert_eq!(complete("config_endstop oid=1 o"), (21, vec![]), "it is given already");
        assert_eq!(complete("help config_e"), (5, vec!["config_endstop".to_owned()]));
        assert_eq!(complete("config_endstop oid=1 pin=gpio28").1.len(), 9, "gpio28, gpio280 to gpio287");
        let help = console.vocabulary.explain("config_endstop").unwrap().join("\n");
        assert!(help.contains("\n  oid: 0 to 255") && help.contains("GPIO17"), "{help}");
        assert!(console.vocabulary.explain("endstop_state").unwrap()[1].contains("(a response)"));
        drop(console);
        peer.join().unwrap();
    }

    #[test]
    fn a_word_that_is_near_is_proposed_and_a_long_one_has_none() {
        let names = || ["get_clock", "get_config", "get_uptime"].into_iter();
        for (word, near) in [("get_clok", Some("get_clock")), ("get_uptme", Some("get_uptime")), ("reset", None)] {
            assert_eq!(nearest(word, names()), near);
        }
        // Comparing this word with each name would take minutes.
        assert_eq!(nearest(&"x".repeat(1 << 26), names()), None);
    }
}
