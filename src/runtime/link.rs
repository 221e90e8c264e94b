// SPDX-License-Identifier: GPL-3.0-or-later
//! The link: reads the pty, checks blocks, hands commands to the core, frames responses.
//!
//! It answers `identify` and `get_clock` by itself when they come alone in a block: they need
//! no core, and the host's clock synchronisation sees the shortest round trip, also while a bus
//! holds the blocks before them back.

#![forbid(unsafe_code)]

use std::io;
use std::sync::Arc;
use std::thread::{self, Thread};
use std::time::Duration;

use log::{info, log, warn};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use rtrb::Producer;

use pinion_firmware::mcu::base::{ClockResponse, IdentifyResponse, identify_response};
use pinion_firmware::mcu::{Dialect, DialectName, Response};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, TimeSource};
use pinion_linux::clock::monotonic;
use pinion_protocol::block::{Received, Receiver, Sequence, frame};
use pinion_protocol::vlq::{Reader, Writer};

use super::core::{Payload, Request};
use super::guardian::{GuardianWatch, in_ms};
use super::host::HostFinder;
use super::ledger::{Ledger, is_after};
use super::outlet::{Inlet, LinkWake, Progress};
use super::pty::Pty;
use super::signals::{Signal, Signals};
use super::status::HostBoard;
use super::survey::Surveyor;
use super::watchdog::{Vigil, Watchdog};

/// What a shell writes to the pty to stop the machine, as in Klipper's service file.
const FORCE_SHUTDOWN: &[u8] = b"FORCE_SHUTDOWN\n";
/// Bytes read from the pty and not yet taken in.
const INPUT_BYTES: usize = 4096;
/// Bytes for a host that does not read; then responses wait in the ring, then they are lost.
const OUTPUT_BYTES: usize = 16 * 1024;
/// How long to poll for the core to be done with the blocks that it was handed.
const AWAIT_CORE: Duration = Duration::from_micros(100);
/// How long to wait for more once there is something to tell the host: one write is to tell of many blocks.
const AWAIT_MORE: Duration = Duration::from_micros(20);
/// How long to wait for a core that has no room for requests.
const STALL_MS: u64 = 1;
/// Room in the core's ring that blocks leave to requests: one to stop must find it where a slow bus
/// holds the blocks back.
const REQUESTS_KEPT: usize = 8;
/// How long a host may be looked for before it is served as one of which nothing is known. A card that has just
/// begun to be read after the computer's start may take longer than a second for the few hundred files; klippy
/// gives up after five (`_start_session` in serialhdl.py).
const FIND_LIMIT: Duration = Duration::from_secs(3);
/// How long a host has to read why the program ends.
const FAREWELL: Duration = Duration::from_secs(1);

/// The messages that the link knows by itself.
struct Known {
    dialect: Arc<Dialect>,
    get_clock: Option<u32>,
    identify: Option<u32>,
}

impl Known {
    fn new(dialect: Arc<Dialect>) -> Known {
        Known {
            get_clock: dialect.command_id("get_clock"),
            identify: dialect.command_id("identify offset=%u count=%c"),
            dialect,
        }
    }

    /// The answer to a block that holds nothing but one of these commands.
    fn answer(&self, payload: &[u8], now: impl FnOnce() -> Clock) -> Option<Writer> {
        let mut reader = Reader::new(payload);
        let id = Some(reader.int().ok()?);
        if id == self.get_clock && reader.is_empty() {
            return self.encode(&ClockResponse::from(now()));
        }
        if id != self.identify {
            return None;
        }
        let (offset, count) = (reader.int().ok()?, reader.int().ok()?);
        if !reader.is_empty() {
            return None;
        }
        let piece: IdentifyResponse<'_> = identify_response(self.dialect.compressed(), offset, count as u8);
        self.encode(&piece)
    }

    fn encode<R: Response>(&self, response: &R) -> Option<Writer> {
        let mut writer = Writer::default();
        writer.int(self.dialect.response_id::<R>()?);
        response.encode(&mut writer);
        Some(writer)
    }
}

