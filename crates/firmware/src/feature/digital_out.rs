// SPDX-License-Identifier: GPL-3.0-or-later
//! Digital outputs: queued changes, software PWM, and `max_duration`. `max_duration` limits how long an output may
//! differ from its shutdown value without news from the host.

use crate::board::Pin;
use crate::mcu::{
    Command, Context, Feature, MoveQueue, Next, Object, Oid, OutputLine, Report, Timer, WireClock, command,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Clock, Ticks};

use super::{changes_too_late, not_refreshed, set_too_late};

pub(super) const FEATURE: Feature = Feature {
    serves: "output pins",

    commands: &[CONFIG_DIGITAL_OUT, SET_DIGITAL_OUT_PWM_CYCLE, QUEUE_DIGITAL_OUT, UPDATE_DIGITAL_OUT, SET_DIGITAL_OUT],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `update_digital_out` while changes are queued.
    UPDATE_WITH_QUEUE = "update_digital_out not valid with active queue";
    /// An output would stay on for longer than its `max_duration`.
    DIGITAL_MAX_DURATION = "Scheduled digital out event will exceed max_duration";
    /// `set_digital_out_pwm_cycle` while changes are queued.
    PWM_CYCLE_WITH_QUEUE = "Can not set soft pwm cycle ticks while updates pending";
    /// The host did not refresh an output before its `max_duration` ran out.
    MISSED_DIGITAL = "Missed scheduling of next digital out event";
}

const TIMER: Timer = Timer::exact(0);

struct Move {
    at: Clock,
    on_ticks: Ticks,
}

/// The next event of the output's timer.
enum Phase {
    /// Applies the next change of the queue.
    Load,
    /// Toggles the pin.
    Toggle,
}

const KIND: &str = "digital output";

struct DigitalOut {
    line: OutputLine,
    max_duration: Ticks,
    cycle: Ticks,
    queue: MoveQueue<Move>,
    phase: Phase,
    /// Whether software PWM pulses the pin.
    toggling: bool,
    on: bool,
    on_ticks: Ticks,
    off_ticks: Ticks,
    /// When the timer runs next, if it is running.
    wake: Clock,
    /// When the current state ends: at the next change, or when `max_duration` runs out.
    end: Option<Clock>,
}

