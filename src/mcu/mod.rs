// SPDX-License-Identifier: GPL-3.0-or-later
//! The machine: oids, timers, move queue, shutdown.
//!
//! It does no I/O of its own: it reads the time from the clock that it is given, calls the
//! board's traits and leaves responses in an outbox. So all of it runs in virtual time too.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Board, Pin};
use crate::lateness::Lateness;
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, Ticks, TimeSource};
use crate::wire::vlq::{Reader, Writer};

pub mod base;
mod command;
mod device;
mod dialect;
mod moves;
mod object;
mod outbox;
mod output;
mod parameters;
mod stats;
mod timers;

pub use command::{Command, Constant, Feature, Handler, Response};
pub(crate) use command::{command, response};
pub use device::{Completion, DeviceId, Job, Ticket, Workers};
pub use dialect::Dialect;
pub use moves::{MOVE_COUNT, MovePool, MoveQueue};
pub use object::{Next, Object};
pub use outbox::{Note, Outbox};
pub use output::Line;
pub use parameters::{Oid, WireClock};
pub use timers::TimerId;

use device::Place;
use stats::Stats;
use timers::Timers;

/// The machine's own responses come first in the list of all.
const fn response_index(format: &str) -> usize {
    base::response_index(format)
}

/// How far a timer may fall behind before the machine stops: 100 ms, as in the firmware.
const LATE_LIMIT: Ticks = Ticks::from_us(100_000);
/// Timers that may run before commands get a turn.
const REPEAT_COUNT: u32 = 100;
/// Between two `stats` responses.
const STATS_TICKS: Ticks = Ticks::from_us(5_000_000);
/// Two timers for each of 256 objects and one for the machine.
const TIMERS_MAX: usize = 2 * 256 + 1;

/// The machine.
pub struct Mcu {
    /// The boards' lines and devices.
    pub board: Box<dyn Board>,
    /// The moves that are free.
    pub moves: MovePool,
    clock: Arc<dyn TimeSource>,
    workers: Box<dyn Workers>,
    outbox: Box<dyn Outbox>,
    dialect: Arc<Dialect>,
    objects: Vec<Option<Box<dyn Object>>>,
    /// The objects that the log knows by a pin.
    pins: Vec<(Oid, Pin)>,
    oids_allocated: bool,
    timers: Timers,
    /// The instant of the timer whose event runs: in the firmware it is still the queue's
    /// first, which decides whether an added timer is too close.
    running: Option<Clock>,
    last_read: Clock,
    devices: Vec<Place>,
    completions: Vec<Completion>,
    /// Lines set by `set_digital_out`, which no object owns, and their shutdown values.
    set_lines: Vec<(Pin, bool, Line)>,
    /// Hardware PWM channels in use, and whose they are.
    channels: Vec<(Pin, Oid, DeviceId)>,
    config_crc: u32,
    halted: Option<Reason>,
    halting: bool,
    stats: Stats,
    lateness: Lateness,
}

