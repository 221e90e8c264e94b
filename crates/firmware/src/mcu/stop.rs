// SPDX-License-Identifier: GPL-3.0-or-later
//! How the MCU stops. It removes timers, drives outputs to their shutdown values and informs the host.
//!
//! A shutdown value that cannot be written at once is *owed*: a worker has to write it, or the write failed. A failed
//! write is retried every [`RETRY_TICKS`]. The program watches [`Mcu::debtor`]: the guardian handles a debt that lasts.
//!
//! The guardian cannot write some outputs ([`Object::is_guarded`]). Their debt ends after [`UNGUARDED_LIMIT`], because
//! ending the program for it would help nobody. The MCU still retries them until the next configuration.

#![forbid(unsafe_code)]

use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, Ticks};

use super::{Context, Mcu, Note, Oid, Safe, State, TimerId, base};

#[cfg(doc)]
use super::Object;

/// The time between two attempts to write a shutdown value.
pub const RETRY_TICKS: Ticks = Ticks::from_ms(50);

/// How long the MCU waits for shutdown values that only it can write. It is less than the second after which the
/// guardian takes over.
const UNGUARDED_LIMIT: Ticks = Ticks::from_ms(500);

/// The shutdown values that are still owed.
#[derive(Default)]
pub(super) struct PendingValues {
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

impl PendingValues {
    /// Whether the MCU waits for any of them.
    #[inline]
    pub(super) fn are_awaited(&self) -> bool {
        self.owed.iter().any(|debt| !debt.given_up)
    }
}

impl State {
    /// See [`Context::device_failed`].
    pub(super) fn device_failed(&mut self, oid: Oid, kind: &str, shutdown: Shutdown) -> Result<(), Shutdown> {
        if !self.phase.is_stopped() {
            return Err(shutdown);
        }
        let known = self.pending.owed.iter_mut().find(|debt| debt.oid == oid);
        let again = known.is_some_and(|debt| std::mem::replace(&mut debt.failed, true));
        // It is retried twenty times a second, but logged once.
        if !again {
            let trouble = self.blame(shutdown, kind, oid);
            self.wire.note(Note::Trouble(&trouble));
        }
        self.retry_later();
        Ok(())
    }

    /// See [`Context::warn`].
    pub(super) fn warn(&mut self, oid: Oid, kind: &str, trouble: Shutdown) {
        let trouble = self.blame(trouble, kind, oid);
        self.wire.note(Note::Warning(&trouble));
    }

    /// See [`Context::is_safe`].
    pub(super) fn is_safe(&mut self, oid: Oid) {
        let Some(place) = self.pending.owed.iter().position(|debt| debt.oid == oid) else { return };
        let debt = self.pending.owed.swap_remove(place);
        if debt.failed {
            self.wire.note(Note::Safe(&debt.name));
        }
    }

    fn make_safe(&mut self, oid: Oid) {
        let Some(mut object) = self.objects.take(oid) else { return };
        let safe = object.make_safe(&mut Context::new(self, oid));
        let (kind, guarded) = (object.kind(), object.is_guarded());
        self.objects.put_back(oid, object);
        if !matches!(safe, Ok(Safe::Now)) && !self.pending.owed.iter().any(|debt| debt.oid == oid) {
            let name = self.name_object(kind, oid);
            let since = self.scheduler.last_read();
            self.pending.owed.push(Debt { oid, name, failed: false, guarded, since, given_up: false });
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
        if self.pending.owed.iter().any(|debt| debt.failed || !debt.guarded && !debt.given_up) {
            self.scheduler.cancel(TimerId::RETRY);
            let at = self.scheduler.last_read() + RETRY_TICKS;
            self.scheduler.start(TimerId::RETRY, at);
        }
    }

    /// Retries the shutdown values that could not be written. It stops waiting for overdue ones that the guardian
    /// cannot write.
    pub(super) fn retry(&mut self) {
        let now = self.scheduler.now();
        for debt in self.pending.owed.iter_mut().filter(|debt| !debt.guarded && !debt.given_up) {
            if now.since(debt.since) >= i64::from(UNGUARDED_LIMIT.0) {
                debt.given_up = true;
                let cause = format!(
                    "{} has not taken its shutdown values for {} ms, and nothing else can write them: its outputs may be on",
                    debt.name,
                    UNGUARDED_LIMIT.as_ms()
                );
                let stop = Shutdown::because(reason::BUS_HANGS, cause);
                self.wire.note(Note::Trouble(&stop.remedy("check its power and wiring, then FIRMWARE_RESTART")));
            }
        }
        for place in (0..self.pending.owed.len()).rev() {
            let failed = self.pending.owed.get(place).filter(|debt| debt.failed).map(|debt| debt.oid);
            if let Some(oid) = failed {
                self.make_safe(oid);
            }
        }
        self.retry_later();
    }
}

impl Mcu {
    /// Whether the MCU is stopped.
    pub fn is_shutdown(&self) -> bool {
        self.state.phase.is_stopped()
    }

    /// Why and when the MCU stopped; `None` while it is not stopped.
    pub fn last_stop(&self) -> Option<(&Shutdown, Clock)> {
        self.state.phase.last_stop()
    }

    /// Stops the MCU. It removes all timers, drives the outputs to their shutdown values, and informs the host. An MCU
    /// that is already stopped does this again and keeps its first reason.
    pub fn shut_down(&mut self, shutdown: Shutdown) {
        let state = &mut self.state;
        if state.pending.under_way {
            state.wire.note(Note::Trouble(&shutdown));
            return;
        }
        let clock = state.scheduler.now();
        let again = state.phase.stop(shutdown, clock);
        state.pending.under_way = true;
        if again.is_none() {
            state.pending.owed.iter_mut().for_each(|debt| (debt.since, debt.given_up) = (clock, false));
        }
        state.scheduler.clear();
        for oid in state.objects.oids() {
            if let Some(mut object) = state.objects.take(oid) {
                object.shutdown(&mut Context::new(state, oid));
                state.objects.put_back(oid, object);
            }
        }
        for oid in state.objects.oids() {
            state.make_safe(oid);
        }
        state.pending.under_way = false;
        state.retry_later();
        let Some((why, _)) = state.phase.last_stop() else { return };
        let static_string_id = state.wire.dialect().static_string_id(why.reason);
        state.wire.send(base::ShutdownReport { clock, static_string_id });
        match again {
            None => state.wire.note(Note::Shutdown(why)),
            // The same reason again, for example a second `emergency_stop`, gives the log nothing new.
            Some(again) if again.reason == why.reason => {}
            Some(again) => state.wire.note(Note::Trouble(&again)),
        }
    }

    /// The log's name of an object that owes its shutdown value; `None` if nothing is owed.
    pub fn debtor(&self) -> Option<&str> {
        self.state.pending.owed.iter().find(|debt| !debt.given_up).map(|debt| debt.name.as_str())
    }

    /// Whether any shutdown value is owed.
    #[inline]
    pub fn owes(&self) -> bool {
        self.state.pending.are_awaited()
    }

    pub(super) fn clear_shutdown(&mut self) -> Result<(), Shutdown> {
        self.state.phase.clear_shutdown()?;
        self.state.hold_again();
        Ok(())
    }
}
