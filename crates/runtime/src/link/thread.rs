// SPDX-License-Identifier: GPL-3.0-or-later
//! The link thread: takes blocks from the host to the core, and responses from the core to the host.
//!
//! It answers `identify`, `get_clock` and `get_uptime` itself when they come alone in a block: they need no core.
//! So the host's clock synchronization sees the shortest round trip, even while a bus holds earlier blocks back.
//! It also answers `get_config` from the core's last word about it, if the core has nothing to do before it.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use pinion_firmware::mcu::base::{ClockResponse, Config, ConfigOfV010, IdentifyResponse, Uptime, identify_response};
use pinion_firmware::mcu::{Dialect, Response};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, TimeSource};
use pinion_linux::clock::{monotonic, poll_timeout};
use pinion_protocol::vlq::{Reader, Writer};

use crate::core::{Payload, Request};
use crate::link::core_end::{CoreEnd, STALL};
use crate::link::handshake::{Handshake, Step};
use crate::link::host_end::{HostEnd, Next};
use crate::link::ledger::is_after;
use crate::link::oversight::{FAREWELL, Oversight};
use crate::process::signals::Signal;
use crate::process::watchdog::Watchdog;
use crate::recorder::Recorder;
use pinion_trace::event::Event;
use pinion_trace::ring;

#[cfg(fuzzing)]
#[allow(clippy::expect_used)]
#[path = "../../tests/support/link_fuzz.rs"]
pub(crate) mod fuzz;

/// The messages that the link answers itself.
struct Known {
    dialect: Arc<Dialect>,
    get_clock: Option<u32>,
    get_uptime: Option<u32>,
    identify: Option<u32>,
    get_config: Option<u32>,
}

/// A block that the link may answer itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Question {
    Clock,
    Uptime,
    Identify { offset: u32, count: u8 },
    Config,
}

impl Known {
    fn new(dialect: Arc<Dialect>) -> Known {
        Known {
            get_clock: dialect.command_id("get_clock"),
            get_uptime: dialect.command_id("get_uptime"),
            identify: dialect.command_id("identify offset=%u count=%c"),
            get_config: dialect.command_id("get_config"),
            dialect,
        }
    }

    /// The question in a block that holds only one of these commands.
    fn question(&self, payload: &[u8]) -> Option<Question> {
        let mut reader = Reader::new(payload);
        let id = Some(reader.int().ok()?);
        let question = if id == self.get_clock {
            Question::Clock
        } else if id == self.get_uptime {
            Question::Uptime
        } else if id == self.identify {
            Question::Identify { offset: reader.int().ok()?, count: reader.int().ok()? as u8 }
        } else if id == self.get_config {
            Question::Config
        } else {
            return None;
        };
        reader.is_empty().then_some(question)
    }

    /// The answer. `config`: the answer to `get_config`, unless the core has to give it.
    fn answer(&self, question: Question, now: Clock, config: impl FnOnce() -> Option<Config>) -> Option<Writer> {
        match question {
            Question::Clock => self.encode(&ClockResponse::from(now)),
            Question::Uptime => self.encode(&Uptime::from(now)),
            Question::Identify { offset, count } => {
                let piece: IdentifyResponse<'_> = identify_response(self.dialect.compressed(), offset, count);
                self.encode(&piece)
            }
            Question::Config => {
                let config = config()?;
                self.encode(&config).or_else(|| self.encode(&ConfigOfV010::from(config)))
            }
        }
    }

    fn encode<R: Response>(&self, response: &R) -> Option<Writer> {
        let mut writer = Writer::default();
        writer.int(self.dialect.response_id::<R>()?);
        response.encode(&mut writer);
        Some(writer)
    }
}

/// The link thread.
pub(crate) struct LinkThread {
    host: HostEnd,
    core: CoreEnd,
    handshake: Handshake,
    oversight: Oversight,
    clock: Arc<dyn TimeSource>,
    known: Known,
    /// How many blocks the core had been handed when the host's dialect changed. It is kept until the core begins the
    /// next block. Earlier responses may be in the dialect of the previous host.
    changed_at: Option<u32>,
    recorder: Recorder,
    trace_writer: Option<ring::Writer>,
}

/// The event that ended the link's sleep. The link reads only its descriptor: each read is a system call.
#[derive(Clone, Copy, Debug)]
struct PollEvents {
    by_oversight: bool,
    by_input: bool,
    /// The host is gone.
    by_hangup: bool,
}

/// Why the link ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// A signal asked for it.
    Asked,
    /// The host is gone, and no other can come.
    HostOver,
    /// The guardian is gone. The program has to be started again.
    GuardianLost,
}

