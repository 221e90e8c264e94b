// SPDX-License-Identifier: GPL-3.0-or-later
//! How the MCU stops: timers off, outputs to their shutdown values, the host is told.
//!
//! An output whose shutdown value can not be written at once, as a worker has to write it or as
//! writing failed, is *owed*. What failed is tried again every [`RETRY_TICKS`]. Whoever runs the
//! MCU watches [`Mcu::debtor`]: a debt that lasts is for the guardian. What the guardian can not
//! write either ([`Object::is_guarded`]) is owed for [`UNGUARDED_LIMIT`] only: to end the program for it
//! would help nobody. It is still tried until the next configuration.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, ShutdownReason, reason};
use crate::time::{Clock, Ticks};
use crate::trouble::Trouble;

use super::{Mcu, Note, Oid, Safe, TimerId, Turn, base};

#[cfg(doc)]
use super::Object;

/// The pause between two attempts to write a shutdown value.
pub const RETRY_TICKS: Ticks = Ticks::from_ms(50);

/// How long the MCU waits for shutdown values that only it can write: less than the second after which
/// the guardian takes over.
const UNGUARDED_LIMIT: Ticks = Ticks::from_ms(500);

/// What a stopped MCU knows of its stop.
#[derive(Default)]
pub(super) struct Stop {
    /// Why the MCU is stopped; none while it is not.
    pub(super) reason: Option<ShutdownReason>,
    /// What the log says of the last stop, and when it was.
    pub(super) last: Option<(Box<Trouble>, Clock)>,
    /// Whether `shut_down` is running: what fails meanwhile must not start it again.
    under_way: bool,
    owed: Vec<Debt>,
}

/// An object that owes a shutdown value.
struct Debt {
    oid: Oid,
    /// What the log calls it.
    name: String,
    /// Whether writing failed.
    failed: bool,
    /// Whether the guardian holds the output, too.
    guarded: bool,
    since: Clock,
    /// Whether nobody waits for it any more.
    given_up: bool,
}

impl Mcu {
    /// Whether the MCU is stopped.
    pub fn is_shutdown(&self) -> bool {
        self.stop.reason.is_some()
    }

    /// Stops the MCU: removes all timers, drives the outputs to their shutdown values, and tells
    /// the host. An MCU that is stopped already does the same once more, and keeps its first reason.
    pub fn shut_down(&mut self, shutdown: Shutdown) {
        if self.stop.under_way {
            self.outbox.note(Note::Trouble(&shutdown));
            return;
        }
        let clock = self.now();
        let first = self.stop.reason.is_none();
        let reason = *self.stop.reason.get_or_insert(shutdown.reason);
        self.stop.under_way = true;
        if first {
            self.stop.owed.iter_mut().for_each(|debt| (debt.since, debt.given_up) = (clock, false));
        }
        self.schedule.timers.clear();
        for oid in self.oids() {
            if let Some(mut object) = self.take(oid) {
                object.shutdown(&mut Turn::new(self, oid));
                self.put_back(oid, object);
            }
        }
        for oid in self.oids() {
            self.make_safe(oid);
        }
        self.stop.under_way = false;
        self.retry_later();
        let static_string_id = self.spoken.dialect.static_string_id(reason);
        self.send(base::ShutdownReport { clock, static_string_id });
        if first {
            self.outbox.note(Note::Shutdown(&shutdown));
            self.stop.last = Some((shutdown.trouble, clock));
        } else if shutdown.reason != reason {
            // The same reason again, such as a second `emergency_stop`, would tell the log nothing new.
            self.outbox.note(Note::Trouble(&shutdown));
        }
    }

    /// The given stop as an error, which then stops the MCU; nothing if the MCU is stopped
    /// already (the firmware's `try_shutdown`).
    ///
    /// # Errors
    ///
    /// `shutdown`, unless the MCU is stopped.
    pub fn try_shut_down(&self, shutdown: Shutdown) -> Result<(), Shutdown> {
        match self.stop.reason {
            Some(_) => Ok(()),
            None => Err(shutdown),
        }
    }

