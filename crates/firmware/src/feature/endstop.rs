// SPDX-License-Identifier: GPL-3.0-or-later
//! Endstops: a pin is sampled until it has a level several times in a row. Then a trsync is triggered.

use crate::board::Pin;
use crate::mcu::{
    Command, Context, Feature, Finished, Hold, InputLine, Next, Object, Oid, Response, Sample, Timer, UNREAD_LIMIT,
    WireClock, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::bias;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    serves: "endstops",

    commands: &[CONFIG_ENDSTOP, ENDSTOP_HOME, ENDSTOP_QUERY_STATE],
    responses: &[State::FORM],
    ..Feature::EMPTY
};

response! {
    /// The endstop's level, and whether the MCU still samples it.
    "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c"
    pub(super) struct State { oid: Oid, homing: bool, next_clock: Clock, pin_value: bool }
}

const TIMER: Timer = Timer::exact(0);

struct Endstop {
    pin: InputLine,
    /// The last `endstop_home`. It stays after the trigger, so that `endstop_query_state` can still report the
    /// trigger's time.
    homing: Option<Homing>,
    /// When sampling continues if the samples after the last match do not confirm it.
    next_wake: Clock,
    /// Due time of the sample that the chip's worker is taking. The timer checks until then that it does not take too
    /// long. `None`: the worker takes none.
    due: Option<Clock>,
    /// A query also waits for the worker to read the line. Further commands wait with it.
    asked: Option<Hold>,
}

#[derive(Clone, Copy)]
struct Homing {
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    pin_value: bool,
    trsync: Oid,
    trigger_reason: u8,
    /// How many matching samples are still needed. While confirming, there are fewer than `sample_count`.
    wanted: u8,
}

impl Endstop {
    /// Takes the sample that is due at `at`, or makes the chip's worker take it.
    fn sample(&mut self, context: &mut Context, at: Clock) -> Result<Next, Shutdown> {
        match self.pin.read(context)? {
            Some(level) => self.judge(context, level, at, at),
            None => {
                self.due = Some(at);
                Ok(Next::At(context.last_read() + UNREAD_LIMIT))
            }
        }
    }

    /// Decides on the next sample or the trigger. The sample was due at `at` and taken at `seen`.
    fn judge(&mut self, context: &mut Context, level: bool, at: Clock, seen: Clock) -> Result<Next, Shutdown> {
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
        context.with::<Trsync, _>(trsync, |trsync, context| trsync.trigger(context, trigger_reason))?;
        Ok(Next::Done)
    }

    fn query(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        match self.pin.read(context)? {
            Some(level) => self.report(context, level),
            None => self.asked = Some(context.hold()),
        }
        Ok(())
    }

    /// Answers the waiting query. There is no answer if the MCU is stopped and the chip fails.
    fn answer(&mut self, context: &mut Context, level: Option<bool>) {
        let Some(hold) = self.asked.take() else { return };
        if let Some(level) = level {
            self.report(context, level);
        }
        context.release(hold);
    }

    fn report(&self, context: &mut Context, pin_value: bool) {
        context.send(State {
            oid: context.oid(),
            homing: self.homing.is_some(),
            next_clock: self.next_wake,
            pin_value,
        });
    }
}

impl Object for Endstop {
    fn kind(&self) -> &'static str {
        "endstop"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if self.due.is_some() {
            self.pin.awaited(context)?;
            return Ok(Next::At(at + UNREAD_LIMIT));
        }
        self.sample(context, at)
    }

    /// The chip's worker has read the line.
    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let is_homing = self.due.is_some();
        let sample = if is_homing { self.pin.seen(context, finished) } else { self.pin.sampled(context, finished) };
        let Some(sample) = sample else { return Ok(()) };
        let Sample { level, began, ended } = sample?;
        match level {
            // A query needs a level, so the line is read again.
            None if self.asked.is_some() && !context.is_shutdown() => self.pin.read(context).map(drop)?,
            _ => self.answer(context, level),
        }
        let (Some(at), Some(level)) = (self.due.take(), level) else { return Ok(()) };
        context.cancel(TIMER);
        // The worker may have read the line for a query, before the sample was due. Then it reads again.
        let next = if began < at { self.sample(context, at)? } else { self.judge(context, level, at, ended)? };
        if let Next::At(at) = next {
            let now = context.now();
            context.go_on(TIMER, at.max(now));
        }
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.due = None;
    }
}

const CONFIG_ENDSTOP: Command =
    command!("config_endstop oid=%c pin=%c pull_up=%c", |context, oid: Oid, pin: Pin, pull_up: i8| {
        context.vacant(oid)?;
        let input = context.input(pin, bias(pull_up))?;
        let endstop = Endstop { pin: input, homing: None, next_wake: Clock::EPOCH, due: None, asked: None };
        context.assign_on(pin, oid, endstop)
    });

const ENDSTOP_HOME: Command = command!(
    "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c trsync_oid=%c trigger_reason=%c",
    Endstop,
    |endstop,
     context,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     pin_value: bool,
     trsync_oid: Oid,
     trigger_reason: u8| {
        let at = context.instant(clock);
        context.cancel(TIMER);
        endstop.homing = None;
        endstop.due = None;
        if sample_count == 0 {
            return Ok(());
        }
        context.require::<Trsync>(trsync_oid)?;
        endstop.homing = Some(Homing {
            sample_ticks,
            sample_count,
            rest_ticks,
            pin_value,
            trsync: trsync_oid,
            trigger_reason,
            wanted: sample_count,
        });
        context.schedule(TIMER, at)
    }
);

const ENDSTOP_QUERY_STATE: Command =
    command!("endstop_query_state oid=%c", Endstop, |endstop, context| endstop.query(context));
