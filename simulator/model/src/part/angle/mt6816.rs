// SPDX-License-Identifier: GPL-3.0-or-later
//! MT6816 (MagnTek, rev. 1.3, "SPI Interface").

use super::shaft::{Shaft, even_parity};
use crate::engine::register_map::RegisterChip;

/// The angle is latched when the chip is selected.
pub(super) struct Mt6816 {
    pub(super) shaft: Shaft,
    pub(super) latched: u16,
}

impl RegisterChip for Mt6816 {
    const SPI_MODES: &'static [u8] = &[3];

    fn begin(&mut self) {
        self.latched = self.shaft.angle(14);
    }

    fn read(&mut self, register: u8) -> u8 {
        let angle = self.latched << 2;
        let [high, low] = (angle | even_parity(angle)).to_be_bytes();
        match register {
            0x03 => high,
            0x04 => low,
            _ => 0,
        }
    }

    /// A write programs the chip. That is done in a factory.
    fn write(&mut self, _register: u8, _value: u8) {}
}
