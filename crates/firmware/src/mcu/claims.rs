// SPDX-License-Identifier: GPL-3.0-or-later
//! The table of claims: the GPIO lines in use, and the outputs among them.
//!
//! Several objects may use one line, as in Klipper's C, which sets the line up again. Examples:
//!
//! - `[duplicate_pin_override]` in printer.cfg
//! - a line that `set_digital_out` drove before an object claimed it
//! - chips that share a clock line
//!
//! The last setup decides if the line is an output or an input.

use std::sync::Arc;

use crate::board::{ClaimedLine, Direction, Line, OnWorker, Pin, Pwm, PwmConfig, ShutdownValue};
use crate::shutdown::Shutdown;
use crate::time::Ticks;

use super::level::{JobLine, Level, Recorded};
use super::stop::Subject;
use super::{Calls, Context, DeviceId, LineState, Oid, Remote, State};

/// The GPIO lines in use.
#[derive(Default)]
pub(super) struct Lines {
    claims: Vec<Claim>,
}

impl Lines {
    pub(super) fn len(&self) -> usize {
        self.claims.len()
    }

    /// The state of the line at this place, for the MCU's status.
    pub(super) fn state(&self, place: usize) -> LineState {
        self.claims[place].state()
    }

    /// Whether a line is in a bank.
    pub(super) fn has_banks(&self) -> bool {
        self.claims.iter().any(|claim| claim.line.bank().is_some())
    }

    pub(super) fn get(&self, place: usize) -> Option<&Claim> {
        self.claims.get(place)
    }

    fn output_mut(&mut self, place: usize) -> Option<&mut Output> {
        self.claims.get_mut(place)?.output.as_mut()
    }

    pub(super) fn find(&self, pin: Pin) -> Option<usize> {
        self.claims.iter().position(|claim| claim.pin == pin)
    }
}

/// A line in use.
pub(super) struct Claim {
    /// The board's own number for it.
    pin: Pin,
    line: Arc<dyn Line>,
    /// The line in the worker of its chip and the worker's calls, if calls to that chip may be slow.
    slow: Option<(DeviceId<JobLine>, Calls)>,
    /// Its last setup, with the shutdown value of an output.
    direction: Direction,
    level: Arc<Level>,
    /// Set while a feature drives it as an output.
    output: Option<Output>,
}

impl Claim {
    fn state(&self) -> LineState {
        let bus = self.slow.as_ref().map(|(_, calls)| calls.counts());
        let fast = self.line.is_fast();
        LineState { pin: self.pin, use_: self.direction.into(), level: self.level.get(), fast, bus }
    }

    pub(super) fn pin(&self) -> Pin {
        self.pin
    }

    pub(super) fn line(&self) -> Arc<dyn Line> {
        self.line.clone()
    }

    pub(super) fn level(&self) -> Arc<Level> {
        self.level.clone()
    }

    /// The level to which a stop of the MCU drives the line. `None` if a stop leaves it.
    pub(super) fn value_at_stop(&self) -> Option<ShutdownValue<bool>> {
        self.shutdown_value().filter(|_| self.output.as_ref().is_some_and(Output::is_driven_at_stop))
    }

    /// The level of an output in a stopped MCU.
    pub(super) fn shutdown_value(&self) -> Option<ShutdownValue<bool>> {
        self.direction.shutdown_value()
    }

    /// Drives the line from the core.
    pub(super) fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.line.write(level)?;
        self.level.set(level);
        Ok(())
    }

    /// The line in the worker of its chip, if calls to that chip may be slow.
    pub(super) fn slow(&self) -> Option<DeviceId<JobLine>> {
        self.slow.as_ref().map(|(line, _)| *line)
    }

    /// Removes its output, so that no stop drives it.
    pub(super) fn drop_output(&mut self) {
        self.output = None;
    }

    /// The line for a user that calls it directly, for example a job.
    pub(super) fn shared(&self) -> Arc<dyn Line> {
        let calls = self.slow.as_ref().map(|(_, calls)| calls.clone());
        Arc::new(JobLine { line: self.line.clone(), level: self.level.clone(), calls })
    }
}

/// An output of an object.
pub(super) struct Output {
    /// The object. It names the output in the log.
    owner: Oid,
    /// Whether a stop of the MCU leaves its level.
    is_kept: bool,
    /// Writes the line, if its chip may be slow. `None` also while it runs.
    writer: Option<Remote<JobLine>>,
}

impl Output {
    fn of(owner: Oid, is_kept: bool) -> Output {
        Output { owner, is_kept, writer: None }
    }

    /// Whether a stop of the MCU drives it to its shutdown value.
    fn is_driven_at_stop(&self) -> bool {
        !self.is_kept
    }

    /// The same line's output from now on. A write of the earlier one may be on its way.
    fn taking_over(self, earlier: Option<Output>) -> Output {
        Output { writer: self.writer.or(earlier.and_then(|earlier| earlier.writer)), ..self }
    }

    /// Lets a worker write the line, which is at `level`.
    fn give_writer(&mut self, place: usize, line: DeviceId<JobLine>, level: bool) {
        self.writer.get_or_insert_with(|| Remote::of_output(place, line, level));
    }
}

