// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs that a worker writes, as writing may block: hardware PWM, lines of expanders.

#![forbid(unsafe_code)]

use crate::shutdown::Shutdown;

use super::errand::Job;
use super::{Done, Errand, Mcu, Ticket, WorkerId};

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

/// One write. Each output has one box of these, which is used again and again.
struct Write<S: Settable> {
    output: S,
    value: S::Value,
    result: Result<(), Shutdown>,
}

impl<S: Settable> Errand for Write<S> {
    fn run(&mut self) {
        self.result = self.output.set(self.value);
    }
}

/// An output that is set by a worker. Of the values that come while a write is under way only the
/// newest is written next, as the others are out of date by then.
pub struct Remote<S: Settable> {
    worker: WorkerId,
    /// None while a write is under way: then the worker has the box.
    write: Option<Box<Write<S>>>,
    /// The value to write after the write that is under way.
    next: Option<S::Value>,
    /// Whether commands wait until `next` is written.
    next_holds: bool,
}

impl<S: Settable> Remote<S> {
    /// An output of this worker, which is at `value` now.
    pub fn new(worker: WorkerId, output: S, value: S::Value) -> Remote<S> {
        let write = Some(Box::new(Write { output, value, result: Ok(()) }));
        Remote { worker, write, next: None, next_holds: false }
    }

    /// Has the worker set the output to `value`, now or after the write that is under way. If a
    /// command asks for it, the commands behind that one wait until it is done.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn set(&mut self, mcu: &mut Mcu, ticket: Ticket, value: S::Value) -> Result<(), Shutdown> {
        match self.write.take() {
            Some(write) => {
                let holds = mcu.hold(ticket.oid);
                self.send(mcu, ticket, write, value, holds)
            }
            None => {
                self.next = Some(value);
                self.next_holds = self.next_holds || mcu.hold(ticket.oid);
                Ok(())
            }
        }
    }

    /// To be called when the write comes back to the object. True once nothing is left to be written.
    ///
    /// # Errors
    ///
    /// That of the write, such as "PWM write failed"; "Bus worker queue overflow".
    pub fn returned(&mut self, mcu: &mut Mcu, ticket: Ticket, done: Done) -> Result<bool, Shutdown> {
        let Some(mut write) = done.errand::<Write<S>>() else { return Ok(false) };
        let result = std::mem::replace(&mut write.result, Ok(()));
        match self.next.take() {
            Some(next) => {
                let holds = std::mem::take(&mut self.next_holds);
                self.send(mcu, ticket, write, next, holds)?;
                result.map(|()| false)
            }
            None => {
                self.write = Some(write);
                result.map(|()| true)
            }
        }
    }

    fn send(
        &mut self,
        mcu: &mut Mcu,
        ticket: Ticket,
        mut write: Box<Write<S>>,
        value: S::Value,
        holds: bool,
    ) -> Result<(), Shutdown> {
        write.value = value;
        mcu.hand_over(self.worker, Job { ticket, errand: write, holds })
    }
}
