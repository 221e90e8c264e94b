// SPDX-License-Identifier: GPL-3.0-or-later
//! MT6816 (MagnTek, rev. 1.3, "SPI Interface").

use super::shaft::{Shaft, even_parity};
use crate::engine::spi::SpiChip;

/// A byte with the address and a read bit, then as many registers as the host clocks out. The angle is latched when the
/// chip is selected.
pub(super) struct Mt6816 {
    pub(super) shaft: Shaft,
    latched: u16,
    /// The next register to send; `None` before the address.
    place: Option<u8>,
    address: u8,
}

impl Mt6816 {
    pub(super) fn new(shaft: Shaft) -> Mt6816 {
        Mt6816 { shaft, latched: 0, place: None, address: 0 }
    }
}

impl SpiChip for Mt6816 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.latched = self.shaft.angle(14);
        self.place = None;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let Some(place) = self.place else {
            self.address = byte & 0x7f;
            // A write programs the chip. That is done in a factory.
            self.place = (byte & 0x80 != 0).then_some(self.address);
            return 0xff;
        };
        self.place = Some(place.wrapping_add(1) & 0x7f);
        let angle = self.latched << 2;
        let [high, low] = (angle | even_parity(angle)).to_be_bytes();
        match place {
            0x03 => high,
            0x04 => low,
            _ => 0,
        }
    }
}
