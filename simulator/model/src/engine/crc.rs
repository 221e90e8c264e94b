// SPDX-License-Identifier: GPL-3.0-or-later
//! The checksum of many chips.

use std::borrow::Borrow;

/// A cyclic redundancy check of 8 bits, each byte from its highest bit on.
pub(crate) fn crc8(polynomial: u8, start: u8, bytes: impl IntoIterator<Item: Borrow<u8>>) -> u8 {
    bytes.into_iter().fold(start, |crc, byte| {
        (0..8).fold(crc ^ byte.borrow(), |crc, _| if crc & 0x80 != 0 { (crc << 1) ^ polynomial } else { crc << 1 })
    })
}
