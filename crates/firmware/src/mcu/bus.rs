// SPDX-License-Identifier: GPL-3.0-or-later
//! Chips on a bus.
//!
//! An object, for example an SPI device, represents a chip. A sensor that uses the chip learns the oid of the SPI
//! device at configuration. It asks that object for the chip when it sends a job, because klippy configures the sensor
//! before it sets the SPI device's bus.

use crate::board::{BusDevice, BusError, OnWorker};
use crate::shutdown::Shutdown;

use super::{BusCounts, Calls, Context, DeviceId, Job, JobSlot, Oid};

/// A chip as the device of a job.
pub type Chip = dyn BusDevice;

/// A chip on a bus, and the count of its transfers.
pub struct Bus {
    chip: DeviceId<Chip>,
    calls: Calls,
}

/// A chip that counts its transfers and retries the repeatable ones.
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

impl<J: Job<Device = Chip>> JobSlot<J> {
    /// Sends the job, if it is here, to the chip that object `device` represents.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if the object represents no chip, "Bus worker queue overflow".
    pub fn send_to(&mut self, context: &mut Context, device: Oid) -> Result<(), Shutdown> {
        let chip = context.state.lend(device)?;
        self.send(context, chip)
    }
}

impl Bus {
    /// The chip, for a job.
    pub fn chip(&self) -> DeviceId<Chip> {
        self.chip
    }

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
        let calls = Calls::new(self.clock());
        let chip: Box<Chip> = Box::new(Counted { device, calls: calls.clone() });
        Ok(Bus { chip: self.device(&bus, chip)?, calls })
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
