// SPDX-License-Identifier: GPL-3.0-or-later
//! The level of a line: for the MCU's status, for a recorder of edges, and from a chip that may sleep.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use crate::board::{Direction, Line, Pin};
use crate::shutdown::Shutdown;

use super::{Calls, Settable};

/// Records the edges of outputs. Core and workers call it.
pub trait EdgeRecorder: Send + Sync {
    /// A line is in use from now on.
    fn claimed(&self, pin: Pin, name: String);

    /// An output has changed its level.
    fn edge(&self, pin: Pin, level: bool);
}

/// The level of a line when it was last driven or read. The core or a worker writes this byte.
#[derive(Debug)]
pub(super) struct Level(AtomicU8);

const UNKNOWN: u8 = 2;

impl Level {
    pub(super) fn unknown() -> Level {
        Level(AtomicU8::new(UNKNOWN))
    }

    /// Called when the line is set up.
    pub(super) fn begin(&self, direction: Direction) {
        match direction {
            Direction::Output { level, .. } => self.set(level),
            _ => self.forget(),
        }
    }

    /// Nothing is known of it from now on.
    pub(super) fn forget(&self) {
        self.0.store(UNKNOWN, Ordering::Relaxed);
    }

    #[inline]
    pub(super) fn set(&self, level: bool) {
        self.0.store(u8::from(level), Ordering::Relaxed);
    }

    /// Whether it is known to be high.
    #[inline]
    pub(super) fn is_high(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 1
    }

    pub(super) fn get(&self) -> Option<bool> {
        match self.0.load(Ordering::Relaxed) {
            UNKNOWN => None,
            level => Some(level != 0),
        }
    }
}

/// A line whose edges are recorded.
pub(super) struct Recorded {
    line: Arc<dyn Line>,
    pin: Pin,
    /// The last recorded level.
    level: Level,
    recorder: Arc<dyn EdgeRecorder>,
}

impl Recorded {
    pub(super) fn new(
        line: Arc<dyn Line>,
        pin: Pin,
        direction: Direction,
        recorder: Arc<dyn EdgeRecorder>,
    ) -> Recorded {
        let recorded = Recorded { line, pin, level: Level::unknown(), recorder };
        recorded.turned(direction);
        recorded
    }

    fn is_now(&self, level: bool) {
        if self.level.get() != Some(level) {
            self.level.set(level);
            self.recorder.edge(self.pin, level);
        }
    }

    fn turned(&self, direction: Direction) {
        match direction {
            Direction::Output { level, .. } => self.is_now(level),
            Direction::OpenDrain => self.is_now(true),
            // Somebody else sets its level.
            Direction::Input(_) => self.level.begin(direction),
        }
    }
}

/// It is in no bank, so that each edge is recorded when it is made.
impl Line for Recorded {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.line.write(level)?;
        self.is_now(level);
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.line.read()
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.set_direction(direction)?;
        self.turned(direction);
        Ok(())
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.turn(direction)?;
        self.turned(direction);
        Ok(())
    }

    fn is_fast(&self) -> bool {
        self.line.is_fast()
    }

    fn flush(&self) {
        self.line.flush();
    }

    fn is_posted(&self) -> bool {
        self.line.is_posted()
    }
}

/// A line for jobs. It records its level for the status when a job drives or reads it. Jobs measure the time between
/// edges, so a write returns when it has reached the line.
pub(super) struct JobLine {
    pub(super) line: Arc<dyn Line>,
    pub(super) level: Arc<Level>,
    /// Repeats the calls to a chip that may sleep.
    pub(super) calls: Option<Calls>,
}

impl JobLine {
    fn call<T>(&self, call: impl Fn(&dyn Line) -> Result<T, Shutdown>) -> Result<T, Shutdown> {
        match &self.calls {
            None => call(&*self.line),
            Some(calls) => calls.repeat(|| call(&*self.line)),
        }
    }
}

impl Line for JobLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.call(|line| line.write(level))?;
        self.line.flush();
        self.level.set(level);
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.call(|line| line.read()).inspect(|level| self.level.set(*level))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.call(|line| line.set_direction(direction))?;
        self.level.begin(direction);
        Ok(())
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.call(|line| line.turn(direction))?;
        self.level.begin(direction);
        Ok(())
    }

    fn is_fast(&self) -> bool {
        self.line.is_fast()
    }

    fn is_posted(&self) -> bool {
        self.line.is_posted()
    }
}

impl Settable for JobLine {
    type Value = bool;

    fn set(&mut self, level: bool) -> Result<(), Shutdown> {
        self.write(level)
    }
}
