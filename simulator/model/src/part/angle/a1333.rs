// SPDX-License-Identifier: GPL-3.0-or-later
//! A1333 (Allegro, "SPI Interface").

use super::shaft::{Shaft, even_parity};
use crate::engine::spi::{ShiftRegister, SpiChip};

/// A frame has a zero, a write bit, six bits of address and eight of data. The next frame returns the value that the
/// register has when that frame begins.
pub(super) struct A1333 {
    pub(super) shaft: Shaft,
    frame: ShiftRegister<2>,
    /// The address of the last read.
    address: u8,
}

impl A1333 {
    const ANG: u8 = 0x20;
    const STA: u8 = 0x22;
    const ANG15: u8 = 0x32;

    pub(super) fn new(shaft: Shaft) -> A1333 {
        A1333 { shaft, frame: ShiftRegister::load([0; 2]), address: 0 }
    }

    fn register(&self) -> u16 {
        match self.address {
            A1333::ANG => {
                // Odd parity in bit 12.
                let angle = self.shaft.angle(12);
                angle | (even_parity(angle) ^ 1) << 12
            }
            // The chip's identifier, and nothing to report.
            A1333::STA => 0x8000,
            A1333::ANG15 => self.shaft.angle(15),
            _ => 0,
        }
    }
}

impl SpiChip for A1333 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.frame = ShiftRegister::load(self.register().to_be_bytes());
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.frame.exchange(byte)
    }

    fn deselect(&mut self) {
        // A write needs a code that no host has here.
        if let Some([first, _]) = self.frame.message().filter(|[first, _]| self.frame.count == 2 && first & 0x40 == 0) {
            self.address = first & 0x3f;
        }
    }
}
