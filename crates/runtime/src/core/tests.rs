// SPDX-License-Identifier: GPL-3.0-or-later
//! The core with a link and a board that the test drives.

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
use pinion_firmware::mcu::{Dialect, DialectName, Note, Outbox};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{TimeSource, Timing, VirtualClock};
use pinion_linux::clock::Monotonic;
use pinion_linux::parker::Parker;
use pinion_protocol::vlq::{Reader, Writer};
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
    thread: JoinHandle<OutputState>,
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

    fn quit(mut self) -> OutputState {
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
    assert_eq!(rig.quit(), OutputState::Safe);
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
    assert_eq!(rig.quit(), OutputState::Safe);
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
    assert_eq!(rig.quit(), OutputState::Safe);
}

#[test]
fn the_link_is_told_of_a_block_without_a_response() {
    let mut rig = Rig::new();
    rig.wake.sleeping();
    rig.run("update_digital_out oid=%c value=%c", &[1, 1]);
    // The host waits for its acknowledgement.
    rig.wait_until_link_wakes();
    assert_eq!(rig.progress.done(), CONFIGURATION + 1);
    assert_eq!(rig.quit(), OutputState::Safe);
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
    assert_eq!(rig.quit(), OutputState::Safe);
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
    assert_eq!(rig.quit(), OutputState::Safe);
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
    assert_eq!(rig.quit(), OutputState::Safe);
}

#[test]
fn a_program_that_ends_waits_for_its_last_writes_and_says_what_failed() {
    for (broken, left) in
        [(false, OutputState::Safe), (true, OutputState::Pending("digital output oid 1 (gpio30)".into()))]
    {
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
