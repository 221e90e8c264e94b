// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices behind a bus or a file, the workers that run their conversations, and their answers.

#![forbid(unsafe_code)]

use crate::board::{Attachment, Buffer, Device};
use crate::shutdown::Shutdown;

use super::{Mcu, Oid};

#[cfg(doc)]
use super::Object;

/// Whom a device's answer is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    /// The object that asked.
    pub oid: Oid,
    /// Whatever tells its requests apart.
    pub tag: u8,
}

/// A request to a device on a worker.
#[derive(Debug)]
pub struct Job {
    /// The device, as [`Workers::attach`] numbered it.
    pub device: usize,
    /// Whom the answer is for.
    pub ticket: Ticket,
    /// What the device takes.
    pub data: Buffer,
    /// Whether a machine that stops asks: that must find room where requests have filled the
    /// queue, as it may switch a heater off.
    pub stopping: bool,
}

/// A device's answer.
#[derive(Debug)]
pub struct Completion {
    /// Whom it is for.
    pub ticket: Ticket,
    /// What the device left, or why it could not.
    pub result: Result<Buffer, Shutdown>,
}

/// Runs the conversations of devices that take their time.
pub trait Workers: Send {
    /// Gives a device to the worker of its bus; returns the device's number.
    fn attach(&mut self, bus: &str, device: Box<dyn Device>) -> Result<usize, Shutdown>;

    /// Hands a job over, without waiting.
    fn submit(&mut self, job: Job) -> Result<(), Shutdown>;

    /// Whether every bus has room for the jobs of one more message block, each of which is a
    /// byte of it at least.
    fn has_room(&self) -> bool;

    /// The next answer, in order among the jobs of one bus.
    fn completion(&mut self) -> Option<Completion>;

    /// Whether there is one.
    fn has_completion(&self) -> bool;

    /// Ends every device. No answer to an earlier job comes after this.
    fn reset(&mut self);
}

/// A device of an object, as [`Mcu::attach`] numbered it.
#[derive(Clone, Copy, Debug)]
pub struct DeviceId(usize);

pub(super) enum Place {
    Inline(Box<dyn Device>),
    Worker(usize),
}

impl Mcu {
    /// Takes a device in.
    pub fn attach(&mut self, attachment: Attachment) -> Result<DeviceId, Shutdown> {
        self.devices.push(match attachment {
            Attachment::Inline(device) => Place::Inline(device),
            Attachment::Worker { bus, device } => Place::Worker(self.workers.attach(&bus, device)?),
        });
        Ok(DeviceId(self.devices.len() - 1))
    }

    /// Asks a device; the answer comes to [`Object::completed`].
    pub fn submit(&mut self, device: DeviceId, ticket: Ticket, mut data: Buffer) -> Result<(), Shutdown> {
        match self.devices.get_mut(device.0) {
            Some(Place::Inline(device)) => {
                let result = device.run(&mut data).map(|()| data);
                self.completions.push(Completion { ticket, result });
                Ok(())
            }
            Some(Place::Worker(device)) => {
                let device = *device;
                self.workers.submit(Job { device, ticket, data, stopping: self.halting })
            }
            None => Ok(()),
        }
    }

    /// Whether the host's next block may be run. Where a bus falls behind it waits, and holds the
    /// host back as a machine would that runs its transfers itself. The blocks of a stopped
    /// machine ask no bus for anything.
    #[inline]
    pub fn has_room(&self) -> bool {
        self.halted.is_some() || self.workers.has_room()
    }

    /// Whether [`Mcu::run_workers`] has something to do.
    pub fn has_completion(&self) -> bool {
        self.workers.has_completion()
    }

    /// Takes in the answers of devices on workers.
    #[inline]
    pub fn run_workers(&mut self) {
        while let Some(completion) = self.workers.completion() {
            self.completions.push(completion);
            self.run_completions();
        }
    }

    #[inline]
    pub(super) fn run_completions(&mut self) {
        while let Some(Completion { ticket, result }) = self.completions.pop() {
            let slot = self.objects.get_mut(usize::from(ticket.oid.0));
            let done = match slot.and_then(Option::take) {
                Some(mut object) => {
                    let done = object.completed(self, ticket, result);
                    let done = done.map_err(|stop| self.blame(stop, object.kind(), ticket.oid));
                    self.put_back(ticket.oid, object);
                    done
                }
                // Nobody's: only its failure tells anything.
                None => result.map(drop).or_else(|shutdown| self.device_failed(shutdown)),
            };
            if let Err(shutdown) = done {
                self.shut_down(shutdown);
            }
        }
    }
}
