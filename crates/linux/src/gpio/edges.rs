// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines whose edges the kernel timestamps, through its newer kind of request (`gpio_v2`, Linux 5.10).

#![forbid(unsafe_code)]

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::refusal::{Subject, text};
use super::{CONSUMER, Handle, lacks};
use crate::sys;
use pinion_firmware::board::{Bias, Direction, Edge, Edges, Line};
use pinion_firmware::shutdown::{Shutdown, reason};

/// `GPIO_V2_LINE_FLAG_` flags.
mod flag {
    pub(super) const INPUT: u64 = 1 << 2;
    pub(super) const BOTH_EDGES: u64 = 1 << 4 | 1 << 5;
    pub(super) const PULL_UP: u64 = 1 << 8;
    pub(super) const PULL_DOWN: u64 = 1 << 9;
}

/// How many edges the kernel keeps: the most that it offers (gpiolib-cdev.c).
const EVENTS_KEPT: u32 = 1024;
/// Edges taken by one read.
const EVENTS: usize = 16;
/// `struct gpio_v2_line_event` (linux/gpio.h): `timestamp_ns` at 0, `id` at 8, `line_seqno` at 20.
const EVENT_BYTES: usize = 48;
/// GPIO_V2_LINE_EVENT_RISING_EDGE.
const RISING: u32 = 1;

/// A request of the newer kind (`gpio_v2`), for a line with edges.
struct EdgeRequest {
    file: File,
    subject: Subject,
    /// The flags of the last setup that the kernel took (`GPIO_V2_LINE_FLAG_`).
    flags: AtomicU64,
}

impl EdgeRequest {
    fn set(&self, flags: u64) -> Result<(), Shutdown> {
        if flags != self.flags.load(Ordering::Relaxed) {
            sys::set_line_flags(&self.file, flags).map_err(|error| {
                let code = error.raw_os_error().unwrap_or_default();
                Shutdown::because(reason::INPUT_LINE, self.subject.refusal("an input", code, Bias::None, None, ""))
            })?;
            self.flags.store(flags, Ordering::Relaxed);
        }
        Ok(())
    }

    fn unreadable(&self, error: &io::Error) -> Shutdown {
        let code = error.raw_os_error().unwrap_or_default();
        Shutdown::because(reason::LINE_READ, self.subject.lost("read", code, false))
    }
}

/// An input line whose edges the kernel counts. The kernel cannot turn a request of [`HeldLine`](super::HeldLine) into
/// one with edges. So this is another kind of line, and cannot become an output.
pub(crate) struct EdgeLine(Arc<EdgeRequest>);

/// The edges of an [`EdgeLine`].
pub(crate) struct LineEdges {
    request: Arc<EdgeRequest>,
    /// The `line_seqno` of the last edge that was taken.
    seen: u32,
}

impl Handle {
    /// Requests the line from the kernel as an input, with its edges. If this fails, the error is for the log: a
    /// request without edges may still work.
    pub(crate) fn request_edges(self, dev: &Path, bias: Bias) -> Result<(EdgeLine, LineEdges), Box<str>> {
        if lacks(&self.subject.label, bias) {
            return Err(self.subject.no_bias(bias).to_string().into());
        }
        let flags = flag::INPUT | flag::BOTH_EDGES | bias_flag(bias);
        let file = File::open(dev.join(&self.subject.chip))
            .and_then(|chip| sys::request_line(&chip, self.subject.offset, flags, EVENTS_KEPT, CONSUMER))
            .map_err(|error| no_edges(error.raw_os_error().unwrap_or_default()))?;
        let request = Arc::new(EdgeRequest { file, subject: self.subject, flags: AtomicU64::new(flags) });
        Ok((EdgeLine(request.clone()), LineEdges { request, seen: 0 }))
    }
}

fn bias_flag(bias: Bias) -> u64 {
    match bias {
        Bias::None => 0,
        Bias::PullUp => flag::PULL_UP,
        Bias::PullDown => flag::PULL_DOWN,
    }
}

