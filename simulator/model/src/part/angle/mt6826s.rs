// SPDX-License-Identifier: GPL-3.0-or-later
//! MT6826S (MagnTek, rev. 1.1, "SPI Interface").

use super::shaft::Shaft;
use crate::engine::crc::crc8;
use crate::engine::spi::SpiChip;

/// Four bits of command and twelve of address, then data. A read returns as many registers as the host clocks out. The
/// angle is latched when the chip is selected.
pub(super) struct Mt6826s {
    pub(super) shaft: Shaft,
    latched: u16,
    head: u16,
    bytes: usize,
    registers: [u8; 0x156],
    /// The motor's turns at the start of a calibration.
    calibrates_from: Option<f64>,
}

impl Mt6826s {
    const READ: u16 = 0x3;
    const WRITE: u16 = 0x6;
    const ANGLE: usize = 0x003;
    const CRC: usize = 0x006;
    const AUTOCAL_FREQ: usize = 0x00e;
    const AUTOCAL_STATUS: usize = 0x113;
    const AUTOCAL_KEY: usize = 0x155;
    const AUTOCAL_START: u8 = 0x5e;
    /// Number of turns that a calibration takes.
    const AUTOCAL_TURNS: f64 = 16.0;

    pub(super) fn new(shaft: Shaft) -> Mt6826s {
        let mut registers = [0; 0x156];
        // Calibration at 100 to 200 turns per minute.
        registers[Mt6826s::AUTOCAL_FREQ] = 5 << 4;
        Mt6826s { shaft, latched: 0, head: 0, bytes: 0, registers, calibrates_from: None }
    }

    fn register(&self, address: usize) -> u8 {
        let [high, low] = (self.latched << 1).to_be_bytes();
        // The magnet and the supply have no faults.
        let angle = [high, low, 0];
        match address {
            Mt6826s::ANGLE..Mt6826s::CRC => angle[address - Mt6826s::ANGLE],
            Mt6826s::CRC => crc8(0x07, 0, angle),
            Mt6826s::AUTOCAL_STATUS => match self.calibrates_from {
                None => 0,
                Some(from) if (self.shaft.turns() - from).abs() < Mt6826s::AUTOCAL_TURNS => 1 << 6,
                Some(_) => 3 << 6,
            },
            _ => self.registers.get(address).copied().unwrap_or(0),
        }
    }
}

impl SpiChip for Mt6826s {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.latched = self.shaft.angle(15);
        (self.head, self.bytes) = (0, 0);
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let place = self.bytes;
        self.bytes += 1;
        if place < 2 {
            self.head = self.head << 8 | u16::from(byte);
            return 0xff;
        }
        let address = usize::from(self.head & 0xfff) + place - 2;
        match self.head >> 12 {
            Mt6826s::READ => return self.register(address),
            Mt6826s::WRITE if place == 2 => {
                if let Some(register) = self.registers.get_mut(address) {
                    *register = byte;
                }
                if address == Mt6826s::AUTOCAL_KEY && byte == Mt6826s::AUTOCAL_START {
                    self.calibrates_from = Some(self.shaft.turns());
                }
            }
            _ => {}
        }
        0xff
    }
}
