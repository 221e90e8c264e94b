// SPDX-License-Identifier: GPL-3.0-or-later
//! The machine: oids, timers, move queue, shutdown.
//!
//! It does no I/O of its own: it reads the time from the clock that it is given, calls the
//! board's traits and leaves responses in an outbox. So all of it runs in virtual time too.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Board, Pin};
use crate::lateness::Lateness;
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, Ticks, TimeSource, Timing};
use pinion_protocol::vlq::{Reader, Writer};

pub mod base;
mod bus;
mod calls;
mod command;
mod dialect;
mod errand;
mod generation;
mod lines;
mod moves;
mod object;
mod outbox;
mod parameters;
mod remote;
mod snapshot;
mod stats;
mod stop;
mod timers;

pub use crate::{command, response};
pub use bus::{Bus, Conversation, Talk};
pub use calls::{Calls, UNREAD_LIMIT, Unread};
pub use command::{Command, Constant, ConstantValue, Enumeration, Feature, Form, Handler, Response, place_of_response};
pub use dialect::{Dialect, Firmware};
pub use errand::{Completion, Done, Errand, Job, Ticket, WorkerId, Workers};
pub use generation::{DialectName, Generation, Generations, only, since, until};
pub use lines::{InputLine, OutputLine, PromptLine};
pub use moves::{MOVE_COUNT, MovePool, MoveQueue};
pub use object::{Next, Object, Safe};
pub use outbox::{Note, Outbox};
pub use parameters::{Oid, WireClock};
pub use remote::{Remote, Settable};
pub use snapshot::{BusCounts, LineState, LineUse, ObjectState, Present, QueueState, Report, Snapshot};
pub use stop::RETRY_TICKS;
pub use timers::TimerId;

use lines::Claim;
use stats::Stats;
use stop::{HOLD_LIMIT, Stop};
use timers::Timers;

/// The machine's own responses come first in the list of all.
const fn response_index(format: &str) -> usize {
    place_of_response(&[base::FEATURE], format)
}

/// How far a timer may fall behind before the machine stops: 100 ms, as in the firmware.
const LATE_LIMIT: Ticks = Ticks::from_us(100_000);
/// The longest wait within a timer's event. Meanwhile nothing else runs, not even a command that stops the machine.
pub const SPIN_MAX: Ticks = Ticks::from_us(50);
/// Timers that run before it is looked whether they fall behind, and commands get a turn
/// (`TIMER_REPEAT_COUNT` of the firmware's linux/timer.c).
const REPEAT_COUNT: u32 = 20;
/// The same, where there was no command to run (`TIMER_IDLE_REPEAT_COUNT`).
const IDLE_REPEAT_COUNT: u32 = 100;
/// Between two `stats` responses.
const STATS_TICKS: Ticks = Ticks::from_us(5_000_000);
/// Objects with an oid.
const OBJECTS_MAX: usize = 256;
/// Two timers for each object and three for the machine.
const TIMERS_MAX: usize = 2 * OBJECTS_MAX + 3;

/// The machine.
pub struct Mcu {
    /// The moves that are free.
    pub moves: MovePool,
    timing: Timing,
    board: Box<dyn Board>,
    workers: Box<dyn Workers>,
    outbox: Box<dyn Outbox>,
    dialect: Arc<Dialect>,
    /// By oid, and behind those the features' own.
    objects: Vec<Option<Box<dyn Object>>>,
    /// What `allocate_oids` said; none before.
    oid_count: usize,
    /// The objects that the log knows by a pin.
    pins: Vec<(Oid, Pin)>,
    /// The GPIO lines in use.
    claims: Vec<Claim>,
    timers: Timers,
    /// Whether the last timers that ran left some that were due.
    busy: bool,
    last_read: Clock,
    /// Whether a command runs, or an errand that a command sent is taken in.
    commanded: bool,
    /// Conversations that commands wait for, and whose the last one is.
    holds: u32,
    held_by: Option<Oid>,
    /// Whether a `config_reset` waits for outputs to be at their shutdown values.
    reset_due: bool,
    config_crc: u32,
    oids_allocated: bool,
    /// The dialect of a host that came since the machine was configured.
    next_dialect: Option<Arc<Dialect>>,
    stop: Stop,
    stats: Stats,
    lateness: Lateness,
}

