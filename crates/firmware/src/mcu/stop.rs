// SPDX-License-Identifier: GPL-3.0-or-later
//! How the MCU stops. It removes timers, drives outputs to their shutdown values and informs the host.
//!
//! A stop drives the outputs in the table of lines itself, and asks each object with a device of its own
//! ([`Object::make_safe`]). A shutdown value that cannot be written at once is *pending*: a worker has to write it, or the
//! write failed. A failed write is retried every [`RETRY_TICKS`]. The program watches [`Mcu::pending_value`]. The
//! guardian takes over if a value stays pending.
//!
//! The guardian cannot write some outputs ([`Object::is_guarded`]). The MCU waits for these no longer than
//! [`UNGUARDED_LIMIT`], because the end of the program would help nobody. It still retries them until the next
//! configuration.

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

/// The pending shutdown values.
#[derive(Default)]
pub(super) struct PendingValues {
    /// Whether `shut_down` is running. A failure within it must not start it again.
    under_way: bool,
    values: Vec<PendingValue>,
}

/// Owner of a pending shutdown value.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Subject {
    /// An object that drives its device itself.
    Object(Oid),
    /// The output at this place of the table of lines.
    Output(usize),
}

/// A pending shutdown value.
struct PendingValue {
    subject: Subject,
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
        self.values.iter().any(|value| !value.given_up)
    }
}

impl State {
    /// See [`Context::device_failed`].
    pub(super) fn device_failed(&mut self, subject: Subject, shutdown: Shutdown) -> Result<(), Shutdown> {
        if !self.phase.is_stopped() {
            return Err(shutdown.of(&self.name_subject(subject, None)));
        }
        self.note_failure(subject, None, shutdown);
        Ok(())
    }

    /// The log's name for a subject. `kind` is the kind of an object that is not in the table, because it is called.
    fn name_subject(&self, subject: Subject, kind: Option<&str>) -> String {
        let oid = match subject {
            Subject::Object(oid) => oid,
            Subject::Output(place) => self.owner(place),
        };
        let kind = kind.or_else(|| self.objects.get(oid).map(|object| object.kind()));
        self.name_object(kind.unwrap_or("output"), oid)
    }

    /// Logs a failure of a stopped MCU. The shutdown value is retried later.
    pub(super) fn note_failure(&mut self, subject: Subject, kind: Option<&str>, shutdown: Shutdown) {
        let known = self.pending.values.iter_mut().find(|value| value.subject == subject);
        let again = known.is_some_and(|value| std::mem::replace(&mut value.failed, true));
        // It is retried twenty times a second, but logged once.
        if !again {
            let trouble = shutdown.of(&self.name_subject(subject, kind));
            self.wire.note(Note::Trouble(&trouble));
        }
        self.retry_later();
    }

    /// See [`Context::warn`].
    pub(super) fn warn(&mut self, oid: Oid, kind: &str, trouble: Shutdown) {
        let trouble = self.blame(trouble, kind, oid);
        self.wire.note(Note::Warning(&trouble));
    }

    /// An output or the outputs of an object are at their shutdown values.
    pub(super) fn is_safe(&mut self, subject: Subject) {
        let Some(place) = self.pending.values.iter().position(|value| value.subject == subject) else { return };
        let value = self.pending.values.swap_remove(place);
        if value.failed {
            self.wire.note(Note::Safe(&value.name));
        }
    }

    /// Nothing drives the output any more, for example because its line is an input now. So no shutdown value is pending
    /// for it.
    pub(super) fn drop_pending(&mut self, subject: Subject) {
        self.pending.values.retain(|value| value.subject != subject);
    }

    fn make_safe(&mut self, subject: Subject) {
        let oid = match subject {
            Subject::Object(oid) => oid,
            Subject::Output(place) => return self.make_output_safe(place),
        };
        let Some(mut object) = self.objects.take(oid) else { return };
        let safe = object.make_safe(&mut Context::new(self, oid));
        let guarded = object.is_guarded();
        self.objects.put_back(oid, object);
        self.note_safety(subject, guarded, safe);
    }

    /// Notes the result of an attempt to reach a shutdown value.
    pub(super) fn note_safety(&mut self, subject: Subject, guarded: bool, safe: Result<Safe, Shutdown>) {
        if !matches!(safe, Ok(Safe::Now)) && !self.pending.values.iter().any(|value| value.subject == subject) {
            let name = self.name_subject(subject, None);
            let since = self.scheduler.last_read();
            self.pending.values.push(PendingValue { subject, name, failed: false, guarded, since, given_up: false });
        }
        match safe {
            Ok(Safe::Now) => self.is_safe(subject),
            Ok(Safe::Later) => {}
            Err(failure) => self.note_failure(subject, None, failure),
        }
    }

    /// Starts the timer of the next attempt. It is needed if a shutdown value could not be written, or if the MCU will
    /// stop waiting for one.
    fn retry_later(&mut self) {
        if self.pending.values.iter().any(|value| value.failed || !value.guarded && !value.given_up) {
            self.scheduler.cancel(TimerId::RETRY);
            let at = self.scheduler.last_read() + RETRY_TICKS;
            self.scheduler.start(TimerId::RETRY, at);
        }
    }

    /// Retries the shutdown values that could not be written. It stops waiting for overdue ones that the guardian
    /// cannot write.
    pub(super) fn retry(&mut self) {
        let now = self.scheduler.now();
        for value in self.pending.values.iter_mut().filter(|value| !value.guarded && !value.given_up) {
            if now.since(value.since) >= i64::from(UNGUARDED_LIMIT.0) {
                value.given_up = true;
                let cause = format!(
                    "{} has not accepted its shutdown values for {} ms, and nothing else can write them: its outputs may be on",
                    value.name,
                    UNGUARDED_LIMIT.as_ms()
                );
                let stop = Shutdown::because(reason::BUS_HANGS, cause);
                self.wire.note(Note::Trouble(&stop.remedy("check its power and wiring, then FIRMWARE_RESTART")));
            }
        }
        for place in (0..self.pending.values.len()).rev() {
            let failed = self.pending.values.get(place).filter(|value| value.failed).map(|value| value.subject);
            if let Some(subject) = failed {
                self.make_safe(subject);
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
            state.pending.values.iter_mut().for_each(|value| (value.since, value.given_up) = (clock, false));
        }
        state.scheduler.clear();
        for oid in state.objects.oids() {
            if let Some(mut object) = state.objects.take(oid) {
                object.shutdown(&mut Context::new(state, oid));
                state.objects.put_back(oid, object);
            }
        }
        for place in 0..state.lines.len() {
            state.make_output_safe(place);
        }
        for oid in state.objects.oids() {
            state.make_safe(Subject::Object(oid));
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

    /// The log's name of an object whose shutdown value is pending; `None` without one.
    pub fn pending_value(&self) -> Option<&str> {
        self.state.pending.values.iter().find(|value| !value.given_up).map(|value| value.name.as_str())
    }

    /// Whether any shutdown value is pending.
    #[inline]
    pub fn has_pending_values(&self) -> bool {
        self.state.pending.are_awaited()
    }

    pub(super) fn clear_shutdown(&mut self) -> Result<(), Shutdown> {
        self.state.phase.clear_shutdown()?;
        self.state.hold_again();
        Ok(())
    }
}
