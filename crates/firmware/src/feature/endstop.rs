// SPDX-License-Identifier: GPL-3.0-or-later
//! Endstops: a pin is sampled until it has a level several times in a row, then a trsync is triggered.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{
    Command, Done, Feature, InputLine, Mcu, Next, Object, Oid, Response, Ticket, TimerId, UNREAD_LIMIT, WireClock,
    command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::bias;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    name: "endstop",
    commands: &[CONFIG_ENDSTOP, ENDSTOP_HOME, ENDSTOP_QUERY_STATE],
    responses: &[State::FORM],
    ..Feature::EMPTY
};

response! {
    /// The endstop's level, and whether the machine still samples it.
    "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c"
    pub(super) struct State { oid: Oid, homing: bool, next_clock: Clock, pin_value: bool }
}

struct Endstop {
    pin: InputLine,
    /// The last `endstop_home`. It stays after the trigger, so that `endstop_query_state` can still
    /// tell when that came.
    homing: Option<Homing>,
    /// When sampling goes on if the samples after the last match do not confirm it.
    next_wake: Clock,
    /// When the sample was due that the chip's worker is taking; none if it takes none. The timer then runs
    /// when that takes too long.
    due: Option<Clock>,
    /// A query waits for the worker's look at the line, too; `true` if further commands wait with it.
    asked: Option<bool>,
}

#[derive(Clone, Copy)]
struct Homing {
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    pin_value: bool,
    trsync: Oid,
    trigger_reason: u8,
    /// How many matching samples are still wanted; fewer than `sample_count` while confirming.
    wanted: u8,
}

impl Endstop {
    fn ticket(oid: Oid) -> Ticket {
        Ticket { oid, tag: 0 }
    }

    /// Takes the sample that is due at `at`, or has the chip's worker take it.
    fn sample(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock) -> Result<Next, Shutdown> {
        match self.pin.read(mcu, Self::ticket(oid))? {
            Some(level) => self.judge(mcu, level, at, at),
            None => {
                self.due = Some(at);
                Ok(Next::At(mcu.last_read() + UNREAD_LIMIT))
            }
        }
    }

    /// Decides how to go on by a sample that was due at `at` and is of the instant `seen`.
    fn judge(&mut self, mcu: &mut Mcu, level: bool, at: Clock, seen: Clock) -> Result<Next, Shutdown> {
        let Some(homing) = &mut self.homing else { return Ok(Next::Done) };
        let confirming = homing.wanted < homing.sample_count;
        if level != homing.pin_value {
            homing.wanted = homing.sample_count;
            return Ok(Next::At(if confirming { self.next_wake } else { at + homing.rest_ticks }));
        }
        if !confirming {
            self.next_wake = seen + homing.rest_ticks;
        }
        homing.wanted -= 1;
        if homing.wanted > 0 {
            return Ok(Next::At(at + homing.sample_ticks));
        }
        let Homing { trsync, trigger_reason, .. } = *homing;
        mcu.with::<Trsync, _>(trsync, |object, mcu| object.trigger(mcu, trsync, trigger_reason))?;
        Ok(Next::Done)
    }

    fn query(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        match self.pin.read(mcu, Self::ticket(oid))? {
            Some(level) => self.report(mcu, oid, level),
            None => self.asked = Some(mcu.hold(oid)),
        }
        Ok(())
    }

    /// Answers the query that waits, with nothing in a stopped machine whose chip fails.
    fn answer(&mut self, mcu: &mut Mcu, oid: Oid, level: Option<bool>) {
        let Some(held) = self.asked.take() else { return };
        if let Some(level) = level {
            self.report(mcu, oid, level);
        }
        if held {
            mcu.release();
        }
    }

    fn report(&self, mcu: &mut Mcu, oid: Oid, pin_value: bool) {
        mcu.send(State { oid, homing: self.homing.is_some(), next_clock: self.next_wake, pin_value });
    }
}

impl Object for Endstop {
    fn kind(&self) -> &'static str {
        "endstop"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        if self.due.is_some() {
            self.pin.awaited(mcu)?;
            return Ok(Next::At(at + UNREAD_LIMIT));
        }
        self.sample(mcu, oid, at)
    }

    /// The chip's worker has looked.
    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let (began, ended) = (done.began, done.ended);
        let is_homing = self.due.is_some();
        let level = if is_homing { self.pin.seen(mcu, done)? } else { self.pin.sampled(mcu, done)? };
        match level {
            // A query is answered with a level that was seen.
            None if self.asked.is_some() && !mcu.is_shutdown() => self.pin.read(mcu, Self::ticket(oid)).map(drop)?,
            _ => self.answer(mcu, oid, level),
        }
        let (Some(at), Some(level)) = (self.due.take(), level) else { return Ok(()) };
        mcu.cancel(TimerId::new(oid, 0));
        // The worker may have looked for a query, before the sample was due: then it looks again.
        let next = if began < at { self.sample(mcu, oid, at)? } else { self.judge(mcu, level, at, ended)? };
        if let Next::At(at) = next {
            let now = mcu.now();
            mcu.go_on(TimerId::new(oid, 0), at.max(now));
        }
        Ok(())
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.due = None;
    }
}

const CONFIG_ENDSTOP: Command =
    command!("config_endstop oid=%c pin=%c pull_up=%c", |mcu, oid: Oid, pin: Pin, pull_up: i8| {
        mcu.vacant(oid)?;
        let input = mcu.input(pin, bias(pull_up))?;
        let endstop = Endstop { pin: input, homing: None, next_wake: Clock::EPOCH, due: None, asked: None };
        mcu.assign_on(pin, oid, endstop)
    });

const ENDSTOP_HOME: Command = command!(
    "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c trsync_oid=%c trigger_reason=%c",
    |mcu,
     oid: Oid,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     pin_value: bool,
     trsync_oid: Oid,
     trigger_reason: u8| {
        let at = mcu.instant(clock);
        mcu.with::<Endstop, _>(oid, |endstop, mcu| {
            mcu.cancel(TimerId::new(oid, 0));
            endstop.homing = None;
            endstop.due = None;
            if sample_count == 0 {
                return Ok(());
            }
            mcu.with::<Trsync, _>(trsync_oid, |_, _| Ok(()))?;
            endstop.homing = Some(Homing {
                sample_ticks,
                sample_count,
                rest_ticks,
                pin_value,
                trsync: trsync_oid,
                trigger_reason,
                wanted: sample_count,
            });
            mcu.schedule(TimerId::new(oid, 0), at)
        })
    }
);

const ENDSTOP_QUERY_STATE: Command = command!("endstop_query_state oid=%c", |mcu, oid: Oid| {
    mcu.with::<Endstop, _>(oid, |endstop, mcu| endstop.query(mcu, oid))
});
