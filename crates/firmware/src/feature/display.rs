// SPDX-License-Identifier: GPL-3.0-or-later
//! Shared code of the displays on bare lines. A worker writes a command's bytes at the display's pace. The commands
//! behind it wait.

use std::sync::Arc;

use crate::board::{Line, Pin};
use crate::mcu::{Context, Finished, Object, Remote, Safe, Settable};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};
use pinion_protocol::block::PAYLOAD_MAX;

use super::pace::Pace;

/// All displays share a worker, because commands wait for each other anyway.
const WORKER: &str = "display";

/// A display on bare lines. It runs on the worker.
pub(super) trait Panel: Send + 'static {
    /// Writes bytes to the display. It ends early if the pace is stopped.
    fn write(&mut self, register: Register, bytes: &[u8]) -> Result<(), Shutdown>;

    /// Sets the lines to their levels in a stopped MCU.
    fn idle(&mut self) -> Result<(), Shutdown>;
}

/// The display's register for the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Register {
    Commands,
    Data,
}

/// A task for a display.
#[derive(Clone, Copy)]
pub(super) enum Update {
    Write { register: Register, bytes: [u8; PAYLOAD_MAX], len: usize },
    Idle,
}

/// A panel and the pace of its jobs.
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
    /// Makes a display. Its lines are already at their idle levels.
    pub(super) fn new(context: &mut Context, kind: &'static str, pace: Pace, panel: P) -> Result<Display<P>, Shutdown> {
        let panel = context.device(WORKER, Box::new(Paced { panel, pace: pace.clone() }))?;
        Ok(Display { kind, pace, panel: Remote::new(0, panel, Update::Idle) })
    }

    /// Writes bytes. The commands behind this one wait until the display has them.
    pub(super) fn write(&mut self, context: &mut Context, register: Register, data: &[u8]) -> Result<(), Shutdown> {
        let mut bytes = [0; PAYLOAD_MAX];
        let len = data.len().min(PAYLOAD_MAX);
        bytes[..len].copy_from_slice(&data[..len]);
        self.panel.set(context, Update::Write { register, bytes, len })
    }
}

impl<P: Panel> Object for Display<P> {
    fn kind(&self) -> &'static str {
        self.kind
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        self.panel.settle(context, self.kind, finished)
    }

    /// Aborts a write that is under way.
    fn make_safe(&mut self, context: &mut Context) -> Result<Safe, Shutdown> {
        self.pace.stop();
        self.panel.set(context, Update::Idle)?;
        Ok(Safe::Later)
    }
}

/// An output of a display. It is written only if its level changes, because a write costs a microsecond.
pub(super) struct Wire {
    line: Arc<dyn Line>,
    level: bool,
}

impl Wire {
    /// Claims a line at low level.
    pub(super) fn claim(context: &mut Context, pin: Pin) -> Result<Wire, Shutdown> {
        Ok(Wire { line: context.shared_output(pin, false)?, level: false })
    }

    pub(super) fn set(&mut self, level: bool) -> Result<(), Shutdown> {
        if level != self.level {
            self.line.write(level)?;
            self.level = level;
        }
        Ok(())
    }

    /// Drives the line low from any level.
    pub(super) fn idle(&mut self) -> Result<(), Shutdown> {
        self.level = false;
        self.line.write(false)
    }
}

/// The time that a display needs after each byte.
pub(super) struct Busy {
    pub(super) pace: Pace,
    /// When the display got the last byte.
    since: Option<Clock>,
}

impl Busy {
    pub(super) fn new(pace: Pace) -> Busy {
        Busy { pace, since: None }
    }

    /// Waits until `ticks` after the last byte. False: the job must end.
    pub(super) fn over(&self, ticks: Ticks) -> bool {
        self.pace.until(self.since.map_or_else(|| self.pace.now(), |since| since + ticks))
    }

    /// Notes that the display has got a byte now.
    pub(super) fn begin(&mut self) {
        self.since = Some(self.pace.now());
    }
}

/// Waits for the nanoseconds that a display needs between two edges.
pub(super) fn hold(pace: &Pace, ticks: Ticks) {
    let at = pace.now() + ticks;
    pace.until(at);
}
