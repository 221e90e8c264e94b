// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of a pin's edges, such as a fan's tachometer: the pin is polled, and the count told in
//! intervals.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{
    Command, Done, Feature, InputLine, Mcu, Next, Object, Oid, Response, Ticket, TimerId, WireClock, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

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

struct Counter {
    pin: InputLine,
    poll_ticks: Ticks,
    sample_ticks: Ticks,
    /// The count is told at the first look after this.
    next_sample: Clock,
    /// Edges, modulo 2^32. It is odd while the pin is high.
    count: u32,
    /// When the last edge was seen; before the first one, when counting began (the firmware says 0,
    /// which klippy takes for some instant that may lie ahead).
    count_clock: Clock,
    /// Whether an expander's worker looks at the pin.
    looking: bool,
    /// Whether that look is of the present query.
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
            let next_clock = at + self.poll_ticks;
            mcu.send(State { oid, next_clock, count: self.count, count_clock: self.count_clock });
        }
    }
}

impl Object for Counter {
    fn kind(&self) -> &'static str {
        "counter"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        // An expander that still looks misses this turn.
        if !self.looking {
            match self.pin.read(mcu, Ticket { oid, tag: 0 })? {
                Some(level) => self.look(mcu, oid, level, at),
                None => (self.looking, self.counts) = (true, true),
            }
        }
        Ok(Next::At(at + self.poll_ticks))
    }

    /// An expander's worker has looked.
    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let began = done.began;
        self.looking = false;
        let level = self.pin.returned(done).or_else(|failure| mcu.try_shut_down(failure).map(|()| false))?;
        if std::mem::take(&mut self.counts) {
            self.look(mcu, oid, level, began);
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
        let counter = Counter {
            pin: mcu.input(pin, bias(pull_up))?,
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
            mcu.cancel(TimerId::new(oid, 0));
            counter.poll_ticks = poll_ticks;
            counter.sample_ticks = sample_ticks;
            counter.next_sample = at;
            if counter.count == 0 {
                counter.count_clock = at;
            }
            counter.counts = false;
            mcu.schedule(TimerId::new(oid, 0), at)
        })
    }
);
