// SPDX-License-Identifier: GPL-3.0-or-later
//! The core's way to the link: responses for the host and lines for the log. Neither side waits for the other: a record
//! that does not fit its ring is dropped. Lines have a ring of their own. So the line with the reason of a stop gets
//! through even if the host does not read its responses.

use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;

use log::Level;
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtrb::{Consumer, Producer, RingBuffer};

use pinion_firmware::lateness::us;
use pinion_firmware::mcu::{DeviceWarning, Note, Outbox};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_shm::progress::Progress;
use pinion_shm::sleep_flag::SleepFlag;

/// Size of the ring of responses. Some 1,000 responses fit.
const RING_BYTES: usize = 1 << 16;
/// Size of the head of a response in the ring: its length, and how many blocks the core had begun.
const HEAD_BYTES: usize = 6;
/// Longest line for the log. A longer one is cut.
const LINE_BYTES: usize = 1024;
/// Size of the head of a line in the ring: its level, its length, and how much of its text names its kind.
const LINE_HEAD_BYTES: usize = 4;
/// Size of the ring of lines.
const LINES_BYTES: usize = 1 << 15;
/// The part of that ring that is kept free for the line with the reason of a stop. That line comes last. Before it,
/// each object may have logged that it could not be stopped.
const LINES_SPARE: usize = 2 * (LINE_HEAD_BYTES + LINE_BYTES);

/// Wakes the link. Costs a system call only if the link sleeps.
pub(crate) struct LinkWake {
    sleep_flag: SleepFlag,
    event: EventFd,
}

impl LinkWake {
    pub(crate) fn new() -> io::Result<LinkWake> {
        let event = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
        Ok(LinkWake { sleep_flag: SleepFlag::default(), event })
    }

    /// The core calls this after it has put something into a ring.
    pub(crate) fn wake(&self) {
        if self.sleep_flag.is_to_be_woken() {
            // The write can fail only if the counter is full of wake-ups, and then the link wakes, too.
            let _ = self.event.write(1);
        }
    }

    /// The link calls this before it sleeps. After this it must check the rings once more.
    pub(crate) fn sleeping(&self) {
        self.sleep_flag.begin();
    }

    /// The link calls this after its sleep. `called`: its event was readable.
    pub(crate) fn awake(&self, called: bool) {
        self.sleep_flag.end();
        if called {
            let _ = self.event.read();
        }
    }

    pub(crate) fn event(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}

/// The core's end of the rings.
pub(crate) struct ResponseWriter {
    responses: Producer<u8>,
    lines: Producer<u8>,
    wake: Arc<LinkWake>,
    progress: Arc<Progress>,
}

/// The link's end of the rings.
pub(crate) struct ResponseReader {
    responses: Consumer<u8>,
    lines: Consumer<u8>,
    payload: Vec<u8>,
}

/// Makes the rings, and returns both ends.
pub(crate) fn response_ring(wake: Arc<LinkWake>, progress: Arc<Progress>) -> (ResponseWriter, ResponseReader) {
    let (to_host, responses) = RingBuffer::new(RING_BYTES);
    let (to_log, lines) = RingBuffer::new(LINES_BYTES);
    let reader = ResponseReader { responses, lines, payload: vec![0; usize::from(u16::MAX)] };
    (ResponseWriter { responses: to_host, lines: to_log, wake, progress }, reader)
}

/// Puts a record into a ring as a whole, or drops it if it does not fit.
fn push(ring: &mut Producer<u8>, head: &[u8], bytes: &[u8]) {
    if let Ok(chunk) = ring.write_chunk_uninit(head.len() + bytes.len()) {
        chunk.fill_from_iter(head.iter().chain(bytes).copied());
    }
}

/// Fills `to` from a ring, if the ring has enough bytes.
fn pop<'a>(ring: &mut Consumer<u8>, to: &'a mut [u8]) -> Option<&'a [u8]> {
    let chunk = ring.read_chunk(to.len()).ok()?;
    for (to, from) in to.iter_mut().zip(chunk) {
        *to = from;
    }
    Some(to)
}

