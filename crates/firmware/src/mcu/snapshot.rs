// SPDX-License-Identifier: GPL-3.0-or-later
//! What an MCU tells of itself when asked: its state, objects, lines and queues.
//!
//! The core fills a snapshot in while no timer is near, a few rows at a time. Whoever asks has made room for
//! all of it, so that the core neither allocates nor waits.

#![forbid(unsafe_code)]

use std::fmt::{self, Write as _};
use std::sync::atomic::{AtomicU8, Ordering};

use crate::board::{Direction, Pin};
use crate::lateness::Lateness;
use crate::shutdown::ShutdownReason;
use crate::time::Clock;

use super::{DialectName, Mcu, OBJECTS_MAX, Oid};

/// The most lines that are told of.
const LINES_MAX: usize = 512;
/// The most workers that are told of.
const QUEUES_MAX: usize = 32;
/// How many bytes of a text are told, such as the detail of a shutdown.
const TEXT_BYTES: usize = 1024;
/// How many bytes of a worker's name are told.
const NAME_BYTES: usize = 32;
/// Lines and objects that are told in one go. A row costs some 10 ns, or a miss of the cache or two.
const ROWS: usize = 16;

/// The MCU at an instant.
#[derive(Debug)]
pub struct Snapshot {
    /// When it was begun.
    pub at: Clock,
    /// Whether the MCU is configured.
    pub is_configured: bool,
    /// Whether a host has begun to configure it.
    pub oids_allocated: bool,
    /// The dialect that it speaks.
    pub dialect: Option<DialectName>,
    /// Why and when it stopped; none while it is not.
    pub stopped: Option<(ShutdownReason, Clock)>,
    /// The cause and remedy of the stop, as the log has them.
    pub detail: String,
    /// The output that is not at its shutdown value yet; empty if there is none.
    pub debtor: String,
    /// Whether commands wait for a bus.
    pub is_held: bool,
    /// Moves that are queued, and that there is room for.
    pub moves: (u16, u16),
    /// How late timers were.
    pub lateness: Lateness,
    /// The GPIO lines in use.
    pub lines: Vec<LineState>,
    /// The objects, by their oids.
    pub objects: Vec<ObjectState>,
    /// The workers with the jobs that they have.
    pub queues: Vec<QueueState>,
    /// How many lines and objects there were as this was begun.
    shape: (usize, usize),
    /// Rows that are told already, and one for the head.
    told: usize,
}

/// A GPIO line in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineState {
    /// By the board's own number for it.
    pub pin: Pin,
    /// What it was set up as last.
    pub use_: LineUse,
    /// The level that it was driven to or that was seen last; none if it was not looked at yet.
    pub level: Option<bool>,
    /// The calls of its worker, if its chip is an expander.
    pub bus: Option<BusCounts>,
}

/// What a line is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineUse {
    /// It is driven.
    Output,
    /// It is read.
    Input,
    /// It is pulled low or let go.
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

/// An object of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ObjectState {
    /// The host's number for it; none for what belongs to no object, such as the lines of `set_digital_out`.
    pub oid: Option<u8>,
    /// What people call it.
    pub kind: &'static str,
    /// The pin that the log names it by.
    pub pin: Option<Pin>,
    /// What it says of itself.
    pub report: Report,
    /// The calls to its device, if a worker makes them.
    pub bus: Option<BusCounts>,
}

/// What an object says of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// How many changes or moves it has queued.
    pub queued: usize,
    /// Its present value.
    pub value: Option<Present>,
}

/// An object's present value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Present {
    /// A sample of an ADC, 0 to [`crate::board::ADC_MAX`].
    Adc(u16),
    /// For how much of each period an output is on, 0 to [`crate::board::PWM_MAX`].
    Pwm(u16),
    /// A stepper's position in steps.
    Steps(i32),
}

/// Calls to a device since it was configured. The counts wrap around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusCounts {
    /// Calls, those that failed among them.
    pub transfers: u32,
    /// Calls that failed.
    pub errors: u32,
    /// Of these, those that were made again.
    pub retries: u32,
}

/// A worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueState {
    name: [u8; NAME_BYTES],
    /// Jobs that wait for it.
    pub waiting: usize,
}

impl QueueState {
    /// Its name, such as `spi0`.
    pub fn name(&self) -> String {
        let name: Vec<u8> = self.name.iter().copied().take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&name).into_owned()
    }
}

