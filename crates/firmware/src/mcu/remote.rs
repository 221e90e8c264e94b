// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs that a worker writes, as writing may block: hardware PWM, lines of expanders.

#![forbid(unsafe_code)]

use crate::shutdown::Shutdown;

use super::{Back, Done, Errand, Hold, Slot, Turn, WorkerId};

/// An output that can be set to a value.
pub trait Settable: Send + 'static {
    /// What it is set to.
    type Value: Copy + Send;

    /// Sets it. Runs on a worker, and may block there.
    ///
    /// # Errors
    ///
    /// Those of the output, such as "PWM write failed".
    fn set(&mut self, value: Self::Value) -> Result<(), Shutdown>;
}

/// One write.
struct Write<S: Settable> {
    output: S,
    value: S::Value,
}

impl<S: Settable> Errand for Write<S> {
    type Answer = ();
    type Failure = Shutdown;

    fn run(&mut self) -> Result<(), Shutdown> {
        self.output.set(self.value)
    }
}

/// An output that is set by a worker. Of the values that come while a write is under way only the
/// newest is written next, as the others are out of date by then.
pub struct Remote<S: Settable> {
    worker: WorkerId,
    write: Slot<Write<S>>,
    /// The value to write after the write that is under way, and what waits for it.
    next: Option<(S::Value, Hold)>,
}

impl<S: Settable> Remote<S> {
    /// An output of this worker, which is at `value` now.
    pub fn new(worker: WorkerId, output: S, value: S::Value) -> Remote<S> {
        Remote { worker, write: Slot::new(Write { output, value }), next: None }
    }

    /// Has the worker set the output to `value`, now or after the write that is under way. If a
    /// command asks for it, the commands behind that one wait until it is done.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn set(&mut self, turn: &mut Turn, value: S::Value) -> Result<(), Shutdown> {
        let hold = match self.next.take() {
            Some((_, hold @ Hold(true))) => hold,
            _ => turn.hold(),
        };
        self.write(turn, value, hold)
    }

    fn write(&mut self, turn: &mut Turn, value: S::Value, hold: Hold) -> Result<(), Shutdown> {
        match self.write.here() {
            Some(write) => {
                write.value = value;
                self.write.send_with(turn, self.worker, hold)
            }
            None => {
                self.next = Some((value, hold));
                Ok(())
            }
        }
    }

    /// Takes the write that is done, if it is this output's. True once nothing is left to be written.
    pub fn back(&mut self, turn: &mut Turn, done: &mut Done) -> Option<Result<bool, Shutdown>> {
        let Back { result, .. } = self.write.back(done)?;
        let result = result.map_err(Shutdown::clone);
        Some(match self.next.take() {
            Some((next, hold)) => self.write(turn, next, hold).and(result.map(|()| false)),
            None => result.map(|()| true),
        })
    }

    /// The same for an output of an object whose outputs are all at their shutdown values once this one is. The object
    /// is of this kind.
    ///
    /// # Errors
    ///
    /// That of the write, such as "PWM write failed", unless the MCU is stopped.
    pub fn settle(&mut self, turn: &mut Turn, kind: &str, done: &mut Done) -> Result<(), Shutdown> {
        match self.back(turn, done) {
            Some(Ok(true)) => turn.is_safe(),
            Some(Err(failure)) => return turn.device_failed(kind, failure),
            _ => {}
        }
        Ok(())
    }
}
