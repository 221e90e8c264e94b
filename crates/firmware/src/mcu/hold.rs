// SPDX-License-Identifier: GPL-3.0-or-later
//! One order: commands wait for the conversations that commands began.
//!
//! The firmware runs a command to its end before it looks at the next, and
//! acknowledges a block after its last command; klippy relies on both. So an errand that a
//! command sends *holds*: until it is back, the core runs no further command and leaves the block
//! unacknowledged ([`Mcu::is_held`]). Timers go on, and errands that they send hold nothing. A
//! stopped machine is not held.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, reason};
use crate::time::Ticks;

use super::{Mcu, Oid, TimerId};

/// How long commands may wait for an errand before the machine stops. klippy, too, gives up waiting
/// for an answer after five seconds (`SerialRetryCommand` in serialhdl.py). Without this limit a bus
/// that hangs would keep the host from stopping the machine: once its window of unacknowledged blocks
/// is full, it can not even send an `emergency_stop`.
const HOLD_LIMIT: Ticks = Ticks::from_us(5_000_000);

/// What commands wait for.
#[derive(Default)]
pub(super) struct Hold {
    /// Whether a command runs, or an errand that a command sent is taken in.
    pub(super) is_commanded: bool,
    /// Conversations that commands wait for.
    pub(super) count: u32,
    /// Whose the last one is.
    holder: Option<Oid>,
}

impl Mcu {
    /// If a command runs now, makes further commands wait for this object, until [`Mcu::release`] was
    /// called as often as this. Returns whether they wait.
    pub fn hold(&mut self, oid: Oid) -> bool {
        if self.hold.is_commanded {
            if self.hold.count == 0 {
                self.limit_hold();
            }
            self.hold.count += 1;
            self.hold.holder = Some(oid);
        }
        self.hold.is_commanded
    }

    /// Has the machine stop if commands still wait in [`HOLD_LIMIT`].
    fn limit_hold(&mut self) {
        self.schedule.timers.remove(TimerId::HOLD);
        let limit = self.now() + HOLD_LIMIT;
        self.schedule.timers.insert(limit, TimerId::HOLD);
    }

    /// Takes back one [`Mcu::hold`] that returned true.
    pub fn release(&mut self) {
        self.hold.count = self.hold.count.saturating_sub(1);
        if self.hold.count == 0 {
            self.schedule.timers.remove(TimerId::HOLD);
        }
    }

    /// Whether no further command may run now, as an errand that a command sent is under way, or a
    /// `config_reset` waits for the outputs.
    #[inline]
    pub fn is_held(&self) -> bool {
        self.hold.count > 0 && self.stop.reason.is_none() || self.configuration.reset_due
    }

    /// A stop is over. A conversation from before it holds commands again, and its limit may be over.
    pub(super) fn hold_again(&mut self) {
        if self.hold.count > 0 {
            self.limit_hold();
        }
    }

    /// The timer of [`HOLD_LIMIT`]: commands have waited too long for an errand.
    pub(super) fn held_too_long(&mut self) {
        if self.is_held() {
            let holder = self
                .hold
                .holder
                .and_then(|oid| Some((oid, self.configuration.objects.get(oid.index())?.as_ref()?.kind())));
            let what = holder.map_or_else(|| "a device".to_owned(), |(oid, kind)| self.name_object(kind, oid));
            let detail = format!(
                "{what} has not answered for {} s: does its bus or its driver hang (dmesg)?",
                HOLD_LIMIT.0 / crate::time::CLOCK_FREQ
            );
            self.shut_down(Shutdown::because(reason::BUS_HANGS, detail));
        }
    }
}
