// SPDX-License-Identifier: GPL-3.0-or-later
//! The link between any host and any core, for `fuzz/`. There are no threads: bytes choose each side's next action.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::sync::{LazyLock, OnceLock};

use nix::fcntl::OFlag;
use nix::unistd::getegid;
use rtrb::{Consumer, RingBuffer};

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{DialectName, Note, Outbox as _};
use pinion_firmware::time::VirtualClock;
use pinion_linux::clock::Monotonic;
use pinion_protocol::block::{BLOCK_MAX, PAYLOAD_MAX, Received, Receiver, Resync, Resynced, Sequence, frame};
use pinion_shm::progress::Progress;

use super::*;
use crate::core::heartbeat::Heartbeat;
use crate::core::responses::{LinkWake, ResponseWriter, response_ring};
use crate::core::start::REQUESTS;
use crate::link::ledger::Ledger;
use crate::process::notify::Notify;
use crate::process::signals::Signals;
use crate::process::watchdog::Vigil;
use crate::recorder::Recording;
use crate::status::HostStatus;
use crate::transport::Transport as _;
use crate::transport::pty::{Access, Pty};

/// Memory that is shared with a guardian is never freed, so there is only one recording.
static RECORDING: LazyLock<Recording> = LazyLock::new(Recording::of_a_test);

/// Blocks that klippy sends before it waits for an acknowledgement (`MAX_PENDING_BLOCKS` in chelper/serialqueue.c).
const PENDING_MAX: u32 = 12;

/// Made only once: to compress a dictionary takes milliseconds, and a page that is shared with a guardian is never freed.
static ONCE: OnceLock<(Arc<Dialect>, Heartbeat)> = OnceLock::new();

fn clock() -> Arc<VirtualClock> {
    Arc::new(VirtualClock::at(Clock::from_ticks(0)))
}

/// Lets a host and a core of this board act as `bytes` choose.
pub fn link(mut bytes: &[u8], board: impl FnOnce(Arc<VirtualClock>) -> Box<dyn Board>) {
    let once = ONCE.get_or_init(|| {
        let dialect = Dialect::new(&crate::FIRMWARE, &*board(clock()), DialectName::Master);
        (Arc::new(dialect.expect("a dictionary")), Heartbeat::new(Monotonic::start()).expect("a page"))
    });
    let mut bench = Bench::new(once);
    while let Some((&step, rest)) = bytes.split_first() {
        bytes = rest;
        let count = usize::from(step >> 3);
        let mut next = |count: usize| {
            let (next, rest) = bytes.split_at(count.min(bytes.len()));
            bytes = rest;
            next
        };
        match step & 7 {
            0 => bench.write(next(count)),
            1 => bench.send(next(2 * count)),
            2 => bench.ask(count),
            3 => bench.listen(),
            4 => bench.core.begin(),
            5 => bench.core.response_ring.send(&[count as u8; PAYLOAD_MAX][..2 * count.min(PAYLOAD_MAX / 2)]),
            6 => bench.core.finish(),
            _ => match count {
                0 => bench.leave(),
                1 => bench.write(b"FORCE_SHUTDOWN\n"),
                2 => bench.core.response_ring.note(Note::Reset),
                _ => {}
            },
        }
        bench.turn();
    }
    bench.settle();
}

/// The core, as far as the link sees it.
struct Core {
    requests: Consumer<Request>,
    progress: Arc<Progress>,
    response_ring: ResponseWriter,
    is_busy: bool,
    /// The blocks that it was handed.
    blocks: Vec<Vec<u8>>,
}

impl Core {
    /// Takes the next request. A block stays under way until [`Core::finish`].
    fn begin(&mut self) {
        while !self.is_busy
            && let Ok(request) = self.requests.pop()
        {
            if let Request::Run(payload) = request {
                self.progress.begin();
                self.blocks.push(payload.as_slice().to_vec());
                self.is_busy = true;
            }
        }
    }

    fn finish(&mut self) {
        if std::mem::take(&mut self.is_busy) {
            self.progress.finish();
        }
    }
}

