// SPDX-License-Identifier: GPL-3.0-or-later
//! The link: reads the pty, checks blocks, hands commands to the core, frames responses.
//!
//! It answers `identify` and `get_clock` by itself when they come alone in a block: they need
//! no core, and the host's clock synchronisation sees the shortest round trip.

#![forbid(unsafe_code)]

use std::io;
use std::sync::Arc;
use std::thread::{self, Thread};
use std::time::Duration;

use log::{info, log, warn};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use rtrb::Producer;

use crate::mcu::base::{ClockResponse, IdentifyResponse, identify_response};
use crate::mcu::{Dialect, Response};
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, TimeSource, monotonic};
use crate::wire::block::{Received, Receiver, Sequence, frame};
use crate::wire::vlq::{Reader, Writer};

use super::core::{Payload, Request};
use super::guardian::{GuardianWatch, in_ms};
use super::outlet::{Inlet, LinkWake, Progress};
use super::pty::Pty;
use super::signals::{Signal, Signals};
use super::watchdog::{Vigil, Watchdog};

/// What a shell writes to the pty to stop the machine, as in Klipper's service file.
const FORCE_SHUTDOWN: &[u8] = b"FORCE_SHUTDOWN\n";
/// Bytes read from the pty and not yet taken in.
const INPUT_BYTES: usize = 4096;
/// Bytes for a host that does not read; then responses wait in the ring, then they are lost.
const OUTPUT_BYTES: usize = 16 * 1024;
/// How long to wait awake for the core to be done with blocks.
const LINGER: Duration = Duration::from_micros(100);
/// How long to wait for a core that has no room for requests.
const STALL_MS: u64 = 1;
/// Room in the core's ring that blocks leave to requests: one to stop must find it where a slow bus
/// holds the blocks back.
const REQUESTS_KEPT: usize = 8;
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
            return Some(self.encode(&ClockResponse { clock: now() }));
        }
        if id != self.identify {
            return None;
        }
        let (offset, count) = (reader.int().ok()?, reader.int().ok()?);
        if !reader.is_empty() {
            return None;
        }
        let piece: IdentifyResponse<'_> = identify_response(self.dialect.compressed(), offset, count as u8);
        Some(self.encode(&piece))
    }

    fn encode<R: Response>(&self, response: &R) -> Writer {
        let mut writer = Writer::default();
        writer.int(self.dialect.response_id::<R>());
        response.encode(&mut writer);
        writer
    }
}

/// The link.
pub(super) struct Link {
    pty: Pty,
    clock: Arc<dyn TimeSource>,
    known: Known,
    receiver: Receiver,
    input: Vec<u8>,
    output: Vec<u8>,
    attached: bool,
    requests: Producer<Request>,
    core: Thread,
    inlet: Inlet,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    /// Blocks handed to the core.
    handed: u32,
    /// Blocks answered here.
    answered: u32,
    /// What the last empty block said: how many blocks were done.
    acknowledged: u32,
    /// Whether there is a processor beside the core's.
    lingers: bool,
    /// How many blocks the last framed response says were received.
    said: u32,
    /// A NAK is owed, once everything before it is done.
    refused: bool,
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
    pub(super) dialect: Arc<Dialect>,
    pub(super) requests: Producer<Request>,
    pub(super) core: Thread,
    pub(super) inlet: Inlet,
    pub(super) progress: Arc<Progress>,
    pub(super) wake: Arc<LinkWake>,
    pub(super) signals: Signals,
    pub(super) guardian: Option<GuardianWatch>,
    pub(super) vigil: Vigil,
}

impl Link {
    pub(super) fn new(parts: Parts) -> Link {
        let Parts { pty, clock, dialect, requests, core, inlet, progress, wake, signals, guardian, vigil } = parts;
        Link {
            pty,
            clock,
            known: Known::new(dialect),
            receiver: Receiver::default(),
            input: Vec::with_capacity(INPUT_BYTES),
            output: Vec::with_capacity(2 * OUTPUT_BYTES),
            attached: false,
            requests,
            core,
            inlet,
            progress,
            wake,
            handed: 0,
            answered: 0,
            acknowledged: 0,
            said: 0,
            lingers: thread::available_parallelism().is_ok_and(|count| count.get() > 1),
            refused: false,
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
            let stalled = self.take_in();
            self.linger();
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
            if woken.by_input {
                self.read()?;
            }
        }
    }

    /// Passes on what the core said last.
    pub(super) fn finish(mut self) -> Vigil {
        self.give_out();
        self.vigil
    }

    /// The program begins to end.
    pub(super) fn stopping(&self) {
        self.vigil.stopping();
    }

    fn tell_status(&self) {
        let host = if self.attached { "a host is attached" } else { "no host is attached" };
        self.vigil.status(&format!("serving on {}, {host}", self.pty.link().display()));
    }

