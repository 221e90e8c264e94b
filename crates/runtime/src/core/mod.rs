// SPDX-License-Identifier: GPL-3.0-or-later
//! The core owns the MCU. It runs due timers first, then commands while no timer is near. Otherwise it waits.

#![forbid(unsafe_code)]

pub(crate) mod budget;
pub(crate) mod busy_poll;
pub(crate) mod heartbeat;
pub(crate) mod monitors;
pub(crate) mod responses;
pub(crate) mod start;
pub mod wakeup;
pub(crate) mod workers;

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use rtrb::Consumer;

use pinion_firmware::mcu::{Dialect, Mcu, base};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks};
use pinion_linux::clock::monotonic;
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::vlq::Reader;
use pinion_sync::progress::Progress;

use crate::core::busy_poll::PollBudget;
use crate::core::heartbeat::{BEAT, Heartbeat};
use crate::core::responses::LinkWake;
use crate::core::wakeup::{Waiter, Woken};
use crate::recorder::TraceWriter;
use crate::status::SnapshotWriter;

/// The payload of a message block on its way to the core.
#[derive(Clone, Copy)]
pub(crate) struct Payload {
    len: u8,
    bytes: [u8; PAYLOAD_MAX],
}

impl Payload {
    /// A copy of `payload`, the payload of one block.
    pub(crate) fn new(payload: &[u8]) -> Payload {
        let len = payload.len().min(PAYLOAD_MAX);
        let mut bytes = [0; PAYLOAD_MAX];
        bytes[..len].copy_from_slice(&payload[..len]);
        Payload { len: len as u8, bytes }
    }

    pub(crate) fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// A request of the link to the core.
pub(crate) enum Request {
    /// Run the commands of a block.
    Run(Payload),
    /// Stop the MCU.
    Shutdown(Shutdown),
    /// Speak this dialect: another host came. The link keeps a copy, so that the core never frees one.
    Speak(Arc<Dialect>),
    /// Report how late timers were.
    Report,
    /// Stop the MCU and end. A running MCU stops for this reason, if there is one. Otherwise somebody asked for it.
    Quit(Option<Shutdown>),
    /// Hang forever, for a test.
    Hang,
}

/// No command starts if a timer is due within this span. A command takes one or two microseconds.
const NEAR: Ticks = Ticks::from_us(5);
/// Before a timer farther away than this, the core naps. Before a nearer one it needs no heartbeat.
const FAR_TICKS: i64 = (BEAT.as_nanos() / NS_PER_TICK as u128) as i64;
/// Work that can wait is done only if no timer is due within this span. To wake the link takes some microseconds. To
/// publish a part of the status takes one, or several if nothing of it is in the cache.
const SOON: Ticks = Ticks::from_us(30);
/// Highest number of waiting requests at which a core held by a bus wakes the link for finished blocks. To acknowledge
/// each block costs as much as to run it.
const FEW: usize = 3;
/// How long the core polls for the next command before it sleeps. Hosts send in bursts. A wake-up takes as long: 20 to
/// 50 us on the computers measured.
const NEXT_COMMAND: Ticks = Ticks::from_us(30);
/// How long the core polls for the answer of a bus that a command waits for.
const ANSWER: Ticks = Ticks::from_us(100);
/// Longest time that another thread keeps the processor after a yield. 3.5 ms were measured.
const SLICE: Ticks = Ticks::from_ms(5);
/// A command runs after it has yielded to this many timers.
const YIELDS_MAX: u32 = 20;
/// How long an ending program waits until its outputs have their shutdown values. The guardian acts earlier.
const LAST_WRITES: Duration = Duration::from_millis(1500);

pub(crate) struct Core {
    mcu: Mcu,
    requests: Consumer<Request>,
    waiter: Waiter,
    heartbeat: Heartbeat,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    /// The present block, and the offset of its next command.
    block: Option<(Payload, usize)>,
    yielded: u32,
    /// How many of the link's stop requests the core has taken.
    stops_taken: u32,
    /// The link was not yet woken for some finished blocks.
    untold: bool,
    polling: PollBudget,
    /// The output whose shutdown value is pending, as the guardian knows.
    pending: Option<String>,
    snapshots: SnapshotWriter,
    trace_writer: TraceWriter,
}

/// The parts of the core.
pub(crate) struct Parts {
    pub(crate) mcu: Mcu,
    pub(crate) requests: Consumer<Request>,
    pub(crate) waiter: Waiter,
    pub(crate) heartbeat: Heartbeat,
    pub(crate) progress: Arc<Progress>,
    pub(crate) wake: Arc<LinkWake>,
    pub(crate) snapshots: SnapshotWriter,
    pub(crate) trace_writer: TraceWriter,
    /// There is a second processor, so that the core may poll.
    pub(crate) may_poll: bool,
}

/// The result of a turn for commands.
enum Turn {
    Done,
    Idle,
    Quit,
}

/// The state of the outputs after the program was asked to end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Left {
    /// At their shutdown values.
    Safe,
    /// This output is not at its shutdown value, as far as is known.
    Pending(String),
}

