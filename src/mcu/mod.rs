// SPDX-License-Identifier: GPL-3.0-or-later
//! The machine: oids, timers, move queue, shutdown.
//!
//! It does no I/O of its own: it reads the time from the clock that it is given, calls the
//! board's traits and leaves responses in an outbox. So all of it runs in virtual time too.

#![forbid(unsafe_code)]

use std::any::Any;
use std::sync::Arc;

use crate::board::{Attachment, Board, Buffer, Device, Output, Pin, PwmConfig};
use crate::lateness::Lateness;
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, Ticks, TimeSource};
use crate::wire::Malformed;
use crate::wire::format::{Arg, Field};
use crate::wire::vlq::{Reader, Writer};

pub mod base;
mod command;
mod dialect;
mod moves;
mod stats;
mod timers;

pub use command::{Command, Constant, Feature, Handler, Response};
pub(crate) use command::{command, response};
pub use dialect::Dialect;
pub use moves::{MOVE_COUNT, MovePool, MoveQueue};
pub use timers::TimerId;

use stats::Stats;
use timers::Timers;

/// The machine's own responses come first in the list of all.
const fn response_index(format: &str) -> usize {
    base::response_index(format)
}

/// An object's id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Oid(pub u8);

impl Oid {
    /// What `set_digital_out` and `set_pwm_out` set belongs to no object. `allocate_oids` counts
    /// to 255 at most, so none can have this.
    const NOBODY: Oid = Oid(u8::MAX);
}

impl Arg<'_> for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    #[inline]
    fn decode(reader: &mut Reader<'_>) -> Result<Oid, Malformed> {
        u8::decode(reader).map(Oid)
    }
}

impl Field for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    fn encode(&self, writer: &mut Writer) {
        self.0.encode(writer);
    }
}

impl Arg<'_> for Pin {
    // A pin under `%c` exceeds 255: the host writes every integer whole.
    const CONVERSIONS: &'static [&'static str] = &["%u", "%c"];
    fn decode(reader: &mut Reader<'_>) -> Result<Pin, Malformed> {
        reader.int().map(Pin)
    }
}

impl Arg<'_> for Ticks {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    #[inline]
    fn decode(reader: &mut Reader<'_>) -> Result<Ticks, Malformed> {
        reader.int().map(Ticks)
    }
}

/// An instant as the host sent it, to be widened by [`Mcu::instant`].
#[derive(Clone, Copy, Debug)]
pub struct WireClock(pub u32);

impl Arg<'_> for WireClock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn decode(reader: &mut Reader<'_>) -> Result<WireClock, Malformed> {
        reader.int().map(WireClock)
    }
}

impl Field for Clock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn encode(&self, writer: &mut Writer) {
        writer.int(self.wire());
    }
}

/// What becomes of a timer after its event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// It runs again at that instant.
    At(Clock),
    /// It is done.
    Done,
}

/// An object that the host configured under an oid. Its methods run in the core: once
/// configured they must not allocate, lock, log or block.
pub trait Object: Any + Send {
    /// What it is, for the configuration's summary: `stepper`, `digital output`.
    fn kind(&self) -> &'static str;

    /// A timer of this object is due since `at`.
    fn event(&mut self, _mcu: &mut Mcu, _timer: TimerId, _at: Clock) -> Result<Next, Shutdown> {
        Ok(Next::Done)
    }

    /// A device of this object answered.
    fn completed(
        &mut self,
        _mcu: &mut Mcu,
        _ticket: Ticket,
        _result: Result<Buffer, Shutdown>,
    ) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The trsync that this object waits for was triggered.
    fn triggered(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The machine stops: timers are gone, outputs go to their shutdown values.
    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        Ok(())
    }
}

/// Whom a device's answer is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    /// The object that asked.
    pub oid: Oid,
    /// Whatever tells its requests apart.
    pub tag: u8,
}

/// A request to a device on a worker.
#[derive(Debug)]
pub struct Job {
    /// The device, as [`Workers::attach`] numbered it.
    pub device: usize,
    /// Whom the answer is for.
    pub ticket: Ticket,
    /// What the device takes.
    pub data: Buffer,
    /// Whether a machine that stops asks: that must find room where requests have filled the
    /// queue, as it may switch a heater off.
    pub stopping: bool,
}

