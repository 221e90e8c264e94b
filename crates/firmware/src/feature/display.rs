// SPDX-License-Identifier: GPL-3.0-or-later
//! What the displays on bare lines have in common: a command's bytes are written by a worker, at the
//! display's pace, and the commands behind it wait.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Line, Pin};
use crate::mcu::{Done, Mcu, Object, Remote, Safe, Settable, Turn};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};
use pinion_protocol::block::PAYLOAD_MAX;

use super::pace::Pace;

/// All displays share a worker: commands wait for each other anyway.
const WORKER: &str = "display";

/// A display on bare lines. It runs on the worker.
pub(super) trait Panel: Send + 'static {
    /// Writes bytes to the display; ends early when the pace does.
    fn write(&mut self, register: Register, bytes: &[u8]) -> Result<(), Shutdown>;

    /// Drives the lines to where they belong in a stopped machine.
    fn idle(&mut self) -> Result<(), Shutdown>;
}

/// What bytes are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Register {
    Commands,
    Data,
}

/// What is to be done with a display.
#[derive(Clone, Copy)]
pub(super) enum Update {
    Write { register: Register, bytes: [u8; PAYLOAD_MAX], len: usize },
    Idle,
}

/// A panel, and the pace of its errands.
struct Paced<P> {
    panel: P,
    pace: Pace,
}

impl<P: Panel> Settable for Paced<P> {
    type Value = Update;

    fn set(&mut self, update: Update) -> Result<(), Shutdown> {
        match update {
            Update::Write { register, bytes, len } => self.panel.write(register, &bytes[..len]),
            Update::Idle => {
                self.pace.resume();
                self.panel.idle()
            }
        }
    }
}

/// A display as an object.
pub(super) struct Display<P: Panel> {
    kind: &'static str,
    pace: Pace,
    panel: Remote<Paced<P>>,
}

impl<P: Panel> Display<P> {
    /// A display whose lines stand at their idle levels.
    pub(super) fn new(mcu: &mut Mcu, kind: &'static str, pace: Pace, panel: P) -> Result<Display<P>, Shutdown> {
        let worker = mcu.worker(WORKER)?;
        let panel = Remote::new(worker, Paced { panel, pace: pace.clone() }, Update::Idle);
        Ok(Display { kind, pace, panel })
    }

    /// Writes bytes; the commands behind this one wait until they are with the display.
    pub(super) fn write(&mut self, turn: &mut Turn, register: Register, data: &[u8]) -> Result<(), Shutdown> {
        let mut bytes = [0; PAYLOAD_MAX];
        let len = data.len().min(PAYLOAD_MAX);
        bytes[..len].copy_from_slice(&data[..len]);
        self.panel.set(turn, Update::Write { register, bytes, len })
    }
}

impl<P: Panel> Object for Display<P> {
    fn kind(&self) -> &'static str {
        self.kind
    }

    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        self.panel.settle(turn, self.kind, done)
    }

    /// What is being written is broken off.
    fn make_safe(&mut self, turn: &mut Turn) -> Result<Safe, Shutdown> {
        self.pace.stop();
        self.panel.set(turn, Update::Idle)?;
        Ok(Safe::Later)
    }
}

/// An output of a display, which is called only when its level changes: a call costs a microsecond.
pub(super) struct Wire {
    line: Arc<dyn Line>,
    level: bool,
}

impl Wire {
    /// Claims a line, low.
    pub(super) fn claim(mcu: &mut Mcu, pin: Pin) -> Result<Wire, Shutdown> {
        Ok(Wire { line: mcu.shared_output(pin, false)?, level: false })
    }

    pub(super) fn set(&mut self, level: bool) -> Result<(), Shutdown> {
        if level != self.level {
            self.line.write(level)?;
            self.level = level;
        }
        Ok(())
    }

    /// Drives it low, whatever it was.
    pub(super) fn idle(&mut self) -> Result<(), Shutdown> {
        self.level = false;
        self.line.write(false)
    }
}

/// The time that a display needs after each byte.
pub(super) struct Busy {
    pub(super) pace: Pace,
    /// When the last byte was with the display.
    since: Option<Clock>,
}

impl Busy {
    pub(super) fn new(pace: Pace) -> Busy {
        Busy { pace, since: None }
    }

    /// Waits until so long after the last byte. False if the errand is to end.
    pub(super) fn over(&self, ticks: Ticks) -> bool {
        self.pace.until(self.since.map_or_else(|| self.pace.now(), |since| since + ticks))
    }

    /// A byte is with the display now.
    pub(super) fn begin(&mut self) {
        self.since = Some(self.pace.now());
    }
}

/// Waits for the nanoseconds that a display wants between two edges.
pub(super) fn hold(pace: &Pace, ticks: Ticks) {
    let at = pace.now() + ticks;
    pace.until(at);
}
