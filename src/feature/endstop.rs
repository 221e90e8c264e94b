// SPDX-License-Identifier: GPL-3.0-or-later
//! Endstops: sample a pin, confirm, trigger a trsync.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{
    Command, Done, Feature, InputLine, Mcu, Next, Object, Oid, Response, Ticket, TimerId, WireClock, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::bias;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    name: "endstop",
    commands: &[CONFIG_ENDSTOP, ENDSTOP_HOME, ENDSTOP_QUERY_STATE],
    responses: &[State::FORMAT],
    ..Feature::EMPTY
};

response! {
    /// Where the endstop stands.
    "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c"
    pub(super) struct State { oid: Oid, homing: bool, next_clock: Clock, pin_value: bool }
}

struct Endstop {
    pin: InputLine,
    /// What the host asked for last; a trigger leaves it, so that it can ask when it came.
    homing: Option<Homing>,
    /// The search after the samples of the last match.
    next_wake: Clock,
    /// The sample that is due, while its chip's worker looks.
    due: Option<Clock>,
    /// Whether the host waits for that look, too, and with it the commands behind its query.
    asked: Option<Held>,
}

/// Whether commands wait.
type Held = bool;

#[derive(Clone, Copy)]
struct Homing {
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    pin_value: bool,
    trsync: Oid,
    trigger_reason: u8,
    /// The matching samples still wanted; below `sample_count` while confirming.
    wanted: u8,
}

impl Endstop {
    fn ticket(oid: Oid) -> Ticket {
        Ticket { oid, tag: 0 }
    }

    /// Takes the sample that is due at `at`, now or as soon as the chip's worker has looked.
    fn sample(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock) -> Result<Next, Shutdown> {
        match self.pin.read(mcu, Self::ticket(oid))? {
            Some(level) => self.judge(mcu, level, at),
            None => {
                self.due = Some(at);
                Ok(Next::Done)
            }
        }
    }

    /// Counts a sample of the instant `at`.
    fn judge(&mut self, mcu: &mut Mcu, level: bool, at: Clock) -> Result<Next, Shutdown> {
        let Some(homing) = &mut self.homing else { return Ok(Next::Done) };
        let confirming = homing.wanted < homing.sample_count;
        if level != homing.pin_value {
            homing.wanted = homing.sample_count;
            return Ok(Next::At(if confirming { self.next_wake } else { at + homing.rest_ticks }));
        }
        if !confirming {
            self.next_wake = at + homing.rest_ticks;
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
        self.sample(mcu, oid, at)
    }

    /// The chip's worker has looked.
    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let began = done.began;
        let level = self.pin.returned(done).or_else(|failure| mcu.try_shut_down(failure).map(|()| false))?;
        if let Some(held) = self.asked.take() {
            self.report(mcu, oid, level);
            if held {
                mcu.release();
            }
        }
        let Some(at) = self.due.take() else { return Ok(()) };
        // A look that was under way before the sample was due says nothing of it.
        let next = if began < at { self.sample(mcu, oid, at)? } else { self.judge(mcu, level, at)? };
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
