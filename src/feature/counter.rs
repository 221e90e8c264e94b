// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of a pin's edges, such as a fan's tachometer.
//!
//! The firmware polls the pin, and so do we where nothing else can be had. Where the board has
//! interrupts, the kernel counts and dates the edges, and a worker asks it at each sample: no edge is
//! too short after the one before, and the core has one timer in a second to run instead of a thousand.

#![forbid(unsafe_code)]

use std::sync::Arc;

use log::warn;

use crate::board::{EdgeCount, Edges, Pin};
use crate::mcu::{
    Command, Done, Errand, Feature, InputLine, Mcu, Next, Object, Oid, Response, Ticket, TimerId, WireClock, WorkerId,
    command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

use super::bias;

pub(super) const FEATURE: Feature = Feature {
    name: "counter",
    commands: &[CONFIG_COUNTER, QUERY_COUNTER],
    responses: &[State::FORM],
    ..Feature::EMPTY
};

response! {
    /// The edges so far, and the instants of the next look and of the last edge. klippy takes the
    /// count for that of one `poll_ticks` before `next_clock`.
    "counter_state oid=%c next_clock=%u count=%u count_clock=%u"
    pub(super) struct State { oid: Oid, next_clock: Clock, count: u32, count_clock: Clock }
}

/// Tags of errands.
const LOOK: u8 = 0;
const READ_EDGES: u8 = 1;

/// More interrupts than these are none of a tachometer (20,000 rpm with two pulses are 1333 edges a
/// second), but of a pin that floats or oscillates. Each costs the kernel 10 us and more, and whatever
/// else this computer does comes after them.
const EDGES_PER_S_MAX: u32 = 20_000;
/// The time over which they are counted, at least: a contact that bounces is no such pin.
const STORM_TICKS: Ticks = Ticks::from_us(100_000);

/// A worker's look at what the kernel has counted.
struct Reading {
    edges: Box<dyn Edges>,
    clock: Arc<dyn TimeSource>,
    /// What the log calls the pin.
    name: String,
    /// Since when edges are counted in order to see whether there are too many, and how many there
    /// were then.
    since: (Clock, u32),
    /// Whether there were, so that there are no more interrupts.
    given_up: bool,
    /// How many edges there were, and when the last one was.
    seen: Result<(u32, Option<Clock>), Shutdown>,
}

impl Reading {
    fn read(&mut self) -> Result<(u32, Option<Clock>), Shutdown> {
        let EdgeCount { count, last } = self.edges.count()?;
        let now = self.clock.now();
        let (since, before) = self.since;
        let ticks = now.since(since).unsigned_abs();
        if ticks >= u64::from(STORM_TICKS.0) {
            self.since = (now, count);
            let per_s = u64::from(count.wrapping_sub(before)) * u64::from(CLOCK_FREQ) / ticks;
            if per_s > u64::from(EDGES_PER_S_MAX) {
                self.edges.end()?;
                self.given_up = true;
                warn!("{}", too_many(&self.name, per_s));
            }
        }
        Ok((count, last.map(|last| self.clock.instant_of(last))))
    }
}

impl Errand for Reading {
    fn run(&mut self) {
        self.seen = self.read();
    }
}

/// For the log: a pin has so many edges in a second that its interrupts were given up.
fn too_many(name: &str, per_s: u64) -> String {
    format!(
        "counter ({name}): {per_s} edges a second are none of a fan, and their interrupts slow this computer down: it is polled from now on; does the pin float? Connect it, or give it a pull-up (^)"
    )
}

/// For the log: nothing counts a pin's edges.
fn polled(name: &str, why: &str) -> String {
    format!("counter ({name}): {why}, so it is polled: pulses shorter than its poll_interval are missed")
}

/// The kernel's count of the edges, and who asks for it.
struct Counted {
    worker: WorkerId,
    /// Here while the worker does not read.
    reading: Option<Box<Reading>>,
}

struct Counter {
    pin: InputLine,
    /// None where the pin is polled.
    counted: Option<Counted>,
    poll_ticks: Ticks,
    sample_ticks: Ticks,
    /// The count is told at the first look after this.
    next_sample: Clock,
    /// Edges, modulo 2^32. While the pin is polled it is odd as long as that is high.
    count: u32,
    /// When the last edge was seen; before the first one, when counting began (the firmware says 0,
    /// which klippy takes for some instant that may lie ahead).
    count_clock: Clock,
    /// Whether an expander's worker looks at the pin.
    looking: bool,
    /// Whether what a worker does is for the present query.
    counts: bool,
}

impl Counter {
    /// Takes in the level at an instant.
    fn look(&mut self, mcu: &mut Mcu, oid: Oid, level: bool, at: Clock) {
        if level != (self.count % 2 == 1) {
            self.count = self.count.wrapping_add(1);
            self.count_clock = at;
        }
        if self.next_sample < at {
            self.next_sample = at + self.sample_ticks;
            self.tell(mcu, oid, at);
        }
    }

    /// Tells the count that was right at an instant.
    fn tell(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock) {
        let next_clock = at + self.poll_ticks;
        mcu.send(State { oid, next_clock, count: self.count, count_clock: self.count_clock });
    }

    /// Takes in what the kernel has counted.
    fn has_read(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let ended = done.ended;
        let (Some(counted), Some(mut reading)) = (&mut self.counted, done.errand::<Reading>()) else { return Ok(()) };
        let seen = std::mem::replace(&mut reading.seen, Ok((0, None)));
        counted.reading = Some(reading);
        match seen {
            Ok((count, last)) => {
                self.count = count;
                self.count_clock = last.unwrap_or(self.count_clock);
                if std::mem::take(&mut self.counts) {
                    self.tell(mcu, oid, ended);
                }
                Ok(())
            }
            Err(failure) => mcu.try_shut_down(failure),
        }
    }
}

impl Object for Counter {
    fn kind(&self) -> &'static str {
        "counter"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        if let Some(Counted { worker, reading }) = &mut self.counted
            && !reading.as_ref().is_some_and(|reading| reading.given_up)
        {
            // A worker that still reads misses this turn.
            if let Some(reading) = reading.take() {
                self.counts = true;
                mcu.dispatch(*worker, Ticket { oid, tag: READ_EDGES }, reading)?;
            }
            return Ok(Next::At(at + self.sample_ticks.max(self.poll_ticks)));
        }
        // So does an expander that still looks.
        if self.looking {
            self.pin.awaited(mcu)?;
        } else {
            match self.pin.read(mcu, Ticket { oid, tag: LOOK })? {
                Some(level) => self.look(mcu, oid, level, at),
                None => (self.looking, self.counts) = (true, true),
            }
        }
        Ok(Next::At(at + self.poll_ticks))
    }

    /// A worker has read the count, or looked at an expander's pin.
    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        if done.tag == READ_EDGES {
            return self.has_read(mcu, oid, done);
        }
        let ended = done.ended;
        self.looking = false;
        let level = self.pin.sampled(mcu, done)?;
        if std::mem::take(&mut self.counts) {
            // A pin that could not be looked at keeps its last level.
            self.look(mcu, oid, level.unwrap_or(self.count % 2 == 1), ended);
        }
        Ok(())
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.counts = false;
    }
}

