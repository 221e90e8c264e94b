// SPDX-License-Identifier: GPL-3.0-or-later
//! From the core to the link: responses for the host and lines for the log, through rings that
//! neither side waits for. Lines have one of their own, as a host that does not read must not
//! cost the line that says why the machine stopped.

#![forbid(unsafe_code)]

use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use log::Level;
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtrb::{Consumer, Producer, RingBuffer};

use crate::lateness::us;
use crate::mcu::{Note, Outbox};
use crate::shutdown::{Shutdown, reason};

/// Bytes between core and link: some 1,000 responses. When the host does not read, later ones
/// are dropped.
const RING_BYTES: usize = 1 << 16;
/// A payload's length and the blocks begun.
const HEAD_BYTES: usize = 6;
/// The longest line for the log.
const LINE_BYTES: usize = 1024;
/// A line's level and its length.
const LINE_HEAD_BYTES: usize = 3;
/// Bytes of lines between core and link.
const LINES_BYTES: usize = 1 << 15;
/// Of these, what only a machine that stops may use: each object can have trouble with that, and
/// the reason comes last.
const LINES_SPARE: usize = 2 * (LINE_HEAD_BYTES + LINE_BYTES);

/// Wakes the link, at the price of a system call only while it sleeps.
pub(super) struct LinkWake {
    asleep: AtomicBool,
    event: EventFd,
}

impl LinkWake {
    pub(super) fn new() -> io::Result<LinkWake> {
        let event = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
        Ok(LinkWake { asleep: AtomicBool::new(false), event })
    }

    /// Something is there for the link.
    pub(super) fn wake(&self) {
        if self.asleep.swap(false, Ordering::SeqCst) {
            // It can only be full of wake-ups already.
            let _ = self.event.write(1);
        }
    }

    /// The link is about to sleep, and looks once more at all that could wake it.
    ///
    /// Either that look sees what the core put there, or the core's [`LinkWake::wake`] sees that the
    /// link sleeps. A swap guarantees that, as it reads, too: when it comes after the core's swap in
    /// `wake` it reads that one's value, and so sees all that the core wrote before. With a plain
    /// store it would not: the core could find the link awake, the link could look before the core's
    /// response is to be seen, and would then sleep on it.
    pub(super) fn sleeping(&self) {
        self.asleep.swap(true, Ordering::SeqCst);
    }

    /// The link is awake, and was called or not.
    pub(super) fn awake(&self, called: bool) {
        self.asleep.store(false, Ordering::SeqCst);
        if called {
            let _ = self.event.read();
        }
    }

    pub(super) fn event(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}

/// How far link and core are with the host's blocks and with requests to stop.
///
/// The core counts the blocks that it has begun and done. A response carries the sequence
/// number of the block that it answers: klippy takes a response for an answer to a query only
/// if its number says that the query was received (`#sent_time` in serialhdl.py), and a number
/// that runs ahead of the core would make an answer to an earlier query of the same name one.
#[derive(Debug, Default)]
pub(super) struct Progress {
    begun: AtomicU32,
    done: AtomicU32,
    stops_handed: AtomicU32,
}

impl Progress {
    /// The core takes up the next block.
    pub(super) fn begin(&self) {
        self.begun.fetch_add(1, Ordering::Relaxed);
    }

    /// The core is done with the block, and has said all that it had to say of it.
    pub(super) fn finish(&self) {
        self.done.fetch_add(1, Ordering::Release);
    }

    /// How many blocks are done.
    pub(super) fn done(&self) -> u32 {
        self.done.load(Ordering::Acquire)
    }

    /// The link is about to hand the core a request to stop: a block with `emergency_stop`,
    /// `Request::Shutdown` or `Request::Quit`.
    pub(super) fn stop_handed(&self) {
        self.stops_handed.fetch_add(1, Ordering::Release);
    }

