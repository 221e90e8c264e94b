// SPDX-License-Identifier: GPL-3.0-or-later
//! Conversations with chips on a bus.
//!
//! An object that is a bus device (an SPI device, say) lends it: an object that talks to the chip
//! names the device's oid at configuration and asks for it when it talks. klippy configures a
//! sensor first and sets the bus of its device afterwards.

#![forbid(unsafe_code)]

use std::sync::{Arc, Mutex, PoisonError};

use crate::board::{BusDevice, BusError};
use crate::shutdown::Shutdown;

use super::{Errand, Mcu, Oid, Ticket, WorkerId};

/// A device that several conversations use in turn. They all run on the worker of its bus, so
/// nobody ever waits for the lock, and the core never takes it.
type SharedDevice = Arc<Mutex<Box<dyn BusDevice>>>;

/// A bus device and the worker of its bus.
#[derive(Clone)]
pub struct Bus {
    worker: WorkerId,
    device: SharedDevice,
}

/// What is said to a chip: plain code that runs on the worker.
pub trait Talk: Send + 'static {
    /// Has the conversation, and keeps what came of it.
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError>;
}

/// A conversation: what is said, and how it went.
pub struct Conversation<T> {
    /// What is said, and what came of it.
    pub talk: T,
    /// How it went.
    pub result: Result<(), BusError>,
    device: Option<SharedDevice>,
}

impl<T: Talk> Conversation<T> {
    /// A conversation to be had with [`Mcu::converse`].
    pub fn new(talk: T) -> Box<Conversation<T>> {
        Box::new(Conversation { talk, result: Ok(()), device: None })
    }
}

impl<T: Talk> Errand for Conversation<T> {
    fn run(&mut self) {
        let Some(device) = self.device.take() else { return };
        let mut chip = device.lock().unwrap_or_else(PoisonError::into_inner);
        self.result = self.talk.talk(&mut **chip);
    }
}

impl Bus {
    /// A device that lives on this worker.
    pub fn new(worker: WorkerId, device: Box<dyn BusDevice>) -> Bus {
        Bus { worker, device: Arc::new(Mutex::new(device)) }
    }
}

/// The worker of every bus that is made of lines. Such buses may share lines in any way, several
/// clocks one MISO, say, so one worker runs them all.
const SOFTWARE: &str = "software";

impl Mcu {
    /// A device on a bus that is made of lines.
    ///
    /// # Errors
    ///
    /// That the worker can not be started.
    pub fn software_bus(&mut self, device: Box<dyn BusDevice>) -> Result<Bus, Shutdown> {
        Ok(Bus::new(self.worker(SOFTWARE)?, device))
    }

    /// Has a conversation with the device of object `device`; it comes back to
    /// [`Object::returned`](super::Object::returned).
    pub fn converse<T: Talk>(
        &mut self,
        device: Oid,
        ticket: Ticket,
        conversation: Box<Conversation<T>>,
    ) -> Result<(), Shutdown> {
        let bus = self.lend(device)?;
        self.converse_on(&bus, ticket, conversation)
    }

    /// The same, for the device's own object.
    pub fn converse_on<T: Talk>(
        &mut self,
        bus: &Bus,
        ticket: Ticket,
        mut conversation: Box<Conversation<T>>,
    ) -> Result<(), Shutdown> {
        conversation.device = Some(bus.device.clone());
        self.dispatch(bus.worker, ticket, conversation)
    }
}
