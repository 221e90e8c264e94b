// SPDX-License-Identifier: GPL-3.0-or-later
//! From the core to the link: responses for the host and lines for the log, through a ring
//! that neither side waits for.

#![forbid(unsafe_code)]

use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use log::Level;
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtrb::chunks::ChunkError;
use rtrb::{Consumer, Producer, RingBuffer};

use crate::lateness::us;
use crate::mcu::{Note, Outbox};
use crate::shutdown::Reason;

/// Bytes between core and link: some 1,000 responses. When the host does not read, later ones
/// are dropped.
const RING_BYTES: usize = 1 << 16;
/// A record's kind, its length and the blocks begun.
const HEAD_BYTES: usize = 7;
/// The longest line for the log.
const LINE_BYTES: usize = 1024;

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
    pub(super) fn sleeping(&self) {
        // Not a store: what was there when the core last called has to be seen afterwards.
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

/// How many of the link's blocks the core has begun and done. A response carries the sequence
/// number of the block that it answers: klippy takes a response for an answer to a query only
/// if its number says that the query was received (`#sent_time` in serialhdl.py), and a number
/// that runs ahead of the core would make an answer to an earlier query of the same name one.
#[derive(Debug, Default)]
pub(super) struct Progress {
    begun: AtomicU32,
    done: AtomicU32,
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
}

/// What a record of the ring is.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Response = 0,
    Error = 1,
    Warning = 2,
    Info = 3,
}

/// The core's end.
pub(super) struct Outlet {
    ring: Producer<u8>,
    wake: Arc<LinkWake>,
    progress: Arc<Progress>,
}

/// The link's end.
pub(super) struct Inlet {
    ring: Consumer<u8>,
    record: Vec<u8>,
}

/// Something that the core said.
pub(super) enum Record<'a> {
    /// A payload, and how many blocks the core had begun when it said so.
    Response(&'a [u8], u32),
    Line(Level, String),
}

/// Both ends of a ring.
pub(super) fn outlet(wake: Arc<LinkWake>, progress: Arc<Progress>) -> (Outlet, Inlet) {
    let (producer, consumer) = RingBuffer::new(RING_BYTES);
    (Outlet { ring: producer, wake, progress }, Inlet { ring: consumer, record: vec![0; LINE_BYTES] })
}

impl Outlet {
    fn push(&mut self, kind: Kind, bytes: &[u8]) {
        let mut head = [0; HEAD_BYTES];
        head[0] = kind as u8;
        head[1..3].copy_from_slice(&(bytes.len() as u16).to_le_bytes());
        head[3..].copy_from_slice(&self.progress.begun.load(Ordering::Relaxed).to_le_bytes());
        match self.ring.write_chunk_uninit(HEAD_BYTES + bytes.len()) {
            Ok(chunk) => {
                chunk.fill_from_iter(head.into_iter().chain(bytes.iter().copied()));
            }
            // The host does not read: what it misses is lost, as in the firmware.
            Err(ChunkError::TooFewSlots(_)) => {}
        }
        self.wake.wake();
    }

    fn line(&mut self, kind: Kind, line: std::fmt::Arguments<'_>) {
        let mut text = [0; LINE_BYTES];
        let mut rest = &mut text[..];
        // A line that is too long is cut.
        let _ = rest.write_fmt(line);
        let len = LINE_BYTES - rest.len();
        self.push(kind, &text[..len]);
    }
}

impl Outbox for Outlet {
    fn send(&mut self, payload: &[u8]) {
        self.push(Kind::Response, payload);
    }

    fn note(&mut self, note: Note<'_>) {
        match note {
            Note::Shutdown(shutdown) => {
                // What somebody asked for is no error.
                let asked = matches!(shutdown.reason, Reason::CommandRequest | Reason::ForceShutdown);
                let kind = if asked { Kind::Warning } else { Kind::Error };
                self.line(kind, format_args!("shutdown: {shutdown}"));
            }
            Note::Trouble(shutdown) => self.line(Kind::Error, format_args!("while shut down: {shutdown}")),
            Note::Lateness(lateness, margin) => {
                self.line(Kind::Info, format_args!("timers: {lateness}; the core wakes {:.1} us early", us(margin)));
            }
            Note::Reset => self.line(Kind::Info, format_args!("configuration dropped, waiting for a new one")),
            Note::Configured(kinds) => self.line(Kind::Info, format_args!("configured: {}", Kinds(kinds))),
        }
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
    /// The next record, if a whole one is there.
    pub(super) fn next(&mut self) -> Option<Record<'_>> {
        let mut head = [0; HEAD_BYTES];
        for (to, from) in head.iter_mut().zip(self.ring.read_chunk(HEAD_BYTES).ok()?) {
            *to = from;
        }
        let [kind, low, high, begun @ ..] = head;
        let len = usize::from(u16::from_le_bytes([low, high])).min(LINE_BYTES);
        // The core commits a record as a whole.
        let body = self.ring.read_chunk(len).ok()?;
        for (to, from) in self.record.iter_mut().zip(body) {
            *to = from;
        }
        let record = &self.record[..len];
        let line = |level| Record::Line(level, String::from_utf8_lossy(record).into_owned());
        Some(match kind {
            kind if kind == Kind::Error as u8 => line(Level::Error),
            kind if kind == Kind::Warning as u8 => line(Level::Warn),
            kind if kind == Kind::Info as u8 => line(Level::Info),
            _ => Record::Response(record, u32::from_le_bytes(begun)),
        })
    }

    pub(super) fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shutdown::Shutdown;

    #[test]
    fn records_come_out_as_they_went_in_and_a_full_ring_drops() {
        let progress = Arc::new(Progress::default());
        let (mut outlet, mut inlet) = outlet(Arc::new(LinkWake::new().unwrap()), progress.clone());
        progress.begin();
        outlet.send(b"one");
        outlet.note(Note::Shutdown(&Shutdown::because(Reason::AdcRange, "oid 3")));
        assert!(matches!(inlet.next(), Some(Record::Response(b"one", 1))));
        let Some(Record::Line(Level::Error, line)) = inlet.next() else { panic!() };
        assert_eq!(line, "shutdown: ADC out of range: oid 3");
        for _ in 0..RING_BYTES {
            outlet.send(&[7; 60]);
        }
        let mut whole = 0;
        while let Some(Record::Response(record, 1)) = inlet.next() {
            assert_eq!(record, [7; 60]);
            whole += 1;
        }
        assert_eq!(whole, RING_BYTES / (HEAD_BYTES + 60));
    }
}
