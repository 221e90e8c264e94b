// SPDX-License-Identifier: GPL-3.0-or-later
//! AS5047D (ams, v1-10, "SPI Interface").

use super::shaft::{Shaft, even_parity};
use crate::engine::spi::{ShiftRegister, SpiChip};

/// A frame has its even parity, a read bit, and 14 bits of address. An answer has its parity, an error bit, and 14 bits
/// of data. The value is latched when the frame ends, and comes with the next frame.
pub(super) struct As5047d {
    pub(super) shaft: Shaft,
    frame: ShiftRegister<2>,
    answer: u16,
    /// The address for the next frame's data.
    writes: Option<u16>,
    errors: u16,
    /// SETTINGS1 and SETTINGS2.
    settings: [u16; 2],
}

impl As5047d {
    const READ: u16 = 1 << 14;
    const FRAMING: u16 = 1;
    const INVALID: u16 = 1 << 1;
    const PARITY: u16 = 1 << 2;

    pub(super) fn new(shaft: Shaft) -> As5047d {
        As5047d { shaft, frame: ShiftRegister::load([0; 2]), answer: 0, writes: None, errors: 0, settings: [0x01, 0] }
    }

    /// The value at an address; `None` if there is no such register.
    fn register(&mut self, address: u16) -> Option<u16> {
        match address {
            0x0000 | 0x0003 | 0x0016 | 0x0017 => Some(0),
            0x0001 => Some(std::mem::take(&mut self.errors)),
            0x0018 | 0x0019 => Some(self.settings[usize::from(address & 1)]),
            // DIAAGC: the offset loop is finished, and the gain is in the middle.
            0x3ffc => Some(0x0180),
            // MAG: the magnet fits.
            0x3ffd => Some(0x1200),
            // ANGLEUNC and ANGLECOM, which differ while the motor turns fast.
            0x3ffe | 0x3fff => Some(self.shaft.angle(14)),
            _ => None,
        }
    }

    fn take_in(&mut self, frame: u16) -> u16 {
        if even_parity(frame) != 0 {
            self.errors |= As5047d::PARITY;
            return 0;
        }
        let address = frame & 0x3fff;
        if let Some(setting) = self.writes.take() {
            self.settings[usize::from(setting & 1)] = frame & 0xff;
            return frame & 0xff;
        }
        let value = self.register(address);
        if frame & As5047d::READ == 0 && matches!(address, 0x0018 | 0x0019) {
            self.writes = Some(address);
        }
        value.unwrap_or_else(|| {
            self.errors |= As5047d::INVALID;
            0
        })
    }
}

impl SpiChip for As5047d {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 1
    }

    fn select(&mut self, _rate_hz: u32) {
        self.frame = ShiftRegister::load(self.answer.to_be_bytes());
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.frame.exchange(byte)
    }

    fn deselect(&mut self) {
        // Reading the error flags clears them: the answer reports the earlier errors.
        let had_errors = self.errors != 0;
        let data = match self.frame.message() {
            Some(frame) if self.frame.count == 2 => self.take_in(u16::from_be_bytes(frame)),
            _ => {
                self.errors |= As5047d::FRAMING;
                0
            }
        };
        let answer = data | u16::from(had_errors || self.errors != 0) << 14;
        self.answer = answer | even_parity(answer) << 15;
    }
}