    /// See [`Turn::device_failed`].
    pub(super) fn device_failed(&mut self, oid: Oid, kind: &str, shutdown: Shutdown) -> Result<(), Shutdown> {
        if self.stop.reason.is_none() {
            return Err(shutdown);
        }
        let known = self.stop.owed.iter_mut().find(|debt| debt.oid == oid);
        let again = known.is_some_and(|debt| std::mem::replace(&mut debt.failed, true));
        // What is tried twenty times a second is told once.
        if !again {
            let trouble = self.blame(shutdown, kind, oid);
            self.outbox.note(Note::Trouble(&trouble));
        }
        self.retry_later();
        Ok(())
    }

    /// See [`Turn::warn`].
    pub(super) fn warn(&mut self, oid: Oid, kind: &str, trouble: Shutdown) {
        let trouble = self.blame(trouble, kind, oid);
        self.outbox.note(Note::Warning(&trouble));
    }

    /// See [`Turn::is_safe`].
    pub(super) fn is_safe(&mut self, oid: Oid) {
        let Some(place) = self.stop.owed.iter().position(|debt| debt.oid == oid) else { return };
        let debt = self.stop.owed.swap_remove(place);
        if debt.failed {
            self.outbox.note(Note::Safe(&debt.name));
        }
    }

    /// The name of an object that owes its shutdown value, for the log; none if nothing is owed.
    pub fn debtor(&self) -> Option<&str> {
        self.stop.owed.iter().find(|debt| !debt.given_up).map(|debt| debt.name.as_str())
    }

    /// Whether any shutdown value is owed.
    #[inline]
    pub fn owes(&self) -> bool {
        self.stop.owed.iter().any(|debt| !debt.given_up)
    }

    fn oids(&self) -> impl Iterator<Item = Oid> + use<> {
        (0..self.configuration.objects.len()).map(Oid::at)
    }

    fn make_safe(&mut self, oid: Oid) {
        let Some(mut object) = self.take(oid) else { return };
        let safe = object.make_safe(&mut Turn::new(self, oid));
        let (kind, guarded) = (object.kind(), object.is_guarded());
        self.put_back(oid, object);
        if !matches!(safe, Ok(Safe::Now)) && !self.stop.owed.iter().any(|debt| debt.oid == oid) {
            let name = self.name_object(kind, oid);
            let since = self.schedule.last_read;
            self.stop.owed.push(Debt { oid, name, failed: false, guarded, since, given_up: false });
        }
        match safe {
            Ok(Safe::Now) => self.is_safe(oid),
            Ok(Safe::Later) => {}
            Err(trouble) => {
                // The MCU is stopped, so this notes the failure and returns Ok.
                let _ = self.device_failed(oid, kind, trouble);
            }
        }
    }

    /// Starts the timer of the next attempt, if any shutdown value could not be written, or will be given
    /// up.
    fn retry_later(&mut self) {
        if self.stop.owed.iter().any(|debt| debt.failed || !debt.guarded && !debt.given_up) {
            self.schedule.timers.remove(TimerId::RETRY);
            let at = self.schedule.last_read + RETRY_TICKS;
            self.schedule.timers.insert(at, TimerId::RETRY);
        }
    }

    /// Tries again to write the shutdown values that could not be written, and no longer waits for those
    /// that only this computer could write and could not.
    pub(super) fn retry(&mut self) {
        let now = self.now();
        for debt in self.stop.owed.iter_mut().filter(|debt| !debt.guarded && !debt.given_up) {
            if now.since(debt.since) >= i64::from(UNGUARDED_LIMIT.0) {
                debt.given_up = true;
                let cause = format!(
                    "{} has not taken its shutdown values for {} ms, and nothing else can write them: its outputs may be on",
                    debt.name,
                    UNGUARDED_LIMIT.as_ms()
                );
                let stop = Shutdown::because(reason::BUS_HANGS, cause);
                self.outbox.note(Note::Trouble(&stop.remedy("check its power and wiring, then FIRMWARE_RESTART")));
            }
        }
        for place in (0..self.stop.owed.len()).rev() {
            let failed = self.stop.owed.get(place).filter(|debt| debt.failed).map(|debt| debt.oid);
            if let Some(oid) = failed {
                self.make_safe(oid);
            }
        }
        self.retry_later();
    }

    pub(super) fn clear_shutdown(&mut self) -> Result<(), Shutdown> {
        if self.stop.reason.take().is_none() {
            let what = "clear_shutdown came while the MCU was not stopped";
            return Err(Shutdown::by_host(reason::NOT_SHUTDOWN, what));
        }
        self.hold_again();
        Ok(())
    }
}