impl ResponseWriter {
    /// Puts a line into its ring, or drops it if fewer than `spare` bytes would stay free. The log limits the lines of
    /// one kind. The first `kind` bytes name it.
    fn line(&mut self, kind: usize, level: Level, spare: usize, line: std::fmt::Arguments<'_>) {
        let mut text = [0; LINE_BYTES];
        let mut rest = &mut text[..];
        // The write fails when the text is full. The line is cut there.
        let _ = rest.write_fmt(line);
        let len = LINE_BYTES - rest.len();
        if self.lines.slots() >= LINE_HEAD_BYTES + len + spare {
            let [low, high] = (len as u16).to_le_bytes();
            push(&mut self.lines, &[level as u8, low, high, kind.min(len) as u8], &text[..len]);
        }
        self.wake.wake();
    }

    /// The same for a line about a stop. Its kind is `what`, with the reason.
    fn stop_line(&mut self, what: &str, level: Level, spare: usize, shutdown: &Shutdown) {
        let kind = what.len() + shutdown.reason.text().len();
        self.line(kind, level, spare, format_args!("{what}{shutdown}"));
    }
}

impl Outbox for ResponseWriter {
    fn send(&mut self, payload: &[u8]) {
        let mut head = [0; HEAD_BYTES];
        head[..2].copy_from_slice(&(payload.len() as u16).to_le_bytes());
        head[2..].copy_from_slice(&self.progress.begun().to_le_bytes());
        self.progress.withdraw();
        // If the host does not read, the ring fills up, and responses are dropped, as in Klipper's C.
        push(&mut self.responses, &head, payload);
        self.wake.wake();
    }

    fn note(&mut self, note: Note<'_>) {
        // Names and counts come after the part that is the kind.
        let mut line = |kind: &str, line: std::fmt::Arguments<'_>| {
            self.line(kind.len(), Level::Info, LINES_SPARE, line);
        };
        match note {
            Note::Shutdown(shutdown) => self.stop_line("shutdown: ", gravity(shutdown), 0, shutdown),
            Note::Warning(shutdown) => self.stop_line("", Level::Warn, LINES_SPARE, shutdown),
            Note::Device(DeviceWarning { kind, trouble }) => {
                self.line(kind.len(), Level::Warn, LINES_SPARE, format_args!("{trouble}"));
            }
            Note::Trouble(shutdown) => self.stop_line("while shut down: ", gravity(shutdown), LINES_SPARE, shutdown),
            Note::Safe(name) => line("", format_args!("{name} has now reached its shutdown value")),
            Note::Lateness(lateness, margin) => {
                let margin = us(margin);
                line("timers: ", format_args!("timers: {lateness}; the core wakes {margin:.1} us early"));
            }
            Note::Reset => line("configuration", format_args!("configuration dropped, waiting for a new one")),
            Note::Renewed => line(
                "the host's process",
                format_args!("the host's process is gone and another has come: the MCU is reset for it"),
            ),
            Note::Configured(kinds) => line("configured: ", format_args!("configured: {}", Kinds(kinds))),
        }
    }
}

/// The level at which a stop is logged. It is information if somebody asked for the stop: M112, FIRMWARE_RESTART,
/// SIGTERM or FORCE_SHUTDOWN. For FORCE_SHUTDOWN the link logs a warning itself.
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

impl ResponseReader {
    /// The payload of the next response, and how many blocks the core had begun when it sent the response.
    pub(crate) fn response(&mut self) -> Option<(&[u8], u32)> {
        let mut head = [0; HEAD_BYTES];
        pop(&mut self.responses, &mut head)?;
        let [low, high, begun @ ..] = head;
        let len = usize::from(u16::from_le_bytes([low, high]));
        Some((pop(&mut self.responses, &mut self.payload[..len])?, u32::from_le_bytes(begun)))
    }

