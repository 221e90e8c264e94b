// SPDX-License-Identifier: GPL-3.0-or-later
//! Conversations with chips on a bus.
//!
//! An object such as an SPI device stands for a chip, and lends it to other objects. One that talks
//! to the chip, such as a sensor, learns the oid of the SPI device at configuration, but borrows the
//! chip only as it talks: klippy configures the sensor before it sets the bus of the SPI device.

#![forbid(unsafe_code)]

use std::sync::{Arc, Mutex, PoisonError};

use crate::board::{BusDevice, BusError, BusStatus, OnWorker};
use crate::shutdown::Shutdown;
use crate::trouble::Trouble;

use super::{BusCounts, Calls, Errand, Mcu, Oid, Slot, Turn, WorkerId};

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
    /// What comes of it.
    type Answer: Copy + Send;

    /// Has the conversation.
    ///
    /// # Errors
    ///
    /// Those of the calls of `chip`.
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<Self::Answer, BusError>;
}

/// A conversation with a chip, as an [`Errand`].
pub struct Conversation<T> {
    /// What is said.
    pub talk: T,
    /// Set as it is sent.
    device: Option<SharedDevice>,
}

impl<T: Talk> Errand for Conversation<T> {
    type Answer = T::Answer;
    type Failure = BusError;

    fn run(&mut self) -> Result<T::Answer, BusError> {
        let device = self.device.take().ok_or_else(no_device)?;
        let mut chip = device.lock().unwrap_or_else(PoisonError::into_inner);
        self.talk.talk(&mut **chip)
    }
}

impl<T: Talk> Slot<Conversation<T>> {
    /// A slot for conversations. It allocates: objects make theirs at configuration.
    pub fn talking(talk: T) -> Slot<Conversation<T>> {
        Slot::new(Conversation { talk, device: None })
    }

    /// Sends the conversation, if it is here, to the chip that object `device` stands for.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if the object stands for no chip, "Bus worker queue overflow".
    pub fn converse(&mut self, turn: &mut Turn, device: Oid) -> Result<(), Shutdown> {
        let bus = turn.lend(device)?;
        self.converse_on(turn, &bus)
    }

    /// The same, for the object that stands for the chip itself.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn converse_on(&mut self, turn: &mut Turn, bus: &Bus) -> Result<(), Shutdown> {
        if let Some(conversation) = self.here() {
            conversation.device = Some(bus.device.clone());
        }
        self.send(turn, bus.worker)
    }
}

/// A conversation that was sent without a chip, which [`Slot::converse_on`] does not do.
#[cold]
fn no_device() -> BusError {
    BusError::new(BusStatus::Nack, Trouble::new("it was sent without a chip").remedy("please report it"))
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
}