impl LinkThread {
    pub(crate) fn new(
        host: HostEnd,
        core: CoreEnd,
        handshake: Handshake,
        oversight: Oversight,
        clock: Arc<dyn TimeSource>,
        recorder: Recorder,
    ) -> LinkThread {
        let known = Known::new(handshake.first_dialect());
        recorder.speak(&known.dialect);
        let trace_writer = recorder.link();
        LinkThread { host, core, handshake, oversight, clock, known, changed_at: None, recorder, trace_writer }
    }

    /// Feeds a hardware watchdog from now on.
    pub(crate) fn feed(&mut self, watchdog: Watchdog) {
        self.oversight.feed(watchdog);
    }

    /// Serves the host until the program has to end.
    pub(crate) fn run(&mut self) -> io::Result<End> {
        self.oversight.ready();
        self.report_status();
        loop {
            let now = monotonic();
            if let Some(why) = self.oversight.tick(now) {
                self.lose_guardian(why);
            }
            let before = self.core.handed();
            let stalled = self.take_in();
            self.core.await_done(before);
            self.give_out();
            let woken = self.wait(stalled, now)?;
            if woken.by_oversight {
                if self.oversight.has_lost_guardian() {
                    self.lose_guardian("somebody killed the guardian");
                }
                while let Some(signal) = self.oversight.next_signal() {
                    match signal {
                        Signal::End => return Ok(End::Asked),
                        Signal::Report => self.request(Request::Report),
                        Signal::Hang => self.request(Request::Hang),
                    }
                }
            }
            if self.oversight.is_over() {
                return Ok(End::GuardianLost);
            }
            if (woken.by_hangup || woken.by_input) && self.read(woken.by_hangup)? {
                return Ok(End::HostOver);
            }
        }
    }

    /// Passes on the core's last responses and log lines.
    pub(crate) fn finish(&mut self) {
        self.give_out();
    }

    /// Gives a host time to read why the program ends. Unread bytes are lost when the terminal closes. Then klippy
    /// reports a lost communication, seconds later.
    pub(crate) fn farewell(&mut self) {
        let end = monotonic() + FAREWELL;
        while self.host.is_attached() && monotonic() < end {
            // Bytes without room in the terminal go out as the host reads.
            let is_out = self.host.is_out() && !self.core.reader.has_response();
            let events = if is_out { PollFlags::empty() } else { PollFlags::POLLOUT };
            let Some(event) = self.host.event() else { return };
            let mut fds = [PollFd::new(event, events)];
            // A host that hangs up has read it. A further signal ends the wait.
            if poll(&mut fds, poll_timeout(end.saturating_sub(monotonic()))) != Ok(1)
                || fds[0].revents() != Some(PollFlags::POLLOUT)
            {
                return;
            }
            self.give_out();
        }
    }

    /// Closes the link, then stops the watchdogs.
    pub(crate) fn close(self) {
        let LinkThread { host, core, handshake, oversight, recorder, .. } = self;
        drop((host, core, handshake, recorder));
        oversight.end();
    }

    /// Informs the service manager that the program begins to end.
    pub(crate) fn stopping(&self) {
        self.oversight.stopping();
    }

    /// Passes a request to the core.
    pub(crate) fn request(&mut self, request: Request) {
        self.core.request(request);
    }

    fn report_status(&self) {
        self.oversight.status(&self.host.summary());
    }