impl Core {
    pub(crate) fn new(parts: Parts) -> Core {
        let Parts { mcu, requests, waiter, heartbeat, progress, wake, snapshots, trace_writer, may_poll } = parts;
        Core {
            untold: false,
            polling: PollBudget::new(may_poll, mcu.last_read()),
            mcu,
            requests,
            waiter,
            heartbeat,
            progress,
            wake,
            block: None,
            yielded: 0,
            stops_taken: 0,
            pending: None,
            snapshots,
            trace_writer,
        }
    }

    /// Runs until it is asked to quit.
    pub(crate) fn run(mut self) -> Left {
        self.trace_writer.start();
        let mut busy_since = self.mcu.now();
        let mut was_shutdown = false;
        loop {
            if self.mcu.is_shutdown() != was_shutdown {
                was_shutdown = !was_shutdown;
                if was_shutdown {
                    self.mcu.report_lateness(self.waiter.margin());
                }
            }
            let behind = self.mcu.run_timers();
            if let Some(standstill) = self.heartbeat.standstill(self.mcu.last_read()) {
                self.mcu.shut_down(standstill);
            }
            self.heartbeat.beat(self.mcu.last_read(), self.mcu.is_running());
            self.mcu.run_workers();
            self.tell_pending();
            self.waiter.ran(self.mcu.last_read());
            if behind {
                self.record();
            }
            if self.mcu.is_held() && !self.mcu.is_shutdown() && self.progress.stops_handed() != self.stops_taken {
                self.stop_ahead();
            }
            let near = self.mcu.next_timer().is_some_and(|next| next < self.mcu.last_read() + NEAR);
            if behind || !near || self.yielded >= YIELDS_MAX {
                match self.run_commands(behind) {
                    Turn::Done => {
                        let span = if self.mcu.is_held() { ANSWER } else { NEXT_COMMAND };
                        self.polling.expect(self.mcu.last_read(), span);
                        continue;
                    }
                    Turn::Quit => {
                        if !was_shutdown {
                            self.mcu.report_lateness(self.waiter.margin());
                        }
                        return self.end();
                    }
                    Turn::Idle => {}
                }
            }
            let deadline = self.mcu.next_timer();
            // The timers have just read it, if none is due.
            let now = self.mcu.last_read();
            if deadline.is_some_and(|deadline| deadline <= now) {
                self.yielded += 1;
                continue;
            }
            self.record();
            if self.snapshots.is_asked() && !soon(deadline, now) {
                self.snapshots.publish(&self.mcu, self.requests.slots(), self.waiter.margin());
                continue;
            }
            if self.untold && self.mcu.is_held() && self.requests.slots() <= FEW && !soon(deadline, now) {
                self.untold = false;
                self.wake.wake();
                continue;
            }
            if self.polling.goes_on(now)
                && self.waiter.has_time_to_spare()
                && may_yield(self.waiter.is_realtime(), now, deadline)
            {
                thread::yield_now();
                continue;
            }
            self.mcu.account(Ticks(now.since(busy_since) as u32));
            let to_go = deadline.map_or(2 * FAR_TICKS, |deadline| deadline.since(now));
            let Some(deadline) = deadline.filter(|_| to_go <= FAR_TICKS) else {
                // Sleep half the way: this leaves room for a late wake-up.
                busy_since = self.nap(now, now + Ticks(FAR_TICKS.min(to_go / 2) as u32));
                continue;
            };
            let exact = self.mcu.next_exact_timer();
            let Core { waiter, progress, stops_taken, mcu, block, requests, .. } = &mut self;
            let calls = Calls { core: progress, stops_taken: *stops_taken, mcu, block: block.as_ref(), requests };
            // Near a timer, calls have to wait.
            busy_since = match waiter.wait(now, deadline, exact, |now| deadline >= now + NEAR && calls.any()) {
                // The edge must not wait for another read of the clock.
                Woken::Due(now) => {
                    self.mcu.saw(now);
                    self.yielded += 1;
                    now
                }
                Woken::Called(now) => now,
            };
        }
    }