/// The link.
pub(super) struct Link {
    pty: Pty,
    clock: Arc<dyn TimeSource>,
    known: Known,
    /// How many blocks the core had been given when the host's dialect changed, until it begins the next one. What
    /// it says before that may be in the words of the host that was there before.
    changed_at: Option<u32>,
    /// Those that a host may speak.
    dialects: Vec<Arc<Dialect>>,
    /// Those before the board changed last, kept until it changes again, so that the core never frees one.
    outdated: Vec<Arc<Dialect>>,
    /// None if the dialect does not depend on the host.
    finder: Option<HostFinder>,
    host: Arc<HostBoard>,
    /// None if the board never changes.
    surveyor: Option<Surveyor>,
    /// Until when the host's first bytes wait for its dialect, and for what the board has now.
    finding: Option<Duration>,
    /// Whether they waited for too long, and the answer is still to come.
    is_overdue: bool,
    receiver: Receiver,
    input: Vec<u8>,
    output: Vec<u8>,
    attached: bool,
    requests: Producer<Request>,
    core: Thread,
    inlet: Inlet,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    ledger: Ledger,
    /// Whether there is a processor beside the core's, to poll on for the core.
    may_poll: bool,
    signals: Signals,
    guardian: Option<GuardianWatch>,
    vigil: Vigil,
    /// When to end, as the guardian is gone.
    leave_at: Option<Duration>,
}

/// What ended the link's sleep: it looks only where there is something, as each look is a system
/// call.
#[derive(Clone, Copy, Debug)]
struct Woken {
    by_signal: bool,
    by_input: bool,
    /// The host is gone.
    by_hangup: bool,
}

/// Why the link ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    /// A signal asked for it.
    Asked,
    /// The guardian is gone: the program has to be started anew.
    GuardianLost,
}

/// What the link is made of.
pub(super) struct Parts {
    pub(super) pty: Pty,
    pub(super) clock: Arc<dyn TimeSource>,
    /// Those that a host may speak; the first one is spoken before a host comes.
    pub(super) dialects: Vec<Arc<Dialect>>,
    pub(super) finder: Option<HostFinder>,
    /// Where it says whether a host is there.
    pub(super) host: Arc<HostBoard>,
    pub(super) surveyor: Option<Surveyor>,
    pub(super) requests: Producer<Request>,
    pub(super) core: Thread,
    pub(super) inlet: Inlet,
    pub(super) progress: Arc<Progress>,
    pub(super) wake: Arc<LinkWake>,
    pub(super) signals: Signals,
    pub(super) guardian: Option<GuardianWatch>,
    pub(super) vigil: Vigil,
    /// There are processors to poll on.
    pub(super) may_poll: bool,
}

impl Link {
    pub(super) fn new(parts: Parts) -> Link {
        let Parts {
            pty,
            clock,
            dialects,
            finder,
            host,
            surveyor,
            requests,
            core,
            inlet,
            progress,
            wake,
            signals,
            guardian,
            vigil,
            may_poll,
        } = parts;
        Link {
            pty,
            clock,
            known: Known::new(dialects[0].clone()),
            changed_at: None,
            dialects,
            outdated: Vec::new(),
            finder,
            host,
            surveyor,
            finding: None,
            is_overdue: false,
            receiver: Receiver::default(),
            input: Vec::with_capacity(INPUT_BYTES),
            output: Vec::with_capacity(2 * OUTPUT_BYTES),
            attached: false,
            requests,
            core,
            inlet,
            progress,
            wake,
            ledger: Ledger::default(),
            may_poll,
            signals,
            guardian,
            vigil,
            leave_at: None,
        }
    }

    /// Feeds a hardware watchdog from now on.
    pub(super) fn feed(&mut self, watchdog: Watchdog) {
        self.vigil.feed(watchdog);
    }

    /// Serves the host until the program has to end.
    pub(super) fn run(&mut self) -> io::Result<End> {
        self.vigil.ready();
        self.tell_status();
        loop {
            if self.vigil.due().is_some() {
                self.vigil.tick(monotonic());
            }
            if self.guardian.as_mut().is_some_and(|guardian| guardian.due().is_some() && guardian.hangs(monotonic())) {
                self.lose_guardian("the guardian gives no sign of life: was it stopped? (a restart ends it)");
            }
            let handed = self.ledger.handed();
            let stalled = self.take_in();
            if self.may_poll && self.ledger.handed() != handed {
                self.await_core();
            }
            self.give_out();
            let woken = self.wait(stalled)?;
            if woken.by_signal {
                while let Some(signal) = self.signals.next() {
                    match signal {
                        Signal::End => return Ok(End::Asked),
                        Signal::Report => self.request(Request::Report),
                        Signal::Hang => self.request(Request::Hang),
                    }
                }
            }
            if self.leave_at.is_some_and(|at| monotonic() >= at) {
                return Ok(End::GuardianLost);
            }
            if woken.by_hangup {
                self.part_from_host()?;
            }
            if woken.by_input {
                self.read()?;
            }
        }
    }

