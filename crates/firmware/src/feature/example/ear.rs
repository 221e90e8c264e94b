// SPDX-License-Identifier: GPL-3.0-or-later
//! Ears: sensors on SPI that hear a bell.

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::feature::spi::{Spi, spi_shutdown};
use crate::mcu::{
    Back, Command, Conversation, Done, Feature, Next, Object, Oid, Response, Slot, Talk, Timer, Turn, WireClock,
    command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

pub(super) const FEATURE: Feature =
    Feature { commands: &[CONFIG_EAR, QUERY_EAR], responses: &[Heard::FORM], ..Feature::EMPTY };

response! {
    /// What the ear heard.
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

impl Talk for Listen {
    /// The loudness.
    type Answer = u8;

    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<u8, BusError> {
        let mut message = [READ | Register::Loudness as u8, 0];
        chip.exchange(&mut message)?;
        Ok(message[1])
    }
}

struct Ear {
    spi: Oid,
    listen: Slot<Conversation<Listen>>,
    rest_ticks: Ticks,
}

const CONFIG_EAR: Command = command!("config_ear oid=%c spi_oid=%c", |mcu, oid: Oid, spi_oid: Oid| {
    mcu.require::<Spi>(spi_oid)?;
    mcu.assign(oid, Ear { spi: spi_oid, listen: Slot::talking(Listen), rest_ticks: Ticks(0) })
});

const QUERY_EAR: Command =
    command!("query_ear oid=%c clock=%u rest_ticks=%u", Ear, |ear, turn, clock: WireClock, rest_ticks: Ticks| {
        let at = turn.instant(clock);
        turn.cancel(TIMER);
        ear.listen.drop_pending();
        ear.rest_ticks = rest_ticks;
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        turn.schedule(TIMER, at)
    });

impl Object for Ear {
    fn kind(&self) -> &'static str {
        "ear"
    }

    fn event(&mut self, turn: &mut Turn, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if self.listen.is_here() {
            self.listen.converse(turn, self.spi)?;
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        let Some(Back { result, counts: true, .. }) = self.listen.back(done) else { return Ok(()) };
        match result {
            Ok(loudness) => turn.send(Heard { oid: turn.oid(), loudness }),
            Err(error) => return turn.try_shut_down(spi_shutdown(error.clone())),
        }
        Ok(())
    }

    fn shutdown(&mut self, _turn: &mut Turn) {
        self.listen.drop_pending();
    }
}