    /// How many requests to stop were handed to the core, which counts those that it took out of
    /// the ring: where these are fewer, one waits there, or will in a moment.
    pub(super) fn stops_handed(&self) -> u32 {
        self.stops_handed.load(Ordering::Acquire)
    }
}

/// The core's end.
pub(super) struct Outlet {
    responses: Producer<u8>,
    lines: Producer<u8>,
    wake: Arc<LinkWake>,
    progress: Arc<Progress>,
}

/// The link's end.
pub(super) struct Inlet {
    responses: Consumer<u8>,
    lines: Consumer<u8>,
    payload: Vec<u8>,
}

/// Both ends.
pub(super) fn outlet(wake: Arc<LinkWake>, progress: Arc<Progress>) -> (Outlet, Inlet) {
    let (to_host, responses) = RingBuffer::new(RING_BYTES);
    let (to_log, lines) = RingBuffer::new(LINES_BYTES);
    let inlet = Inlet { responses, lines, payload: vec![0; usize::from(u16::MAX)] };
    (Outlet { responses: to_host, lines: to_log, wake, progress }, inlet)
}

/// Puts a record in as a whole, or not at all.
fn push(ring: &mut Producer<u8>, head: &[u8], bytes: &[u8]) {
    if let Ok(chunk) = ring.write_chunk_uninit(head.len() + bytes.len()) {
        chunk.fill_from_iter(head.iter().chain(bytes).copied());
    }
}

/// Takes so many bytes out of a ring, if they are there.
fn pop<'a>(ring: &mut Consumer<u8>, to: &'a mut [u8]) -> Option<&'a [u8]> {
    let chunk = ring.read_chunk(to.len()).ok()?;
    for (to, from) in to.iter_mut().zip(chunk) {
        *to = from;
    }
    Some(to)
}

impl Outlet {
    /// What does not leave `spare` bytes free is lost.
    fn line(&mut self, level: Level, spare: usize, line: std::fmt::Arguments<'_>) {
        let mut text = [0; LINE_BYTES];
        let mut rest = &mut text[..];
        // A line that is too long is cut.
        let _ = rest.write_fmt(line);
        let len = LINE_BYTES - rest.len();
        if self.lines.slots() >= LINE_HEAD_BYTES + len + spare {
            let [low, high] = (len as u16).to_le_bytes();
            push(&mut self.lines, &[level as u8, low, high], &text[..len]);
        }
        self.wake.wake();
    }
}

impl Outbox for Outlet {
    fn send(&mut self, payload: &[u8]) {
        let mut head = [0; HEAD_BYTES];
        head[..2].copy_from_slice(&(payload.len() as u16).to_le_bytes());
        head[2..].copy_from_slice(&self.progress.begun.load(Ordering::Relaxed).to_le_bytes());
        // When the host does not read, what finds no room is lost, as in the firmware.
        push(&mut self.responses, &head, payload);
        self.wake.wake();
    }

    fn note(&mut self, note: Note<'_>) {
        match note {
            Note::Shutdown(shutdown) => {
                self.line(gravity(shutdown), 0, format_args!("shutdown: {shutdown}"));
            }
            Note::Trouble(shutdown) => {
                self.line(gravity(shutdown), LINES_SPARE, format_args!("while shut down: {shutdown}"));
            }
            Note::Failed(failure) => self.line(Level::Warn, LINES_SPARE, format_args!("{failure}")),
            Note::Safe(name) => {
                self.line(Level::Info, LINES_SPARE, format_args!("{name} is at its shutdown value after all"));
            }
            Note::Lateness(lateness, margin) => {
                let margin = us(margin);
                let line = format_args!("timers: {lateness}; the core wakes {margin:.1} us early");
                self.line(Level::Info, LINES_SPARE, line);
            }
            Note::Reset => {
                self.line(Level::Info, LINES_SPARE, format_args!("configuration dropped, waiting for a new one"));
            }
            Note::Configured(kinds) => {
                self.line(Level::Info, LINES_SPARE, format_args!("configured: {}", Kinds(kinds)));
            }
        }
    }
}

/// What somebody asked for is no fault: M112 and FIRMWARE_RESTART, SIGTERM, and FORCE_SHUTDOWN, of
/// which the link warns.
fn gravity(shutdown: &Shutdown) -> Level {
    match shutdown.reason {
        reason::COMMAND_REQUEST | reason::FORCE_SHUTDOWN => Level::Info,
        _ => Level::Error,
    }
}

struct Kinds<'a>(&'a [(&'static str, usize)]);

impl std::fmt::Display for Kinds<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.0.is_empty() {
            return f.write_str("no objects");
        }
        for (i, (kind, count)) in self.0.iter().enumerate() {
            let comma = if i > 0 { ", " } else { "" };
            let plural = if *count > 1 { "s" } else { "" };
            write!(f, "{comma}{count} {kind}{plural}")?;
        }
        Ok(())
    }
}

