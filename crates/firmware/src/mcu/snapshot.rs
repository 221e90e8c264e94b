// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of an MCU about itself, on request: its state, objects, lines and queues.
//!
//! The core fills a snapshot while no timer is near, a few rows at a time. The caller has reserved memory for all of
//! it. So the core neither allocates nor waits.

use std::fmt::{self, Write as _};

use crate::board::{Direction, Pin};
use crate::lateness::Lateness;
use crate::shutdown::ShutdownReason;
use crate::time::Clock;

use super::{Mcu, OBJECTS_MAX, Oid, State};

/// Highest number of lines in a snapshot.
const LINES_MAX: usize = 512;
/// Highest number of workers in a snapshot.
const QUEUES_MAX: usize = 32;
/// Longest text in a snapshot in bytes, for example the detail of a shutdown.
const TEXT_BYTES: usize = 1024;
/// Longest name of a worker in bytes.
const NAME_BYTES: usize = 32;
/// How many lines and objects are added in one turn. A row costs about 10 ns, or one or two cache misses.
const ROWS: usize = 16;

/// The MCU's state at one moment.
#[derive(Debug)]
pub struct Snapshot {
    /// When the snapshot was begun.
    pub at: Clock,
    /// Whether the MCU is configured.
    pub is_configured: bool,
    /// Whether a host has begun to configure it.
    pub oids_allocated: bool,
    /// The [label](super::Forms::label) of the forms of its messages.
    pub dialect: Option<&'static str>,
    /// Why and when it stopped; `None` while it is not stopped.
    pub stopped: Option<(ShutdownReason, Clock)>,
    /// The cause and remedy of the stop, as in the log.
    pub detail: String,
    /// The object whose shutdown value is pending; empty if there is none.
    pub pending: String,
    /// Whether commands wait for a bus.
    pub is_held: bool,
    /// How many moves are queued, and how many there are in all.
    pub moves: (u16, u16),
    /// How late timers were.
    pub lateness: Lateness,
    /// The GPIO lines in use.
    pub lines: Vec<LineState>,
    /// The objects in the order of their oids.
    pub objects: Vec<ObjectState>,
    /// The workers and their numbers of jobs.
    pub queues: Vec<QueueState>,
    /// How many lines and objects there were when the snapshot was begun.
    shape: (usize, usize),
    /// How many rows are filled in, plus one for the head.
    filled: usize,
}

/// A GPIO line in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineState {
    /// The board's own number for it.
    pub pin: Pin,
    /// Its last setup.
    pub use_: LineUse,
    /// The level that was last driven or read; `None` if it was never read.
    pub level: Option<bool>,
    /// Whether it is written and read without a call of the kernel.
    pub fast: bool,
    /// The calls of its worker, if its chip is an expander.
    pub bus: Option<BusCounts>,
}

/// How a line is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineUse {
    /// It is driven.
    Output,
    /// It is read.
    Input,
    /// It is pulled low or released.
    OpenDrain,
}

impl From<Direction> for LineUse {
    fn from(direction: Direction) -> LineUse {
        match direction {
            Direction::Output { .. } => LineUse::Output,
            Direction::Input(_) => LineUse::Input,
            Direction::OpenDrain => LineUse::OpenDrain,
        }
    }
}

/// The state of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ObjectState {
    /// The host's number for it; `None` for a feature's own object, for example the lines of `set_digital_out`.
    pub oid: Option<u8>,
    /// The log's name for this kind of object.
    pub kind: &'static str,
    /// The pin by which the log names it.
    pub pin: Option<Pin>,
    /// Its report about itself.
    pub report: Report,
    /// The calls to its device, if a worker makes them.
    pub bus: Option<BusCounts>,
}

/// An object's report about itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// How many changes or moves it has queued.
    pub queued: usize,
    /// Its present value.
    pub value: Option<Present>,
    /// Whether its device fails and its last answers are repeated.
    pub repeats: bool,
}

/// An object's present value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Present {
    /// A sample of an ADC, 0 to [`crate::board::ADC_MAX`].
    Adc(u16),
    /// The part of each period in which an output is on, 0 to [`crate::board::PWM_MAX`].
    Pwm(u16),
    /// A stepper's position in steps.
    Steps(i32),
}

/// Counts of calls to a device since its configuration. They wrap around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusCounts {
    /// All calls, also the failed ones.
    pub transfers: u32,
    /// Failed calls.
    pub errors: u32,
    /// Failed calls that were repeated.
    pub retries: u32,
}