/// For the log: why the kernel does not report a line's edges.
fn no_edges(code: i32) -> Box<str> {
    let why = match code {
        libc::ENXIO => "its chip has no interrupts".to_owned(),
        libc::EBUSY => "its interrupt is in use".to_owned(),
        libc::EINVAL | libc::ENOTTY => "this needs Linux 5.10 and a driver that supports it".to_owned(),
        _ => text(code),
    };
    format!("the kernel does not report its edges ({why})").into()
}

impl Line for EdgeLine {
    /// Does nothing, because the line is an input.
    fn write(&self, _level: bool) -> Result<(), Shutdown> {
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        sys::line_level(&self.0.file).map_err(|error| self.0.unreadable(&error))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let Direction::Input(bias) = direction else {
            let cause = format!("{} counts pulses and cannot be an output as well", self.0.subject);
            return Err(Shutdown::because(reason::OUTPUT_LINE, cause).remedy("choose another pin for one of the two"));
        };
        self.0.subject.setting(direction)?;
        let before = self.0.flags.load(Ordering::Relaxed);
        self.0.set(before & !(flag::PULL_UP | flag::PULL_DOWN) | bias_flag(bias))
    }
}

impl Edges for LineEdges {
    /// Takes at most as many edges as the kernel keeps. So a line that never rests does not hold up the worker.
    fn take(&mut self, see: &mut dyn FnMut(Edge)) -> Result<(), Shutdown> {
        let mut events = [0; EVENTS * EVENT_BYTES];
        for _ in 0..EVENTS_KEPT as usize / EVENTS {
            let bytes = match (&self.request.file).read(&mut events) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                read => read.map_err(|error| self.request.unreadable(&error))?,
            };
            for event in events[..bytes].chunks_exact(EVENT_BYTES) {
                let (edge, line_seqno) = edge_of(event, self.seen);
                self.seen = line_seqno;
                see(edge);
            }
            if bytes < events.len() {
                return Ok(());
            }
        }
        Ok(())
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        self.request.set(self.request.flags.load(Ordering::Relaxed) & !flag::BOTH_EDGES)
    }
}

/// The edge in an event, and its `line_seqno`. `seen` is the `line_seqno` of the event before.
fn edge_of(event: &[u8], seen: u32) -> (Edge, u32) {
    let word = |at: usize| {
        let bytes = event.get(at..).and_then(|rest| rest.first_chunk());
        u32::from_ne_bytes(*bytes.unwrap_or(&[0; 4]))
    };
    let timestamp_ns = u64::from_ne_bytes(*event.first_chunk().unwrap_or(&[0; 8]));
    let (id, line_seqno) = (word(8), word(20));
    let dropped = line_seqno.wrapping_sub(seen).saturating_sub(1);
    (Edge { at: Duration::from_nanos(timestamp_ns), level: id == RISING, dropped }, line_seqno)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_event_is_laid_out_as_the_kernel_has_it() {
        // timestamp_ns, id, offset, seqno, line_seqno and padding.
        let mut event = [0xee; EVENT_BYTES];
        event[..8].copy_from_slice(&5_000_000_007_u64.to_ne_bytes());
        event[20..24].copy_from_slice(&70_000_u32.to_ne_bytes());
        for (id, level) in [(1_u32, true), (2, false)] {
            event[8..12].copy_from_slice(&id.to_ne_bytes());
            for (seen, dropped) in [(69_999, 0), (69_990, 9), (0, 69_999)] {
                assert_eq!(edge_of(&event, seen), (Edge { at: Duration::new(5, 7), level, dropped }, 70_000));
            }
        }
        // The kernel's number starts over at 2^32.
        event[20..24].copy_from_slice(&1_u32.to_ne_bytes());
        assert_eq!(edge_of(&event, u32::MAX).0.dropped, 1);
    }

    #[test]
    fn a_line_without_edges_says_why() {
        for (code, why) in [
            (libc::ENXIO, "its chip has no interrupts"),
            (libc::EBUSY, "its interrupt is in use"),
            (libc::EINVAL, "needs Linux 5.10"),
        ] {
            assert!(no_edges(code).contains(why), "{}", no_edges(code));
        }
    }
}