impl DigitalOut {
    /// Applies the oldest change of the queue, which was due at `at`.
    fn load(&mut self, context: &mut Context, at: Clock) -> Result<Next, Shutdown> {
        let Some(Move { on_ticks, .. }) = self.queue.pop(context.moves()) else {
            return Err(not_refreshed(MISSED_DIGITAL, self.max_duration).late_for(at));
        };
        let on = on_ticks.0 != 0;
        self.line.write(context, on)?;
        self.on = on;
        self.toggling = on && on_ticks < self.cycle;
        let limited = self.max_duration.0 != 0 && (self.toggling || on != self.line.shutdown_value(context));
        self.end = limited.then(|| at + self.max_duration);
        if let Some(next) = self.queue.first() {
            if self.end.is_some_and(|end| end < next.at) {
                return Err(changes_too_late(DIGITAL_MAX_DURATION, self.max_duration));
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

    /// Makes the edge of a pulse, which was due at `at`.
    fn toggle(&mut self, context: &mut Context, at: Clock) -> Result<Next, Shutdown> {
        self.line.write(context, !self.on)?;
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

    fn queue(&mut self, context: &mut Context, at: Clock, on_ticks: Ticks) -> Result<(), Shutdown> {
        let first = self.queue.is_empty();
        self.queue.push(context.moves(), Move { at, on_ticks })?;
        if !first {
            return Ok(());
        }
        if self.end.is_some_and(|end| end < at) {
            return Err(changes_too_late(DIGITAL_MAX_DURATION, self.max_duration));
        }
        self.end = Some(at);
        if self.toggling && self.wake < at {
            // `toggle` sees the new end and loads the change then.
            return Ok(());
        }
        context.cancel(TIMER);
        self.phase = Phase::Load;
        self.wake = at;
        context.schedule(TIMER, at)
    }

    fn update(&mut self, context: &mut Context, value: bool) -> Result<(), Shutdown> {
        if !self.queue.is_empty() {
            return Err(Shutdown::by_host(UPDATE_WITH_QUEUE, "update_digital_out came while changes are queued"));
        }
        context.cancel(TIMER);
        self.line.write(context, value)?;
        self.on = value;
        self.toggling = false;
        self.end = None;
        if value != self.line.shutdown_value(context) && self.max_duration.0 != 0 {
            let end = context.now() + self.max_duration;
            self.end = Some(end);
            self.phase = Phase::Load;
            self.wake = end;
            context.schedule(TIMER, end)?;
        }
        Ok(())
    }
}

impl Object for DigitalOut {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        match self.phase {
            Phase::Load => self.load(context, at),
            Phase::Toggle => self.toggle(context, at),
        }
    }

    fn report(&self) -> Report {
        Report { queued: self.queue.len(), ..Report::default() }
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.on = self.line.shutdown_value(context);
        self.toggling = false;
        self.end = None;
        self.queue.clear(context.moves());
    }
}

/// The lines that `set_digital_out` has set. They belong to no object of the host. They keep their levels even when the
/// MCU stops.
#[derive(Default)]
struct SetLines(Vec<(Pin, OutputLine)>);

impl SetLines {
    /// Drives a line. The line stays claimed.
    ///
    /// Klipper's C allows this at any time. Here it works at any time for a line that is already claimed. A new line
    /// is refused after `finalize_config`. To claim it, the core would have to open files and wait for the guardian,
    /// and steps would wait too. klippy sets its lines before that.
    ///
    /// # Errors
    ///
    /// "Unable to open out GPIO chip line" for a line that is refused, or for the 257th line; the errors of
    /// [`Context::kept_output`]; "GPIO line write failed".
    fn set(&mut self, context: &mut Context, pin: Pin, value: bool) -> Result<(), Shutdown> {
        let known = self.0.iter().position(|(held, _)| *held == pin);
        match known {
            Some(place) if context.is_finalized() => self.0[place].1.write(context, value),
            _ if context.is_finalized() => Err(set_too_late(context, reason::OUTPUT_LINE, "set_digital_out", pin)),
            // Claim the line again, so that the guardian learns the new level.
            Some(place) => {
                self.0[place].1 = context.kept_output(pin, value)?;
                Ok(())
            }
            None if self.0.len() > usize::from(u8::MAX) => {
                Err(Shutdown::by_host(reason::OUTPUT_LINE, "set_digital_out wants more than 256 lines"))
            }
            None => {
                self.0.push((pin, context.kept_output(pin, value)?));
                Ok(())
            }
        }
    }
}

impl Object for SetLines {
    fn kind(&self) -> &'static str {
        "set_digital_out"
    }
}

const CONFIG_DIGITAL_OUT: Command = command!(
    "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u",
    |context, oid: Oid, pin: Pin, value: bool, default_value: bool, max_duration: Ticks| {
        context.vacant(oid)?;
        let line = context.output(pin, value, default_value)?;
        let output = DigitalOut {
            line,
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
        context.assign_on(pin, oid, output)
    }
);

const SET_DIGITAL_OUT_PWM_CYCLE: Command =
    command!("set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", DigitalOut, |output, _, cycle_ticks: Ticks| {
        if !output.queue.is_empty() {
            return Err(Shutdown::by_host(
                PWM_CYCLE_WITH_QUEUE,
                "set_digital_out_pwm_cycle came while changes are queued",
            ));
        }
        output.cycle = cycle_ticks;
        Ok(())
    });

const QUEUE_DIGITAL_OUT: Command = command!(
    "queue_digital_out oid=%c clock=%u on_ticks=%u",
    DigitalOut,
    |output, context, clock: WireClock, on_ticks: Ticks| {
        let at = context.instant(clock);
        output.queue(context, at, on_ticks)
    }
);

const UPDATE_DIGITAL_OUT: Command =
    command!("update_digital_out oid=%c value=%c", DigitalOut, |output, context, value: bool| output
        .update(context, value));

const SET_DIGITAL_OUT: Command = command!("set_digital_out pin=%u value=%c", |context, pin: Pin, value: bool| {
    let oid = context.own::<SetLines>();
    context.with::<SetLines, _>(oid, |lines, context| lines.set(context, pin, value))
});