/// A worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueState {
    name: [u8; NAME_BYTES],
    /// Jobs that wait for this worker.
    pub waiting: usize,
}

impl QueueState {
    /// Its name, for example `spi0`.
    pub fn name(&self) -> String {
        let name: Vec<u8> = self.name.iter().copied().take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&name).into_owned()
    }
}

impl Default for Snapshot {
    /// An empty snapshot with memory for all rows of an MCU.
    fn default() -> Snapshot {
        Snapshot {
            at: Clock::EPOCH,
            is_configured: false,
            oids_allocated: false,
            dialect: None,
            stopped: None,
            detail: String::with_capacity(TEXT_BYTES),
            pending: String::with_capacity(TEXT_BYTES),
            is_held: false,
            moves: (0, 0),
            lateness: Lateness::default(),
            lines: Vec::with_capacity(LINES_MAX),
            objects: Vec::with_capacity(OBJECTS_MAX + ROWS),
            queues: Vec::with_capacity(QUEUES_MAX),
            shape: (0, 0),
            filled: 0,
        }
    }
}

impl Snapshot {
    /// Call this before the snapshot is filled again.
    pub fn clear(&mut self) {
        self.filled = 0;
    }
}

/// Appends an item if the list has room for it.
fn append<T>(list: &mut Vec<T>, item: T) {
    if list.len() < list.capacity() {
        list.push(item);
    }
}

/// Writes as much of a text as there is room for.
fn put(text: &mut String, from: impl fmt::Display) {
    text.clear();
    // The write fails when there is no room left. The text ends there.
    let _ = write!(Room(text), "{from}");
}

/// A text that does not grow beyond its allocated memory.
struct Room<'a>(&'a mut String);

impl fmt::Write for Room<'_> {
    fn write_str(&mut self, from: &str) -> fmt::Result {
        let room = self.0.capacity() - self.0.len();
        let end = (0..=room.min(from.len())).rev().find(|end| from.is_char_boundary(*end));
        let end = end.unwrap_or(0);
        self.0.push_str(&from[..end]);
        if end == from.len() { Ok(()) } else { Err(fmt::Error) }
    }
}

impl Mcu {
    /// Fills in the next part of a snapshot: the head first, then a few lines or objects. True when it is complete. It
    /// begins again if lines or objects came or went since its head. It does not allocate.
    pub fn fill(&self, to: &mut Snapshot) -> bool {
        let State { lines, objects, workers, .. } = &self.state;
        let shape = (lines.len(), objects.len());
        if to.filled == 0 || to.shape != shape {
            to.shape = shape;
            to.filled = 1;
            self.fill_head(to);
            return false;
        }
        let (first, rows) = (to.filled - 1, shape.0 + shape.1);
        let next = (first + ROWS).min(rows);
        for row in first..next {
            match row.checked_sub(shape.0) {
                None => append(&mut to.lines, lines.state(row)),
                Some(index) => {
                    if let Some(state) = self.object_state(index) {
                        append(&mut to.objects, state);
                    }
                }
            }
        }
        to.filled = next + 1;
        if next < rows {
            return false;
        }
        let queues = &mut to.queues;
        workers.report(&mut |bus, waiting| {
            let mut name = [0; NAME_BYTES];
            name.iter_mut().zip(bus.bytes()).for_each(|(to, from)| *to = from);
            append(queues, QueueState { name, waiting });
        });
        true
    }

    fn fill_head(&self, to: &mut Snapshot) {
        let State { phase, scheduler, wire, moves, .. } = &self.state;
        to.at = scheduler.last_read();
        to.is_configured = phase.is_finalized();
        to.oids_allocated = phase.is_allocated();
        to.dialect = Some(wire.dialect().forms().label());
        to.stopped = phase.last_stop().map(|(why, at)| (why.reason, at));
        match phase.last_stop() {
            Some((why, _)) => put(&mut to.detail, &why.trouble),
            None => to.detail.clear(),
        }
        put(&mut to.pending, self.pending_value().unwrap_or_default());
        to.is_held = self.is_held();
        to.moves = moves.used();
        to.lateness.clone_from(scheduler.lateness());
        to.lines.clear();
        to.objects.clear();
        to.queues.clear();
    }

    fn object_state(&self, index: usize) -> Option<ObjectState> {
        let oid = Oid::at(index);
        let object = self.state.objects.get(oid)?;
        Some(ObjectState {
            oid: (index < Oid::FIRST_OWN).then_some(index as u8),
            kind: object.kind(),
            pin: self.state.objects.pin(oid),
            report: object.report(),
            bus: object.counts(),
        })
    }
}