    /// Sleeps while no timer is due, or until the core is woken, so that the heartbeat continues. Unlike the wait for a
    /// timer, it ends without spinning. Returns the time now.
    fn nap(&mut self, now: Clock, end: Clock) -> Clock {
        let Core { progress, stops_taken, mcu, block, requests, .. } = &*self;
        let calls = Calls { core: progress, stops_taken: *stops_taken, mcu, block: block.as_ref(), requests };
        if calls.any() { now } else { self.waiter.nap(now, end) }
    }

    /// Records the last sleep, and what has changed. The core does this when no timer is due: before it polls or sleeps.
    #[inline]
    fn record(&mut self) {
        if let Some(sleep) = self.waiter.take_sleep() {
            self.trace_writer.woke(sleep);
        }
        self.trace_writer.turn(&mut self.mcu, !self.waiter.is_realtime());
    }

    /// Gives the guardian the name of an output with a pending shutdown value.
    fn tell_pending(&mut self) {
        if !self.mcu.has_pending_values() {
            if self.pending.take().is_some() {
                self.heartbeat.clear_pending(self.mcu.last_read());
            }
            return;
        }
        let pending = self.mcu.pending_value();
        if pending != self.pending.as_deref() {
            self.heartbeat.set_pending(pending.unwrap_or_default(), self.mcu.last_read());
            self.pending = pending.map(str::to_owned);
        }
    }

    /// Waits until the outputs have their shutdown values.
    fn end(mut self) -> Left {
        let deadline = monotonic() + LAST_WRITES;
        while self.mcu.has_pending_values() && monotonic() < deadline {
            self.mcu.run_timers();
            self.mcu.run_workers();
            self.tell_pending();
            self.heartbeat.beat(self.mcu.now(), false);
            thread::sleep(Duration::from_millis(1));
        }
        let left = self.mcu.pending_value().map_or(Left::Safe, |pending| Left::Pending(pending.to_owned()));
        // This beat gives workers and devices time to end.
        self.heartbeat.beat(self.mcu.now(), false);
        left
    }

    /// How many commands fit before the next timer, if each takes [`NEAR`]. At least one.
    fn room(&self) -> i64 {
        let to_go = |next: Clock| next.since(self.mcu.last_read()) / i64::from(NEAR.0);
        self.mcu.next_timer().map_or(i64::MAX, to_go).max(1)
    }

    /// Stops the MCU ahead of a held block, because a stop request waits behind it. The MCU then refuses the requests
    /// before the stop request, as any stopped MCU does.
    #[cold]
    fn stop_ahead(&mut self) {
        let Core { mcu, requests, block, .. } = self;
        let rest = block.as_ref().is_some_and(|(payload, at)| mcu.is_emergency(&payload.as_slice()[*at..]));
        let waiting = requests.slots();
        let stop = match requests.read_chunk(waiting) {
            _ if rest => Some(base::emergency()),
            Err(_) => None,
            Ok(waiting) => {
                let (first, second) = waiting.as_slices();
                let mut heard = mcu.heard();
                first.iter().chain(second).find_map(|request| match request {
                    Request::Run(payload) => heard.is_emergency(payload.as_slice()).then(base::emergency),
                    Request::Shutdown(shutdown) => Some(shutdown.clone()),
                    Request::Quit(why) => Some(why.clone().unwrap_or_else(program_ends)),
                    Request::Speak(dialect) => {
                        heard = dialect;
                        None
                    }
                    Request::Report | Request::Hang => None,
                })
            }
        };
        // Without one, it is still on its way into the ring.
        if let Some(stop) = stop {
            self.mcu.shut_down(stop);
        }
    }

