// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's serial ports. RX and TX of a port are on one wire, together with the chips.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use pinion_firmware::board::SerialPort;
use pinion_firmware::time::{Clock, TimeSource};
use pinion_firmware::trouble::Trouble;

use super::time::pass;

/// A chip on the wire.
pub(crate) trait SerialChip: Send {
    /// Hears bytes without a pause between them, at this rate. Returns the bytes that the chip then sends.
    fn hear(&mut self, bytes: &[u8], rate_hz: u32, now: Clock) -> Vec<u8>;
}

/// The wire of a port, with its chips.
pub(crate) struct SerialWire {
    /// The port's name, as in the dictionary.
    pub(crate) name: String,
    /// One message at a time, as on any wire. Only workers wait here.
    chips: Mutex<Vec<Box<dyn SerialChip>>>,
}

impl SerialWire {
    pub(crate) fn new(name: &str) -> SerialWire {
        SerialWire { name: name.to_owned(), chips: Mutex::default() }
    }

    /// Puts a chip on the wire.
    pub(crate) fn solder(&mut self, chip: Box<dyn SerialChip>) {
        self.chips.get_mut().unwrap_or_else(PoisonError::into_inner).push(chip);
    }

    /// The bytes on the wire after a message. If two chips answer at once, the low level of one wins.
    fn answer(&self, bytes: &[u8], rate_hz: u32, now: Clock) -> Vec<u8> {
        let mut chips = self.chips.lock().unwrap_or_else(PoisonError::into_inner);
        chips.iter_mut().fold(Vec::new(), |mut wire, chip| {
            let answer = chip.hear(bytes, rate_hz, now);
            wire.resize(wire.len().max(answer.len()), 0xff);
            wire.iter_mut().zip(answer).for_each(|(wire, byte)| *wire &= byte);
            wire
        })
    }
}

/// The MCU's end.
pub(crate) struct SerialDevice {
    pub(crate) wire: Arc<SerialWire>,
    pub(crate) clock: Arc<dyn TimeSource>,
    pub(crate) rate_hz: u32,
    pub(crate) received: Vec<u8>,
}

impl SerialDevice {
    /// The time of bytes with start and stop bits.
    fn pass(&self, bytes: usize) {
        pass(Duration::from_secs_f64(10.0 * bytes as f64 / f64::from(self.rate_hz.max(1))));
    }
}

impl SerialPort for SerialDevice {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.pass(bytes.len());
        self.received = bytes.to_vec();
        self.received.extend(self.wire.answer(bytes, self.rate_hz, self.clock.now()));
        Ok(())
    }

    fn receive(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble> {
        let count = bytes.len().min(self.received.len());
        match count {
            0 => pass(limit),
            _ => self.pass(count),
        }
        bytes[..count].copy_from_slice(&self.received[..count]);
        self.received.drain(..count);
        Ok(count)
    }
}