struct Bench {
    link: LinkThread,
    core: Core,
    device: std::path::PathBuf,
    /// The host's end, while a host is there.
    host: Option<File>,
    /// Finds the blocks in the host's input.
    resync: Resync,
    heard: Vec<u8>,
    heard_bytes: usize,
    /// The last number that the host heard.
    last: Sequence,
    /// An MCU that takes in the hosts' bytes.
    model: Receiver,
    written: Vec<u8>,
    /// The blocks that the model took.
    taken: Vec<Vec<u8>>,
    /// How many of them the host knows to be done. `None`: their numbers of four bits do not show it.
    known: Option<u32>,
    /// Somebody wrote FORCE_SHUTDOWN, which is no bytes for the MCU.
    is_forced: bool,
}

impl Bench {
    fn new((dialect, heartbeat): &'static (Arc<Dialect>, Heartbeat)) -> Bench {
        let symlink = std::env::temp_dir().join(format!("pinion-fuzz-{}", std::process::id()));
        let access = Access { mode: 0o600, group: Some(getegid().to_string()) };
        let pty = Pty::open(&symlink, &access).expect("a terminal");
        let device = pty.terminal().expect("a terminal").to_owned();
        let (wake, progress) = (Arc::new(LinkWake::new().expect("an eventfd")), Arc::new(Progress::default()));
        let (response_ring, reader) = response_ring(wake.clone(), progress.clone());
        let (requests, inbox) = RingBuffer::new(REQUESTS);
        let (parker, ledger) = (Arc::default(), Ledger::default());
        let end = CoreEnd {
            requests,
            parker,
            reader,
            progress: progress.clone(),
            wake,
            ledger,
            asked_at: None,
            may_poll: false,
        };
        let vigil = Vigil::new(Notify::from_env().expect("no service manager"), None, *heartbeat);
        let oversight = Oversight::new(Signals::new().expect("signals"), None, vigil).expect("epoll");
        let handshake = Handshake::of(dialect.clone());
        let host = HostEnd::new(Box::new(pty), Arc::new(HostStatus::default()));
        let (recorder, _) = Recorder::new(RECORDING.clone()).expect("one recorder at a time");
        Bench {
            link: LinkThread::new(host, end, handshake, oversight, clock(), recorder),
            core: Core { requests: inbox, progress, response_ring, is_busy: false, blocks: Vec::new() },
            device,
            host: None,
            resync: Resync::default(),
            heard: Vec::new(),
            heard_bytes: 0,
            last: Sequence::default(),
            model: Receiver::default(),
            written: Vec::new(),
            taken: Vec::new(),
            known: Some(0),
            is_forced: false,
        }
    }

    /// The host writes these bytes, as many as the terminal has room for.
    fn write(&mut self, bytes: &[u8]) {
        let flags = (OFlag::O_NONBLOCK | OFlag::O_NOCTTY).bits();
        let open =
            || File::options().read(true).write(true).custom_flags(flags).open(&self.device).expect("the terminal");
        let written = self.host.get_or_insert_with(open).write(bytes).unwrap_or(0);
        self.written.extend_from_slice(&bytes[..written]);
        loop {
            let (len, received) = self.model.next(&self.written);
            match received {
                Received::Nothing => break,
                Received::Payload(payload) => self.taken.push(payload.to_vec()),
                Received::Nak(_) | Received::Skip => {}
            }
            self.written.drain(..len);
        }
    }

    /// The host sends a block.
    fn send(&mut self, payload: &[u8]) {
        if self.pending().is_none_or(|pending| pending < PENDING_MAX) {
            let mut block = Vec::new();
            frame(payload, self.model.expected(), &mut block);
            self.write(&block);
        }
    }

    /// How many blocks the host does not know to be done.
    fn pending(&self) -> Option<u32> {
        self.known.map(|known| self.taken.len() as u32 - known)
    }

