// SPDX-License-Identifier: GPL-3.0-or-later
//! Trsync: a trigger that stops several steppers at once, with a timeout and reports.

use crate::mcu::{Command, Context, Feature, Next, Object, Oid, Response, Timer, WireClock, command, response};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

pub(super) const FEATURE: Feature = Feature {
    serves: "homing",

    commands: &[CONFIG_TRSYNC, TRSYNC_START, TRSYNC_SET_TIMEOUT, TRSYNC_TRIGGER],
    responses: &[State::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `stepper_stop_on_trigger` for a stepper that already waits for a trigger.
    SIGNAL_ACTIVE = "Can't add signal that is already active";
}

response! {
    /// Whether the trigger can still be pulled, and if not, why it was pulled.
    "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u"
    pub(super) struct State { oid: Oid, can_trigger: bool, trigger_reason: u8, clock: Clock }
}

pub(super) struct Trsync {
    can_trigger: bool,
    report_ticks: Ticks,
    trigger_reason: u8,
    expire_reason: u8,
    /// The objects that wait for the trigger.
    signals: Vec<Oid>,
}

/// Room for the waiting objects, made at configuration. It is always enough: there are no more objects, and none waits
/// for two triggers.
const SIGNALS_MAX: usize = 256;

const REPORT: Timer = Timer::exact(0);
const EXPIRE: Timer = Timer::exact(1);

impl Trsync {
    /// Pulls the trigger, unless it was pulled before. Calls every waiting object, and reports to the host.
    pub(super) fn trigger(&mut self, context: &mut Context, reason: u8) -> Result<(), Shutdown> {
        if self.pull(context, reason)? {
            self.report(context);
        }
        Ok(())
    }

    /// Pulls the trigger without a report to the host. False if it was pulled before.
    fn pull(&mut self, context: &mut Context, reason: u8) -> Result<bool, Shutdown> {
        let pulled = std::mem::take(&mut self.can_trigger);
        if pulled {
            self.trigger_reason = reason;
            while let Some(signal) = self.signals.pop() {
                context.trigger(signal)?;
            }
        }
        Ok(pulled)
    }

    fn report(&self, context: &mut Context) {
        let clock = context.now();
        context.send(State {
            oid: context.oid(),
            can_trigger: self.can_trigger,
            trigger_reason: self.trigger_reason,
            clock,
        });
    }

    /// Adds the object of this context to the objects that wait for the trigger.
    ///
    /// # Errors
    ///
    /// "Can't add signal that is already active" if it waits for one already, "Invalid oid type".
    pub(super) fn add_signal(context: &mut Context, trsync: Oid) -> Result<(), Shutdown> {
        let waiting = context.oid();
        if context.any::<Trsync>(|trsync| trsync.signals.contains(&waiting)) {
            return Err(Shutdown::by_host(SIGNAL_ACTIVE, "it already waits for a trigger"));
        }
        context.with::<Trsync, _>(trsync, |trsync, _| {
            trsync.signals.push(waiting);
            Ok(())
        })
    }

    /// Whether this trsync can still be triggered, and the object of this context waits for it.
    pub(super) fn may_stop(context: &mut Context, trsync: Oid) -> bool {
        let waiting = context.oid();
        let may = |trsync: &mut Trsync, _: &mut Context| Ok(trsync.can_trigger && trsync.signals.contains(&waiting));
        context.with::<Trsync, _>(trsync, may).unwrap_or(false)
    }

    fn clear(&mut self, context: &mut Context) {
        context.cancel(REPORT);
        context.cancel(EXPIRE);
        self.signals.clear();
        self.can_trigger = false;
        self.trigger_reason = 0;
        self.expire_reason = 0;
    }
}

impl Object for Trsync {
    fn kind(&self) -> &'static str {
        "trsync"
    }

    fn event(&mut self, context: &mut Context, timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if timer == EXPIRE {
            self.trigger(context, self.expire_reason)?;
            return Ok(Next::Done);
        }
        self.report(context);
        Ok(Next::At(at + self.report_ticks))
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.clear(context);
    }
}

const CONFIG_TRSYNC: Command = command!("config_trsync oid=%c", |context, oid: Oid| {
    let trsync = Trsync {
        can_trigger: false,
        report_ticks: Ticks(0),
        trigger_reason: 0,
        expire_reason: 0,
        signals: Vec::with_capacity(SIGNALS_MAX),
    };
    context.assign(oid, trsync)
});

const TRSYNC_START: Command = command!(
    "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c",
    Trsync,
    |trsync, context, report_clock: WireClock, report_ticks: Ticks, expire_reason: u8| {
        let report_at = context.instant(report_clock);
        trsync.clear(context);
        trsync.can_trigger = true;
        trsync.report_ticks = report_ticks;
        trsync.expire_reason = expire_reason;
        match report_ticks {
            Ticks(0) => Ok(()),
            _ => context.schedule(REPORT, report_at),
        }
    }
);

const TRSYNC_SET_TIMEOUT: Command =
    command!("trsync_set_timeout oid=%c clock=%u", Trsync, |trsync, context, clock: WireClock| {
        let expire_at = context.instant(clock);
        if !trsync.can_trigger {
            return Ok(());
        }
        context.cancel(EXPIRE);
        context.schedule(EXPIRE, expire_at)
    });

const TRSYNC_TRIGGER: Command = command!("trsync_trigger oid=%c reason=%c", Trsync, |trsync, context, reason: u8| {
    trsync.pull(context, reason)?;
    context.cancel(REPORT);
    context.cancel(EXPIRE);
    let trigger_reason = trsync.trigger_reason;
    // The host itself pulled the trigger and does not need to know when. The clock is 0, as in Klipper's C.
    context.send(State { oid: context.oid(), can_trigger: false, trigger_reason, clock: Clock::EPOCH });
    Ok(())
});
