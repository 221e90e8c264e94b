// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines: the table of claims, and the outputs and inputs that objects use.
//!
//! Several objects may use one line, as in the firmware, which sets the line up again. Examples:
//!
//! - `[duplicate_pin_override]` in printer.cfg
//! - a line that `set_digital_out` drove before an object claimed it
//! - chips that share a clock line
//!
//! The last setup decides if the line is an output or an input.

#![forbid(unsafe_code)]

use std::mem;
use std::sync::Arc;

use crate::board::{Bias, Board, ClaimedLine, CountedLine, Direction, Edges, Line, OnWorker, Pin};
use crate::shutdown::{Shutdown, reason};
use crate::time::Clock;

use super::snapshot::Level;
use super::{
    Back, Batch, Calls, Context, Done, Errand, LineState, Remote, Safe, Settable, Slot, State, UNREAD_LIMIT, Unread,
    WorkerId,
};

/// The GPIO lines in use.
#[derive(Default)]
pub(super) struct Outputs {
    claims: Vec<Claim>,
}

impl Outputs {
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

    fn find(&self, pin: Pin) -> Option<usize> {
        self.claims.iter().position(|claim| claim.pin == pin)
    }
}

/// A line in use.
struct Claim {
    /// The board's own number for it.
    pin: Pin,
    line: Arc<dyn Line>,
    /// The worker of its chip and the worker's calls, if calls to that chip may be slow.
    slow: Option<(WorkerId, Calls)>,
    /// Its last setup.
    direction: Direction,
    /// Its level, for the MCU's status.
    shown: Arc<Level>,
}

impl Claim {
    fn state(&self) -> LineState {
        let bus = self.slow.as_ref().map(|(_, calls)| calls.counts());
        let fast = self.line.is_fast();
        LineState { pin: self.pin, use_: self.direction.into(), level: self.shown.get(), fast, bus }
    }

    /// The line for a user that calls it directly, for example an errand.
    fn shared(&self) -> Arc<dyn Line> {
        let watched = Arc::new(Watched { line: self.line.clone(), shown: self.shown.clone() });
        match &self.slow {
            None => watched,
            Some((_, calls)) => Arc::new(Repeated { line: watched, calls: calls.clone() }),
        }
    }
}

/// A line that records its level for the status when an errand drives or reads it. Errands measure the time between
/// edges, so a write returns when it has reached the line.
struct Watched {
    line: Arc<dyn Line>,
    shown: Arc<Level>,
}

impl Line for Watched {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.shown.set(level);
        self.line.write(level)?;
        self.line.flush();
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.line.read().inspect(|level| self.shown.set(*level))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.shown.begin(direction);
        self.line.set_direction(direction)
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.shown.begin(direction);
        self.line.turn(direction)
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
struct Repeated {
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

/// An output that the core itself drives. A call takes one or two microseconds.
pub struct PromptLine {
    line: Arc<dyn Line>,
    level: bool,
    shown: Arc<Level>,
    /// A batch has made an edge that its user has not seen yet.
    is_batched: bool,
}

impl PromptLine {
    /// Drives the line.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn write(&mut self, level: bool) -> Result<(), Shutdown> {
        self.level = level;
        self.shown.set(level);
        self.line.write(level)
    }

    /// Inverts the line.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn toggle(&mut self) -> Result<(), Shutdown> {
        self.write(!self.level)
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
        let level = !self.level;
        self.is_batched = self.line.bank().is_some_and(|(bank, line)| batch.add(bank, line, level));
        if self.is_batched {
            self.level = level;
            self.shown.set(level);
        }
        self.is_batched
    }

    /// Whether a batch has inverted the line since the last call.
    #[inline]
    pub fn was_batched(&mut self) -> bool {
        mem::take(&mut self.is_batched)
    }
}

impl Settable for Repeated {
    type Value = bool;

    fn set(&mut self, level: bool) -> Result<(), Shutdown> {
        self.write(level)
    }
}

/// An output line of any chip.
pub struct OutputLine {
    level: bool,
    driver: Driver,
    shown: Arc<Level>,
}

enum Driver {
    Prompt(Arc<dyn Line>),
    Slow(Remote<Repeated>),
}

impl OutputLine {
    /// Drives the line, directly or through its chip's worker.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn write(&mut self, context: &mut Context, level: bool) -> Result<(), Shutdown> {
        self.level = level;
        self.shown.set(level);
        match &mut self.driver {
            Driver::Prompt(line) => line.write(level),
            Driver::Slow(line) => line.set(context, level),
        }
    }

    /// Inverts the line.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    #[inline]
    pub fn toggle(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        self.write(context, !self.level)
    }

    /// Drives the line of a stopped MCU to `level`, its shutdown value.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    pub fn make_safe(&mut self, context: &mut Context, level: bool) -> Result<Safe, Shutdown> {
        self.write(context, level)?;
        Ok(match self.driver {
            Driver::Prompt(_) => Safe::Now,
            Driver::Slow(_) => Safe::Later,
        })
    }

    /// Handles the worker's finished write, if it was to this line ([`Remote::settle`]).
    ///
    /// # Errors
    ///
    /// "GPIO line write failed", unless the MCU is stopped.
    pub fn settle(&mut self, context: &mut Context, kind: &str, done: &mut Done) -> Result<(), Shutdown> {
        match &mut self.driver {
            Driver::Prompt(_) => Ok(()),
            Driver::Slow(line) => line.settle(context, kind, done),
        }
    }
}