impl Default for Snapshot {
    /// An empty one, with room for all that an MCU may have.
    fn default() -> Snapshot {
        Snapshot {
            at: Clock::EPOCH,
            is_configured: false,
            oids_allocated: false,
            dialect: None,
            stopped: None,
            detail: String::with_capacity(TEXT_BYTES),
            debtor: String::with_capacity(TEXT_BYTES),
            is_held: false,
            moves: (0, 0),
            lateness: Lateness::default(),
            lines: Vec::with_capacity(LINES_MAX),
            objects: Vec::with_capacity(OBJECTS_MAX + ROWS),
            queues: Vec::with_capacity(QUEUES_MAX),
            shape: (0, 0),
            told: 0,
        }
    }
}

impl Snapshot {
    /// To be called before it is filled in anew.
    pub fn clear(&mut self) {
        self.told = 0;
    }
}

/// Appends to a list that has room for it.
fn append<T>(list: &mut Vec<T>, item: T) {
    if list.len() < list.capacity() {
        list.push(item);
    }
}

/// Puts as much of a text as has room.
fn put(text: &mut String, from: impl fmt::Display) {
    text.clear();
    // The write fails where there is no room left: the text is cut there.
    let _ = write!(Room(text), "{from}");
}

/// A text that does not grow beyond what is allocated for it.
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
    /// Tells the next part of a snapshot: the head first, then a few lines or objects. True once it is whole. It
    /// begins anew if lines or objects came or went meanwhile. Does not allocate.
    pub fn tell(&self, to: &mut Snapshot) -> bool {
        let shape = (self.configuration.claims.len(), self.configuration.objects.len());
        if to.told == 0 || to.shape != shape {
            to.shape = shape;
            to.told = 1;
            self.tell_head(to);
            return false;
        }
        let (first, rows) = (to.told - 1, shape.0 + shape.1);
        let next = (first + ROWS).min(rows);
        for row in first..next {
            match row.checked_sub(shape.0) {
                None => append(&mut to.lines, self.configuration.claims[row].state()),
                Some(index) => {
                    if let Some(state) = self.object_state(index) {
                        append(&mut to.objects, state);
                    }
                }
            }
        }
        to.told = next + 1;
        if next < rows {
            return false;
        }
        let queues = &mut to.queues;
        self.workers.tell(&mut |bus, waiting| {
            let mut name = [0; NAME_BYTES];
            name.iter_mut().zip(bus.bytes()).for_each(|(to, from)| *to = from);
            append(queues, QueueState { name, waiting });
        });
        true
    }

    fn tell_head(&self, to: &mut Snapshot) {
        to.at = self.schedule.last_read;
        to.is_configured = self.is_finalized();
        to.oids_allocated = self.is_allocated();
        to.dialect = Some(self.spoken.dialect.name());
        let last = self.stop.last.as_ref().filter(|_| self.is_shutdown());
        let at = last.map_or(self.schedule.last_read, |(_, at)| *at);
        to.stopped = self.stop.reason.map(|reason| (reason, at));
        match last {
            Some((trouble, _)) => put(&mut to.detail, trouble),
            None => to.detail.clear(),
        }
        put(&mut to.debtor, self.debtor().unwrap_or_default());
        to.is_held = self.is_held();
        to.moves = self.moves.used();
        to.lateness.clone_from(&self.schedule.lateness);
        to.lines.clear();
        to.objects.clear();
        to.queues.clear();
    }

    fn object_state(&self, index: usize) -> Option<ObjectState> {
        let object = self.configuration.objects.get(index)?.as_ref()?;
        Some(ObjectState {
            oid: (index < Oid::FIRST_OWN).then_some(index as u8),
            kind: object.kind(),
            pin: self.configuration.pins.iter().find(|(oid, _)| oid.index() == index).map(|(_, pin)| *pin),
            report: object.report(),
            bus: object.counts(),
        })
    }
}

/// The level of a line as it was driven or seen last. Its writer, the core or a worker, stores a byte.
#[derive(Debug)]
pub(super) struct Level(AtomicU8);

const UNKNOWN: u8 = 2;

impl Level {
    pub(super) fn of(direction: Direction) -> Level {
        let level = Level(AtomicU8::new(UNKNOWN));
        level.begin(direction);
        level
    }

    /// The line is set up.
    pub(super) fn begin(&self, direction: Direction) {
        match direction {
            Direction::Output { level, .. } => self.set(level),
            _ => self.0.store(UNKNOWN, Ordering::Relaxed),
        }
    }

    #[inline]
    pub(super) fn set(&self, level: bool) {
        self.0.store(u8::from(level), Ordering::Relaxed);
    }

    pub(super) fn get(&self) -> Option<bool> {
        match self.0.load(Ordering::Relaxed) {
            UNKNOWN => None,
            level => Some(level != 0),
        }
    }
}