impl Mcu {
    /// A machine that waits for its configuration; it says `starting`.
    pub fn new(
        dialect: Arc<Dialect>,
        board: Box<dyn Board>,
        timing: Timing,
        workers: Box<dyn Workers>,
        outbox: Box<dyn Outbox>,
    ) -> Mcu {
        let now = timing.clock.now();
        let mut timers = Timers::with_capacity(TIMERS_MAX);
        timers.insert(now + STATS_TICKS, TimerId::STATS);
        let mut mcu = Mcu {
            moves: MovePool::default(),
            timing,
            board,
            workers,
            outbox,
            dialect,
            objects: Vec::new(),
            oid_count: 0,
            pins: Vec::new(),
            claims: Vec::new(),
            timers,
            busy: false,
            last_read: now,
            commanded: false,
            holds: 0,
            held_by: None,
            reset_due: false,
            config_crc: 0,
            oids_allocated: false,
            next_dialect: None,
            stop: Stop::default(),
            stats: Stats::default(),
            lateness: Lateness::default(),
        };
        mcu.send(base::Starting {});
        mcu
    }

    // ---- time

    /// The present instant.
    #[inline]
    pub fn now(&mut self) -> Clock {
        self.last_read = self.timing.clock.now();
        self.last_read
    }

    /// Spins until `end`, for [`SPIN_MAX`] at most. No other timer or command runs meanwhile, so this is for spans as
    /// short as a step's pulse.
    #[inline]
    pub fn spin_until(&mut self, end: Clock) {
        if self.last_read < end {
            let now = self.now();
            if now < end {
                self.timing.clock.spin_until(end.min(now + SPIN_MAX));
                self.now();
            }
        }
    }

    /// The clock, for what a worker paces by it.
    pub fn clock(&self) -> Arc<dyn TimeSource> {
        self.timing.clock.clone()
    }

    /// The instant that was read last: in the past, by little while timers run.
    #[inline]
    pub fn last_read(&self) -> Clock {
        self.last_read
    }

    /// The instant that the host means: the one nearest to now.
    pub fn instant(&mut self, clock: WireClock) -> Clock {
        let now = self.now();
        Clock::widen(clock.0, now)
    }

    // ---- timers