    /// Sleeps until there is something to do. `now` may be a little in the past: a read of the clock is not free.
    fn wait(&mut self, stalled: bool, now: Duration) -> io::Result<PollEvents> {
        self.core.wake.sleeping();
        if self.core.has_news() && !self.host.is_full() || self.core.reader.has_line() {
            self.core.wake.awake(false);
            return Ok(PollEvents { by_oversight: false, by_input: true, by_hangup: false });
        }
        let mut events = PollFlags::empty();
        if !stalled {
            events |= PollFlags::POLLIN;
        }
        if !self.host.is_out() && self.host.reports_room() {
            events |= PollFlags::POLLOUT;
        }
        // The terminal is the first. poll(2) waits for the kernel's thread that moves its bytes. An event of the core that
        // is already listened to would interrupt this wait, for a wake-up of the link in vain.
        let (wake, event, due) = (self.core.wake.event(), self.host.event(), self.host.due());
        let mut fds = [
            PollFd::new(event.unwrap_or(wake), events),
            PollFd::new(wake, PollFlags::POLLIN),
            PollFd::new(self.oversight.event(), PollFlags::POLLIN),
        ];
        let from = if event.is_some() { 0 } else { 1 };
        match poll(&mut fds[from..], self.timeout(stalled, due, now)) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(error.into()),
        }
        let events = |fd: &PollFd<'_>| fd.revents().unwrap_or(PollFlags::empty());
        let woken = PollEvents {
            by_oversight: !events(&fds[2]).is_empty(),
            by_input: events(&fds[0]).intersects(PollFlags::POLLIN | PollFlags::POLLERR)
                || due.is_some_and(|due| monotonic() >= due),
            by_hangup: events(&fds[0]).contains(PollFlags::POLLHUP),
        };
        let called = !events(&fds[1]).is_empty();
        self.core.wake.awake(called);
        Ok(woken)
    }

    /// `due` is the link's own deadline.
    fn timeout(&self, stalled: bool, due: Option<Duration>, now: Duration) -> PollTimeout {
        let due = self.oversight.due().into_iter().chain(due).min().map(|at| at.saturating_sub(now));
        stalled.then_some(STALL).into_iter().chain(due).min().map_or(PollTimeout::NONE, poll_timeout)
    }

    /// The guardian is gone or of no use. This stops the MCU. The program ends when the host has had time to read why.
    fn lose_guardian(&mut self, why: &str) {
        let cause = format!("{why}, and without it a crash would leave heaters on");
        let stop = Shutdown::because(reason::GUARDIAN_LOST, cause);
        self.request(Request::Shutdown(stop.remedy("Pinion ends, so that its service restarts it with one")));
        self.oversight.lose_guardian();
    }

    /// Reads the bytes that have come. True if no host can come any more.
    fn read(&mut self, hung_up: bool) -> io::Result<bool> {
        let was_open = self.host.is_open();
        let read = self.host.read(hung_up)?;
        if read.is_gone {
            self.handshake.end();
            self.record(Event::HostGone);
        }
        if let Some(stop) = self.host.intrusion() {
            self.request(Request::Shutdown(stop));
        }
        if read.is_gone || read.is_new_host || self.host.is_open() != was_open {
            self.report_status();
        }
        if read.is_new_host {
            self.handshake.begin(self.host.terminal());
            self.record(Event::HostCame);
        }
        if read.is_sign {
            self.record(Event::Alive);
        }
        if read.is_forced {
            self.handshake.stop();
            let stop = Shutdown::because(reason::FORCE_SHUTDOWN, "somebody wrote FORCE_SHUTDOWN to the pty");
            self.request(Request::Shutdown(stop.remedy("send FIRMWARE_RESTART")));
        }
        Ok(read.is_over)
    }

    /// Whether the link still has to find the host's dialect or the board's devices.
    fn is_finding(&mut self) -> bool {
        loop {
            match self.handshake.step() {
                Step::Wait => return true,
                Step::Renew => self.request(Request::Renew),
                Step::Speak(dialect) => self.speak(dialect),
                Step::Done => return false,
            }
        }
    }

    /// Speaks this dialect from now on.
    fn speak(&mut self, dialect: Arc<Dialect>) {
        // The search for the host has logged that, too.
        self.recorder.carry(self.host.is_carried());
        if Arc::ptr_eq(&dialect, &self.known.dialect) {
            return;
        }
        if dialect.forms() != self.known.dialect.forms() {
            self.changed_at = Some(self.core.ledger.handed());
        }
        self.known = Known::new(dialect.clone());
        self.recorder.speak(&dialect);
        self.request(Request::Speak(dialect));
    }

    /// Takes in the blocks that were read. True if they have to wait: for the host's dialect, or for room in the core's
    /// ring.
    fn take_in(&mut self) -> bool {
        if self.is_finding() {
            return true;
        }
        let before = self.core.handed();
        let stalled = loop {
            if !self.core.has_room() {
                self.record(Event::Full);
                break true;
            }
            match self.host.next() {
                Next::Nothing => break false,
                Next::Nak(why) => {
                    self.core.ledger.refuse();
                    self.record(Event::Refused(why));
                }
                Next::Block(payload) => {
                    let at = self.clock.now();
                    let event = if self.answer(&payload, at) {
                        Event::Answered { id: Reader::new(payload.as_slice()).int().unwrap_or(0) as i16 }
                    } else {
                        let stops = self.known.dialect.is_emergency(payload.as_slice());
                        self.core.hand(payload, stops);
                        Event::BlockIn(self.core.ledger.handed())
                    };
                    self.record_at(at, event);
                }
            }
        };
        self.core.wake_for(before);
        self.host.forget_taken() && stalled
    }

    /// Answers a block here, if that is possible. A host that does not read gets its answers from the core, like all
    /// others. The core drops answers that find no room.
    fn answer(&mut self, payload: &Payload, now: Clock) -> bool {
        let Some(question) = self.known.question(payload.as_slice()) else { return false };
        let core_done = self.core.progress.done();
        self.frame_responses();
        if self.host.is_full() {
            return false;
        }
        let config = || self.core.config(core_done);
        let Some(answer) = self.known.answer(question, now, config) else { return false };
        let Some(number) = self.core.ledger.answer(core_done) else { return false };
        if let Some(answer) = answer.payload() {
            self.host.frame(answer, number);
        }
        true
    }

    /// Frames the core's responses, as long as the host reads.
    fn frame_responses(&mut self) {
        while !self.host.is_full() {
            let Some((payload, core_begun)) = self.core.reader.response() else { return };
            self.changed_at = self.changed_at.filter(|changed_at| !is_after(core_begun, *changed_at));
            if self.changed_at.is_some() && !self.known.dialect.is_own_response(payload) {
                continue;
            }
            self.host.frame(payload, self.core.ledger.respond(core_begun));
        }
    }

    /// Frames the core's responses and acknowledgements, and writes as much as the link has room for.
    fn give_out(&mut self) {
        self.core.log_lines();
        // The order matters. The responses to finished blocks are already in the ring, and all are framed before these
        // blocks are acknowledged.
        let core_done = self.core.progress.done();
        self.frame_responses();
        if !self.host.is_full() {
            let [news, nak] = self.core.ledger.acknowledge(core_done);
            for number in news.into_iter().chain(nak) {
                self.host.frame(&[], number);
            }
            if nak.is_some() {
                self.record(Event::Nak);
            }
        }
        let bytes = self.host.write();
        if bytes > 0 {
            self.record(Event::Out(bytes));
        }
    }

    fn record(&mut self, event: Event) {
        self.record_at(self.clock.now(), event);
    }

    fn record_at(&mut self, at: Clock, event: Event) {
        if let Some(trace_writer) = &mut self.trace_writer {
            trace_writer.write(at, event);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FIRMWARE;
    use pinion_firmware::mcu::DialectName;
    use pinion_firmware::time::VirtualClock;
    use pinion_testbench::board::{Bench, FakeBoard};

    #[test]
    fn the_link_answers_a_question_that_is_alone_in_its_block() {
        let board = FakeBoard(Bench::new(VirtualClock::at(Clock::EPOCH), Clock::EPOCH));
        let dialect = Arc::new(Dialect::new(&FIRMWARE, &board, DialectName::Master).unwrap());
        let known = Known::new(dialect.clone());
        let answer = |commands: &[(&str, &[u32])]| {
            let mut block = Writer::default();
            for (format, parameters) in commands {
                block.int(dialect.command_id(format).unwrap());
                parameters.iter().for_each(|parameter| block.int(*parameter));
            }
            let question = known.question(block.payload().unwrap())?;
            let answer = known.answer(question, Clock::from_ticks(7 << 32 | 1234), || None)?;
            Some(answer.payload().unwrap().to_vec())
        };
        let get_clock: (&str, &[u32]) = ("get_clock", &[]);
        let get_uptime: (&str, &[u32]) = ("get_uptime", &[]);
        let identify: (&str, &[u32]) = ("identify offset=%u count=%c", &[40, 20]);

        let clock = answer(&[get_clock]).unwrap();
        let mut reader = Reader::new(&clock);
        assert_eq!(reader.int().ok(), dialect.response_id::<ClockResponse>());
        assert_eq!((reader.int(), reader.is_empty()), (Ok(1234), true));

        let uptime = answer(&[get_uptime]).unwrap();
        let mut reader = Reader::new(&uptime);
        assert_eq!(reader.int().ok(), dialect.response_id::<Uptime>());
        assert_eq!((reader.int(), reader.int(), reader.is_empty()), (Ok(7), Ok(1234), true));

        let piece = answer(&[identify]).unwrap();
        let mut reader = Reader::new(&piece);
        assert_eq!(reader.int().ok(), dialect.response_id::<IdentifyResponse<'_>>());
        assert_eq!((reader.int(), reader.bytes()), (Ok(40), Ok(&dialect.compressed()[40..60])));
        assert!(reader.is_empty());

        // Commands that need the core, or the order of a block.
        let others: [&[(&str, &[u32])]; 8] = [
            &[],
            &[("get_config", &[])],
            &[("update_digital_out oid=%c value=%c", &[1, 1])],
            &[get_clock, get_clock],
            &[get_clock, get_uptime],
            &[get_clock, identify],
            &[identify, get_clock],
            &[("identify offset=%u count=%c", &[40])],
        ];
        for commands in others {
            assert_eq!(answer(commands), None, "{commands:?}");
        }
    }
}
