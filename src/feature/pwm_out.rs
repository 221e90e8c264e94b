// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM outputs: queued values, and a limit to how long the host may be silent.

#![forbid(unsafe_code)]

use crate::board::{Buffer, Pin, PwmConfig};
use crate::mcu::{
    Command, Constant, DeviceId, Feature, Mcu, MoveQueue, Next, Object, Oid, Ticket, TimerId, WireClock, command,
};
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, Ticks};

use super::{changes_too_late, not_refreshed};

pub(super) const FEATURE: Feature = Feature {
    name: "pwm_out",
    commands: &[CONFIG_PWM_OUT, QUEUE_PWM_OUT, SET_PWM_OUT],
    responses: &[],
    constants: &[("PWM_MAX", Constant::Number(32768))],
};

struct Move {
    at: Clock,
    value: u16,
}

struct PwmOut {
    device: DeviceId,
    default_value: u16,
    max_duration: Ticks,
    queue: MoveQueue<Move>,
    /// When the host must have sent another value.
    end: Option<Clock>,
}

impl PwmOut {
    fn timer(oid: Oid) -> TimerId {
        TimerId::new(oid, 0)
    }

    fn write(&self, mcu: &mut Mcu, oid: Oid, value: u16) -> Result<(), Shutdown> {
        mcu.submit(self.device, Ticket { oid, tag: 0 }, Buffer::new(&value.to_le_bytes()))
    }

    fn queue(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock, value: u16) -> Result<(), Shutdown> {
        let first = self.queue.is_empty();
        self.queue.push(&mut mcu.moves, Move { at, value })?;
        if !first {
            return Ok(());
        }
        if self.end.take().is_some_and(|end| end < at) {
            return Err(changes_too_late(Reason::PwmMaxDuration, self.max_duration));
        }
        mcu.cancel(Self::timer(oid));
        mcu.schedule(Self::timer(oid), at)
    }
}

impl Object for PwmOut {
    fn kind(&self) -> &'static str {
        "PWM output"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        let Some(Move { value, .. }) = self.queue.pop(&mut mcu.moves) else {
            return Err(not_refreshed(Reason::MissedPwm, self.max_duration));
        };
        self.write(mcu, oid, value)?;
        let limited = value != self.default_value && self.max_duration.0 != 0;
        let end = limited.then(|| at + self.max_duration);
        let Some(next) = self.queue.first().map(|next| next.at) else {
            self.end = end;
            return Ok(end.map_or(Next::Done, Next::At));
        };
        if end.is_some_and(|end| end < next) {
            return Err(changes_too_late(Reason::PwmMaxDuration, self.max_duration));
        }
        Ok(Next::At(next))
    }

    fn completed(&mut self, mcu: &mut Mcu, _ticket: Ticket, result: Result<Buffer, Shutdown>) -> Result<(), Shutdown> {
        result.map(drop).or_else(|shutdown| mcu.device_failed(shutdown))
    }

    fn shutdown(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        self.end = None;
        self.queue.clear(&mut mcu.moves);
        self.write(mcu, oid, self.default_value)
    }
}

const CONFIG_PWM_OUT: Command = command!(
    "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    |mcu, oid: Oid, pin: Pin, cycle_ticks: Ticks, value: u16, default_value: u16, max_duration: Ticks| {
        mcu.vacant(oid)?;
        let config = PwmConfig { pin, cycle: cycle_ticks, value, shutdown_value: default_value };
        let device = mcu.pwm(oid, config)?;
        mcu.assign_on(pin, oid, PwmOut { device, default_value, max_duration, queue: MoveQueue::default(), end: None })
    }
);

const QUEUE_PWM_OUT: Command =
    command!("queue_pwm_out oid=%c clock=%u value=%hu", |mcu, oid: Oid, clock: WireClock, value: u16| {
        let at = mcu.instant(clock);
        mcu.with::<PwmOut, _>(oid, |output, mcu| output.queue(mcu, oid, at, value))
    });

const SET_PWM_OUT: Command =
    command!("set_pwm_out pin=%u cycle_ticks=%u value=%hu", |mcu, pin: Pin, cycle_ticks: Ticks, value: u16| {
        mcu.set_pwm(PwmConfig { pin, cycle: cycle_ticks, value, shutdown_value: value })
    });
