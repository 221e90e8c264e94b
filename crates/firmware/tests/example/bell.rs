// SPDX-License-Identifier: GPL-3.0-or-later
//! Bells: struck at an instant.

use crate::board::Pin;
use crate::mcu::{
    Command, Context, Feature, Next, Object, Oid, OutputLine, Response, Timer, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

pub(super) const FEATURE: Feature =
    Feature { commands: &[CONFIG_BELL, RING_BELL], responses: &[Rung::FORM], shutdowns: SHUTDOWNS, ..Feature::EMPTY };

shutdowns! {
    /// `ring_bell` while the bell still swings.
    STILL_SWINGING = "Bell is still swinging";
}

response! {
    /// The bell was struck.
    "bell_rung oid=%c clock=%u"
    pub(super) struct Rung { oid: Oid, clock: Clock }
}

const TIMER: Timer = Timer::exact(0);
/// How long the line is high.
const STRIKE: Ticks = Ticks::from_us(20_000);
const KIND: &str = "bell";

struct Bell {
    line: OutputLine,
    swinging: bool,
    struck: bool,
}

const CONFIG_BELL: Command = command!("config_bell oid=%c pin=%u", |context, oid: Oid, pin: Pin| {
    context.vacant(oid)?;
    let line = context.output(pin, false, false)?;
    context.assign_on(pin, oid, Bell { line, swinging: false, struck: false })
});

const RING_BELL: Command = command!("ring_bell oid=%c clock=%u", Bell, |bell, context, clock: WireClock| {
    let at = context.instant(clock);
    bell.ring(context, at)
});

impl Bell {
    fn ring(&mut self, context: &mut Context, at: Clock) -> Result<(), Shutdown> {
        if self.swinging {
            return Err(Shutdown::by_host(STILL_SWINGING, "ring_bell came too soon"));
        }
        self.swinging = true;
        context.schedule(TIMER, at)
    }
}

impl Object for Bell {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        self.struck = !self.struck;
        self.line.write(context, self.struck)?;
        if self.struck {
            context.send(Rung { oid: context.oid(), clock: at });
            return Ok(Next::At(at + STRIKE));
        }
        self.swinging = false;
        Ok(Next::Done)
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.swinging = false;
        self.struck = false;
    }
}