impl Mcu {
    /// A machine that waits for its configuration; it says `starting`.
    pub fn new(
        dialect: Arc<Dialect>,
        board: Box<dyn Board>,
        clock: Arc<dyn TimeSource>,
        workers: Box<dyn Workers>,
        outbox: Box<dyn Outbox>,
    ) -> Mcu {
        let now = clock.now();
        let mut timers = Timers::with_capacity(TIMERS_MAX);
        timers.insert(now + STATS_TICKS, TimerId::STATS);
        let mut mcu = Mcu {
            board,
            moves: MovePool::default(),
            clock,
            workers,
            outbox,
            dialect,
            objects: Vec::new(),
            pins: Vec::new(),
            oids_allocated: false,
            timers,
            running: None,
            last_read: now,
            devices: Vec::new(),
            completions: Vec::new(),
            set_lines: Vec::new(),
            channels: Vec::new(),
            config_crc: 0,
            halted: None,
            halting: false,
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
        self.last_read = self.clock.now();
        self.last_read
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
        let first = self.running.or(self.timers.next());
        self.timers.insert(at, timer);
        if first.is_none_or(|first| at < first) && self.halted.is_none() {
            let late = self.now().since(at);
            if late > 0 {
                return Err(Shutdown::because(
                    Reason::TimerTooClose,
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

    /// Runs the timers that are due, some at most, so that commands get their turn. Returns
    /// the next one's instant, which may have passed.
    pub fn run_timers(&mut self) -> Option<Clock> {
        for _ in 0..REPEAT_COUNT {
            let at = self.timers.next()?;
            if at > self.last_read && at > self.now() {
                return Some(at);
            }
            self.run_timer();
        }
        let at = self.timers.next()?;
        let late = self.now().since(at);
        if late > i64::from(LATE_LIMIT.0) && self.halted.is_none() {
            self.shut_down(Shutdown::because(
                Reason::TimerPast,
                format!(
                    "events are {} ms late: more steps are asked for than this machine can do, or something kept it from running",
                    late as u64 / u64::from(Ticks::from_us(1000).0)
                ),
            ));
        }
        self.timers.next()
    }

    #[inline]
    fn run_timer(&mut self) {
        let Some((at, timer)) = self.timers.pop() else { return };
        self.lateness.record(self.last_read.since(at));
        self.running = Some(at);
        let result = match timer.oid() {
            Some(oid) => match self.objects.get_mut(usize::from(oid.0)).and_then(Option::take) {
                Some(mut object) => {
                    let result = object.event(self, timer, at).map_err(|stop| self.blame(stop, object.kind(), oid));
                    self.put_back(oid, object);
                    result
                }
                None => Ok(Next::Done),
            },
            None => Ok(self.send_stats(at)),
        };
        self.running = None;
        match result {
            Ok(Next::At(at)) => self.timers.insert(at, timer),
            Ok(Next::Done) => {}
            Err(shutdown) => self.shut_down(shutdown),
        }
        self.run_completions();
    }

    // ---- commands and responses

    /// Runs one command off the front of a block's payload. If it stops the machine, the rest
    /// of the block is dropped, as in the firmware.
    #[inline]
    pub fn execute(&mut self, payload: &mut Reader<'_>) {
        let command = *payload;
        if let Err(mut shutdown) = self.try_execute(payload) {
            if shutdown.reason == Reason::CommandParser {
                shutdown = self.cut_short(command);
            }
            *payload = Reader::new(&[]);
            self.shut_down(shutdown);
        }
        self.run_completions();
    }

    /// Whether a block stops the machine: the host asks for that in it, or it makes no sense.
    #[cold]
    pub fn is_stopped_by(&self, payload: &[u8]) -> bool {
        let mut payload = Reader::new(payload);
        while !payload.is_empty() {
            match payload.int().ok().and_then(|id| self.dialect.command(id).ok()) {
                Some(command) if command.format != base::EMERGENCY_STOP.format => {
                    if command.skip(&mut payload).is_err() {
                        return true;
                    }
                }
                _ => return true,
            }
        }
        false
    }

    /// Says which command ends before its parameters do.
    #[cold]
    fn cut_short(&self, mut command: Reader<'_>) -> Shutdown {
        let id = command.int().ok();
        let format = id.and_then(|id| self.dialect.command(id).ok()).map_or("a command's id", |entry| entry.format);
        Shutdown::because(
            Reason::CommandParser,
            format!(
                "a message ends in the middle of \"{format}\": restart the host so that it reads the dictionary anew"
            ),
        )
    }

    #[inline]
    fn try_execute(&mut self, payload: &mut Reader<'_>) -> Result<(), Shutdown> {
        let id = payload.int()?;
        let command = self.dialect.command(id)?;
        match self.halted {
            Some(reason) if !command.in_shutdown => {
                command.skip(payload)?;
                self.send(base::IsShutdown { static_string_id: reason as u16 });
                Ok(())
            }
            _ => (command.handler)(self, payload),
        }
    }

    /// Sends a response.
    pub fn send<R: Response>(&mut self, response: R) {
        let mut writer = Writer::default();
        writer.int(self.dialect.response_id::<R>());
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
        self.send(base::Stats { count, sum, sumsq });
        // A suspended machine owes no statistics of its sleep.
        let next = at + STATS_TICKS;
        Next::At(next.max(self.last_read))
    }

    // ---- shutdown

    /// Whether the machine is stopped.
    pub fn is_shutdown(&self) -> bool {
        self.halted.is_some()
    }

    /// Whether the machine is configured and not stopped.
    #[inline]
    pub fn is_running(&self) -> bool {
        self.is_finalized() && self.halted.is_none()
    }

    /// Stops the machine: timers off, outputs to their shutdown values, the host is told. The
    /// first reason stays.
    pub fn shut_down(&mut self, shutdown: Shutdown) {
        if self.halting {
            self.outbox.note(Note::Trouble(&shutdown));
            return;
        }
        let clock = self.now();
        let first = self.halted.is_none();
        let reason = *self.halted.get_or_insert(shutdown.reason);
        self.halting = true;
        self.timers.clear();
        for oid in 0..self.objects.len() {
            let Some(mut object) = self.objects[oid].take() else { continue };
            let done = object.shutdown(self, Oid(oid as u8));
            self.objects[oid] = Some(object);
            if let Err(trouble) = done {
                self.outbox.note(Note::Trouble(&trouble));
            }
        }
        self.halting = false;
        self.send(base::ShutdownReport { clock, static_string_id: reason as u16 });
        if first {
            self.outbox.note(Note::Shutdown(&shutdown));
        } else if shutdown.reason != reason {
            // A host that stops a stopped machine says nothing new.
            self.outbox.note(Note::Trouble(&shutdown));
        }
    }

    /// Stops the machine, if it is not stopped already (the firmware's `try_shutdown`).
    pub fn try_shut_down(&self, shutdown: Shutdown) -> Result<(), Shutdown> {
        match self.halted {
            Some(_) => Ok(()),
            None => Err(shutdown),
        }
    }

    /// A device failed: stops the machine, or says so in the log if that is stopped already. To
    /// stop it anew would ask the device anew.
    pub fn device_failed(&mut self, shutdown: Shutdown) -> Result<(), Shutdown> {
        if self.halted.is_none() {
            return Err(shutdown);
        }
        self.outbox.note(Note::Trouble(&shutdown));
        Ok(())
    }

    fn clear_shutdown(&mut self) -> Result<(), Shutdown> {
        self.halted.take().map(drop).ok_or_else(|| {
            Shutdown::by_host(Reason::NotShutdown, "clear_shutdown came while the machine was not stopped")
        })
    }

    // ---- configuration

    /// Whether the configuration is complete.
    pub fn is_finalized(&self) -> bool {
        self.moves.count != 0
    }

    fn allocate_oids(&mut self, count: u8) -> Result<(), Shutdown> {
        if self.oids_allocated {
            return Err(Shutdown::because(
                Reason::OidsAllocated,
                "allocate_oids came twice: a host before left its configuration unfinished, for a wrong pin or because it was killed: FIRMWARE_RESTART",
            ));
        }
        self.oids_allocated = true;
        self.objects.resize_with(usize::from(count), || None);
        Ok(())
    }

    fn finalize(&mut self, crc: u32) -> Result<(), Shutdown> {
        if self.is_finalized() {
            return Err(Shutdown::by_host(Reason::AlreadyFinalized, "finalize_config came twice"));
        }
        self.moves.finalize();
        self.config_crc = crc;
        // From here on the core does not allocate: a block full of requests to inline devices
        // leaves at most as many answers.
        self.completions.reserve(crate::wire::block::PAYLOAD_MAX);
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

    fn reset(&mut self) -> Result<(), Shutdown> {
        self.clear_shutdown().map_err(|_| {
            Shutdown::by_host(Reason::ConfigResetRunning, "config_reset came without an emergency_stop before it")
        })?;
        self.timers.clear();
        self.objects.clear();
        self.pins.clear();
        self.oids_allocated = false;
        self.devices.clear();
        self.workers.reset();
        self.completions.clear();
        self.set_lines.clear();
        self.channels.clear();
        self.board.reset();
        self.moves = MovePool::default();
        self.config_crc = 0;
        self.outbox.note(Note::Reset);
        Ok(())
    }
}
