// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs that a worker writes, because writing may block: hardware PWM, lines of expanders.

use crate::shutdown::Shutdown;

use super::{Back, Context, DeviceId, Finished, Hold, Job, JobSlot};

/// An output that can be set to a value.
pub trait Settable: Send + 'static {
    /// The type of its values.
    type Value: Copy + Send + 'static;

    /// Sets the output. Runs on a worker, and may block there.
    ///
    /// # Errors
    ///
    /// The output's errors, for example "PWM write failed".
    fn set(&mut self, value: Self::Value) -> Result<(), Shutdown>;
}

/// One write.
struct Write<S: Settable>(S::Value);

impl<S: Settable> Job for Write<S> {
    type Device = S;
    type Out = ();
    type Failure = Shutdown;

    fn run(&mut self, output: &mut S) -> Result<(), Shutdown> {
        output.set(self.0)
    }
}

/// An output that a worker sets. If several values come during a write, only the newest is written next. The others are
/// out of date by then.
pub struct Remote<S: Settable> {
    output: DeviceId<S>,
    write: JobSlot<Write<S>>,
    /// The value to write after the present write, and its hold on commands.
    next: Option<(S::Value, Hold)>,
}

impl<S: Settable> Remote<S> {
    /// Creates an output that is at `value` now. Its object gets the writes back under `number`.
    pub fn new(number: u8, output: DeviceId<S>, value: S::Value) -> Remote<S> {
        Remote { output, write: JobSlot::numbered(number, Write(value)), next: None }
    }

    /// The same for the output at this place of the table of lines.
    pub(super) fn of_output(place: usize, output: DeviceId<S>, value: S::Value) -> Remote<S> {
        Remote { output, write: JobSlot::of_output(place, Write(value)), next: None }
    }

    /// Lets the worker set the output to `value`, now or after the present write. If a command calls this, the next
    /// commands wait until the value is written.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn set(&mut self, context: &mut Context, value: S::Value) -> Result<(), Shutdown> {
        let hold = match self.next.take() {
            Some((_, hold @ Hold(true))) => hold,
            _ => context.hold(),
        };
        self.write(context, value, hold)
    }

    fn write(&mut self, context: &mut Context, value: S::Value, hold: Hold) -> Result<(), Shutdown> {
        match self.write.here() {
            Some(write) => {
                write.0 = value;
                self.write.send_with(context, self.output, hold)
            }
            None => {
                self.next = Some((value, hold));
                Ok(())
            }
        }
    }

    /// Handles a finished write. `Ok(true)` means that nothing is left to write.
    pub fn back(&mut self, context: &mut Context, finished: Finished) -> Option<Result<bool, Shutdown>> {
        let Back { result, .. } = self.write.back(finished)?;
        let result = result.map_err(Shutdown::clone);
        Some(match self.next.take() {
            Some((next, hold)) => self.write(context, next, hold).and(result.map(|()| false)),
            None => result.map(|()| true),
        })
    }

    /// The same, for an object of this kind. All its outputs are safe when this one is at its shutdown value.
    ///
    /// # Errors
    ///
    /// The error of the write, for example "PWM write failed", unless the MCU is stopped.
    pub fn settle(&mut self, context: &mut Context, kind: &str, finished: Finished) -> Result<(), Shutdown> {
        match self.back(context, finished) {
            Some(Ok(true)) => context.is_safe(),
            Some(Err(failure)) => return context.device_failed(kind, failure),
            _ => {}
        }
        Ok(())
    }
}