    /// Runs one command of a block, or as many as there is time for. If the next request is no block, it serves that
    /// request.
    #[inline]
    fn run_commands(&mut self, one: bool) -> Turn {
        self.yielded = 0;
        if self.mcu.is_held() {
            match next_commands(self.block.as_ref(), &self.requests) {
                Some(commands) if self.mcu.may_run(commands) => {}
                next => {
                    // The blocks behind it can wait as well.
                    self.progress.hold(next.is_some());
                    return Turn::Idle;
                }
            }
        }
        self.progress.hold(false);
        let (payload, mut at) = match self.block.take() {
            Some(block) => block,
            None => match self.requests.pop() {
                Ok(Request::Run(payload)) => {
                    self.trace_writer.began(self.mcu.last_read(), self.progress.begin());
                    (payload, 0)
                }
                Ok(request) => return self.serve(request),
                Err(_) => return Turn::Idle,
            },
        };
        let bytes = payload.as_slice();
        let mut reader = Reader::new(&bytes[at..]);
        let (began, mut count) = (self.mcu.last_read(), 0);
        for _ in 0..if one { 1 } else { self.room() } {
            if reader.is_empty() || !self.mcu.may_run(reader.rest()) {
                break;
            }
            self.mcu.execute(&mut reader);
            count += 1;
        }
        self.trace_writer.ran(began, &bytes[at..], count);
        at = bytes.len() - reader.rest().len();
        if at < bytes.len() || self.mcu.keeps_block() {
            self.progress.hold(self.mcu.is_held());
            self.block = Some((payload, at));
            return Turn::Done;
        }
        if self.progress.stops_handed() != self.stops_taken && self.mcu.is_emergency(bytes) {
            self.stops_taken = self.stops_taken.wrapping_add(1);
        }
        // A send that is under way may still stop the MCU, and `get_config` comes after it.
        self.progress.publish(if self.mcu.is_held() { 0 } else { self.mcu.config().word() });
        self.progress.finish();
        // The end of the next block is early enough, if that block may begin. But an MCU that is being configured takes
        // its time for a block.
        self.untold = !self.requests.is_empty() && self.mcu.is_running();
        if !self.untold {
            self.wake.wake();
        }
        Turn::Done
    }

    /// Serves a request other than a block.
    fn serve(&mut self, request: Request) -> Turn {
        match request {
            Request::Shutdown(shutdown) => {
                self.stops_taken = self.stops_taken.wrapping_add(1);
                self.mcu.shut_down(shutdown);
            }
            Request::Speak(dialect) => self.mcu.speak(dialect),
            Request::Report => self.mcu.report_lateness(self.waiter.margin()),
            Request::Quit(why) => {
                let is_last = |why: &Shutdown| self.mcu.last_stop().is_some_and(|(stop, _)| stop.reason == why.reason);
                let why = why.filter(|why| self.mcu.is_running() || is_last(why));
                let is_news = why.is_some();
                self.mcu.shut_down(why.unwrap_or_else(program_ends));
                if is_news {
                    self.record();
                }
                return Turn::Quit;
            }
            Request::Hang => loop {
                thread::park();
            },
            Request::Run(_) => {}
        }
        Turn::Done
    }
}

fn program_ends() -> Shutdown {
    Shutdown::because(reason::FORCE_SHUTDOWN, "the program ends; the host sees the connection close")
}

/// The commands that come next: the rest of the block that was begun, or the next block.
#[inline]
fn next_commands<'a>(block: Option<&'a (Payload, usize)>, requests: &'a Consumer<Request>) -> Option<&'a [u8]> {
    match block {
        Some((payload, at)) => payload.as_slice().get(*at..),
        None => match requests.peek() {
            Ok(Request::Run(payload)) => Some(payload.as_slice()),
            _ => None,
        },
    }
}

/// Reasons to end the core's wait.
struct Calls<'a> {
    core: &'a Progress,
    stops_taken: u32,
    mcu: &'a Mcu,
    block: Option<&'a (Payload, usize)>,
    requests: &'a Consumer<Request>,
}

impl Calls<'_> {
    /// Whether there is work: a job is finished, or a command may run. A stop request behind a command that may not
    /// run is work too.
    #[inline]
    fn any(&self) -> bool {
        self.mcu.has_completion()
            || match self.mcu.is_held() {
                false => self.block.is_some() || !self.requests.is_empty(),
                true => {
                    !self.mcu.is_shutdown() && self.core.stops_handed() != self.stops_taken
                        || next_commands(self.block, self.requests).is_some_and(|commands| self.mcu.may_run(commands))
                }
            }
    }
}

/// Whether a timer is too near for work that can wait.
fn soon(deadline: Option<Clock>, now: Clock) -> bool {
    deadline.is_some_and(|deadline| deadline <= now + SOON)
}