/// A device's answer.
#[derive(Debug)]
pub struct Completion {
    /// Whom it is for.
    pub ticket: Ticket,
    /// What the device left, or why it could not.
    pub result: Result<Buffer, Shutdown>,
}

/// Runs the conversations of devices that take their time.
pub trait Workers: Send {
    /// Gives a device to the worker of its bus; returns the device's number.
    fn attach(&mut self, bus: &str, device: Box<dyn Device>) -> Result<usize, Shutdown>;

    /// Hands a job over, without waiting.
    fn submit(&mut self, job: Job) -> Result<(), Shutdown>;

    /// Whether every bus has room for the jobs of one more message block, each of which is a
    /// byte of it at least.
    fn has_room(&self) -> bool;

    /// The next answer, in order among the jobs of one bus.
    fn completion(&mut self) -> Option<Completion>;

    /// Whether there is one.
    fn has_completion(&self) -> bool;

    /// Ends every device. No answer to an earlier job comes after this.
    fn reset(&mut self);
}

/// Where the machine leaves what it has to say.
pub trait Outbox: Send {
    /// A response to the host: the payload of one message block. It is dropped if the host
    /// does not read.
    fn send(&mut self, payload: &[u8]);

    /// Something for the log.
    fn note(&mut self, note: Note<'_>);
}

/// Something for the log.
#[derive(Debug)]
pub enum Note<'a> {
    /// The machine stopped.
    Shutdown(&'a Shutdown),
    /// Something else failed while it stopped.
    Trouble(&'a Shutdown),
    /// The host configured this many objects of each kind.
    Configured(&'a [(&'static str, usize)]),
    /// How late timers were since the machine was made, and how early the core now wakes for
    /// them.
    Lateness(&'a Lateness, Ticks),
    /// The machine was rebuilt and waits for a configuration.
    Reset,
}

/// A device of an object, as [`Mcu::attach`] numbered it.
#[derive(Clone, Copy, Debug)]
pub struct DeviceId(usize);

enum Place {
    Inline(Box<dyn Device>),
    Worker(usize),
}

/// An output line and its present level.
pub struct Line {
    output: Box<dyn Output>,
    level: bool,
}

impl Line {
    /// Drives the line.
    #[inline]
    pub fn write(&mut self, level: bool) -> Result<(), Shutdown> {
        self.level = level;
        self.output.write(level)
    }

    /// Inverts the line.
    #[inline]
    pub fn toggle(&mut self) -> Result<(), Shutdown> {
        self.write(!self.level)
    }

    /// Gives the line away.
    pub fn into_output(self) -> Box<dyn Output> {
        self.output
    }
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
                    let result = object.event(self, timer, at).map_err(|stop| stop.of(object.kind(), oid.0));
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

    // ---- objects

    #[inline]
    fn put_back(&mut self, oid: Oid, object: Box<dyn Object>) {
        if let Some(slot) = self.objects.get_mut(usize::from(oid.0)) {
            *slot = Some(object);
        }
    }