impl State {
    /// Claims a line for one more use, and returns its place. `output`: a feature drives it.
    fn claim(
        &mut self,
        pin: Pin,
        direction: Direction,
        output: Option<Output>,
    ) -> Result<(usize, &mut Claim), Shutdown> {
        let pin = self.board.canonical(pin);
        let Some(place) = self.lines.find(pin) else {
            let ClaimedLine { line, sleeps_on } = self.board.line(pin, direction)?;
            let line = match &self.recorder {
                None => line,
                Some(recorder) => {
                    recorder.claimed(pin, pin.name_in(&self.board.pins()));
                    Arc::new(Recorded::new(line, pin, direction, recorder.clone()))
                }
            };
            return self.enter(pin, ClaimedLine { line, sleeps_on }, direction, output);
        };
        let claim = &mut self.lines.claims[place];
        // An output of an object keeps its shutdown value when something else drives the same line.
        let kept = claim.value_at_stop().filter(|_| !output.as_ref().is_some_and(Output::is_driven_at_stop));
        let direction = match (direction, kept) {
            (Direction::Output { level, .. }, Some(shutdown_value)) => Direction::Output { level, shutdown_value },
            (direction, _) => direction,
        };
        claim.line.set_direction(direction)?;
        claim.direction = direction;
        claim.level.begin(direction);
        if kept.is_none() || claim.shutdown_value().is_none() {
            claim.output = output.map(|output| output.taking_over(claim.output.take()));
        }
        if claim.value_at_stop().is_none() {
            self.drop_pending(Subject::Output(place));
        }
        Ok((place, &mut self.lines.claims[place]))
    }

    /// Adds a line from the board to the table.
    pub(super) fn enter(
        &mut self,
        pin: Pin,
        claimed: ClaimedLine,
        direction: Direction,
        output: Option<Output>,
    ) -> Result<(usize, &mut Claim), Shutdown> {
        let ClaimedLine { line, sleeps_on } = claimed;
        let level = Arc::new(Level::unknown());
        let slow = match sleeps_on {
            None => None,
            Some(chip) => {
                let calls = Calls::new(self.scheduler.clock());
                let own = JobLine { line: line.clone(), level: level.clone(), calls: Some(calls.clone()) };
                Some((self.device(&chip, Box::new(own))?, calls))
            }
        };
        level.begin(direction);
        self.lines.claims.push(Claim { pin, line, slow, direction, level, output });
        let place = self.lines.claims.len() - 1;
        Ok((place, &mut self.lines.claims[place]))
    }

    /// Calls `f` with the writer of an output, for the output's object. `None` without a writer.
    pub(super) fn with_writer<R>(
        &mut self,
        place: usize,
        f: impl FnOnce(&mut Remote<JobLine>, &mut Context) -> R,
    ) -> Option<R> {
        let output = self.lines.output_mut(place)?;
        let (owner, mut writer) = (output.owner, output.writer.take()?);
        let result = f(&mut writer, &mut Context::new(self, owner));
        if let Some(output) = self.lines.output_mut(place) {
            output.writer = Some(writer);
        }
        Some(result)
    }

    /// The object that an output belongs to.
    pub(super) fn owner(&self, place: usize) -> Oid {
        self.lines.get(place).and_then(|claim| claim.output.as_ref()).map_or(Oid::NONE, |output| output.owner)
    }
}

impl Context<'_> {
    /// Claims a line for one more use. It fails after `finalize_config`.
    pub(super) fn claim(&mut self, pin: Pin, direction: Direction) -> Result<&Claim, Shutdown> {
        self.board()?;
        self.claim_late(pin, direction)
    }

    /// Claims a line also after `finalize_config`.
    pub(super) fn claim_late(&mut self, pin: Pin, direction: Direction) -> Result<&Claim, Shutdown> {
        self.state.claim(pin, direction, None).map(|(_, claim)| &*claim)
    }

    /// Claims a line as this object's output, and returns its place.
    pub(super) fn claim_output(
        &mut self,
        pin: Pin,
        level: bool,
        shutdown_value: bool,
        is_kept: bool,
    ) -> Result<(usize, &mut Claim), Shutdown> {
        self.board()?;
        let output = Output::of(self.oid(), is_kept);
        let direction = Direction::Output { level, shutdown_value: ShutdownValue::new(shutdown_value) };
        let (place, claim) = self.state.claim(pin, direction, Some(output))?;
        let slow = claim.slow();
        if let (Some(output), Some(line)) = (&mut claim.output, slow) {
            output.give_writer(place, line, claim.level.is_high());
        }
        Ok((place, claim))
    }

    /// Claims a hardware PWM output, and returns its shutdown value for the object that writes it at a stop. As in
    /// Klipper's C, several objects may have one channel.
    ///
    /// # Errors
    ///
    /// "Unable to config pwm device", "PWM write failed", "Guardian process lost".
    pub fn pwm(
        &mut self,
        pin: Pin,
        cycle: Ticks,
        value: u16,
        shutdown_value: u16,
    ) -> Result<(OnWorker<dyn Pwm>, ShutdownValue<u16>), Shutdown> {
        let shutdown_value = ShutdownValue::new(shutdown_value);
        let channel = self.board()?.pwm(PwmConfig { pin, cycle, value, shutdown_value })?;
        Ok((channel, shutdown_value))
    }

    /// The shutdown value of an output that the guardian cannot set: only its object writes it.
    pub fn unguarded(&self, shutdown_value: u16) -> ShutdownValue<u16> {
        ShutdownValue::new(shutdown_value)
    }
}