    /// The next line for the log, and how many of its bytes name its kind.
    pub(crate) fn line(&mut self) -> Option<(Level, String, usize)> {
        let mut head = [0; LINE_HEAD_BYTES];
        pop(&mut self.lines, &mut head)?;
        let [level, low, high, kind] = head;
        let level = [Level::Error, Level::Warn].into_iter().find(|known| *known as u8 == level).unwrap_or(Level::Info);
        let mut text = [0; LINE_BYTES];
        let len = usize::from(u16::from_le_bytes([low, high])).min(LINE_BYTES);
        let text = pop(&mut self.lines, &mut text[..len])?;
        Some((level, String::from_utf8_lossy(text).into_owned(), kind.into()))
    }

    pub(crate) fn has_response(&self) -> bool {
        !self.responses.is_empty()
    }

    pub(crate) fn has_line(&self) -> bool {
        !self.lines.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ends() -> (ResponseWriter, ResponseReader, Arc<Progress>) {
        let progress = Arc::new(Progress::default());
        let (response_ring, reader) = response_ring(Arc::new(LinkWake::new().unwrap()), progress.clone());
        (response_ring, reader, progress)
    }

    #[test]
    fn the_kinds_of_objects_are_counted_in_words() {
        assert_eq!(Kinds(&[("stepper", 2), ("heater", 1)]).to_string(), "2 steppers, 1 heater");
        assert_eq!(Kinds(&[]).to_string(), "no objects");
    }

    #[test]
    fn what_the_host_does_not_read_is_dropped_and_the_reason_of_a_stop_is_not() {
        let (mut response_ring, mut reader, progress) = ends();
        progress.begin();
        response_ring.send(b"one");
        assert_eq!(reader.response(), Some((&b"one"[..], 1)));
        for _ in 0..RING_BYTES {
            response_ring.send(&[7; 60]);
        }
        response_ring.note(Note::Shutdown(&Shutdown::because(reason::ADC_READ, "oid 3")));
        assert!(reader.has_line());
        assert_eq!(reader.line(), Some((Level::Error, "shutdown: Error on analog read: oid 3".into(), 30)));
        assert_eq!(reader.line(), None);
        let mut whole = 0;
        while let Some((response, 1)) = reader.response() {
            assert_eq!(response, [7; 60]);
            whole += 1;
        }
        assert_eq!(whole, RING_BYTES / (HEAD_BYTES + 60));
        assert!(!reader.has_response());
    }

    #[test]
    fn troubles_leave_room_for_the_reason_of_a_stop() {
        let (mut response_ring, mut reader, _) = ends();
        let trouble = Shutdown::because(reason::PWM_WRITE, "no ".repeat(LINE_BYTES));
        for _ in 0..256 {
            response_ring.note(Note::Trouble(&trouble));
        }
        let reason = format!("M112 {}", "of this host ".repeat(LINE_BYTES));
        response_ring.note(Note::Shutdown(&Shutdown::because(reason::COMMAND_REQUEST, reason)));
        let mut lines: Vec<_> = std::iter::from_fn(|| reader.line()).collect();
        let (level, line, _) = lines.pop().unwrap();
        assert_eq!(level, Level::Info);
        assert!(line.starts_with("shutdown: Command request: M112 of this host"), "{line}");
        assert!(lines.len() > 20);
        assert!(lines.iter().all(|(level, line, _)| *level == Level::Error && line.len() == LINE_BYTES));
    }

    #[test]
    fn what_was_asked_for_is_no_warning() {
        let (mut response_ring, mut reader, _) = ends();
        let end = Shutdown::because(reason::FORCE_SHUTDOWN, "the end");
        response_ring.note(Note::Shutdown(&end));
        response_ring.note(Note::Trouble(&end));
        assert_eq!(reader.line(), Some((Level::Info, "shutdown: Force shutdown command: the end".into(), 32)));
        let line = "while shut down: Force shutdown command: the end".to_owned();
        assert_eq!(reader.line(), Some((Level::Info, line, 39)));
    }
}