/// Reads an input of a chip that may sleep.
struct Sampling(Repeated);

impl Errand for Sampling {
    type Answer = bool;
    type Failure = Shutdown;

    fn run(&mut self) -> Result<bool, Shutdown> {
        self.0.read()
    }
}

/// The result of a worker's look at an input.
pub struct Look {
    /// `None` if the look failed.
    pub level: Option<bool>,
    /// When the worker began to look.
    pub began: Clock,
    /// When the worker finished.
    pub ended: Clock,
}

/// An input line of any chip.
pub struct InputLine {
    pin: Pin,
    sensor: Sensor,
    shown: Arc<Level>,
}

enum Sensor {
    Prompt(Arc<dyn Line>),
    Slow { worker: WorkerId, look: Slot<Sampling>, unread: Unread },
}

impl InputLine {
    fn new(claim: &Claim) -> InputLine {
        let (line, shown) = (claim.line.clone(), claim.shown.clone());
        let sensor = match &claim.slow {
            None => Sensor::Prompt(line),
            Some((worker, calls)) => {
                let look = Slot::new(Sampling(Repeated { line, calls: calls.clone() }));
                Sensor::Slow { worker: *worker, look, unread: Unread::default() }
            }
        };
        InputLine { pin: claim.pin, sensor, shown }
    }

    /// The line's level. `None` if the chip's worker has to look: the level then comes later, to the object's
    /// `returned`.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    #[inline]
    pub fn read(&mut self, context: &mut Context) -> Result<Option<bool>, Shutdown> {
        if let Sensor::Slow { worker, look, unread } = &mut self.sensor
            && look.is_here()
        {
            unread.asked(context.now());
            look.send(context, *worker)?;
        }
        self.prompt_level()
    }

    /// The line's level; `None` if the chip's worker would have to look.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    #[inline]
    pub fn prompt_level(&self) -> Result<Option<bool>, Shutdown> {
        match &self.sensor {
            Sensor::Prompt(line) => line.read().inspect(|level| self.shown.set(*level)).map(Some),
            Sensor::Slow { .. } => Ok(None),
        }
    }

    /// Whether the chip's worker is looking at the line.
    pub fn is_looking(&self) -> bool {
        matches!(&self.sensor, Sensor::Slow { look, .. } if !look.is_here())
    }

    /// Handles a finished look, if it was at this line. It fails with "GPIO line read failed" when no look has
    /// succeeded for [`UNREAD_LIMIT`].
    pub fn sampled(&mut self, context: &Context, done: &mut Done) -> Option<Result<Look, Shutdown>> {
        self.take_in(context, done, false)
    }

    /// The same, if a move depends on the input. One failed look is a failure at once.
    pub fn seen(&mut self, context: &Context, done: &mut Done) -> Option<Result<Look, Shutdown>> {
        self.take_in(context, done, true)
    }

    fn take_in(&mut self, context: &Context, done: &mut Done, at_once: bool) -> Option<Result<Look, Shutdown>> {
        let Sensor::Slow { look, unread, .. } = &mut self.sensor else { return None };
        let Back { result, began, ended, .. } = look.back(done)?;
        let level = match result {
            Ok(level) => {
                unread.read();
                self.shown.set(level);
                Ok(Some(level))
            }
            Err(failure) if at_once || unread.is_too_long(ended) => {
                context.try_shut_down(failure.clone()).map(|()| None)
            }
            Err(_) => Ok(None),
        };
        Some(level.map(|level| Look { level, began, ended }))
    }

    /// Checks a look that may still be on its way. Call this while one may be.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed" when no look has succeeded for [`UNREAD_LIMIT`].
    pub fn awaited(&self, context: &mut Context) -> Result<(), Shutdown> {
        let Sensor::Slow { look, unread, .. } = &self.sensor else { return Ok(()) };
        if look.is_here() || !unread.is_too_long(context.now()) {
            return Ok(());
        }
        let (name, ms) = (context.name(self.pin), UNREAD_LIMIT.as_ms());
        let stop = Shutdown::because(reason::LINE_READ, format!("{name} has not answered for {ms} ms"));
        context.try_shut_down(
            stop.remedy("check its power and wiring, look at the kernel's log (dmesg), then FIRMWARE_RESTART"),
        )
    }
}

/// The counter of a line's edges and the worker that reads it, or the reason why there is none.
pub type CountedEdges = Result<(WorkerId, Box<dyn Edges>), Box<str>>;

