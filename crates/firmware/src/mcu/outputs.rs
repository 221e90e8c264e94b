// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs: the lines that features drive, and how a stop drives them to their shutdown values.

use std::mem;
use std::sync::Arc;

use crate::board::{Line, ShutdownValue};
use crate::shutdown::Shutdown;

use super::claims::Claim;
use super::level::Level;
use super::stop::Subject;
use super::{Batch, Context, Finished, Safe, State};

/// An output line of any chip.
pub struct OutputLine {
    place: usize,
    /// The line, if the core itself drives it.
    prompt: Option<PromptLine>,
}

impl OutputLine {
    pub(super) fn new(place: usize, claim: &Claim) -> OutputLine {
        OutputLine { place, prompt: claim.slow().is_none().then(|| PromptLine::new(claim)) }
    }

    /// Drives the line, directly or through its chip's worker. If a command calls this, the next commands wait until
    /// the worker has written it.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn write(&mut self, context: &mut Context, level: bool) -> Result<(), Shutdown> {
        match &mut self.prompt {
            Some(line) => line.write(level),
            None => context.state.write_output(self.place, level),
        }
    }

    /// The line's level in a stopped MCU.
    pub fn shutdown_value(&self, context: &Context) -> bool {
        context.state.lines.get(self.place).and_then(Claim::shutdown_value).unwrap_or_default().get()
    }
}

/// An output that the core itself drives. A call takes one or two microseconds.
pub struct PromptLine {
    line: Arc<dyn Line>,
    level: Arc<Level>,
    /// A batch has made an edge that its user has not seen yet.
    is_batched: bool,
}

impl PromptLine {
    pub(super) fn new(claim: &Claim) -> PromptLine {
        PromptLine { line: claim.line(), level: claim.level(), is_batched: false }
    }

    /// Drives the line.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn write(&mut self, level: bool) -> Result<(), Shutdown> {
        // Stored before the call, so that nothing has to be kept through it.
        self.level.set(level);
        self.line.write(level).map_err(|stop| self.failed(stop))
    }

    #[cold]
    #[inline(never)]
    fn failed(&self, stop: Shutdown) -> Shutdown {
        self.level.forget();
        stop
    }

    /// Inverts the line.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn toggle(&mut self) -> Result<(), Shutdown> {
        self.write(!self.level.is_high())
    }

    /// Returns when the last write has reached the line ([`Line::flush`]).
    #[inline]
    pub fn flush(&self) {
        self.line.flush();
    }

    /// Whether the line is written without a call of the kernel.
    pub fn is_fast(&self) -> bool {
        self.line.is_fast()
    }

    /// Inverts the line with a batch of edges, if the batch takes it.
    pub fn join(&mut self, batch: &mut Batch) -> bool {
        let level = !self.level.is_high();
        self.is_batched = self.line.bank().is_some_and(|(bank, line)| batch.add(bank, line, level));
        if self.is_batched {
            self.level.set(level);
        }
        self.is_batched
    }

    /// Whether a batch has inverted the line since the last call.
    #[inline]
    pub fn was_batched(&mut self) -> bool {
        mem::take(&mut self.is_batched)
    }
}

impl State {
    /// Lets the worker of a chip write an output.
    fn write_output(&mut self, place: usize, level: bool) -> Result<(), Shutdown> {
        self.with_writer(place, |writer, context| writer.set(context, level)).unwrap_or(Ok(()))
    }

    /// A worker has written an output.
    pub(super) fn output_written(&mut self, place: usize, finished: Finished) -> Result<(), Shutdown> {
        match self.with_writer(place, |writer, context| writer.back(context, finished)).flatten() {
            Some(Ok(true)) => self.is_safe(Subject::Output(place)),
            Some(Err(failure)) => return self.device_failed(Subject::Output(place), failure),
            _ => {}
        }
        Ok(())
    }

    /// Drives an output to its shutdown value, unless it keeps its level.
    pub(super) fn make_output_safe(&mut self, place: usize) {
        let Some(claim) = self.lines.get(place) else { return };
        let Some(value) = claim.value_at_stop().map(ShutdownValue::get) else { return };
        let safe = match claim.slow() {
            None => claim.write(value).map(|()| Safe::Now),
            Some(_) => self.write_output(place, value).map(|()| Safe::Later),
        };
        self.note_safety(Subject::Output(place), true, safe);
    }
}
