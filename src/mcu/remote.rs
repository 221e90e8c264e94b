// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs that a worker writes, as writing takes its time: hardware PWM, lines of expanders.

#![forbid(unsafe_code)]

use crate::shutdown::Shutdown;

use super::errand::Job;
use super::{Done, Errand, Mcu, Ticket, WorkerId};

/// Something that is set to values.
pub trait Settable: Send + 'static {
    /// What it is set to.
    type Value: Copy + Send;

    /// Sets it. Runs on a worker, and may block there.
    fn set(&mut self, value: Self::Value) -> Result<(), Shutdown>;
}

/// One write: there is one box for each output.
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

/// An output that is set by a worker. While a write is under way only the newest value is kept
/// for the next one: the values before it are out of date.
pub struct Remote<S: Settable> {
    worker: WorkerId,
    /// Here while no write is under way.
    write: Option<Box<Write<S>>>,
    next: Option<S::Value>,
    /// Whether commands wait for the next value to be written.
    next_holds: bool,
}

impl<S: Settable> Remote<S> {
    /// An output of this worker, which stands at `value`.
    pub fn new(worker: WorkerId, output: S, value: S::Value) -> Remote<S> {
        let write = Some(Box::new(Write { output, value, result: Ok(()) }));
        Remote { worker, write, next: None, next_holds: false }
    }

    /// Sets it, now or as soon as the present write is over. Commands wait if it is a command
    /// that asks.
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

    /// Takes in that a write is over. True once nothing is left to be written.
    ///
    /// # Errors
    ///
    /// What the write came to.
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
