// SPDX-License-Identifier: GPL-3.0-or-later
//! Queued values of an output, and `max_duration`. `max_duration` limits how long the output may differ from its
//! shutdown value without news from the host. Hardware PWM channels and PCA9685 share this code.

use crate::board::ShutdownValue;
use crate::mcu::{Context, MoveQueue, Next, Timer};
use crate::shutdown::{Shutdown, ShutdownReason};
use crate::time::{Clock, Ticks};

use super::{changes_too_late, not_refreshed};

const TIMER: Timer = Timer::exact(0);

struct Move {
    at: Clock,
    value: u16,
}

/// The shutdown texts of a kind of output.
pub(super) struct Texts {
    /// An output would stay on for longer than its `max_duration`.
    pub(super) max_duration: ShutdownReason,
    /// The host did not refresh an output in time.
    pub(super) missed: ShutdownReason,
}

/// The values of an output. The object has no timer except the queue's.
pub(super) struct ValueQueue {
    shutdown_value: ShutdownValue<u16>,
    max_duration: Ticks,
    texts: &'static Texts,
    queue: MoveQueue<Move>,
    /// When the current value ends. The host must have queued another one by then.
    end: Option<Clock>,
}

impl ValueQueue {
    pub(super) fn new(shutdown_value: ShutdownValue<u16>, max_duration: Ticks, texts: &'static Texts) -> ValueQueue {
        ValueQueue { shutdown_value, max_duration, texts, queue: MoveQueue::default(), end: None }
    }

    /// The value in a stopped MCU.
    pub(super) fn shutdown_value(&self) -> u16 {
        self.shutdown_value.get()
    }

    /// How many values are queued.
    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Appends a value. If it is the only one, the timer of the object takes it at `at`.
    pub(super) fn queue(&mut self, context: &mut Context, at: Clock, value: u16) -> Result<(), Shutdown> {
        let first = self.queue.is_empty();
        self.queue.push(context.moves(), Move { at, value })?;
        if !first {
            return Ok(());
        }
        if self.end.take().is_some_and(|end| end < at) {
            return Err(changes_too_late(self.texts.max_duration, self.max_duration));
        }
        context.cancel(TIMER);
        context.schedule(TIMER, at)
    }

    /// Takes the value that is due.
    pub(super) fn pop(&mut self, context: &mut Context) -> Result<u16, Shutdown> {
        let due = self.queue.pop(context.moves());
        due.map(|due| due.value).ok_or_else(|| not_refreshed(self.texts.missed, self.max_duration).late_for(self.end))
    }

    /// When the timer runs next, after the output got a value that was due at `at`.
    pub(super) fn next(&mut self, value: u16, at: Clock) -> Result<Next, Shutdown> {
        let limited = value != self.shutdown_value() && self.max_duration.0 != 0;
        let end = limited.then(|| at + self.max_duration);
        let Some(next) = self.queue.first().map(|next| next.at) else {
            self.end = end;
            return Ok(end.map_or(Next::Done, Next::At));
        };
        if end.is_some_and(|end| end < next) {
            return Err(changes_too_late(self.texts.max_duration, self.max_duration));
        }
        Ok(Next::At(next))
    }

    /// Forgets all values when the MCU stops.
    pub(super) fn clear(&mut self, context: &mut Context) {
        self.end = None;
        self.queue.clear(context.moves());
    }
}
