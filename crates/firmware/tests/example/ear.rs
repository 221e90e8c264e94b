// SPDX-License-Identifier: GPL-3.0-or-later
//! Ears: sensors on SPI that hear a bell.

use crate::board::BusError;
use crate::feature::spi::{Spi, spi_shutdown};
use crate::mcu::{
    Back, Chip, Command, Context, Feature, Finished, Job, JobSlot, Next, Object, Oid, Response, Timer, WireClock,
    command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

pub(super) const FEATURE: Feature =
    Feature { commands: &[CONFIG_EAR, QUERY_EAR], responses: &[Heard::FORM], ..Feature::EMPTY };

response! {
    /// The last sound.
    "ear_heard oid=%c loudness=%c"
    pub(super) struct Heard { oid: Oid, loudness: u8 }
}

const TIMER: Timer = Timer::sampling(0);

#[derive(Clone, Copy)]
enum Register {
    Loudness = 0x01,
}

/// The bit of a register's number that means reading.
const READ: u8 = 0x80;

struct Listen;

impl Job for Listen {
    type Device = Chip;
    /// The loudness.
    type Out = u8;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<u8, BusError> {
        let mut message = [READ | Register::Loudness as u8, 0];
        chip.exchange(&mut message)?;
        Ok(message[1])
    }
}

struct Ear {
    spi: Oid,
    listen: JobSlot<Listen>,
    rest_ticks: Ticks,
}

const CONFIG_EAR: Command = command!("config_ear oid=%c spi_oid=%c", |context, oid: Oid, spi_oid: Oid| {
    context.require::<Spi>(spi_oid)?;
    context.assign(oid, Ear { spi: spi_oid, listen: JobSlot::new(Listen), rest_ticks: Ticks(0) })
});

const QUERY_EAR: Command =
    command!("query_ear oid=%c clock=%u rest_ticks=%u", Ear, |ear, context, clock: WireClock, rest_ticks: Ticks| {
        let at = context.instant(clock);
        context.cancel(TIMER);
        ear.listen.drop_pending();
        ear.rest_ticks = rest_ticks;
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        context.schedule(TIMER, at)
    });

impl Object for Ear {
    fn kind(&self) -> &'static str {
        "ear"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if self.listen.is_here() {
            self.listen.send_to(context, self.spi)?;
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, is_wanted: true, .. }) = self.listen.back(finished) else { return Ok(()) };
        match result {
            Ok(loudness) => context.send(Heard { oid: context.oid(), loudness }),
            Err(error) => return context.try_shut_down(spi_shutdown(error.clone())),
        }
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.listen.drop_pending();
    }
}