    /// Passes on what the core said last.
    pub(super) fn finish(&mut self) {
        self.give_out();
    }

    /// Leaves a host the time to read why the program ends: what is unread when the terminal closes is lost,
    /// and klippy then tells of a lost communication, seconds later.
    pub(super) fn farewell(&mut self) {
        let end = monotonic() + FAREWELL;
        while self.attached && monotonic() < end {
            // What the terminal had no room for goes out as the host reads.
            let is_out = self.output.is_empty() && !self.inlet.has_response();
            let events = if is_out { PollFlags::empty() } else { PollFlags::POLLOUT };
            let mut fds = [PollFd::new(self.pty.master(), events)];
            // A host that hangs up has read it; a further signal cuts it short.
            if poll(&mut fds, in_ms(end.saturating_sub(monotonic()))) != Ok(1)
                || fds[0].revents() != Some(PollFlags::POLLOUT)
            {
                return;
            }
            self.give_out();
        }
    }

    /// Closes the terminal.
    pub(super) fn close(self) -> Vigil {
        self.vigil
    }

    /// The program begins to end.
    pub(super) fn stopping(&self) {
        self.vigil.stopping();
    }

    fn tell_status(&self) {
        self.host.attach(self.attached);
        let host = if self.attached { "a host is attached" } else { "no host is attached" };
        self.vigil.status(&format!("serving on {}, {host}", self.pty.symlink().display()));
    }

    /// Asks the core something. It takes requests in faster than a person or a signal asks.
    pub(super) fn request(&mut self, request: Request) {
        if matches!(request, Request::Shutdown(_) | Request::Quit) {
            self.progress.stop_handed();
        }
        let mut request = request;
        while let Err(rtrb::PushError::Full(back)) = self.requests.push(request) {
            request = back;
            self.core.unpark();
            std::thread::sleep(Duration::from_millis(STALL_MS));
        }
        self.core.unpark();
    }

    /// Sleeps until there is something to do.
    fn wait(&mut self, stalled: bool) -> io::Result<Woken> {
        self.wake.sleeping();
        let news = self.inlet.has_response() || self.ledger.is_behind(self.progress.done());
        if news && !self.is_full() || self.inlet.has_line() {
            self.wake.awake(false);
            return Ok(Woken { by_signal: false, by_input: true, by_hangup: false });
        }
        let mut events = PollFlags::empty();
        if !stalled {
            events |= PollFlags::POLLIN;
        }
        if !self.output.is_empty() {
            events |= PollFlags::POLLOUT;
        }
        // Without a guardian any other descriptor stands in.
        let guardian = self.guardian.as_ref().map_or(self.wake.event(), GuardianWatch::socket);
        let mut fds = [
            PollFd::new(self.pty.master(), events),
            PollFd::new(self.wake.event(), PollFlags::POLLIN),
            PollFd::new(self.signals.event(), PollFlags::POLLIN),
            PollFd::new(guardian, PollFlags::empty()),
        ];
        match poll(&mut fds, self.timeout(stalled)) {
            Ok(_) | Err(nix::errno::Errno::EINTR) => {}
            Err(error) => return Err(error.into()),
        }
        let events = |fd: &PollFd<'_>| fd.revents().unwrap_or(PollFlags::empty());
        let woken = Woken {
            by_signal: !events(&fds[2]).is_empty(),
            by_input: events(&fds[0]).contains(PollFlags::POLLIN),
            by_hangup: events(&fds[0]).contains(PollFlags::POLLHUP),
        };
        let (called, lost) = (!events(&fds[1]).is_empty(), !events(&fds[3]).is_empty());
        self.wake.awake(called);
        if lost && self.guardian.is_some() {
            self.lose_guardian("somebody killed the guardian");
        }
        Ok(woken)
    }

    fn timeout(&self, stalled: bool) -> PollTimeout {
        let stall = stalled.then_some(Duration::from_millis(STALL_MS));
        let look = self.guardian.as_ref().and_then(GuardianWatch::due);
        let due = self.leave_at.into_iter().chain(self.vigil.due()).chain(look).min();
        let due = due.map(|at| at.saturating_sub(monotonic()));
        stall.into_iter().chain(due).min().map_or(PollTimeout::NONE, in_ms)
    }

