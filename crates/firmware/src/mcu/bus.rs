// SPDX-License-Identifier: GPL-3.0-or-later
//! Conversations with chips on a bus.
//!
//! An object such as an SPI device stands for a chip, and lends it to other objects. One that talks
//! to the chip, such as a sensor, learns the oid of the SPI device at configuration, but borrows the
//! chip only as it talks: klippy configures the sensor before it sets the bus of the SPI device.

#![forbid(unsafe_code)]

use std::sync::{Arc, Mutex, PoisonError};

use crate::board::{BusDevice, BusError, OnWorker};
use crate::shutdown::Shutdown;

use super::{BusCounts, Calls, Errand, Mcu, Oid, Ticket, WorkerId};

/// A chip that several conversations use in turn. All of them run on the worker of its bus, one
/// after the other, so the lock is always free. The core never takes it.
type SharedDevice = Arc<Mutex<Box<dyn BusDevice>>>;

/// A chip and the worker of its bus.
#[derive(Clone)]
pub struct Bus {
    worker: WorkerId,
    device: SharedDevice,
    calls: Calls,
}

/// A chip whose transfers are counted, and made again where that may be.
struct Counted {
    device: Box<dyn BusDevice>,
    calls: Calls,
}

impl BusDevice for Counted {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.calls.once(|| self.device.exchange(bytes))
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.calls.once(|| self.device.send(bytes))
    }

    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.calls.once(|| self.device.write_read(write, read))
    }

    fn read_register(&mut self, register: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.calls.repeat(|| self.device.write_read(register, read))
    }
}

/// What is said to a chip: plain code that runs on the worker and may block there.
pub trait Talk: Send + 'static {
    /// Has the conversation, and keeps what the chip answered.
    ///
    /// # Errors
    ///
    /// Those of the calls of `chip`.
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError>;
}

/// A conversation with a chip: an [`Errand`] that is made once and used again and again.
pub struct Conversation<T> {
    /// What is said, and afterwards also what the chip answered.
    pub talk: T,
    /// Whether the last conversation succeeded.
    pub result: Result<(), BusError>,
    device: Option<SharedDevice>,
}

impl<T: Talk> Conversation<T> {
    /// A conversation for [`Mcu::converse`]. It allocates: objects make theirs at configuration.
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
    /// What went over the bus to this chip.
    pub(super) fn counts(&self) -> BusCounts {
        self.calls.counts()
    }
}

/// The worker of every bus that is made of lines. Such buses may share lines in any way, several
/// clocks one MISO, say, so one worker runs them all.
const SOFTWARE: &str = "software";

impl Mcu {
    /// A chip that the board has opened.
    ///
    /// # Errors
    ///
    /// That the worker can not be started.
    pub fn bus(&mut self, OnWorker { bus, device }: OnWorker<dyn BusDevice>) -> Result<Bus, Shutdown> {
        let (worker, calls) = (self.worker(&bus)?, Calls::new(self.clock()));
        let counted = Counted { device, calls: calls.clone() };
        Ok(Bus { worker, device: Arc::new(Mutex::new(Box::new(counted))), calls })
    }

    /// A device on a bus that is made of lines.
    ///
    /// # Errors
    ///
    /// That the worker can not be started.
    pub fn software_bus(&mut self, device: Box<dyn BusDevice>) -> Result<Bus, Shutdown> {
        self.bus(OnWorker { bus: SOFTWARE.to_owned(), device })
    }

    /// Sends a conversation to the chip that object `device` stands for. It comes back to
    /// [`Object::returned`](super::Object::returned) of the ticket's object.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if the object stands for no chip, "Bus worker queue overflow".
    pub fn converse<T: Talk>(
        &mut self,
        device: Oid,
        ticket: Ticket,
        conversation: Box<Conversation<T>>,
    ) -> Result<(), Shutdown> {
        let bus = self.lend(device)?;
        self.converse_on(&bus, ticket, conversation)
    }

    /// The same, for the object that stands for the chip itself.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
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
