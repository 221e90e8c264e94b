// SPDX-License-Identifier: GPL-3.0-or-later
//! Input lines: the core reads them, or the worker of their chip.

use std::sync::Arc;

use crate::board::{Line, Pin};
use crate::shutdown::{Shutdown, reason};
use crate::time::Clock;

use super::claims::Claim;
use super::level::{JobLine, Level};
use super::{Back, Context, DeviceId, Finished, Job, JobSlot, UNREAD_LIMIT, Unread};

/// Reads an input of a chip that may sleep.
struct Read;

impl Job for Read {
    type Device = JobLine;
    type Out = bool;
    type Failure = Shutdown;

    fn run(&mut self, line: &mut JobLine) -> Result<bool, Shutdown> {
        line.read()
    }
}

/// A worker's sample of an input.
pub struct Sample {
    /// `None` if the read failed.
    pub level: Option<bool>,
    /// When the worker began to read.
    pub began: Clock,
    /// When the worker finished.
    pub ended: Clock,
}

/// An input line of any chip.
pub struct InputLine {
    pin: Pin,
    sensor: Sensor,
    level: Arc<Level>,
}

enum Sensor {
    Prompt(Arc<dyn Line>),
    Slow { line: DeviceId<JobLine>, read: JobSlot<Read>, unread: Unread },
}

impl InputLine {
    /// The object gets the worker's reads back under `number`.
    pub(super) fn new(number: u8, claim: &Claim) -> InputLine {
        let sensor = match claim.slow() {
            None => Sensor::Prompt(claim.line()),
            Some(line) => Sensor::Slow { line, read: JobSlot::numbered(number, Read), unread: Unread::default() },
        };
        InputLine { pin: claim.pin(), sensor, level: claim.level() }
    }

    /// The line's level. `None` if the chip's worker has to read it: the level then comes later, to the object's
    /// `finished`.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    #[inline]
    pub fn read(&mut self, context: &mut Context) -> Result<Option<bool>, Shutdown> {
        if let Sensor::Slow { line, read, unread } = &mut self.sensor
            && read.is_here()
        {
            unread.asked(context.now());
            read.send(context, *line)?;
        }
        self.prompt_level()
    }

    /// The line's level; `None` if the chip's worker would have to read it.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    #[inline]
    pub fn prompt_level(&self) -> Result<Option<bool>, Shutdown> {
        match &self.sensor {
            Sensor::Prompt(line) => line.read().inspect(|level| self.level.set(*level)).map(Some),
            Sensor::Slow { .. } => Ok(None),
        }
    }

    /// Whether the chip's worker is reading the line.
    pub fn is_looking(&self) -> bool {
        matches!(&self.sensor, Sensor::Slow { read, .. } if !read.is_here())
    }

    /// Handles a finished read. It fails with "GPIO line read failed" when no read has
    /// succeeded for [`UNREAD_LIMIT`].
    pub fn sampled(&mut self, context: &Context, finished: Finished) -> Option<Result<Sample, Shutdown>> {
        self.take_in(context, finished, false)
    }

    /// The same, if a move depends on the input. One failed read is a failure at once.
    pub fn seen(&mut self, context: &Context, finished: Finished) -> Option<Result<Sample, Shutdown>> {
        self.take_in(context, finished, true)
    }

    fn take_in(&mut self, context: &Context, finished: Finished, at_once: bool) -> Option<Result<Sample, Shutdown>> {
        let Sensor::Slow { read, unread, .. } = &mut self.sensor else { return None };
        let Back { result, began, ended, .. } = read.back(finished)?;
        let level = match result {
            Ok(level) => {
                unread.read();
                self.level.set(level);
                Ok(Some(level))
            }
            Err(failure) if at_once || unread.is_too_long(ended) => {
                context.try_shut_down(failure.clone()).map(|()| None)
            }
            Err(_) => Ok(None),
        };
        Some(level.map(|level| Sample { level, began, ended }))
    }

    /// Checks a read that may still be on its way. Call this while one may be.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed" when no read has succeeded for [`UNREAD_LIMIT`].
    pub fn awaited(&self, context: &mut Context) -> Result<(), Shutdown> {
        let Sensor::Slow { read, unread, .. } = &self.sensor else { return Ok(()) };
        if read.is_here() || !unread.is_too_long(context.now()) {
            return Ok(());
        }
        let (name, ms) = (context.name(self.pin), UNREAD_LIMIT.as_ms());
        let stop = Shutdown::because(reason::LINE_READ, format!("{name} has not answered for {ms} ms"));
        context.try_shut_down(
            stop.remedy("check its power and wiring, look at the kernel's log (dmesg), then FIRMWARE_RESTART"),
        )
    }
}