    /// The host sends a block that the link can answer, or a stop.
    fn ask(&mut self, which: usize) {
        let mut writer = Writer::default();
        let (dialect, _) = ONCE.get().expect("a bench");
        let id = |command| dialect.command_id(command).expect("every MCU has it");
        match which {
            0 => writer.int(id("emergency_stop")),
            1..8 => writer.int(id("get_clock")),
            _ => {
                writer.int(id("identify offset=%u count=%c"));
                writer.int(which as u32 * 97);
                writer.int(40);
            }
        }
        self.send(writer.payload().expect("room"));
    }

    /// The host reads all bytes that are there.
    fn listen(&mut self) {
        let Some(host) = &mut self.host else { return };
        let mut piece = [0; 4096];
        while let Ok(len @ 1..) = host.read(&mut piece) {
            self.heard.extend_from_slice(&piece[..len]);
            self.heard_bytes += len;
        }
        let taken = self.taken.len() as u32;
        loop {
            let (len, found) = self.resync.next(&self.heard);
            match found {
                Resynced::Nothing => break,
                Resynced::Garbage { .. } => panic!("the link wrote no block: {:?}", self.heard),
                Resynced::Block(number, _) => {
                    // Four bits of a number that never goes back, and that is never ahead of the taken blocks.
                    self.known = self.known.filter(|known| taken - known < 16).map(|known| {
                        let number = (known..=taken).find(|at| Sequence::after(*at) == number);
                        number.unwrap_or_else(|| panic!("{known} blocks were done, and {taken} were taken"))
                    });
                    self.last = number;
                }
            }
            self.heard.drain(..len);
        }
    }

    fn leave(&mut self) {
        if self.host.take().is_some() {
            // It may have read a part of a block.
            self.heard.clear();
        }
    }

    /// The link's work when it wakes.
    fn turn(&mut self) {
        // The link would wait for room for its own requests.
        while self.link.core.requests.slots() < 4 {
            self.core.finish();
            self.core.begin();
        }
        let mut fds = [PollFd::new(self.link.host.event().expect("a terminal"), PollFlags::POLLIN)];
        poll(&mut fds, PollTimeout::ZERO).expect("the terminal");
        let events = fds[0].revents().unwrap_or(PollFlags::empty());
        if events.contains(PollFlags::POLLHUP) {
            self.link.read(true).expect("the terminal");
        }
        if events.contains(PollFlags::POLLIN) {
            let before = self.link.core.requests.slots();
            self.link.read(false).expect("the terminal");
            if self.link.core.requests.slots() != before {
                (self.is_forced, self.known) = (true, None);
            }
        }
        self.link.take_in();
        self.link.give_out();
    }

    /// All sides do all that is left. Then a block out of order is refused with the number of the blocks that are done.
    fn settle(&mut self) {
        self.exhaust();
        self.write(&[0x7e; BLOCK_MAX]);
        let mut block = Vec::new();
        frame(b"", self.model.expected().next(), &mut block);
        self.exhaust();
        self.write(&block);
        self.exhaust();
        if self.is_forced {
            return;
        }
        assert_eq!(self.last, Sequence::after(self.taken.len() as u32), "of {} blocks", self.taken.len());
        // The link answers some blocks itself. The others came to the core whole and in order.
        let mut blocks = self.core.blocks.iter().peekable();
        let mut is_for_core = |block: &&Vec<u8>| blocks.next_if(|next| next == block).is_some();
        for answered in self.taken.iter().filter(|block| !is_for_core(block)) {
            let known = &self.link.known;
            // The core has published no answer.
            let answer = known.question(answered).and_then(|question| known.answer(question, Clock::EPOCH, || None));
            assert!(answer.is_some(), "{answered:?} is lost");
        }
        assert_eq!(self.core.blocks.len(), self.core.progress.done() as usize);
    }

    /// Goes on until nothing changes any more.
    fn exhaust(&mut self) {
        let mut quiet = 0;
        while quiet < 3 {
            let before = (self.core.blocks.len(), self.core.progress.done(), self.heard_bytes);
            self.core.begin();
            self.core.finish();
            self.turn();
            self.listen();
            let after = (self.core.blocks.len(), self.core.progress.done(), self.heard_bytes);
            quiet = if after == before { quiet + 1 } else { 0 };
        }
    }
}