    /// Asks the core something. It takes requests in faster than a person or a signal asks.
    pub(super) fn request(&mut self, request: Request) {
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
        let full = self.output.len() >= OUTPUT_BYTES;
        let unread = !full && (self.inlet.has_response() || self.done() != self.acknowledged);
        if unread || self.inlet.has_line() {
            self.wake.awake(false);
            return Ok(Woken { by_signal: false, by_input: true });
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
            PollFd::new(self.pty.watch(), PollFlags::POLLIN),
            PollFd::new(self.signals.event(), PollFlags::POLLIN),
            PollFd::new(guardian, PollFlags::empty()),
        ];
        match poll(&mut fds, self.timeout(stalled)) {
            Ok(_) | Err(nix::errno::Errno::EINTR) => {}
            Err(error) => return Err(error.into()),
        }
        let happened = |fd: &PollFd<'_>| fd.revents().is_some_and(|events| !events.is_empty());
        let woken = Woken { by_signal: happened(&fds[3]), by_input: happened(&fds[0]) };
        let (called, visited, lost) = (happened(&fds[1]), happened(&fds[2]), happened(&fds[4]));
        self.wake.awake(called);
        if visited {
            self.notice_host();
        }
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
        let detail =
            format!("{why}, and without it a crash would leave heaters on: Pinion ends, to be started anew with one");
        self.request(Request::Shutdown(Shutdown::because(reason::GUARDIAN_LOST, detail)));
        self.leave_at = Some(monotonic() + FAREWELL);
    }

    fn notice_host(&mut self) {
        let attached = self.pty.attached();
        if attached == self.attached {
            return;
        }
        self.attached = attached;
        self.tell_status();
        if attached {
            info!("host attached");
        } else {
            info!("host gone");
            self.output.clear();
            self.pty.discard_output();
        }
    }

    fn read(&mut self) -> io::Result<()> {
        let filled = self.input.len();
        if filled == INPUT_BYTES {
            return Ok(());
        }
        self.input.resize(INPUT_BYTES, 0);
        let read = self.pty.read(&mut self.input[filled..]);
        self.input.truncate(filled + read.as_ref().copied().unwrap_or(0));
        if read? > 0 && !self.attached {
            // It came since the last sleep: an answer to nobody would be dropped.
            self.notice_host();
        }
        if self.input[filled..] == *FORCE_SHUTDOWN {
            self.input.truncate(filled);
            warn!("FORCE_SHUTDOWN was written to {}", self.pty.device().display());
            self.request(Request::Shutdown(Shutdown::because(
                reason::FORCE_SHUTDOWN,
                "somebody wrote FORCE_SHUTDOWN to the pty; FIRMWARE_RESTART starts anew",
            )));
        }
        Ok(())
    }

    /// How many blocks are done, by the core or here.
    fn done(&self) -> u32 {
        self.progress.done().wrapping_add(self.answered)
    }

    /// Takes in the blocks that were read. True if the core had no room for all of them.
    fn take_in(&mut self) -> bool {
        let mut taken = 0;
        let mut stalled = false;
        let handed = self.handed;
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
                Received::Nak => self.refused = true,
                Received::Payload(payload) => {
                    // Answers leave in the order of the blocks.
                    let idle = self.progress.done() == self.handed;
                    let answer = if idle { self.known.answer(payload, || self.clock.now()) } else { None };
                    let Some(answer) = answer else {
                        // There is room.
                        let _ = self.requests.push(Request::Run(Payload::new(payload)));
                        self.handed = self.handed.wrapping_add(1);
                        continue;
                    };
                    frame_records(&mut self.inlet, self.answered, &mut self.said, &mut self.output);
                    self.answered = self.answered.wrapping_add(1);
                    if let Some(payload) = answer.payload() {
                        frame(payload, Sequence::after(self.done()), &mut self.output);
                    }
                }
            }
        }
        // The core need not know of what is answered here: awake, it would keep the answer waiting.
        if self.handed != handed {
            self.core.unpark();
        }
        self.input.drain(..taken);
        stalled
    }

    /// Leaves the core the microseconds that it needs for the blocks: to sleep and be woken takes
    /// longer.
    fn linger(&self) {
        let handed = self.handed;
        if !self.lingers || self.progress.done() == handed {
            return;
        }
        let end = monotonic() + LINGER;
        while self.progress.done() != handed && monotonic() < end {
            thread::yield_now();
        }
    }

    /// Says once how far the blocks are done. An empty block that repeats the number of the one
    /// before is a NAK to the host, and is sent only for that.
    fn acknowledge(&mut self, done: u32) {
        if done != self.acknowledged {
            self.acknowledged = done;
            // A response of a block that is still being run has said more: to the host a number
            // that goes back is no acknowledgement, it counts the bytes as invalid.
            if done.wrapping_sub(self.said) as i32 >= 0 {
                frame(&[], Sequence::after(done), &mut self.output);
            }
        }
        // Its number is the one after the last block's: that must be done.
        if self.refused && done == self.handed.wrapping_add(self.answered) {
            self.refused = false;
            frame(&[], Sequence::after(done), &mut self.output);
        }
    }

    /// Frames what the core said and writes what the pty has room for.
    fn give_out(&mut self) {
        while let Some((level, line)) = self.inlet.line() {
            log!(level, "{line}");
        }
        // What was said of these blocks is in the ring already.
        let done = self.done();
        frame_records(&mut self.inlet, self.answered, &mut self.said, &mut self.output);
        if self.output.len() < OUTPUT_BYTES {
            self.acknowledge(done);
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
                warn!("writing to {}: {error}", self.pty.device().display());
                self.output.clear();
            }
        }
    }
}

/// Frames what the core said as long as the host reads.
fn frame_records(inlet: &mut Inlet, answered: u32, said: &mut u32, output: &mut Vec<u8>) {
    while output.len() < OUTPUT_BYTES {
        let Some((payload, begun)) = inlet.response() else { return };
        *said = begun.wrapping_add(answered);
        frame(payload, Sequence::after(*said), output);
    }
}