/// Whether a yield cannot delay a timer. After a yield, an ordinary thread may be without a processor for the slices of
/// other threads. A thread that wakes up gets its turn.
fn may_yield(realtime: bool, now: Clock, deadline: Option<Clock>) -> bool {
    realtime || deadline.is_none_or(|deadline| deadline > now + SLICE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recorder::{Recorder, Recording};
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::thread::JoinHandle;
    use std::time::Instant;

    use nix::poll::{PollFd, PollFlags, poll};
    use rtrb::{Producer, RingBuffer};

    use crate::FIRMWARE;
    use crate::core::wakeup::MarginLimits;
    use crate::core::workers::Threads;
    use crate::process::realtime::{Processors, Scheduling};
    use crate::status;
    use pinion_firmware::mcu::{DialectName, Note, Outbox};
    use pinion_firmware::time::{TimeSource, Timing, VirtualClock};
    use pinion_linux::clock::Monotonic;
    use pinion_linux::parker::Parker;
    use pinion_protocol::vlq::Writer;
    use pinion_testbench::board::{Bench, FakeBoard};

    #[derive(Clone, Default)]
    struct Heard(Arc<Mutex<Vec<Vec<u8>>>>);

    impl Outbox for Heard {
        fn send(&mut self, payload: &[u8]) {
            self.0.lock().unwrap().push(payload.to_vec());
        }
        fn note(&mut self, _note: Note<'_>) {}
    }

    /// A clock that counts its readings. The core reads it in each turn.
    struct Counting(Monotonic, AtomicUsize);

    impl TimeSource for Counting {
        fn now(&self) -> Clock {
            self.1.fetch_add(1, Ordering::Relaxed);
            self.0.now()
        }

        fn instant_of(&self, monotonic: Duration) -> Clock {
            self.0.instant_of(monotonic)
        }

        fn duration_of(&self, clock: Clock) -> Duration {
            self.0.duration_of(clock)
        }
    }

    /// A working core with an SPI device and a digital output, and a stand-in for its link.
    struct Rig {
        thread: JoinHandle<Left>,
        parker: Arc<Parker>,
        dialect: Arc<Dialect>,
        clock: Arc<Counting>,
        requests: Producer<Request>,
        progress: Arc<Progress>,
        wake: Arc<LinkWake>,
        heard: Heard,
        bench: Bench,
    }

    const RESPONSE: &str = "spi_transfer_response oid=%c response=%*s";
    const CONFIGURATION: u32 = 7;

    impl Rig {
        fn new() -> Rig {
            let bench = Bench::new(VirtualClock::at(Clock::EPOCH), Clock::EPOCH);
            let board = FakeBoard(bench.clone());
            let dialect = Arc::new(Dialect::new(&FIRMWARE, &board, DialectName::Master).unwrap());
            let monotonic = Monotonic::start();
            let clock = Arc::new(Counting(monotonic, AtomicUsize::new(0)));
            let (requests, inbox) = RingBuffer::new(64);
            let progress = Arc::new(Progress::default());
            let heard = Heard::default();
            let (core_dialect, core_progress, core_heard) = (dialect.clone(), progress.clone(), heard.clone());
            let core_clock: Arc<dyn TimeSource> = clock.clone();
            let wake = Arc::new(LinkWake::new().unwrap());
            let core_wake = wake.clone();
            let parker = Arc::new(Parker::default());
            let core_parker = parker.clone();
            let thread = thread::spawn(move || {
                let heartbeat = Heartbeat::new(monotonic).unwrap();
                let recording = Recording::of_a_test();
                let (_recorder, trace_writer) = Recorder::new(recording.clone()).unwrap();
                let workers =
                    Threads::new(core_parker.clone(), Arc::new(|| ()), core_clock.clone(), heartbeat, recording, true);
                let mcu = Mcu::new(
                    core_dialect,
                    Box::new(board),
                    Timing::of(core_clock.clone()),
                    Box::new(workers),
                    Box::new(core_heard),
                );
                let early = Ticks::from_us(200);
                let (limits, processors) = (MarginLimits::always(early), Processors::new(None).unwrap());
                let waiter = Waiter::new(core_clock, core_parker, limits, Scheduling::Ordinary, processors);
                let (progress, wake) = (core_progress, core_wake);
                let snapshots = status::ends().0;
                let may_poll = true;
                let requests = inbox;
                Core::new(Parts { mcu, requests, waiter, heartbeat, progress, wake, snapshots, trace_writer, may_poll })
                    .run()
            });
            let mut rig = Rig { thread, parker, dialect, clock, requests, progress, wake, heard, bench };
            rig.run("allocate_oids count=%c", &[3]);
            rig.run("config_spi_without_cs oid=%c", &[0]);
            rig.run("spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u", &[0, 0, 0, 1]);
            rig.run("config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u", &[1, 30, 0, 0, 0]);
            rig.run("config_buttons oid=%c button_count=%c", &[2, 1]);
            rig.run("buttons_add oid=%c pos=%c pin=%u pull_up=%c", &[2, 0, 31, 0]);
            rig.run("finalize_config crc=%u", &[1]);
            rig.wait_until("it is configured", |rig| rig.progress.done() == CONFIGURATION);
            rig
        }

        /// The same during a transfer on a hanging bus, with a command behind it.
        fn held() -> Rig {
            let mut rig = Rig::new();
            rig.bench.hang(true);
            rig.transfer(7);
            rig.run("update_digital_out oid=%c value=%c", &[1, 1]);
            rig.wait_until("the transfer is under way", |rig| rig.bench.hangs());
            rig.wait_until("the command behind it waits", |rig| rig.progress.is_held());
            rig
        }

        fn transfer(&mut self, byte: u32) {
            self.run("spi_transfer oid=%c data=%*s", &[0, 1, byte]);
        }

        fn run(&mut self, format: &str, parameters: &[u32]) {
            let payload = self.encode(format, parameters);
            self.request(Request::Run(payload));
        }

        fn encode(&self, format: &str, parameters: &[u32]) -> Payload {
            let mut writer = Writer::default();
            writer.int(self.dialect.command_id(format).unwrap());
            parameters.iter().for_each(|parameter| writer.int(*parameter));
            Payload::new(writer.payload().unwrap())
        }

        fn request(&mut self, request: Request) {
            self.requests.push(request).ok().unwrap();
            self.parker.unpark();
        }

        /// Asks for a stop as the link does.
        fn stop(&mut self, request: Request) {
            self.progress.stop_handed();
            self.request(request);
        }

        fn quit(mut self) -> Left {
            self.bench.hang(false);
            self.stop(Request::Quit(None));
            self.thread.join().unwrap()
        }

        /// The parameters of all responses of this format so far.
        fn said(&self, format: &str) -> Vec<Vec<u8>> {
            let id = self.dialect.dictionary().responses[format].as_i64().unwrap();
            let heard = self.heard.0.lock().unwrap();
            let parameters = heard.iter().filter_map(|payload| {
                let mut reader = Reader::new(payload);
                (i64::from(reader.int().unwrap() as i32) == id).then(|| reader.rest().to_vec())
            });
            parameters.collect()
        }

        fn is_stopped(&self) -> bool {
            !self.said("shutdown clock=%u static_string_id=%hu").is_empty()
        }

        /// Waits until the link, which sleeps, is woken.
        fn wait_until_link_wakes(&self) {
            let mut fds = [PollFd::new(self.wake.event(), PollFlags::POLLIN)];
            assert_eq!(poll(&mut fds, 60_000u16), Ok(1), "the link is not told");
        }

        fn wait_until(&self, what: &str, holds: impl Fn(&Rig) -> bool) {
            let end = Instant::now() + Duration::from_secs(60);
            while !holds(self) {
                assert!(Instant::now() < end, "{what}: {} blocks done", self.progress.done());
                thread::sleep(Duration::from_millis(1));
            }
        }
    }

    #[test]
    fn the_core_is_called_for_work_that_it_can_do_and_for_a_stop() {
        let config = ["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000"];
        let mut rig = pinion_testbench::rig::Rig::with_workers(50_000, &config);
        let progress = Progress::default();
        let (mut reader, requests) = RingBuffer::new(1);
        let called = |mcu: &Mcu, block: Option<&(Payload, usize)>| {
            Calls { core: &progress, stops_taken: 0, mcu, block, requests: &requests }.any()
        };
        let other = (Payload::new(&rig.encode("get_config")), 0);
        let joining = (Payload::new(&rig.encode("spi_send oid=0 data=01")), 0);

        assert!(!called(&rig.mcu, None));
        assert!(called(&rig.mcu, Some(&other)), "the rest of a block");
        reader.push(Request::Run(other.0)).ok().unwrap();
        assert!(called(&rig.mcu, None), "another block");

        rig.begin("spi_send oid=0 data=00");
        assert!(!called(&rig.mcu, None) && !called(&rig.mcu, Some(&other)), "they wait for the bus");
        assert!(called(&rig.mcu, Some(&joining)), "it does not wait");
        rig.stall_until(rig.now() + 50_000);
        assert!(called(&rig.mcu, None), "the bus has answered");
        rig.turn();

        rig.begin("spi_send oid=0 data=00");
        assert!(!called(&rig.mcu, None));
        progress.stop_handed();
        assert!(called(&rig.mcu, None), "a stop does not wait");
    }

    #[test]
    fn a_transfer_holds_its_block_and_the_commands_behind_it_back() {
        let mut rig = Rig::held();
        let turns = rig.clock.1.load(Ordering::Relaxed);
        thread::sleep(2 * BEAT);
        let turns = rig.clock.1.load(Ordering::Relaxed) - turns;
        assert!(turns < 10_000, "the core sleeps as it waits, and read the clock {turns} times");
        assert_eq!(rig.progress.done(), CONFIGURATION, "it is not acknowledged");
        assert!(!rig.bench.level(30), "what is behind it has not run");

        // The core is not woken for a block that it cannot run yet.
        assert!(rig.progress.is_held());
        let payload = rig.encode("update_digital_out oid=%c value=%c", &[1, 1]);
        rig.requests.push(Request::Run(payload)).ok().unwrap();

        // The link sleeps, and the bus answers.
        rig.wake.sleeping();
        rig.bench.hang(false);
        rig.wait_until("all blocks are done", |rig| rig.progress.done() == CONFIGURATION + 3);
        assert_eq!(rig.said(RESPONSE), [[0, 1, !7]]);
        assert!(rig.bench.level(30));
        rig.wait_until_link_wakes();
        for byte in 0..20 {
            rig.transfer(byte);
        }
        rig.wait_until("every block is done", |rig| rig.progress.done() == CONFIGURATION + 23);
        assert_eq!(rig.said(RESPONSE).len(), 21);
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn what_is_only_sent_is_acknowledged_at_once_and_other_commands_wait_for_it() {
        let mut rig = Rig::new();
        rig.bench.hang(true);
        for byte in 0..3 {
            rig.run("spi_send oid=%c data=%*s", &[0, 1, byte]);
            rig.wait_until("its block is done", |rig| rig.progress.done() == CONFIGURATION + 1 + byte);
        }
        rig.run("update_digital_out oid=%c value=%c", &[1, 1]);
        rig.wait_until("the core has seen the block behind them", |rig| rig.progress.is_held());
        assert!(!rig.bench.level(30) && rig.progress.done() == CONFIGURATION + 3);
        assert_eq!(rig.progress.published(), 0, "get_config comes after what is sent");
        rig.bench.hang(false);
        rig.wait_until("every block is done", |rig| rig.progress.done() == CONFIGURATION + 4);
        assert_ne!(rig.progress.published(), 0);
        assert!(rig.bench.level(30));
        let sent: Vec<_> = rig.bench.transfers().into_iter().map(|transfer| transfer.data).collect();
        assert_eq!(sent, [[0], [1], [2]]);
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn a_block_is_acknowledged_while_a_bus_holds_the_next_one() {
        let mut rig = Rig::new();
        // The core is asleep, and finds both blocks when it is woken.
        thread::sleep(Duration::from_millis(20));
        rig.bench.hang(true);
        rig.wake.sleeping();
        let first = rig.encode("update_digital_out oid=%c value=%c", &[1, 1]);
        rig.requests.push(Request::Run(first)).ok().unwrap();
        rig.transfer(7);
        rig.wait_until_link_wakes();
        rig.wait_until("the transfer is under way", |rig| rig.bench.hangs());
        assert_eq!(rig.progress.done(), CONFIGURATION + 1);
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn the_link_is_told_of_a_block_without_a_response() {
        let mut rig = Rig::new();
        rig.wake.sleeping();
        rig.run("update_digital_out oid=%c value=%c", &[1, 1]);
        // The host waits for its acknowledgement.
        rig.wait_until_link_wakes();
        assert_eq!(rig.progress.done(), CONFIGURATION + 1);
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn a_stop_comes_after_the_blocks_before_it_if_no_bus_holds_them() {
        let mut rig = Rig::new();
        rig.progress.stop_handed();
        let on = rig.encode("update_digital_out oid=%c value=%c", &[1, 1]);
        rig.requests.push(Request::Run(on)).ok().unwrap();
        rig.request(Request::Shutdown(Shutdown::because(reason::FORCE_SHUTDOWN, "a test")));
        rig.wait_until("the MCU stops", Rig::is_stopped);
        let levels: Vec<u8> = rig.bench.edges(30).into_iter().map(|(_, level)| level).collect();
        assert_eq!(levels, [1, 0], "on, and its shutdown value");
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn the_core_sleeps_until_a_sample_is_due_and_does_not_spin_before_it() {
        const REST: Ticks = Ticks::from_ms(2);
        let mut rig = Rig::new();
        let first = (rig.clock.now() + Ticks::from_ms(100)).wire();
        let query = "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c";
        rig.run(query, &[2, first, REST.0, 1, 0]);
        rig.wait_until("it is configured", |rig| rig.progress.done() == CONFIGURATION + 1);
        thread::sleep(Duration::from_millis(150));
        let turns = rig.clock.1.load(Ordering::Relaxed);
        thread::sleep(Duration::from_millis(100));
        let turns = rig.clock.1.load(Ordering::Relaxed) - turns;
        // There are 50 samples. A core awake 200 us before each would read the clock thousands of times.
        assert!(turns < 10_000, "the clock was read {turns} times");
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn a_request_to_stop_does_not_wait_for_a_bus_that_hangs() {
        let shutdown = || Shutdown::because(reason::FORCE_SHUTDOWN, "a test");
        for which in 0..4 {
            let mut rig = Rig::held();
            let mut blocks = CONFIGURATION + 2;
            match which {
                0 => rig.stop(Request::Shutdown(shutdown())),
                1 => rig.stop(Request::Quit(None)),
                _ => {
                    blocks += 1;
                    let mut payload = rig.encode("emergency_stop", &[]);
                    if which == 3 {
                        // Among other commands of its block.
                        let get = rig.encode("get_config", &[]);
                        payload = Payload::new(&[get.as_slice(), payload.as_slice(), get.as_slice()].concat());
                    }
                    rig.stop(Request::Run(payload));
                }
            }
            rig.wait_until("the MCU stops", Rig::is_stopped);
            rig.wait_until("the blocks are refused", |rig| rig.progress.done() == blocks);
            assert!(!rig.bench.level(30), "a command that waited has not run");
            rig.bench.hang(false);
            if which != 1 {
                rig.stop(Request::Quit(None));
            }
            rig.thread.join().unwrap();
        }
    }

    #[test]
    fn the_stop_of_a_host_that_came_meanwhile_is_read_in_its_dialect() {
        let mut rig = Rig::held();
        let board = FakeBoard(rig.bench.clone());
        let dialect = Arc::new(Dialect::new(&FIRMWARE, &board, DialectName::V0_11).unwrap());
        rig.request(Request::Speak(dialect.clone()));
        let stop = rig.encode("emergency_stop", &[]);
        let formats = dialect.dictionary().commands.keys().filter(|format| !format.contains('*'));
        let mut blocks = formats.map(|format| {
            let mut writer = Writer::default();
            writer.int(dialect.command_id(format).unwrap());
            format.matches('%').for_each(|_| writer.int(1));
            Payload::new(&[writer.payload().unwrap(), stop.as_slice()].concat())
        });
        // A block that means something else in the earlier dialect.
        let block = blocks.find(|block| !rig.dialect.is_emergency(block.as_slice())).unwrap();
        rig.stop(Request::Run(block));
        rig.wait_until("the MCU stops", Rig::is_stopped);
        rig.bench.hang(false);
        rig.stop(Request::Quit(None));
        rig.thread.join().unwrap();
    }

    #[test]
    fn an_emergency_stop_in_the_block_that_waits_is_seen_too() {
        let mut rig = Rig::new();
        rig.bench.hang(true);
        let transfer = rig.encode("spi_transfer oid=%c data=%*s", &[0, 1, 7]);
        let stop = rig.encode("emergency_stop", &[]);
        let block = Payload::new(&[transfer.as_slice(), stop.as_slice()].concat());
        rig.stop(Request::Run(block));
        rig.wait_until("the MCU stops", Rig::is_stopped);
        assert_eq!(rig.quit(), Left::Safe);
    }

    #[test]
    fn a_program_that_ends_waits_for_its_last_writes_and_says_what_failed() {
        for (broken, left) in [(false, Left::Safe), (true, Left::Pending("digital output oid 1 (gpio30)".into()))] {
            let rig = Rig::new();
            if broken {
                rig.bench.state().broken.insert(30);
            }
            assert_eq!(rig.quit(), left);
        }
    }

    #[test]
    fn an_ordinary_thread_does_not_yield_with_a_timer_ahead() {
        let now = Clock::from_ticks(0);
        let (soon, late) = (now + Ticks::from_ms(1), now + Ticks::from_ms(10));
        assert!(!may_yield(false, now, Some(soon)));
        assert!(may_yield(false, now, Some(late)) && may_yield(false, now, None));
        assert!(may_yield(true, now, Some(soon)));
    }
}