const CONFIG_COUNTER: Command =
    command!("config_counter oid=%c pin=%u pull_up=%c", |mcu, oid: Oid, pin: Pin, pull_up: i8| {
        mcu.vacant(oid)?;
        let (line, edges) = mcu.counted_input(pin, bias(pull_up))?;
        let name = mcu.name(pin);
        let counted = match edges {
            Ok((worker, edges)) => {
                let since = (mcu.now(), 0);
                let reading = Reading { edges, clock: mcu.clock(), name, since, given_up: false, seen: Ok((0, None)) };
                Some(Counted { worker, reading: Some(Box::new(reading)) })
            }
            Err(why) => {
                warn!("{}", polled(&name, &why));
                None
            }
        };
        let counter = Counter {
            pin: line,
            counted,
            poll_ticks: Ticks(0),
            sample_ticks: Ticks(0),
            next_sample: Clock::EPOCH,
            count: 0,
            count_clock: Clock::EPOCH,
            looking: false,
            counts: false,
        };
        mcu.assign_on(pin, oid, counter)
    });

const QUERY_COUNTER: Command = command!(
    "query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u",
    |mcu, oid: Oid, clock: WireClock, poll_ticks: Ticks, sample_ticks: Ticks| {
        let at = mcu.instant(clock);
        mcu.with::<Counter, _>(oid, |counter, mcu| {
            mcu.cancel(TimerId::sampling(oid, 0));
            counter.poll_ticks = poll_ticks;
            counter.sample_ticks = sample_ticks;
            counter.next_sample = at;
            if counter.count == 0 {
                counter.count_clock = at;
            }
            counter.counts = false;
            mcu.schedule(TimerId::sampling(oid, 0), at)
        })
    }
);