impl Inlet {
    /// The next response, and how many blocks the core had begun when it gave it.
    pub(super) fn response(&mut self) -> Option<(&[u8], u32)> {
        let mut head = [0; HEAD_BYTES];
        pop(&mut self.responses, &mut head)?;
        let [low, high, begun @ ..] = head;
        let len = usize::from(u16::from_le_bytes([low, high]));
        Some((pop(&mut self.responses, &mut self.payload[..len])?, u32::from_le_bytes(begun)))
    }

    /// The next line for the log.
    pub(super) fn line(&mut self) -> Option<(Level, String)> {
        let mut head = [0; LINE_HEAD_BYTES];
        pop(&mut self.lines, &mut head)?;
        let [level, low, high] = head;
        let level = [Level::Error, Level::Warn].into_iter().find(|known| *known as u8 == level).unwrap_or(Level::Info);
        let mut text = [0; LINE_BYTES];
        let len = usize::from(u16::from_le_bytes([low, high])).min(LINE_BYTES);
        let text = pop(&mut self.lines, &mut text[..len])?;
        Some((level, String::from_utf8_lossy(text).into_owned()))
    }

    pub(super) fn has_response(&self) -> bool {
        !self.responses.is_empty()
    }

    pub(super) fn has_line(&self) -> bool {
        !self.lines.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ends() -> (Outlet, Inlet, Arc<Progress>) {
        let progress = Arc::new(Progress::default());
        let (outlet, inlet) = outlet(Arc::new(LinkWake::new().unwrap()), progress.clone());
        (outlet, inlet, progress)
    }

    #[test]
    fn what_the_host_does_not_read_is_dropped_and_the_reason_of_a_stop_is_not() {
        let (mut outlet, mut inlet, progress) = ends();
        progress.begin();
        outlet.send(b"one");
        assert_eq!(inlet.response(), Some((&b"one"[..], 1)));
        for _ in 0..RING_BYTES {
            outlet.send(&[7; 60]);
        }
        outlet.note(Note::Shutdown(&Shutdown::because(reason::ADC_READ, "oid 3")));
        assert!(inlet.has_line());
        assert_eq!(inlet.line(), Some((Level::Error, "shutdown: Error on analog read: oid 3".into())));
        assert_eq!(inlet.line(), None);
        let mut whole = 0;
        while let Some((response, 1)) = inlet.response() {
            assert_eq!(response, [7; 60]);
            whole += 1;
        }
        assert_eq!(whole, RING_BYTES / (HEAD_BYTES + 60));
        assert!(!inlet.has_response());
    }

    #[test]
    fn troubles_leave_room_for_the_reason_of_a_stop() {
        let (mut outlet, mut inlet, _) = ends();
        let trouble = Shutdown::because(reason::PWM_WRITE, "no ".repeat(LINE_BYTES));
        for _ in 0..256 {
            outlet.note(Note::Trouble(&trouble));
        }
        let reason = format!("M112 {}", "of this host ".repeat(LINE_BYTES));
        outlet.note(Note::Shutdown(&Shutdown::because(reason::COMMAND_REQUEST, reason)));
        let mut lines: Vec<_> = std::iter::from_fn(|| inlet.line()).collect();
        let (level, line) = lines.pop().unwrap();
        assert_eq!(level, Level::Info);
        assert!(line.starts_with("shutdown: Command request: M112 of this host"), "{line}");
        assert!(lines.len() > 20);
        assert!(lines.iter().all(|(level, line)| *level == Level::Error && line.len() == LINE_BYTES));
    }

    #[test]
    fn what_was_asked_for_is_no_warning() {
        let (mut outlet, mut inlet, _) = ends();
        let end = Shutdown::because(reason::FORCE_SHUTDOWN, "the end");
        outlet.note(Note::Shutdown(&end));
        outlet.note(Note::Trouble(&end));
        assert_eq!(inlet.line(), Some((Level::Info, "shutdown: Force shutdown command: the end".into())));
        assert_eq!(inlet.line(), Some((Level::Info, "while shut down: Force shutdown command: the end".into())));
    }
}
