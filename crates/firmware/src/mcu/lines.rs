// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines: the table of claims, and how features claim a line.
//!
//! Several objects may use one line, as in Klipper's C, which sets the line up again. Examples:
//!
//! - `[duplicate_pin_override]` in printer.cfg
//! - a line that `set_digital_out` drove before an object claimed it
//! - chips that share a clock line
//!
//! The last setup decides if the line is an output or an input.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use crate::board::{Bias, Board, ClaimedLine, CountedLine, Direction, Edges, Line, OnWorker, Pin};
use crate::shutdown::{Shutdown, reason};

use super::outputs::Output;
use super::stop::Subject;
use super::{Calls, Context, DeviceId, InputLine, LineState, OutputLine, PromptLine, Settable, State};

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

    pub(super) fn output_mut(&mut self, place: usize) -> Option<&mut Output> {
        self.claims.get_mut(place)?.output.as_mut()
    }

    fn find(&self, pin: Pin) -> Option<usize> {
        self.claims.iter().position(|claim| claim.pin == pin)
    }
}

/// A line in use.
pub(super) struct Claim {
    /// The board's own number for it.
    pin: Pin,
    line: Arc<dyn Line>,
    /// The line in the worker of its chip and the worker's calls, if calls to that chip may be slow.
    slow: Option<(DeviceId<Repeated>, Calls)>,
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

    pub(super) fn output(&self) -> Option<&Output> {
        self.output.as_ref()
    }

    /// The level to which a stop of the MCU drives the line. `None` if a stop leaves it.
    pub(super) fn value_at_stop(&self) -> Option<bool> {
        self.shutdown_value().filter(|_| self.output.as_ref().is_some_and(Output::is_driven_at_stop))
    }

    /// The level of an output in a stopped MCU.
    pub(super) fn shutdown_value(&self) -> Option<bool> {
        if let Direction::Output { shutdown_value, .. } = self.direction { Some(shutdown_value) } else { None }
    }

    /// Drives the line from the core.
    pub(super) fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.line.write(level)?;
        self.level.set(level);
        Ok(())
    }

    /// The line in the worker of its chip, if calls to that chip may be slow.
    pub(super) fn slow(&self) -> Option<DeviceId<Repeated>> {
        self.slow.as_ref().map(|(line, _)| *line)
    }

    /// The line for a user that calls it directly, for example a job.
    fn shared(&self) -> Arc<dyn Line> {
        let line = Arc::new(Watched { line: self.line.clone(), level: self.level.clone() });
        match &self.slow {
            None => line,
            Some((_, calls)) => Arc::new(Repeated { line, calls: calls.clone() }),
        }
    }
}

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
    fn unknown() -> Level {
        Level(AtomicU8::new(UNKNOWN))
    }

    /// Called when the line is set up.
    fn begin(&self, direction: Direction) {
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

    fn get(&self) -> Option<bool> {
        match self.0.load(Ordering::Relaxed) {
            UNKNOWN => None,
            level => Some(level != 0),
        }
    }
}

/// A line whose edges are recorded.
struct Recorded {
    line: Arc<dyn Line>,
    pin: Pin,
    /// The last recorded level.
    level: Level,
    recorder: Arc<dyn EdgeRecorder>,
}

impl Recorded {
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

/// A line that records its level for the status when a job drives or reads it. Jobs measure the time between
/// edges, so a write returns when it has reached the line.
struct Watched {
    line: Arc<dyn Line>,
    level: Arc<Level>,
}

impl Line for Watched {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.line.write(level)?;
        self.line.flush();
        self.level.set(level);
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.line.read().inspect(|level| self.level.set(*level))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.set_direction(direction)?;
        self.level.begin(direction);
        Ok(())
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.turn(direction)?;
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

/// A line of a chip that may sleep. Each call may be repeated.
#[derive(Clone)]
pub(super) struct Repeated {
    line: Arc<dyn Line>,
    calls: Calls,
}

impl Line for Repeated {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.calls.repeat(|| self.line.write(level))
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.calls.repeat(|| self.line.read())
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.calls.repeat(|| self.line.set_direction(direction))
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.calls.repeat(|| self.line.turn(direction))
    }
}

impl Settable for Repeated {
    type Value = bool;

