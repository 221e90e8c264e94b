// SPDX-License-Identifier: GPL-3.0-or-later
//! One order: commands wait for the conversations that commands began.
//!
//! The firmware runs a command to its end before it looks at the next one. It acknowledges a block after the block's
//! last command. klippy relies on both. So an errand that a command sends *holds*: the core runs no further command
//! until the errand is back, and does not acknowledge the block ([`Mcu::is_held`]). Timers go on, and errands that they
//! send hold nothing. A stopped MCU is not held.
//!
//! A command without an answer (`spi_send`) lets other commands to its object join ([`Mcu::may_run`]). Their errands
//! follow its own on the same bus, in their order. Its block is finished at once. All other commands wait for the last
//! of these errands. So a display costs one wake-up for several messages.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, reason};
use crate::time::Ticks;

use pinion_protocol::vlq::Reader;

use super::{Mcu, Oid, TimerId, Turn};

/// How long commands may wait for an errand before the MCU stops. klippy also gives up waiting for an answer after five
/// seconds (`SerialRetryCommand` in serialhdl.py). Without this limit, a bus that hangs would keep the host from
/// stopping the MCU. Once the host's window of unacknowledged blocks is full, the host cannot even send an
/// `emergency_stop`.
const HOLD_LIMIT: Ticks = Ticks::from_ms(5000);

/// The holds that make commands wait.
#[derive(Default)]
pub(super) struct Holds {
    /// Whether a command runs now, or the MCU takes back an errand that a command sent.
    pub(super) is_commanded: bool,
    /// Conversations that commands wait for.
    pub(super) count: u32,
    /// The object that began the last conversation.
    holder: Option<Oid>,
    /// Highest number of conversations, if the holder lets others join; else 0.
    join_limit: u32,
}

/// Makes commands wait until it is [released](Mcu::release). It has no effect if no command asked for it.
#[must_use]
pub struct Hold(pub(super) bool);

impl Turn<'_> {
    /// Makes further commands wait for this object until the hold is [released](Mcu::release). It has an effect only if
    /// a command runs now.
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

    /// Call this after sending a command's errand. Other commands of this kind to the same object need not wait,
    /// until `limit` errands are on their way.
    pub fn let_join(&mut self, limit: u32) {
        self.holds.join_limit = limit;
    }
}

impl Mcu {
    /// Starts the time of [`HOLD_LIMIT`] again. The MCU stops if commands still wait after it.
    fn limit_hold(&mut self) {
        self.schedule.timers.remove(TimerId::HOLD);
        let limit = self.now() + HOLD_LIMIT;
        self.schedule.timers.insert(limit, TimerId::HOLD);
    }

    /// Ends this hold. Commands run again if no other hold is left. Errands that the object sends from now on hold
    /// nothing: they belong to its own work.
    pub fn release(&mut self, Hold(waits): Hold) {
        if !waits {
            return;
        }
        self.holds.is_commanded = false;
        self.holds.count = self.holds.count.saturating_sub(1);
        if self.holds.count == 0 {
            self.schedule.timers.remove(TimerId::HOLD);
        } else if self.is_held() {
            self.limit_hold();
        }
    }

    /// Whether no further command may run now. Either a command's errand is on its way, or a `config_reset` waits for
    /// the outputs.
    #[inline]
    pub fn is_held(&self) -> bool {
        // The core asks in each of its turns: without branches this takes half the time.
        (self.holds.count > 0) & self.stop.reason.is_none() | self.configuration.reset_due
    }

    /// Whether the last command keeps its block unacknowledged until commands may run again.
    #[inline]
    pub fn keeps_block(&self) -> bool {
        self.is_held() && (self.holds.join_limit == 0 || self.configuration.reset_due)
    }

    /// Whether the first command of this payload may run now: commands do not [wait](Mcu::is_held), or it joins the
    /// command that they wait for.
    #[inline]
    pub fn may_run(&self, payload: &[u8]) -> bool {
        !self.is_held() || self.joins(payload)
    }

    fn joins(&self, payload: &[u8]) -> bool {
        if self.keeps_block() || self.holds.count >= self.holds.join_limit {
            return false;
        }
        let mut reader = Reader::new(payload);
        let command = reader.int().ok().and_then(|id| self.heard().command(id).ok());
        command.is_some_and(|command| command.joins)
            && reader.int().is_ok_and(|oid| self.holds.holder.is_some_and(|holder| holder.index() == oid as usize))
    }

    /// Called after a stop. A conversation from before the stop holds commands again, and its limit may have passed.
    pub(super) fn hold_again(&mut self) {
        if self.holds.count > 0 {
            self.limit_hold();
        }
    }

    /// Runs when the timer of [`HOLD_LIMIT`] is due: commands have waited too long for an errand.
    pub(super) fn held_too_long(&mut self) {
        if self.is_held() {
            let holder = self
                .holds
                .holder
                .and_then(|oid| Some((oid, self.configuration.objects.get(oid.index())?.as_ref()?.kind())));
            let what = holder.map_or_else(|| "a device".to_owned(), |(oid, kind)| self.name_object(kind, oid));
            let cause = format!("{what} has not answered for {} s", HOLD_LIMIT.0 / crate::time::CLOCK_FREQ);
            let stop = Shutdown::because(reason::BUS_HANGS, cause);
            self.shut_down(stop.remedy("check its power and wiring, and look at the kernel's log (dmesg)"));
        }
    }
}
