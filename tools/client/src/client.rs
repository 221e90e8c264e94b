// SPDX-License-Identifier: GPL-3.0-or-later
//! A session with an MCU: its dictionary, its messages, and its clock.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::{Map, Value as Json};

use super::Error;
use super::messages::{Arg, Messages, Params};
use super::serial::{BlockLink, Received};
use pinion_protocol::clock::Clock;
use pinion_protocol::dictionary::{Dictionary, IDENTIFY_ID, IDENTIFY_RESPONSE_ID};

/// How long after its acknowledgement a query without an answer is sent again. The pause doubles each time. The number
/// of retries is klippy's (SerialRetryCommand in serialhdl.py).
const RETRY_DELAY: Duration = Duration::from_millis(10);
const RETRIES: u32 = 5;
/// Timeout for reading the whole dictionary.
const IDENTIFY_TIMEOUT: Duration = Duration::from_secs(60);
const IDENTIFY_CHUNK: u8 = 40;
/// Largest compressed dictionary that is read. A real one has a few kilobytes.
const IDENTIFY_MAX: usize = 128 * 1024;
/// Highest number of responses kept until they are requested. The oldest are dropped first.
const INBOX_MAX: usize = 65_536;
/// The age at which the estimate of the MCU's clock is renewed.
const CLOCK_AGE: Duration = Duration::from_millis(500);