    fn set(&mut self, level: bool) -> Result<(), Shutdown> {
        self.write(level)
    }
}

/// The counter of a line's edges and the worker that reads it, or the reason why there is none.
pub type CountedEdges = Result<DeviceId<dyn Edges>, Box<str>>;

impl State {
    /// Claims a line for one more use, and returns its place. `output`: a feature drives it.
    fn claim(&mut self, pin: Pin, direction: Direction, output: Option<Output>) -> Result<usize, Shutdown> {
        let pin = self.board.canonical(pin);
        let Some(place) = self.lines.find(pin) else {
            let ClaimedLine { line, sleeps_on } = self.board.line(pin, direction)?;
            let level = Arc::new(Level::unknown());
            let line = match &self.recorder {
                None => line,
                Some(recorder) => {
                    recorder.claimed(pin, pin.name_in(&self.board.pins()));
                    let recorded = Recorded { line, pin, level: Level::unknown(), recorder: recorder.clone() };
                    recorded.turned(direction);
                    Arc::new(recorded)
                }
            };
            return self.enter(pin, ClaimedLine { line, sleeps_on }, direction, level, output);
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
        Ok(place)
    }

    /// Adds a line from the board to the table.
    fn enter(
        &mut self,
        pin: Pin,
        claimed: ClaimedLine,
        direction: Direction,
        level: Arc<Level>,
        output: Option<Output>,
    ) -> Result<usize, Shutdown> {
        let ClaimedLine { line, sleeps_on } = claimed;
        let slow = match sleeps_on {
            None => None,
            Some(chip) => {
                let calls = Calls::new(self.scheduler.clock());
                let watched = Arc::new(Watched { line: line.clone(), level: level.clone() });
                let line = Box::new(Repeated { line: watched, calls: calls.clone() });
                Some((self.device(&chip, line)?, calls))
            }
        };
        level.begin(direction);
        self.lines.claims.push(Claim { pin, line, slow, direction, level, output });
        Ok(self.lines.claims.len() - 1)
    }
}

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

    /// Claims a line for one more use. It fails after `finalize_config`.
    fn claim(&mut self, pin: Pin, direction: Direction) -> Result<&Claim, Shutdown> {
        self.board()?;
        let place = self.state.claim(pin, direction, None)?;
        Ok(&self.state.lines.claims[place])
    }

    fn claim_output(&mut self, pin: Pin, direction: Direction, is_kept: bool) -> Result<usize, Shutdown> {
        self.board()?;
        let output = Output::of(self.oid(), is_kept);
        let place = self.state.claim(pin, direction, Some(output))?;
        let claim = &mut self.state.lines.claims[place];
        let slow = claim.slow();
        if let (Some(output), Some(line)) = (&mut claim.output, slow) {
            output.give_writer(place, line, claim.level.is_high());
        }
        Ok(place)
    }

    /// Claims an output and drives it to `level`. The MCU drives it to `shutdown_value` when it stops.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn output(&mut self, pin: Pin, level: bool, shutdown_value: bool) -> Result<OutputLine, Shutdown> {
        let place = self.claim_output(pin, Direction::Output { level, shutdown_value }, false)?;
        Ok(OutputLine::new(place, &self.state.lines.claims[place]))
    }

    /// Claims an output that keeps its level when the MCU stops. `level` is also its level if the program dies.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn kept_output(&mut self, pin: Pin, level: bool) -> Result<OutputLine, Shutdown> {
        let place = self.claim_output(pin, Direction::Output { level, shutdown_value: level }, true)?;
        Ok(OutputLine::new(place, &self.state.lines.claims[place]))
    }

    /// Claims an output with exact edges, for example `step`. It refuses a chip that may sleep. `idle` is its level now
    /// and if the program dies. `is_kept`: a stop of the MCU leaves its level.
    ///
    /// # Errors
    ///
    /// The board's errors, and "Unable to open out GPIO chip line" for a chip that may sleep.
    pub fn prompt_output(&mut self, pin: Pin, use_: &str, idle: bool, is_kept: bool) -> Result<PromptLine, Shutdown> {
        let direction = Direction::Output { level: idle, shutdown_value: idle };
        let place = self.claim_output(pin, direction, is_kept)?;
        let claim = &mut self.state.lines.claims[place];
        if claim.slow.is_some() {
            claim.output = None;
            return Err(too_slow(&self.name(pin), use_, direction));
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
        if claim.slow.is_some() {
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
        self.claim(pin, Direction::Output { level, shutdown_value: level }).map(Claim::shared)
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
            return Ok((self.input(pin, bias)?, Err("the pin has another use, too, from before".into())));
        }
        let CountedLine { line, edges } = self.state.board.counted_line(own, bias)?;
        let level = Arc::new(Level::unknown());
        let place = self.state.enter(own, line, Direction::Input(bias), level, None)?;
        let input = InputLine::new(0, &self.state.lines.claims[place]);
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
        let place = self.state.claim(pin, Direction::Input(bias), None)?;
        Ok(InputLine::new(number, &self.state.lines.claims[place]))
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
