// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines whose edges the kernel counts, by its newer kind of request (`gpio_v2`, Linux 5.10).

#![forbid(unsafe_code)]

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::chip::LineInfo;
use super::refusal::{Subject, text};
use super::{CONSUMER, Handle, lacks};
use crate::sys;
use pinion_firmware::board::{Bias, Direction, EdgeCount, Edges, Line};
use pinion_firmware::shutdown::{Shutdown, reason};

/// `GPIO_V2_LINE_FLAG_` flags.
mod flag {
    pub(super) const INPUT: u64 = 1 << 2;
    pub(super) const BOTH_EDGES: u64 = 1 << 4 | 1 << 5;
    pub(super) const PULL_UP: u64 = 1 << 8;
    pub(super) const PULL_DOWN: u64 = 1 << 9;
}

/// Edges that the kernel keeps for us, if we ask for no other number (gpiolib-cdev.c). Only the last one
/// matters, as each carries the number of those before it, so the fewer the better: so many are read at
/// a time, however many come.
const EVENTS: usize = 16;
/// `struct gpio_v2_line_event` (linux/gpio.h): `timestamp_ns` at 0, `line_seqno` at 20.
const EVENT_BYTES: usize = 48;

/// A request of the newer kind (`gpio_v2`), for a line with edges.
struct EdgeRequest {
    file: File,
    subject: Subject,
    /// `GPIO_V2_LINE_FLAG_` flags of its last set-up.
    flags: AtomicU64,
}

impl EdgeRequest {
    fn set(&self, flags: u64) -> Result<(), Shutdown> {
        if flags != self.flags.swap(flags, Ordering::Relaxed) {
            sys::set_line_flags(&self.file, flags).map_err(|error| {
                let code = error.raw_os_error().unwrap_or_default();
                let detail = self.subject.refusal("an input", code, Bias::None, &LineInfo::default(), "");
                Shutdown::because(reason::INPUT_LINE, detail)
            })?;
        }
        Ok(())
    }

    fn unreadable(&self, error: &io::Error) -> Shutdown {
        let code = error.raw_os_error().unwrap_or_default();
        Shutdown::because(reason::LINE_READ, self.subject.lost("read", code, false))
    }
}

/// An input line whose edges the kernel counts. The kernel has no way from the requests of [`HeldLine`](super::HeldLine)
/// to one with edges, so this is another kind of line, and can not become an output.
pub(crate) struct EdgeLine(Arc<EdgeRequest>);

/// The edges of an [`EdgeLine`].
pub(crate) struct LineEdges {
    request: Arc<EdgeRequest>,
    so_far: EdgeCount,
}

impl Handle {
    /// Requests the line as an input, from the kernel, with its edges. An error for the log, if that can
    /// not be: the line may still be had without.
    pub(crate) fn request_edges(self, dev: &Path, bias: Bias) -> Result<(EdgeLine, LineEdges), Box<str>> {
        if lacks(&self.subject.label, bias) {
            return Err(self.subject.no_bias(bias).into());
        }
        let flags = flag::INPUT | flag::BOTH_EDGES | bias_flag(bias);
        let file = File::open(dev.join(&self.subject.chip))
            .and_then(|chip| sys::request_line(&chip, self.subject.offset, flags, CONSUMER))
            .map_err(|error| no_edges(error.raw_os_error().unwrap_or_default()))?;
        let request = Arc::new(EdgeRequest { file, subject: self.subject, flags: AtomicU64::new(flags) });
        Ok((EdgeLine(request.clone()), LineEdges { request, so_far: EdgeCount::default() }))
    }
}

fn bias_flag(bias: Bias) -> u64 {
    match bias {
        Bias::None => 0,
        Bias::PullUp => flag::PULL_UP,
        Bias::PullDown => flag::PULL_DOWN,
    }
}

/// For the log: why the kernel does not tell of a line's edges.
fn no_edges(code: i32) -> Box<str> {
    let why = match code {
        libc::ENXIO => "its chip has no interrupts".to_owned(),
        libc::EBUSY => "its interrupt is in use".to_owned(),
        libc::EINVAL | libc::ENOTTY => "Linux before 5.10 does so for no line, and some drivers for none".to_owned(),
        _ => text(code),
    };
    format!("the kernel does not tell of its edges ({why})").into()
}

impl Line for EdgeLine {
    /// It is an input.
    fn write(&self, _level: bool) -> Result<(), Shutdown> {
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        sys::line_level(&self.0.file).map_err(|error| self.0.unreadable(&error))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let Direction::Input(bias) = direction else {
            let detail = format!(
                "{} counts pulses and can not be an output as well: choose another pin for one of the two",
                self.0.subject
            );
            return Err(Shutdown::because(reason::OUTPUT_LINE, detail));
        };
        self.0.subject.setting(direction)?;
        let before = self.0.flags.load(Ordering::Relaxed);
        self.0.set(before & !(flag::PULL_UP | flag::PULL_DOWN) | bias_flag(bias))
    }
}

impl Edges for LineEdges {
    /// One read takes all that the kernel keeps. It drops the oldest where there is no room, and has
    /// counted them before that.
    fn count(&mut self) -> Result<EdgeCount, Shutdown> {
        let mut events = [0; EVENTS * EVENT_BYTES];
        let bytes = match (&self.request.file).read(&mut events) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => 0,
            read => read.map_err(|error| self.request.unreadable(&error))?,
        };
        if let Some(last) = events[..bytes].chunks_exact(EVENT_BYTES).next_back() {
            self.so_far = edge_count(last);
        }
        Ok(self.so_far)
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        self.request.set(self.request.flags.load(Ordering::Relaxed) & !flag::BOTH_EDGES)
    }
}

/// What a line's last event tells.
fn edge_count(event: &[u8]) -> EdgeCount {
    let (timestamp_ns, rest) = event.split_first_chunk().unwrap_or((&[0; 8], &[]));
    let line_seqno = rest.get(12..).and_then(|rest| rest.first_chunk()).unwrap_or(&[0; 4]);
    EdgeCount {
        count: u32::from_ne_bytes(*line_seqno),
        last: Some(Duration::from_nanos(u64::from_ne_bytes(*timestamp_ns))),
    }
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
        let last = Some(Duration::new(5, 7));
        assert_eq!(edge_count(&event), EdgeCount { count: 70_000, last });
    }

    #[test]
    fn a_line_without_edges_says_why() {
        for (code, why) in [
            (libc::ENXIO, "its chip has no interrupts"),
            (libc::EBUSY, "its interrupt is in use"),
            (libc::EINVAL, "before 5.10"),
        ] {
            assert!(no_edges(code).contains(why), "{}", no_edges(code));
        }
    }
}