/// A session with an MCU.
#[derive(Debug)]
pub struct Client {
    link: BlockLink,
    /// The path for opening the tty again after a reset that closed it; `None` for a descriptor.
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
    /// Opens a tty, identifies the MCU and estimates its clock. Retries until `timeout`, because the program at the
    /// other end may still be starting.
    pub fn connect(path: &Path, timeout: Duration) -> Result<Client, Error> {
        let until = Instant::now() + timeout;
        loop {
            let rest = until.saturating_duration_since(Instant::now());
            // As klippy does (`_start_session` in serialhdl.py), it waits five seconds before it opens the tty again: an
            // MCU takes up to three to find out who its host is, and begins anew each time.
            let result = BlockLink::open(path, rest.min(Duration::from_secs(5)))
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

    /// Identifies the MCU at the other end of a link and estimates its clock.
    pub fn new(link: BlockLink) -> Result<Client, Error> {
        Client::start(link, None)
    }

    fn start(link: BlockLink, path: Option<PathBuf>) -> Result<Client, Error> {
        let mut client = Client::unidentified(link, path);
        client.identify()?;
        let uptime = client.query("get_uptime", &[], "uptime", None)?;
        let ticks = u64::from(uptime.u32("high")?) << 32 | u64::from(uptime.u32("clock")?);
        client.clock = Clock::from_ticks(ticks);
        client.clock_at = uptime.at;
        client.estimate_clock(8)?;
        Ok(client)
    }

    fn unidentified(link: BlockLink, path: Option<PathBuf>) -> Client {
        Client {
            link,
            path,
            dictionary: Dictionary::default(),
            messages: Messages::new(&before_identify()),
            inbox: VecDeque::new(),
            shutdown: None,
            frequency_hz: 0.0,
            clock: Clock::EPOCH,
            clock_at: Instant::now(),
        }
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

    /// A numeric constant of the dictionary. Fails if there is no such constant.
    pub fn constant(&self, name: &str) -> Result<f64, Error> {
        let value = self.dictionary.config.get(name);
        value
            .and_then(|json| json.as_f64().or_else(|| json.as_str()?.parse().ok()))
            .ok_or_else(|| Error::Dictionary { why: format!("it has no number {name}") })
    }

    /// Ticks per second of the MCU's clock.
    pub fn frequency_hz(&self) -> f64 {
        self.frequency_hz
    }

    /// A time in ticks, rounded.
    pub fn ticks(&self, seconds: f64) -> u32 {
        (seconds * self.frequency_hz).round() as u32
    }

    /// The underlying link.
    pub fn link(&mut self) -> &mut BlockLink {
        &mut self.link
    }

    /// Sends a command. Fails as [`Messages::encode`] and [`BlockLink::send`] do.
    pub fn send(&mut self, command: &str, args: &[(&str, Arg<'_>)]) -> Result<(), Error> {
        let payload = self.messages.encode(command, args)?;
        self.link.send(&payload)
    }

    /// Sends a command in klippy's notation. Fails as [`Messages::encode`] and
    /// [`BlockLink::send`] do.
    pub fn send_line(&mut self, line: &str) -> Result<(), Error> {
        let payload = self.messages.encode_line(line)?;
        self.link.send(&payload)
    }

    /// Sends encoded commands in order, in as few blocks as possible.
    pub fn send_encoded(&mut self, commands: &[Vec<u8>]) -> Result<(), Error> {
        let mut block = Vec::new();
        for command in commands {
            if block.len() + command.len() > pinion_protocol::block::PAYLOAD_MAX && !block.is_empty() {
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

    /// Sends a command and returns its response, with this `oid` if one is given.
    ///
    /// As in klippy, the answer must have arrived when the acknowledgement arrives. Otherwise the command is sent again
    /// after 10 ms, even if the answer arrives in that time. So an MCU that acknowledges before it answers gets the
    /// command twice. Its second answer may then count as the answer to the next query.
    ///
    /// # Errors
    ///
    /// [`Error::Shutdown`] if the MCU shuts down, or if it refuses the command because it is shut down.
    /// [`Error::Timeout`] if the last retry has no answer either.
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
        let begun = Instant::now();
        let result = self.ask(&payload, response, oid);
        if self.shutdown.is_none() {
            self.shutdown = known;
        }
        result?.ok_or_else(|| Error::Timeout {
            waiting_for: format!("`{response}` in answer to `{command}`"),
            after: begun.elapsed(),
        })
    }

    fn ask(&mut self, payload: &[u8], response: &str, oid: Option<u8>) -> Result<Option<Params>, Error> {
        for repetition in 0..=RETRIES {
            self.link.send(payload)?;
            while let Some(received) = self.link.receive_unsettled()? {
                self.file(&received);
                if let Some(params) = self.take(response, oid) {
                    return Ok(Some(params));
                }
                self.check()?;
            }
            if let Some(params) = self.take(response, oid) {
                return Ok(Some(params));
            }
            if repetition < RETRIES {
                self.listen(Instant::now() + RETRY_DELAY * 2u32.pow(repetition))?;
            }
        }
        Ok(None)
    }

    /// Waits for the oldest response with this name, and with this `oid` if one is given; `None` if none arrives in
    /// time. Fails with [`Error::Shutdown`] if the MCU is shut down.
    pub fn wait(&mut self, response: &str, oid: Option<u8>, until: Instant) -> Result<Option<Params>, Error> {
        loop {
            if let Some(params) = self.take(response, oid) {
                return Ok(Some(params));
            }
            self.check()?;
            match self.link.receive(until)? {
                // Checked for each response, so that a flood of others cannot prolong the wait.
                Some(received) => self.file(&received),
                None => return Ok(None),
            }
            if Instant::now() >= until {
                return Ok(self.take(response, oid));
            }
        }
    }

    /// The oldest response with this name, and with this `oid` if one is given, among those that have arrived. Does not
    /// wait.
    pub fn take(&mut self, response: &str, oid: Option<u8>) -> Option<Params> {
        let at = self.inbox.iter().position(|p| p.is(response, oid))?;
        self.inbox.remove(at)
    }

    /// Reads until this instant, for a later [`Client::take`]. Fails with [`Error::Shutdown`] if the MCU is shut down.
    pub fn listen(&mut self, until: Instant) -> Result<(), Error> {
        while let Some(received) = self.link.receive(until)? {
            self.file(&received);
            if Instant::now() >= until {
                break;
            }
        }
        self.check()
    }

    /// Waits until this instant, or not at all if it is past, and takes all responses that have arrived. A shutdown is
    /// one of them.
    pub(super) fn hear(&mut self, until: Instant) -> Result<Vec<Params>, Error> {
        for _ in 0..INBOX_MAX {
            match self.link.receive(until)? {
                Some(received) => self.file(&received),
                None => break,
            }
        }
        Ok(self.drain())
    }

    /// All responses that have arrived and were not taken.
    pub fn drain(&mut self) -> Vec<Params> {
        self.inbox.drain(..).collect()
    }

    /// Fails with [`Error::Shutdown`] if the MCU reported a shutdown.
    pub fn check(&self) -> Result<(), Error> {
        match &self.shutdown {
            Some(reason) => Err(Error::Shutdown { reason: reason.clone() }),
            None => Ok(()),
        }
    }

    /// Waits until the MCU reports a shutdown, and returns the reason; `None` if no report arrives in time.
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

    /// Forgets a shutdown that the MCU reported.
    pub(super) fn forget_shutdown(&mut self) {
        self.shutdown = None;
    }

    /// Opens the tty again and starts a new session. A descriptor cannot be opened again: then it only reads the
    /// dictionary and the clock again.
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

    /// Renews the estimate of the clock from the shortest of several round trips.
    fn estimate_clock(&mut self, round_trips: u32) -> Result<(), Error> {
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

    /// The estimated clock of the MCU at an instant of this computer.
    pub(crate) fn clock_at_instant(&self, at: Instant) -> Clock {
        let ticks = |span: Duration| (span.as_secs_f64() * self.frequency_hz) as i64;
        let since = match at.checked_duration_since(self.clock_at) {
            Some(span) => ticks(span),
            None => -ticks(self.clock_at.saturating_duration_since(at)),
        };
        Clock::from_ticks(self.clock.ticks().saturating_add_signed(since))
    }

    /// The estimated instant of this computer at which the MCU's clock shows `clock`.
    pub fn instant_of(&self, clock: Clock) -> Instant {
        let seconds = clock.since(self.clock) as f64 / self.frequency_hz;
        let span = Duration::try_from_secs_f64(seconds.abs()).unwrap_or_default();
        let instant = if seconds < 0.0 { self.clock_at.checked_sub(span) } else { self.clock_at.checked_add(span) };
        instant.unwrap_or(self.clock_at)
    }

    /// The MCU's clock this many seconds from now. Renews an old estimate.
    pub fn clock_in(&mut self, seconds: f64) -> Result<Clock, Error> {
        if self.clock_at.elapsed() > CLOCK_AGE {
            self.estimate_clock(2)?;
        }
        let now = self.clock_at_instant(Instant::now()).ticks();
        let ahead = (seconds * self.frequency_hz) as i64;
        Ok(Clock::from_ticks(now.saturating_add_signed(ahead)))
    }

    /// The instant nearest to the present with these low 32 bits.
    pub fn widen(&self, wire: u32) -> Clock {
        Clock::widen(wire, self.clock_at_instant(Instant::now()))
    }
}

/// The two messages that a host knows before it reads a dictionary.
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
    use super::super::fake::{FakeMcu, Peer};
    use super::*;
    use pinion_protocol::vlq::Writer;

    #[test]
    fn a_dictionary_is_read_and_a_query_answered() {
        let (peer, link) = FakeMcu::default().start();
        let mut client = Client::new(link).unwrap();
        assert_eq!(client.dictionary().version, "fake");
        assert_eq!(client.frequency_hz(), 50e6);
        let args = [("oid", 7u8.into())];
        let state = client.query("endstop_query_state", &args, "endstop_state", Some(7)).unwrap();
        assert_eq!(state.int("pin_value").unwrap(), 1);
        assert!(state.int("nothing").is_err());
        // The fake clock is at 2^32 + 5.
        assert_eq!(client.widen(5).ticks() & 0xffff_ffff, 5);
        assert!(client.clock_in(0.0).unwrap().ticks() >= 1 << 32);
        drop(client);
        peer.join().unwrap();
    }

    /// An MCU that keeps its answers until the next block.
    fn late() -> (std::thread::JoinHandle<Vec<Vec<u8>>>, Client) {
        let mut held = Vec::new();
        let (peer, link) = Peer::start(0, &[], move |payload| {
            let Some(oid) = payload.get(1) else { return Vec::new() };
            let answer = [69, *oid, 0, 0, 1].map(u32::from);
            let mut writer = Writer::default();
            answer.into_iter().for_each(|value| writer.int(value));
            std::mem::replace(&mut held, vec![writer.payload().unwrap().to_vec()])
        });
        let messages = Messages::new(&super::super::fake::dictionary());
        (peer, Client { messages, ..Client::unidentified(link, None) })
    }

    #[test]
    fn an_answer_that_comes_after_the_acknowledgement_is_asked_for_again() {
        let (peer, mut client) = late();
        for asked in [7u8, 8] {
            // The answers always belong to the block before.
            let state = client.query("endstop_query_state", &[("oid", asked.into())], "endstop_state", Some(asked));
            assert_eq!(state.unwrap().int("oid").unwrap(), i64::from(asked));
        }
        drop(client);
        assert_eq!(peer.join().unwrap(), [[11, 7], [11, 7], [11, 8], [11, 8]]);
    }

    #[test]
    fn a_query_that_is_never_answered_is_given_up() {
        let (peer, link) = Peer::start(0, &[], |_| Vec::new());
        let messages = Messages::new(&super::super::fake::dictionary());
        let mut client = Client { messages, ..Client::unidentified(link, None) };
        let error = client.query("get_clock", &[], "clock", None).unwrap_err().to_string();
        assert!(error.starts_with("no `clock` in answer to `get_clock` within "), "{error}");
        drop(client);
        assert_eq!(peer.join().unwrap(), vec![[2]; 6]);
    }

    #[test]
    fn a_shutdown_carries_the_firmware_s_text() {
        let (peer, link) = FakeMcu::default().start();
        let mut client = Client::new(link).unwrap();
        client.check().unwrap();
        let reason = client.emergency_stop().unwrap();
        assert_eq!(reason.as_deref(), Some("Command request"));
        let error = client.check().unwrap_err();
        assert!(error.to_string().starts_with("the MCU shut down: Command request:"), "{error}");
        assert!(client.wait("nothing", None, Instant::now()).is_err());
        drop(client);
        peer.join().unwrap();
    }

    #[test]
    fn a_dictionary_of_nonsense_is_refused() {
        let (peer, link) = FakeMcu::identifying(vec![1, 2, 3]).start();
        let error = Client::new(link).unwrap_err().to_string();
        assert!(error.starts_with("the MCU's data dictionary is unusable"), "{error}");
        peer.join().unwrap();
    }
}