    /// The guardian is gone, or of no use: stops the machine, and has the program end once the host has had
    /// time to read why.
    fn lose_guardian(&mut self, why: &str) {
        self.guardian = None;
        let cause = format!("{why}, and without it a crash would leave heaters on");
        let stop = Shutdown::because(reason::GUARDIAN_LOST, cause);
        self.request(Request::Shutdown(stop.remedy("Pinion ends, to be started anew with one")));
        self.leave_at = Some(monotonic() + FAREWELL);
    }

    fn meet_host(&mut self) -> io::Result<()> {
        if !self.attached && self.pty.meet_host()? {
            self.attached = true;
            self.tell_status();
            info!("host attached");
            if let Some(surveyor) = &mut self.surveyor {
                surveyor.ask();
            }
            if let Some(finder) = &mut self.finder {
                finder.ask();
                self.is_overdue = false;
            }
            if self.surveyor.is_some() || self.finder.is_some() {
                self.finding = Some(monotonic() + FIND_LIMIT);
            }
        }
        Ok(())
    }

    fn part_from_host(&mut self) -> io::Result<()> {
        self.pty.part_from_host()?;
        self.attached = false;
        self.finding = None;
        self.output.clear();
        self.tell_status();
        info!("host gone");
        Ok(())
    }

    fn read(&mut self) -> io::Result<()> {
        let filled = self.input.len();
        if filled == INPUT_BYTES {
            return Ok(());
        }
        self.input.resize(INPUT_BYTES, 0);
        let read = self.pty.read(&mut self.input[filled..]);
        self.input.truncate(filled + read.as_ref().copied().unwrap_or(0));
        if read? > 0 {
            self.meet_host()?;
        }
        if self.input[filled..] == *FORCE_SHUTDOWN {
            self.input.truncate(filled);
            warn!("FORCE_SHUTDOWN was written to {}", self.pty.device().display());
            let stop = Shutdown::because(reason::FORCE_SHUTDOWN, "somebody wrote FORCE_SHUTDOWN to the pty");
            self.request(Request::Shutdown(stop.remedy("FIRMWARE_RESTART starts anew")));
        }
        Ok(())
    }

    /// Whether it is not known yet what the host is to be told: what the board has, in which dialect.
    fn is_finding(&mut self) -> bool {
        let Some(until) = self.finding else {
            self.hear_late_answer();
            return false;
        };
        let is_late = monotonic() >= until;
        if let Some(surveyor) = &mut self.surveyor {
            if !surveyor.is_done() && !is_late {
                return true;
            }
            if let Some(dialects) = surveyor.take() {
                self.outdated = std::mem::replace(&mut self.dialects, dialects);
                self.speak(self.known.dialect.name());
            }
        }
        if let Some(finder) = &self.finder {
            let found = finder.answer().or_else(|| {
                is_late.then(|| {
                    warn!(
                        "the host's dialect was not found within {FIND_LIMIT:?}: served as Klipper v0.13, master and Kalico"
                    );
                    self.is_overdue = true;
                    DialectName::Union
                })
            });
            let Some(name) = found else { return true };
            self.speak(name);
        }
        self.finding = None;
        false
    }

    /// An answer that came after the host had read another dictionary.
    fn hear_late_answer(&mut self) {
        let answer = self.finder.as_ref().filter(|_| self.is_overdue).and_then(HostFinder::answer);
        let Some(name) = answer else { return };
        self.is_overdue = false;
        if name != DialectName::Union {
            warn!("the host's dialect, {name}, was found too late: it is spoken from the host's RESTART on");
        }
    }

    /// Speaks the dialect of this name from now on.
    fn speak(&mut self, name: DialectName) {
        let of_name = self.dialects.iter().find(|dialect| dialect.name() == name);
        if let Some(dialect) = of_name.filter(|dialect| !Arc::ptr_eq(dialect, &self.known.dialect)).cloned() {
            if name != self.known.dialect.name() {
                self.changed_at = Some(self.ledger.handed());
            }
            self.known = Known::new(dialect.clone());
            self.request(Request::Speak(dialect));
        }
    }

