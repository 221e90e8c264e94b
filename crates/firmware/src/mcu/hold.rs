// SPDX-License-Identifier: GPL-3.0-or-later
//! One order: commands wait for the conversations that commands began.
//!
//! The firmware runs a command to its end before it looks at the next, and
//! acknowledges a block after its last command; klippy relies on both. So an errand that a
//! command sends *holds*: until it is back, the core runs no further command and leaves the block
//! unacknowledged ([`Mcu::is_held`]). Timers go on, and errands that they send hold nothing. A
//! stopped MCU is not held.
//!
//! A command that answers nothing (`spi_send`) lets others of its object join ([`Mcu::joins`]): their errands
//! follow its own on the same bus, in their order. Its block is done at once, and whatever else comes waits for the last of
//! them. So a display costs one wake-up for several messages.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, reason};
use crate::time::Ticks;

use pinion_protocol::vlq::Reader;

use super::{Mcu, Oid, TimerId, Turn};

/// How long commands may wait for an errand before the MCU stops. klippy, too, gives up waiting
/// for an answer after five seconds (`SerialRetryCommand` in serialhdl.py). Without this limit a bus
/// that hangs would keep the host from stopping the MCU: once its window of unacknowledged blocks
/// is full, it can not even send an `emergency_stop`.
const HOLD_LIMIT: Ticks = Ticks::from_ms(5000);

/// What commands wait for.
#[derive(Default)]
pub(super) struct Holds {
    /// Whether a command runs, or an errand that a command sent is taken in.
    pub(super) is_commanded: bool,
    /// Conversations that commands wait for.
    pub(super) count: u32,
    /// Whose the last one is.
    holder: Option<Oid>,
    /// How many conversations there may be in all, if the holder lets others join.
    join_limit: u32,
}

/// Commands wait until this is [released](Mcu::release). If no command has asked for it, none wait.
#[must_use]
pub struct Hold(pub(super) bool);

impl Turn<'_> {
    /// If a command runs now, makes further commands wait for this object until the hold is
    /// [released](Mcu::release).
    pub fn hold(&mut self) -> Hold {
        let holder = self.oid();
        let is_commanded = self.holds.is_commanded;
        if is_commanded {
            self.limit_hold();
            self.holds.count += 1;
            self.holds.holder = Some(holder);
            self.holds.join_limit = 0;
        }
        Hold(is_commanded)
    }

    /// To be called once the errand of a command was sent: commands of its kind that are for the same object need not wait
    /// for it, until `limit` errands are under way.
    pub fn let_join(&mut self, limit: u32) {
        self.holds.join_limit = limit;
    }
}

impl Mcu {
    /// Has the MCU stop if commands still wait in [`HOLD_LIMIT`].
    fn limit_hold(&mut self) {
        self.schedule.timers.remove(TimerId::HOLD);
        let limit = self.now() + HOLD_LIMIT;
        self.schedule.timers.insert(limit, TimerId::HOLD);
    }

    /// Lets commands run again, as far as this hold goes.
    pub fn release(&mut self, Hold(waits): Hold) {
        if !waits {
            return;
        }
        self.holds.count = self.holds.count.saturating_sub(1);
        if self.holds.count == 0 {
            self.schedule.timers.remove(TimerId::HOLD);
        } else if self.is_held() {
            self.limit_hold();
        }
    }

    /// Whether no further command may run now, as an errand that a command sent is under way, or a
    /// `config_reset` waits for the outputs.
    #[inline]
    pub fn is_held(&self) -> bool {
        self.holds.count > 0 && self.stop.reason.is_none() || self.configuration.reset_due
    }

    /// Whether the command that has begun last keeps its block: it is not acknowledged before commands may run again.
    #[inline]
    pub fn keeps_block(&self) -> bool {
        self.is_held() && (self.holds.join_limit == 0 || self.configuration.reset_due)
    }

    /// Whether a command may run though [others wait](Mcu::is_held): it is the first of this payload.
    pub fn joins(&self, payload: &[u8]) -> bool {
        if self.keeps_block() || self.holds.count >= self.holds.join_limit {
            return false;
        }
        let mut reader = Reader::new(payload);
        let command = reader.int().ok().and_then(|id| self.heard().command(id).ok());
        command.is_some_and(|command| command.joins)
            && reader.int().is_ok_and(|oid| self.holds.holder.is_some_and(|holder| holder.index() == oid as usize))
    }

    /// A stop is over. A conversation from before it holds commands again, and its limit may be over.
    pub(super) fn hold_again(&mut self) {
        if self.holds.count > 0 {
            self.limit_hold();
        }
    }

    /// The timer of [`HOLD_LIMIT`]: commands have waited too long for an errand.
    pub(super) fn held_too_long(&mut self) {
        if self.is_held() {
            let holder = self
                .holds
                .holder
                .and_then(|oid| Some((oid, self.configuration.objects.get(oid.index())?.as_ref()?.kind())));
            let what = holder.map_or_else(|| "a device".to_owned(), |(oid, kind)| self.name_object(kind, oid));
            let cause = format!("{what} has not answered for {} s", HOLD_LIMIT.0 / crate::time::CLOCK_FREQ);
            let stop = Shutdown::because(reason::BUS_HANGS, cause);
            self.shut_down(stop.remedy("does its bus or its driver hang (dmesg)?"));
        }
    }
}
