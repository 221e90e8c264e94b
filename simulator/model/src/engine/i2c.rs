// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's I2C buses and the chips at their addresses.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use crate::description::buses::I2cBusConfig;
use pinion_firmware::board::{BusDevice, BusError, BusStatus};
use pinion_firmware::trouble::Trouble;

/// A chip as its data sheet describes it. The calls come in the order of the signals: a start with the address, bytes,
/// perhaps another start, a stop.
pub(crate) trait I2cChip: Send {
    /// A start or a repeated start, to write to the chip or to read from it. Returns whether the chip acknowledges its
    /// address.
    fn start(&mut self, read: bool) -> bool {
        let _ = read;
        true
    }

    /// Takes a byte in. Returns whether the chip acknowledges it.
    fn write(&mut self, byte: u8) -> bool;

    /// Returns the next byte of the chip.
    fn read(&mut self) -> u8;

    /// The bus is free again.
    fn stop(&mut self) {}
}

/// A chip's place on its bus.
struct Socket {
    name: String,
    address: u8,
    chip: Box<dyn I2cChip>,
}

pub(crate) struct I2cBus {
    /// As in the dictionary.
    pub(crate) name: String,
    delay: Duration,
    /// One transfer at a time, as on any bus. Only workers wait here.
    sockets: Mutex<Vec<Socket>>,
}

impl I2cBus {
    /// The bus of a description, without chips.
    pub(crate) fn new(config: &I2cBusConfig) -> I2cBus {
        let delay = Duration::from_micros(config.delay_us);
        I2cBus { name: config.name.clone(), delay, sockets: Mutex::new(Vec::new()) }
    }

    /// Puts a chip on the bus.
    pub(crate) fn solder(&mut self, name: String, address: u8, chip: Box<dyn I2cChip>) {
        self.sockets.get_mut().unwrap_or_else(PoisonError::into_inner).push(Socket { name, address, chip });
    }

    fn transfer(&self, address: u8, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let mut sockets = self.sockets.lock().unwrap_or_else(PoisonError::into_inner);
        thread::sleep(self.delay);
        let failed = |status, cause: &str| {
            let trouble = Trouble::new(cause).remedy("name a chip of the bus");
            Err(BusError::new(status, trouble.of(format_args!("the simulated {} at address {address}", self.name))))
        };
        let Some(socket) = sockets.iter_mut().find(|socket| socket.address == address) else {
            return failed(BusStatus::StartNack, "no chip has this address");
        };
        let Socket { name, chip, .. } = socket;
        let mut talk = |chip: &mut Box<dyn I2cChip>| {
            if (!write.is_empty() || read.is_empty()) && !chip.start(false) {
                return Some((BusStatus::StartNack, "does not acknowledge its address"));
            }
            if !write.iter().all(|byte| chip.write(*byte)) {
                return Some((BusStatus::Nack, "does not acknowledge a byte"));
            }
            if !read.is_empty() && !chip.start(true) {
                let status = if write.is_empty() { BusStatus::StartNack } else { BusStatus::StartReadNack };
                return Some((status, "does not acknowledge its address"));
            }
            read.fill_with(|| chip.read());
            None
        };
        let fault = talk(chip);
        chip.stop();
        fault.map_or(Ok(()), |(status, cause)| failed(status, &format!("{name} {cause}")))
    }
}

/// The MCU's end: one bus device on this bus.
pub(crate) struct I2cDevice {
    pub(crate) bus: Arc<I2cBus>,
    pub(crate) address: u8,
}

impl BusDevice for I2cDevice {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.bus.transfer(self.address, write, read)
    }
}
