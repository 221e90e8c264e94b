// SPDX-License-Identifier: GPL-3.0-or-later
//! Conversations with chips on a bus.
//!
//! An object, for example an SPI device, represents a chip and lends it to other objects. A sensor that talks to the
//! chip learns the oid of the SPI device at configuration. It borrows the chip only while it talks, because klippy
//! configures the sensor before it sets the SPI device's bus.

#![forbid(unsafe_code)]

use std::sync::{Arc, Mutex, PoisonError};

use crate::board::{BusDevice, BusError, BusStatus, OnWorker};
use crate::shutdown::Shutdown;
use crate::trouble::Trouble;

use super::{BusCounts, Calls, Context, Errand, Oid, Slot, WorkerId};

/// A chip that several conversations use in turn. They all run on the worker of its bus, one after the other. So the
/// lock is always free. The core never takes it.
type SharedDevice = Arc<Mutex<Box<dyn BusDevice>>>;

/// A chip and the worker of its bus.
#[derive(Clone)]
pub struct Bus {
    worker: WorkerId,
    device: SharedDevice,
    calls: Calls,
}

/// A chip that counts its transfers and retries the ones that may be repeated.
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

/// The code of a conversation with a chip. It runs on the worker and may block there.
pub trait Talk: Send + 'static {
    /// The result of the conversation.
    type Answer: Copy + Send;

    /// Runs the conversation.
    ///
    /// # Errors
    ///
    /// The errors of the calls to `chip`.
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<Self::Answer, BusError>;
}

/// A conversation with a chip, as an [`Errand`].
pub struct Conversation<T> {
    /// The code of the conversation.
    pub talk: T,
    /// Set when the conversation is sent.
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
    /// Creates a slot for conversations. This allocates, so objects call it at configuration.
    pub fn talking(talk: T) -> Slot<Conversation<T>> {
        Slot::new(Conversation { talk, device: None })
    }

    /// Sends the conversation, if it is here, to the chip that object `device` represents.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if the object represents no chip, "Bus worker queue overflow".
    pub fn converse(&mut self, context: &mut Context, device: Oid) -> Result<(), Shutdown> {
        let bus = context.state.lend(device)?;
        self.converse_on(context, &bus)
    }

    /// The same, for the object that represents the chip itself.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn converse_on(&mut self, context: &mut Context, bus: &Bus) -> Result<(), Shutdown> {
        if let Some(conversation) = self.here() {
            conversation.device = Some(bus.device.clone());
        }
        self.send(context, bus.worker)
    }
}

/// The error for a conversation without a chip. [`Slot::converse_on`] always sets the chip.
#[cold]
fn no_device() -> BusError {
    BusError::new(BusStatus::Nack, Trouble::new("it was sent without a chip").remedy("please report it"))
}

impl Bus {
    /// The transfers to and from this chip.
    pub(super) fn counts(&self) -> BusCounts {
        self.calls.counts()
    }
}

/// The worker of every software bus. These buses may share any lines, for example one MISO with several clocks. So one
/// worker runs them all.
const SOFTWARE: &str = "software";

impl Context<'_> {
    /// A chip that the board has opened.
    ///
    /// # Errors
    ///
    /// An error if the worker cannot be started.
    pub fn bus(&mut self, OnWorker { bus, device }: OnWorker<dyn BusDevice>) -> Result<Bus, Shutdown> {
        let (worker, calls) = (self.worker(&bus)?, Calls::new(self.clock()));
        let counted = Counted { device, calls: calls.clone() };
        Ok(Bus { worker, device: Arc::new(Mutex::new(Box::new(counted))), calls })
    }

    /// A device on a software bus, made of GPIO lines.
    ///
    /// # Errors
    ///
    /// An error if the worker cannot be started.
    pub fn software_bus(&mut self, device: Box<dyn BusDevice>) -> Result<Bus, Shutdown> {
        self.bus(OnWorker { bus: SOFTWARE.to_owned(), device })
    }
}