    /// Takes in the blocks that were read. True if they have to wait: for the host's dialect, or
    /// because the core has no room for all of them.
    fn take_in(&mut self) -> bool {
        if self.is_finding() {
            return true;
        }
        let mut taken = 0;
        let mut stalled = false;
        let (handed, stops) = (self.ledger.handed(), self.progress.stops_handed());
        loop {
            if self.requests.slots() <= REQUESTS_KEPT {
                stalled = taken < self.input.len();
                break;
            }
            let (bytes, received) = self.receiver.next(&self.input[taken..]);
            taken += bytes;
            match received {
                Received::Nothing => break,
                Received::Skip => {}
                Received::Nak => self.ledger.refuse(),
                Received::Payload(payload) => {
                    let payload = Payload::new(payload);
                    if !self.answer(&payload) {
                        self.hand(payload);
                    }
                }
            }
        }
        // The core need not know of what is answered here: awake, it would keep the answer waiting. Nor of what it cannot
        // run yet.
        if self.ledger.handed() != handed && (self.progress.stops_handed() != stops || !self.progress.is_held()) {
            self.core.unpark();
        }
        self.input.drain(..taken);
        stalled
    }

    /// Answers a block here, if that can be done. A host that does not read gets its answers, like
    /// any others, from the core, which drops what finds no room.
    fn answer(&mut self, payload: &Payload) -> bool {
        let Some(answer) = self.known.answer(payload.as_slice(), || self.clock.now()) else { return false };
        let core_done = self.progress.done();
        self.frame_responses();
        if self.is_full() {
            return false;
        }
        let Some(number) = self.ledger.answer(core_done) else { return false };
        if let Some(payload) = answer.payload() {
            frame(payload, Sequence::after(number), &mut self.output);
        }
        true
    }

    /// Hands a block to the core, where there is room for it.
    fn hand(&mut self, payload: Payload) {
        if self.known.dialect.is_emergency(payload.as_slice()) {
            self.progress.stop_handed();
        }
        let _ = self.requests.push(Request::Run(payload));
        self.ledger.hand();
    }

    /// Polls for what the core makes of the blocks that it was handed just now: to sleep and be woken takes longer.
    /// If a bus holds the core, the blocks wait for longer still.
    fn await_core(&self) {
        let handed = self.ledger.handed();
        let (start, mut done) = (monotonic(), self.progress.done());
        if self.progress.is_held() {
            return;
        }
        let (mut tells, mut until) = (false, start + AWAIT_CORE);
        while done != handed {
            let (now, done_now) = (monotonic(), self.progress.done());
            let progresses = done_now != done || !tells && self.inlet.has_response();
            done = done_now;
            if progresses {
                tells = true;
                until = (start + AWAIT_CORE).min(now + AWAIT_MORE);
            }
            if now >= until {
                return;
            }
            thread::yield_now();
        }
    }

    /// Whether the host has to read before it gets any more.
    fn is_full(&self) -> bool {
        self.output.len() >= OUTPUT_BYTES
    }

    /// Frames what the core said, as long as the host reads.
    fn frame_responses(&mut self) {
        while self.output.len() < OUTPUT_BYTES {
            let Some((payload, core_begun)) = self.inlet.response() else { return };
            self.changed_at = self.changed_at.filter(|changed_at| !is_after(core_begun, *changed_at));
            if self.changed_at.is_some() && !self.known.dialect.is_own_response(payload) {
                continue;
            }
            frame(payload, Sequence::after(self.ledger.respond(core_begun)), &mut self.output);
        }
    }

    /// Frames what the core said and writes what the pty has room for.
    fn give_out(&mut self) {
        while let Some((level, line)) = self.inlet.line() {
            log!(level, "{line}");
        }
        // In this order: what the core said of the blocks that are done is in the ring already, and
        // all of it is framed before they are acknowledged.
        let core_done = self.progress.done();
        self.frame_responses();
        if !self.is_full() {
            for number in self.ledger.acknowledge(core_done).into_iter().flatten() {
                frame(&[], Sequence::after(number), &mut self.output);
            }
        }
        if !self.attached {
            self.output.clear();
        }
        if self.output.is_empty() {
            return;
        }
        match self.pty.write(&self.output) {
            Ok(written) => drop(self.output.drain(..written)),
            Err(error) => {
                warn!(
                    "{} can not be written: {error}: what the host should have read is lost, and the host asks again or gives up",
                    self.pty.device().display()
                );
                self.output.clear();
            }
        }
    }
}
