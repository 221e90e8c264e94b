// SPDX-License-Identifier: GPL-3.0-or-later
//! How the MCU stops. It removes timers, drives outputs to their shutdown values and informs the host.
//!
//! A shutdown value that cannot be written at once is *owed*: a worker has to write it, or the write failed. A failed
//! write is retried every [`RETRY_TICKS`]. The program watches [`Mcu::debtor`]: the guardian handles a debt that lasts.
//!
//! The guardian cannot write some outputs ([`Object::is_guarded`]). Their debt ends after [`UNGUARDED_LIMIT`], because
//! ending the program for it would help nobody. The MCU still retries them until the next configuration.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, ShutdownReason, reason};
use crate::time::{Clock, Ticks};

use super::{Mcu, Note, Oid, Safe, TimerId, Turn, base};

#[cfg(doc)]
use super::Object;

/// The time between two attempts to write a shutdown value.
pub const RETRY_TICKS: Ticks = Ticks::from_ms(50);

/// How long the MCU waits for shutdown values that only it can write. It is less than the second after which the
/// guardian takes over.
const UNGUARDED_LIMIT: Ticks = Ticks::from_ms(500);

/// The reason of a stop, and the shutdown values that are still owed.
#[derive(Default)]
pub(super) struct Stop {
    /// Why the MCU is stopped; `None` while it is not.
    pub(super) reason: Option<ShutdownReason>,
    /// The last stop, and its time.
    pub(super) last: Option<(Shutdown, Clock)>,
    /// Whether `shut_down` is running. A failure meanwhile must not start it again.
    under_way: bool,
    owed: Vec<Debt>,
}

/// An object that owes a shutdown value.
struct Debt {
    oid: Oid,
    /// The log's name for it.
    name: String,
    /// Whether writing failed.
    failed: bool,
    /// Whether the guardian also holds the output.
    guarded: bool,
    since: Clock,
    /// Whether the MCU no longer waits for it.
    given_up: bool,
}

impl Mcu {
    /// Whether the MCU is stopped.
    pub fn is_shutdown(&self) -> bool {
        self.stop.reason.is_some()
    }

    /// Why and when the MCU stopped; `None` while it is not stopped.
    pub fn last_stop(&self) -> Option<(&Shutdown, Clock)> {
        self.stop.last.as_ref().filter(|_| self.is_shutdown()).map(|(stop, at)| (stop, *at))
    }

    /// Stops the MCU. It removes all timers, drives the outputs to their shutdown values, and informs the host. An MCU
    /// that is already stopped does this again and keeps its first reason.
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
            self.stop.last = Some((shutdown, clock));
        } else if shutdown.reason != reason {
            // The same reason again, for example a second `emergency_stop`, gives the log nothing new.
            self.outbox.note(Note::Trouble(&shutdown));
        }
    }

    /// Returns the given shutdown as an error, which then stops the MCU. Returns `Ok` if the MCU is already stopped
    /// (the firmware's `try_shutdown`).
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
        // It is retried twenty times a second, but logged once.
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

    /// The log's name of an object that owes its shutdown value; `None` if nothing is owed.
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
                // The MCU is stopped, so this logs the failure and returns `Ok`.
                let _ = self.device_failed(oid, kind, trouble);
            }
        }
    }

    /// Starts the timer of the next attempt. It is needed if a shutdown value could not be written, or if the MCU will
    /// stop waiting for one.
    fn retry_later(&mut self) {
        if self.stop.owed.iter().any(|debt| debt.failed || !debt.guarded && !debt.given_up) {
            self.schedule.timers.remove(TimerId::RETRY);
            let at = self.schedule.last_read + RETRY_TICKS;
            self.schedule.timers.insert(at, TimerId::RETRY);
        }
    }

    /// Retries the shutdown values that could not be written. It stops waiting for overdue ones that the guardian
    /// cannot write.
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
