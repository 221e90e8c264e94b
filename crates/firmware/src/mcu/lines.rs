// SPDX-License-Identifier: GPL-3.0-or-later
//! How features claim a GPIO line: as an output, as an input, or for a job.

use std::sync::Arc;

use crate::board::{Bias, Board, CountedLine, Direction, Edges, Line, OnWorker, Pin};
use crate::shutdown::{Shutdown, reason};

use super::claims::Claim;
use super::{Context, DeviceId, InputLine, OutputLine, PromptLine};

/// The counter of a line's edges and the worker that reads it, or the reason why there is none.
pub type CountedEdges = Result<DeviceId<dyn Edges>, Box<str>>;

impl Context<'_> {
    /// The board, to claim a resource. A claim opens files and waits for the guardian. It would delay the steps of a
    /// configured MCU.
    ///
    /// # Errors
    ///
    /// "Can't assign oid" after `finalize_config`.
    pub fn board(&mut self) -> Result<&mut dyn Board, Shutdown> {
        if self.is_finalized() {
            return Err(Shutdown::by_host(reason::CANNOT_ASSIGN_OID, "a pin or bus is claimed after finalize_config"));
        }
        Ok(&mut *self.state.board)
    }

    /// Claims an output and drives it to `level`. The MCU drives it to `shutdown_value` when it stops.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn output(&mut self, pin: Pin, level: bool, shutdown_value: bool) -> Result<OutputLine, Shutdown> {
        let (place, claim) = self.claim_output(pin, level, shutdown_value, false)?;
        Ok(OutputLine::new(place, claim))
    }

    /// Claims an output that keeps its level when the MCU stops. `level` is also its level if the program dies.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn kept_output(&mut self, pin: Pin, level: bool) -> Result<OutputLine, Shutdown> {
        let (place, claim) = self.claim_output(pin, level, level, true)?;
        Ok(OutputLine::new(place, claim))
    }

    /// Claims an output with exact edges, for example `step`. It refuses a chip that may sleep. `idle` is its level now
    /// and if the program dies. `is_kept`: a stop of the MCU leaves its level.
    ///
    /// # Errors
    ///
    /// The board's errors, and "Unable to open out GPIO chip line" for a chip that may sleep.
    pub fn prompt_output(&mut self, pin: Pin, use_: &str, idle: bool, is_kept: bool) -> Result<PromptLine, Shutdown> {
        let (_, claim) = self.claim_output(pin, idle, idle, is_kept)?;
        if claim.slow().is_some() {
            claim.drop_output();
            return Err(too_slow(&self.name(pin), use_, Direction::at_rest(idle)));
        }
        Ok(PromptLine::new(claim))
    }

    /// Claims a line with exact edges, for a job that drives or reads it. It refuses a chip that may sleep.
    ///
    /// # Errors
    ///
    /// The board's errors. For a chip that may sleep it is "Unable to open out GPIO chip line", or for an input "Unable
    /// to open in GPIO chip line".
    pub fn prompt_line(&mut self, pin: Pin, use_: &str, direction: Direction) -> Result<Arc<dyn Line>, Shutdown> {
        let claim = self.claim(pin, direction)?;
        if claim.slow().is_some() {
            return Err(too_slow(&self.name(pin), use_, direction));
        }
        Ok(claim.shared())
    }

    /// Claims an output that workers drive, for example a chip select. `level` is also its shutdown value.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn shared_output(&mut self, pin: Pin, level: bool) -> Result<Arc<dyn Line>, Shutdown> {
        self.claim(pin, Direction::at_rest(level)).map(Claim::shared)
    }

    /// Claims an input that workers read, with a pull-up if the board allows one.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open in GPIO chip line".
    pub fn shared_input(&mut self, pin: Pin) -> Result<Arc<dyn Line>, Shutdown> {
        let pulled_up = self.claim(pin, Direction::Input(Bias::PullUp)).map(Claim::shared);
        pulled_up.or_else(|_| self.claim(pin, Direction::Input(Bias::None)).map(Claim::shared))
    }

    /// Claims an open-drain wire that workers pull low, release and read.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn shared_wire(&mut self, pin: Pin) -> Result<Arc<dyn Line>, Shutdown> {
        self.claim(pin, Direction::OpenDrain).map(Claim::shared)
    }

    /// Claims an input.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open in GPIO chip line".
    pub fn input(&mut self, pin: Pin, bias: Bias) -> Result<InputLine, Shutdown> {
        self.claim(pin, Direction::Input(bias)).map(|claim| InputLine::new(0, claim))
    }

    /// Claims an input, with edges counted by an interrupt if possible.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open in GPIO chip line".
    pub fn counted_input(&mut self, pin: Pin, bias: Bias) -> Result<(InputLine, CountedEdges), Shutdown> {
        let own = self.board()?.canonical(pin);
        if self.state.lines.find(own).is_some() {
            return Ok((self.input(pin, bias)?, Err("the pin already has another use".into())));
        }
        let CountedLine { line, edges } = self.state.board.counted_line(own, bias)?;
        let (_, claim) = self.state.enter(own, line, Direction::Input(bias), None)?;
        let input = InputLine::new(0, claim);
        let edges = match edges {
            Ok(OnWorker { bus, device }) => Ok(self.device(&bus, device)?),
            Err(why) => Err(why),
        };
        Ok((input, edges))
    }

    /// Claims an input, also after `finalize_config`. This opens a file and may start a thread, which delays steps. So
    /// it is only for `buttons_add`: klippy sends it when it connects, after `finalize_config` and before any step.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open in GPIO chip line".
    pub fn late_input(&mut self, number: u8, pin: Pin, bias: Bias) -> Result<InputLine, Shutdown> {
        self.claim_late(pin, Direction::Input(bias)).map(|claim| InputLine::new(number, claim))
    }

    /// The pin's name in the dictionary.
    pub fn name(&self, pin: Pin) -> String {
        pin.name_in(&self.state.board.pins())
    }
}

#[cold]
fn too_slow(name: &str, use_: &str, direction: Direction) -> Shutdown {
    let refused = if let Direction::Input(_) = direction { reason::INPUT_LINE } else { reason::OUTPUT_LINE };
    let cause = format!(
        "{name} cannot be a {use_} pin: its chip is behind a bus (I2C, SPI, USB) or a firmware call, so an edge would be late by milliseconds"
    );
    Shutdown::because(refused, cause).remedy("choose a pin of the processor itself")
}
