// SPDX-License-Identifier: GPL-3.0-or-later
//! Digital outputs: queued changes, software PWM, and a limit to how long the host may be
//! silent while the output is not at its shutdown value.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{Command, Feature, Line, Mcu, MoveQueue, Next, Object, Oid, TimerId, WireClock, command};
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, Ticks};

use super::{changes_too_late, not_refreshed};

pub(super) const FEATURE: Feature = Feature {
    name: "digital_out",
    commands: &[CONFIG_DIGITAL_OUT, SET_DIGITAL_OUT_PWM_CYCLE, QUEUE_DIGITAL_OUT, UPDATE_DIGITAL_OUT, SET_DIGITAL_OUT],
    responses: &[],
    constants: &[],
};

struct Move {
    at: Clock,
    on_ticks: Ticks,
}

/// What the timer does next.
enum Phase {
    /// Loads the next move.
    Load,
    /// Toggles the pin.
    Toggle,
}

struct DigitalOut {
    line: Line,
    default: bool,
    max_duration: Ticks,
    cycle: Ticks,
    queue: MoveQueue<Move>,
    phase: Phase,
    /// Whether the pin is being pulsed.
    toggling: bool,
    on: bool,
    on_ticks: Ticks,
    off_ticks: Ticks,
    /// When the timer runs next, while it runs.
    wake: Clock,
    /// When the present state must end: the next move, or the limit of `max_duration`.
    end: Option<Clock>,
}

impl DigitalOut {
    fn timer(oid: Oid) -> TimerId {
        TimerId::new(oid, 0)
    }

    /// Applies the oldest move, due at `at`.
    fn load(&mut self, mcu: &mut Mcu, at: Clock) -> Result<Next, Shutdown> {
        let Some(Move { on_ticks, .. }) = self.queue.pop(&mut mcu.moves) else {
            return Err(not_refreshed(Reason::MissedDigital, self.max_duration));
        };
        let on = on_ticks.0 != 0;
        self.line.write(on)?;
        self.on = on;
        self.toggling = on && on_ticks < self.cycle;
        let limited = self.max_duration.0 != 0 && (self.toggling || on != self.default);
        self.end = limited.then(|| at + self.max_duration);
        if let Some(next) = self.queue.first() {
            if self.end.is_some_and(|end| end < next.at) {
                return Err(changes_too_late(Reason::DigitalMaxDuration, self.max_duration));
            }
            self.end = Some(next.at);
        }
        self.phase = Phase::Load;
        if !self.toggling {
            return Ok(self.wake_at(self.end));
        }
        let off_at = at + on_ticks;
        if let Some(end) = self.end
            && off_at >= end
        {
            return Ok(self.wake_at(Some(end)));
        }
        self.phase = Phase::Toggle;
        self.on_ticks = on_ticks;
        self.off_ticks = Ticks(self.cycle.0 - on_ticks.0);
        Ok(self.wake_at(Some(off_at)))
    }

    /// Pulses the pin, due at `at`.
    fn toggle(&mut self, at: Clock) -> Result<Next, Shutdown> {
        self.line.toggle()?;
        self.on = !self.on;
        let mut next = at + if self.on { self.on_ticks } else { self.off_ticks };
        if let Some(end) = self.end
            && next >= end
        {
            self.phase = Phase::Load;
            next = end;
        }
        Ok(self.wake_at(Some(next)))
    }

    fn wake_at(&mut self, at: Option<Clock>) -> Next {
        match at {
            Some(at) => {
                self.wake = at;
                Next::At(at)
            }
            None => Next::Done,
        }
    }

    fn queue(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock, on_ticks: Ticks) -> Result<(), Shutdown> {
        let first = self.queue.is_empty();
        self.queue.push(&mut mcu.moves, Move { at, on_ticks })?;
        if !first {
            return Ok(());
        }
        if self.end.is_some_and(|end| end < at) {
            return Err(changes_too_late(Reason::DigitalMaxDuration, self.max_duration));
        }
        self.end = Some(at);
        if self.toggling && self.wake < at {
            // The pulses end in a load by themselves.
            return Ok(());
        }
        mcu.cancel(Self::timer(oid));
        self.phase = Phase::Load;
        self.wake = at;
        mcu.schedule(Self::timer(oid), at)
    }

    fn update(&mut self, mcu: &mut Mcu, oid: Oid, value: bool) -> Result<(), Shutdown> {
        mcu.cancel(Self::timer(oid));
        if !self.queue.is_empty() {
            return Err(Shutdown::by_host(Reason::UpdateWithQueue, "update_digital_out came while changes are queued"));
        }
        self.line.write(value)?;
        self.on = value;
        self.toggling = false;
        self.end = None;
        if value != self.default && self.max_duration.0 != 0 {
            let end = mcu.now() + self.max_duration;
            self.end = Some(end);
            self.phase = Phase::Load;
            self.wake = end;
            mcu.schedule(Self::timer(oid), end)?;
        }
        Ok(())
    }
}

impl Object for DigitalOut {
    fn kind(&self) -> &'static str {
        "digital output"
    }

    fn event(&mut self, mcu: &mut Mcu, _timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        match self.phase {
            Phase::Load => self.load(mcu, at),
            Phase::Toggle => self.toggle(at),
        }
    }

    fn shutdown(&mut self, mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        self.on = self.default;
        self.toggling = false;
        self.end = None;
        self.queue.clear(&mut mcu.moves);
        self.line.write(self.default)
    }
}

const CONFIG_DIGITAL_OUT: Command = command!(
    "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u",
    |mcu, oid: Oid, pin: Pin, value: bool, default_value: bool, max_duration: Ticks| {
        mcu.vacant(oid)?;
        let line = mcu.output(pin, value, default_value)?;
        let output = DigitalOut {
            line,
            default: default_value,
            max_duration,
            cycle: Ticks(0),
            queue: MoveQueue::default(),
            phase: Phase::Load,
            toggling: false,
            on: value,
            on_ticks: Ticks(0),
            off_ticks: Ticks(0),
            wake: Clock::EPOCH,
            end: None,
        };
        mcu.assign_on(pin, oid, output)
    }
);

const SET_DIGITAL_OUT_PWM_CYCLE: Command =
    command!("set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", |mcu, oid: Oid, cycle_ticks: Ticks| {
        mcu.with::<DigitalOut, _>(oid, |output, _| {
            if !output.queue.is_empty() {
                return Err(Shutdown::by_host(
                    Reason::PwmCycleWithQueue,
                    "set_digital_out_pwm_cycle came while changes are queued",
                ));
            }
            output.cycle = cycle_ticks;
            Ok(())
        })
    });

const QUEUE_DIGITAL_OUT: Command =
    command!("queue_digital_out oid=%c clock=%u on_ticks=%u", |mcu, oid: Oid, clock: WireClock, on_ticks: Ticks| {
        let at = mcu.instant(clock);
        mcu.with::<DigitalOut, _>(oid, |output, mcu| output.queue(mcu, oid, at, on_ticks))
    });

const UPDATE_DIGITAL_OUT: Command = command!("update_digital_out oid=%c value=%c", |mcu, oid: Oid, value: bool| {
    mcu.with::<DigitalOut, _>(oid, |output, mcu| output.update(mcu, oid, value))
});

const SET_DIGITAL_OUT: Command =
    command!("set_digital_out pin=%u value=%c", |mcu, pin: Pin, value: bool| mcu.set_line(pin, value));