    /// Starts a timer. One that is the next of all and has passed is too close.
    pub fn schedule(&mut self, timer: TimerId, at: Clock) -> Result<(), Shutdown> {
        // In the firmware the timer that runs still is the first of the queue.
        let first = self.timing.due.get().or(self.timers.next());
        self.timers.insert(at, timer);
        if first.is_none_or(|first| at < first) && self.stop.reason.is_none() {
            let late = self.now().since(at);
            if late > 0 {
                return Err(Shutdown::because(
                    reason::TIMER_TOO_CLOSE,
                    format!(
                        "the host asked for an event {} us after its time: the host or this machine is overloaded",
                        late as u64 / u64::from(Ticks::from_us(1).0)
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Goes on with an activity of the machine's own: late is late, but no fault of the host.
    pub fn go_on(&mut self, timer: TimerId, at: Clock) {
        self.timers.insert(at, timer);
    }

    /// Stops a timer, if it runs.
    pub fn cancel(&mut self, timer: TimerId) {
        self.timers.remove(timer);
    }

    /// The next timer's instant.
    #[inline]
    pub fn next_timer(&self) -> Option<Clock> {
        self.timers.next()
    }

    /// The instant of the next timer that the core is to be awake for.
    #[inline]
    pub fn next_exact_timer(&self) -> Option<Clock> {
        self.timers.next_exact()
    }

    /// Runs the timers that are due, some at most, so that commands get their turn. True if there
    /// are more of them: then one command is to have its turn, if there is any.
    ///
    /// The firmware runs 20, looks whether they are 100 ms late, lets commands run, and if there
    /// are none runs 100 more before it looks again; so does this machine, as where it looks
    /// decides whether it stops.
    pub fn run_timers(&mut self) -> bool {
        for _ in 0..if self.busy { IDLE_REPEAT_COUNT } else { REPEAT_COUNT } {
            if self.timers.next().is_none_or(|at| at > self.last_read && at > self.now()) {
                self.busy = false;
                return false;
            }
            self.run_timer();
        }
        let late = self.timers.next().map_or(0, |at| self.now().since(at));
        if late > i64::from(LATE_LIMIT.0) && self.stop.reason.is_none() {
            self.shut_down(Shutdown::because(
                reason::TIMER_PAST,
                format!(
                    "events are {} ms late: more steps are asked for than this machine can do, or something kept it from running: run Pinion in real time (-r, as the service does), or move more slowly",
                    late as u64 / u64::from(Ticks::from_us(1000).0)
                ),
            ));
        }
        self.busy = self.timers.next().is_some_and(|at| at <= self.last_read);
        self.busy
    }

    #[inline]
    fn run_timer(&mut self) {
        let Some((at, timer)) = self.timers.pop() else { return };
        if timer.is_exact() {
            self.lateness.record(self.last_read.since(at));
        }
        self.timing.due.set(Some(at));
        let result = match timer.oid() {
            Some(oid) => match self.take(oid) {
                Some(mut object) => {
                    let result = object.event(self, timer, at).map_err(|stop| self.blame(stop, object.kind(), oid));
                    self.put_back(oid, object);
                    result
                }
                None => Ok(Next::Done),
            },
            None => Ok(self.run_own_timer(timer, at)),
        };
        self.timing.due.set(None);
        match result {
            Ok(Next::At(at)) => self.timers.insert(at, timer),
            Ok(Next::Done) => {}
            Err(shutdown) => self.shut_down(shutdown),
        }
    }

    fn run_own_timer(&mut self, timer: TimerId, at: Clock) -> Next {
        match timer {
            TimerId::RETRY => self.retry(),
            TimerId::HOLD => self.held_too_long(),
            _ => return self.send_stats(at),
        }
        Next::Done
    }

    // ---- commands and responses

    /// Runs one command off the front of a block's payload. If it stops the machine, the rest
    /// of the block is dropped, as in the firmware. None may run while the machine
    /// [is held](Mcu::is_held).
    #[inline]
    pub fn execute(&mut self, payload: &mut Reader<'_>) {
        let command = *payload;
        self.busy = false;
        self.commanded = true;
        let done = self.try_execute(payload);
        self.commanded = false;
        if let Err(mut shutdown) = done {
            if shutdown.reason == reason::COMMAND_PARSER {
                shutdown = self.cut_short(command);
            }
            *payload = Reader::new(&[]);
            self.shut_down(shutdown);
        }
    }

    /// Whether a block asks for an emergency stop.
    pub fn is_emergency(&self, payload: &[u8]) -> bool {
        self.heard().is_emergency(payload)
    }

    /// The dialect in which the host speaks that is there, which the machine may not be able to serve yet.
    pub fn heard(&self) -> &Arc<Dialect> {
        self.next_dialect.as_ref().unwrap_or(&self.dialect)
    }

    /// Says which command ends before its parameters do.
    #[cold]
    fn cut_short(&self, mut command: Reader<'_>) -> Shutdown {
        let id = command.int().ok();
        let format = id.and_then(|id| self.heard().command(id).ok()).map_or("a command's id", |entry| entry.format);
        Shutdown::because(
            reason::COMMAND_PARSER,
            format!(
                "a message ends in the middle of \"{format}\": restart the host so that it reads the dictionary anew"
            ),
        )
    }

    #[inline]
    fn try_execute(&mut self, payload: &mut Reader<'_>) -> Result<(), Shutdown> {
        let id = payload.int()?;
        let command = self.heard().command(id)?;
        let is_foreign = self.next_dialect.is_some() && !command.is_own;
        match self.stop.reason {
            // Some of another dialect's commands would run here, on objects that are not their host's.
            Some(reason) if is_foreign || !command.in_shutdown => {
                command.skip(payload)?;
                let static_string_id = self.dialect.static_string_id(reason);
                self.send(base::IsShutdown { static_string_id });
                Ok(())
            }
            None if is_foreign => Err(Shutdown::because(
                reason::INVALID_COMMAND,
                format!(
                    "the machine is configured by a host of the dialect {}, and the present one speaks {}: FIRMWARE_RESTART",
                    self.dialect.name(),
                    self.heard().name()
                ),
            )),
            _ => (command.handler)(self, payload),
        }
    }

    /// Has the machine speak another dialect, for another host: at once, or, if a host has begun to
    /// configure it, after the reset. Until then only the messages of the machine itself are exchanged, which
    /// have the same ids in every dialect: what the objects say would mean something else to the other host, or
    /// nothing, and klippy's reader ends with the first message that it can not decode. `get_config` tells no
    /// check sum that the other host could take for its own.
    /// The same dialect over a board that has changed differs in its names of pins alone.
    pub fn speak(&mut self, dialect: Arc<Dialect>) {
        self.next_dialect = None;
        if dialect.name() == self.dialect.name() || !self.oids_allocated && !self.is_finalized() {
            self.dialect = dialect;
        } else {
            self.next_dialect = Some(dialect);
        }
    }

    /// The dialect that the machine speaks.
    pub fn dialect(&self) -> &Arc<Dialect> {
        &self.dialect
    }

    /// Whether the host takes responses of type `R`.
    pub fn speaks<R: Response>(&self) -> bool {
        self.dialect.response_id::<R>().is_some()
    }

    /// Whether the machine is to behave as for hosts of these generations, where no form of a message
    /// tells them apart.
    pub fn serves(&self, hosts: Generations) -> bool {
        self.dialect.serves(hosts)
    }

    /// Sends a response, if the host takes it.
    pub fn send<R: Response>(&mut self, response: R) {
        if self.next_dialect.is_some() && !base::is_own_response(R::INDEX) {
            return;
        }
        let Some(id) = self.dialect.response_id::<R>() else { return };
        let mut writer = Writer::default();
        writer.int(id);
        response.encode(&mut writer);
        if let Some(payload) = writer.payload() {
            self.outbox.send(payload);
        }
    }

    /// Counts a span in which the core was busy.
    #[inline]
    pub fn account(&mut self, busy: Ticks) {
        self.stats.add(busy);
    }

    /// Says in the log how late timers were; `margin` is how early whoever runs them wakes.
    pub fn report_lateness(&mut self, margin: Ticks) {
        self.outbox.note(Note::Lateness(&self.lateness, margin));
    }

    fn send_stats(&mut self, at: Clock) -> Next {
        let Stats { count, sum, sumsq } = std::mem::take(&mut self.stats);
        // klippy divides by it, and a machine that stood still since the last time counted none.
        let count = count.max(1);
        self.send(base::Stats { count, sum, sumsq });
        // A suspended machine owes no statistics of its sleep.
        let next = at + STATS_TICKS;
        Next::At(next.max(self.last_read))
    }

    /// Whether the machine is configured and not stopped.
    #[inline]
    pub fn is_running(&self) -> bool {
        self.is_finalized() && self.stop.reason.is_none()
    }

    // ---- configuration

    /// Whether the configuration is complete.
    pub fn is_finalized(&self) -> bool {
        self.moves.count != 0
    }

    fn allocate_oids(&mut self, count: u8) -> Result<(), Shutdown> {
        if self.oids_allocated {
            return Err(Shutdown::because(
                reason::OIDS_ALLOCATED,
                "allocate_oids came twice: a host before left its configuration unfinished, for a wrong pin or because it was killed: FIRMWARE_RESTART",
            ));
        }
        self.oids_allocated = true;
        self.oid_count = usize::from(count);
        if self.objects.len() < self.oid_count {
            self.objects.resize_with(self.oid_count, || None);
        }
        Ok(())
    }

    fn finalize(&mut self, crc: u32) -> Result<(), Shutdown> {
        if self.is_finalized() {
            return Err(Shutdown::by_host(reason::ALREADY_FINALIZED, "finalize_config came twice"));
        }
        self.moves.finalize();
        self.config_crc = crc;
        // From here on the core does not allocate.
        self.timers.reserve(TIMERS_MAX);
        let mut kinds: Vec<(&'static str, usize)> = Vec::new();
        for object in self.objects.iter().flatten() {
            match kinds.iter_mut().find(|(kind, _)| *kind == object.kind()) {
                Some((_, count)) => *count += 1,
                None => kinds.push((object.kind(), 1)),
            }
        }
        self.outbox.note(Note::Configured(&kinds));
        Ok(())
    }

    /// Forgets the configuration, as soon as every output is at its shutdown value: afterwards
    /// nothing would try to drive it there. No command runs before.
    fn reset(&mut self) -> Result<(), Shutdown> {
        if !self.is_shutdown() {
            return Err(Shutdown::by_host(
                reason::CONFIG_RESET_RUNNING,
                "config_reset came without an emergency_stop before it",
            ));
        }
        self.reset_due = true;
        self.reset_if_due();
        Ok(())
    }

    fn reset_if_due(&mut self) {
        if !self.reset_due || self.owes() {
            return;
        }
        self.reset_due = false;
        self.stop = Stop::default();
        self.timers.clear();
        self.timers.remove(TimerId::HOLD);
        self.workers.reset();
        self.holds = 0;
        self.objects.clear();
        self.oid_count = 0;
        self.oids_allocated = false;
        self.pins.clear();
        self.claims.clear();
        self.board.reset();
        self.moves = MovePool::default();
        self.config_crc = 0;
        if let Some(dialect) = self.next_dialect.take() {
            self.dialect = dialect;
        }
        self.outbox.note(Note::Reset);
    }

    /// How late a step may be before the machine stops.
    pub fn step_late_limit(&self) -> Ticks {
        self.timing.step_late_limit
    }
}
