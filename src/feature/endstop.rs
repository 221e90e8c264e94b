// SPDX-License-Identifier: GPL-3.0-or-later
//! Endstops: sample a pin, confirm, trigger a trsync.

#![forbid(unsafe_code)]

use crate::board::{Bias, Input, Pin};
use crate::mcu::{Command, Feature, Mcu, Next, Object, Oid, Response, TimerId, WireClock, command, response};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    name: "endstop",
    commands: &[CONFIG_ENDSTOP, ENDSTOP_HOME, ENDSTOP_QUERY_STATE],
    responses: &[State::FORMAT],
    constants: &[],
};

response! {
    /// Where the endstop stands.
    "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c"
    pub(super) struct State { oid: Oid, homing: bool, next_clock: Clock, pin_value: bool }
}

struct Endstop {
    pin: Box<dyn Input>,
    /// What the host asked for last; a trigger leaves it, so that it can ask when it came.
    homing: Option<Homing>,
    /// The search after the samples of the last match.
    next_wake: Clock,
}

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

impl Object for Endstop {
    fn kind(&self) -> &'static str {
        "endstop"
    }

    fn event(&mut self, mcu: &mut Mcu, _timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(homing) = &mut self.homing else { return Ok(Next::Done) };
        let confirming = homing.wanted < homing.sample_count;
        if self.pin.read()? != homing.pin_value {
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
}

const CONFIG_ENDSTOP: Command =
    command!("config_endstop oid=%c pin=%c pull_up=%c", |mcu, oid: Oid, pin: Pin, pull_up: i8| {
        mcu.vacant(oid)?;
        let bias = match pull_up {
            1.. => Bias::PullUp,
            0 => Bias::None,
            _ => Bias::PullDown,
        };
        let input = mcu.board.input(pin, bias)?;
        mcu.assign_on(pin, oid, Endstop { pin: input, homing: None, next_wake: Clock::EPOCH })
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
    mcu.with::<Endstop, _>(oid, |endstop, mcu| {
        let pin_value = endstop.pin.read()?;
        let state = State { oid, homing: endstop.homing.is_some(), next_clock: endstop.next_wake, pin_value };
        mcu.send(state);
        Ok(())
    })
});