    /// Lends an object of type `T` to `f`, or says that the oid is out of range or of another
    /// kind.
    #[inline]
    pub fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Mcu) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        let slot = self.objects.get_mut(usize::from(oid.0));
        let Some(mut object) = slot.and_then(Option::take) else { return Err(not_configured(oid)) };
        let any: &mut dyn Any = &mut *object;
        let result = match any.downcast_mut::<T>() {
            Some(inner) => f(inner, self).map_err(|stop| stop.of(object.kind(), oid.0)),
            None => Err(not_configured(oid)),
        };
        self.put_back(oid, object);
        result
    }

    /// The objects of type `T` for which `f` holds.
    pub fn any<T: Object>(&self, mut f: impl FnMut(&T) -> bool) -> bool {
        self.objects.iter().flatten().any(|object| {
            let any: &dyn Any = &**object;
            any.downcast_ref::<T>().is_some_and(&mut f)
        })
    }

    /// Passes a trsync's trigger on to an object.
    pub fn trigger(&mut self, oid: Oid) -> Result<(), Shutdown> {
        match self.objects.get_mut(usize::from(oid.0)).and_then(Option::take) {
            Some(mut object) => {
                let result = object.triggered(self, oid);
                self.put_back(oid, object);
                result
            }
            None => Ok(()),
        }
    }

    /// Says whether a new object may be put under `oid`: to be asked before a pin is claimed. To
    /// claim one opens files, for which the steps of a configured machine would wait, and nothing
    /// would drive back at the shutdown an output that has no object.
    pub fn vacant(&self, oid: Oid) -> Result<(), Shutdown> {
        let taken = |why: &str| Err(Shutdown::by_host(Reason::CannotAssignOid, format_args!("oid {} is {why}", oid.0)));
        match self.objects.get(usize::from(oid.0)) {
            _ if self.is_finalized() => taken("assigned after finalize_config"),
            Some(None) => Ok(()),
            Some(Some(_)) => taken("assigned twice"),
            None => taken("not below the count of allocate_oids"),
        }
    }

    /// Puts a new object under `oid`.
    pub fn assign(&mut self, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.vacant(oid)?;
        self.put_back(oid, Box::new(object));
        Ok(())
    }

    // ---- lines and devices

    /// Claims an output line. One that `set_digital_out` holds is taken over, if it belongs where
    /// it was set to.
    pub fn output(&mut self, pin: Pin, value: bool, shutdown_value: bool) -> Result<Line, Shutdown> {
        let set = self.set_lines.iter().position(|(held, belongs, _)| *held == pin && *belongs == shutdown_value);
        if let Some(set) = set {
            let (_, _, mut line) = self.set_lines.swap_remove(set);
            line.write(value)?;
            return Ok(line);
        }
        let output = self.board.output(pin, value, shutdown_value)?;
        Ok(Line { output, level: value })
    }

    /// Drives a line that no object owns, and holds it until an object claims it.
    ///
    /// The firmware takes this at any time, and so does this machine for a line that it holds.
    /// To claim one opens files and waits for the guardian: that is refused after
    /// `finalize_config`, as it would keep steps waiting. klippy sets its lines before.
    pub fn set_line(&mut self, pin: Pin, value: bool) -> Result<(), Shutdown> {
        if let Some((_, _, line)) = self.set_lines.iter_mut().find(|(held, ..)| *held == pin) {
            return line.write(value);
        }
        if self.is_finalized() {
            return Err(self.set_too_late(Reason::OutputLine, "set_digital_out", pin));
        }
        let line = self.output(pin, value, value)?;
        self.set_lines.push((pin, value, line));
        Ok(())
    }

    /// Claims a hardware PWM channel for an object.
    pub fn pwm(&mut self, owner: Oid, config: PwmConfig) -> Result<DeviceId, Shutdown> {
        if let Some((first, _)) = self.channel(config.pin) {
            return Err(self.channel_taken(config.pin, first, owner));
        }
        let attachment = self.board.pwm(config)?;
        let device = self.attach(attachment)?;
        self.channels.push((config.pin, owner, device));
        Ok(device)
    }

    /// Sets a hardware PWM channel that no object owns: it keeps its value, at a shutdown too.
    ///
    /// As with [`Mcu::set_line`] a channel that is held may be set anew at any time, by the
    /// worker that has its files; others are refused after `finalize_config`.
    pub fn set_pwm(&mut self, config: PwmConfig) -> Result<(), Shutdown> {
        match self.channel(config.pin) {
            Some((Oid::NOBODY, device)) => {
                let [v0, v1] = config.value.to_le_bytes();
                let [c0, c1, c2, c3] = config.cycle.0.to_le_bytes();
                self.submit(device, Ticket { oid: Oid::NOBODY, tag: 0 }, Buffer::new(&[v0, v1, c0, c1, c2, c3]))
            }
            None if self.is_finalized() => Err(self.set_too_late(Reason::PwmConfig, "set_pwm_out", config.pin)),
            _ => self.pwm(Oid::NOBODY, config).map(drop),
        }
    }

    /// Whose a channel is, if it is in use.
    fn channel(&self, pin: Pin) -> Option<(Oid, DeviceId)> {
        self.channels.iter().find(|(held, ..)| *held == pin).map(|(_, owner, device)| (*owner, *device))
    }

    #[cold]
    fn channel_taken(&self, pin: Pin, first: Oid, second: Oid) -> Shutdown {
        let user = |oid: Oid| match oid {
            Oid::NOBODY => "set_pwm_out".to_owned(),
            Oid(oid) => format!("PWM output oid {oid}"),
        };
        let (name, first, second) = (self.name(pin), user(first), user(second));
        let detail =
            format!("{name} is claimed twice: by {first} and by {second}: change one of the two to another pin");
        Shutdown::because(Reason::PwmConfig, detail)
    }

    #[cold]
    fn set_too_late(&self, reason: Reason, command: &str, pin: Pin) -> Shutdown {
        let name = self.name(pin);
        Shutdown::by_host(
            reason,
            format_args!("{command} wants {name} after finalize_config, and did not set it before"),
        )
    }

    /// What the dictionary calls a pin.
    fn name(&self, pin: Pin) -> String {
        self.board.pins().iter().find_map(|range| range.name_of(pin.0)).unwrap_or(format!("pin number {}", pin.0))
    }

    /// Takes a device in.
    pub fn attach(&mut self, attachment: Attachment) -> Result<DeviceId, Shutdown> {
        self.devices.push(match attachment {
            Attachment::Inline(device) => Place::Inline(device),
            Attachment::Worker { bus, device } => Place::Worker(self.workers.attach(&bus, device)?),
        });
        Ok(DeviceId(self.devices.len() - 1))
    }

    /// Asks a device; the answer comes to [`Object::completed`].
    pub fn submit(&mut self, device: DeviceId, ticket: Ticket, mut data: Buffer) -> Result<(), Shutdown> {
        match self.devices.get_mut(device.0) {
            Some(Place::Inline(device)) => {
                let result = device.run(&mut data).map(|()| data);
                self.completions.push(Completion { ticket, result });
                Ok(())
            }
            Some(Place::Worker(device)) => {
                let device = *device;
                self.workers.submit(Job { device, ticket, data, stopping: self.halting })
            }
            None => Ok(()),
        }
    }

    /// Whether the host's next block may be run. Where a bus falls behind it waits, and holds the
    /// host back as a machine would that runs its transfers itself. The blocks of a stopped
    /// machine ask no bus for anything.
    #[inline]
    pub fn has_room(&self) -> bool {
        self.halted.is_some() || self.workers.has_room()
    }

    /// Whether [`Mcu::run_workers`] has something to do.
    pub fn has_completion(&self) -> bool {
        self.workers.has_completion()
    }

    /// Takes in the answers of devices on workers.
    #[inline]
    pub fn run_workers(&mut self) {
        while let Some(completion) = self.workers.completion() {
            self.completions.push(completion);
            self.run_completions();
        }
    }

    #[inline]
    fn run_completions(&mut self) {
        while let Some(Completion { ticket, result }) = self.completions.pop() {
            let slot = self.objects.get_mut(usize::from(ticket.oid.0));
            let done = match slot.and_then(Option::take) {
                Some(mut object) => {
                    let done = object.completed(self, ticket, result);
                    let done = done.map_err(|stop| stop.of(object.kind(), ticket.oid.0));
                    self.put_back(ticket.oid, object);
                    done
                }
                // Nobody's: only its failure tells anything.
                None => result.map(drop).or_else(|shutdown| self.device_failed(shutdown)),
            };
            if let Err(shutdown) = done {
                self.shut_down(shutdown);
            }
        }
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
            return Err(Shutdown::by_host(Reason::OidsAllocated, "allocate_oids came twice"));
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

#[cold]
fn not_configured(oid: Oid) -> Shutdown {
    Shutdown::because(
        Reason::InvalidOid,
        format!(
            "oid {} is not configured, or as something else: the host's configuration is not this machine's; FIRMWARE_RESTART",
            oid.0
        ),
    )
}