impl State {
    /// Claims a line for one more use.
    fn claim(&mut self, pin: Pin, direction: Direction) -> Result<&Claim, Shutdown> {
        let pin = self.board.canonical(pin);
        if let Some(place) = self.outputs.find(pin) {
            let claim = &mut self.outputs.claims[place];
            claim.line.set_direction(direction)?;
            claim.direction = direction;
            claim.shown.begin(direction);
            return Ok(claim);
        }
        let claimed = self.board.line(pin, direction)?;
        self.enter(pin, claimed, direction)
    }

    /// Adds a line from the board to the table.
    fn enter(&mut self, pin: Pin, claimed: ClaimedLine, direction: Direction) -> Result<&Claim, Shutdown> {
        let ClaimedLine { line, sleeps_on } = claimed;
        let worker = sleeps_on.map(|chip| self.workers.start(&chip)).transpose()?;
        let slow = worker.map(|worker| (worker, Calls::new(self.scheduler.clock())));
        let shown = Arc::new(Level::of(direction));
        let claims = &mut self.outputs.claims;
        claims.push(Claim { pin, line, slow, direction, shown });
        Ok(&claims[claims.len() - 1])
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
        self.state.claim(pin, direction)
    }

    /// Claims an output and drives it to `level`. It goes to `shutdown_value` when the MCU stops.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open out GPIO chip line".
    pub fn output(&mut self, pin: Pin, level: bool, shutdown_value: bool) -> Result<OutputLine, Shutdown> {
        let claim = self.claim(pin, Direction::Output { level, shutdown_value })?;
        let (line, shown) = (claim.line.clone(), claim.shown.clone());
        let driver = match &claim.slow {
            None => Driver::Prompt(line),
            Some((worker, calls)) => Driver::Slow(Remote::new(*worker, Repeated { line, calls: calls.clone() }, level)),
        };
        Ok(OutputLine { level, driver, shown })
    }

    /// Claims an output with exact edges, for example `step`. It refuses a chip that may sleep.
    ///
    /// # Errors
    ///
    /// The board's errors, and "Unable to open out GPIO chip line" for a chip that may sleep.
    pub fn prompt_output(
        &mut self,
        pin: Pin,
        use_: &str,
        level: bool,
        shutdown_value: bool,
    ) -> Result<PromptLine, Shutdown> {
        let claim = self.prompt_claim(pin, use_, Direction::Output { level, shutdown_value })?;
        Ok(PromptLine { line: claim.line.clone(), level, shown: claim.shown.clone(), is_batched: false })
    }

    /// Claims a line with exact edges, for an errand that drives or reads it. It refuses a chip that may sleep.
    ///
    /// # Errors
    ///
    /// The board's errors. For a chip that may sleep it is "Unable to open out GPIO chip line", or for an input "Unable
    /// to open in GPIO chip line".
    pub fn prompt_line(&mut self, pin: Pin, use_: &str, direction: Direction) -> Result<Arc<dyn Line>, Shutdown> {
        self.prompt_claim(pin, use_, direction).map(Claim::shared)
    }

    fn prompt_claim(&mut self, pin: Pin, use_: &str, direction: Direction) -> Result<&Claim, Shutdown> {
        if self.claim(pin, direction)?.slow.is_some() {
            let name = self.name(pin);
            let refused = match direction {
                Direction::Input(_) => reason::INPUT_LINE,
                _ => reason::OUTPUT_LINE,
            };
            let cause = format!(
                "{name} cannot be a {use_} pin: its chip is behind a bus (I2C, SPI, USB) or a firmware call, so an edge would be late by milliseconds"
            );
            return Err(Shutdown::because(refused, cause).remedy("choose a pin of the processor itself"));
        }
        let State { board, outputs, .. } = &self.state;
        let place = outputs.find(board.canonical(pin));
        place
            .map(|place| &outputs.claims[place])
            .ok_or_else(|| Shutdown::because(reason::OUTPUT_LINE, "a line that was claimed is in no table"))
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
        self.claim(pin, Direction::Input(bias)).map(InputLine::new)
    }

    /// Claims an input, with edges counted by an interrupt if possible.
    ///
    /// # Errors
    ///
    /// The board's errors, for example "Unable to open in GPIO chip line".
    pub fn counted_input(&mut self, pin: Pin, bias: Bias) -> Result<(InputLine, CountedEdges), Shutdown> {
        let own = self.board()?.canonical(pin);
        if self.state.outputs.find(own).is_some() {
            return Ok((self.input(pin, bias)?, Err("the pin has another use, too, from before".into())));
        }
        let CountedLine { line, edges } = self.state.board.counted_line(own, bias)?;
        let input = InputLine::new(self.state.enter(own, line, Direction::Input(bias))?);
        let edges = match edges {
            Ok(OnWorker { bus, device }) => Ok((self.state.workers.start(&bus)?, device)),
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
    pub fn late_input(&mut self, pin: Pin, bias: Bias) -> Result<InputLine, Shutdown> {
        self.state.claim(pin, Direction::Input(bias)).map(InputLine::new)
    }

    /// The pin's name in the dictionary.
    pub fn name(&self, pin: Pin) -> String {
        pin.name_in(&self.state.board.pins())
    }
}
