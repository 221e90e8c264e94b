// SPDX-License-Identifier: GPL-3.0-or-later
//! TLE5012B (Infineon, V2.1 and its user's manual, "SSC Data Transfer").

use std::sync::Arc;

use super::shaft::Shaft;
use crate::engine::crc::crc8;
use crate::engine::spi::SpiChip;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// One wire both ways: a command word (read, lock, whether to read the latched values, address, count), data words, and
/// the chip's safety word with a checksum. An empty selection latches angle, revolutions and clock.
pub(super) struct Tle5012b {
    pub(super) shaft: Shaft,
    time: Arc<dyn TimeSource>,
    registers: [u16; 0x40],
    /// The latched values of AVAL to FSYNC.
    latched: [u16; 4],
    /// The frame of the last angle that was read.
    read_frame: Option<u64>,
    /// STAT has not been read since power-up.
    was_reset: bool,
    /// The bytes of the command and the data.
    said: Vec<u8>,
    bytes: usize,
}

impl Tle5012b {
    const STAT: usize = 0x00;
    const AVAL: usize = 0x02;
    const FSYNC: usize = 0x05;
    const MOD1: usize = 0x06;
    /// Registers that need the lock code for a write.
    const LOCKED: std::ops::RangeInclusive<usize> = 0x05..=0x11;
    const LOCK: u16 = 0b1010;
    /// Frequency of its timer.
    const TIMER_HZ: u64 = 750_000;
    /// TEMPER at 25 degrees: -152 at 0 degrees, and 2.776 for each degree.
    const TEMPER: i16 = -83;

    pub(super) fn new(shaft: Shaft, time: Arc<dyn TimeSource>) -> Tle5012b {
        let mut registers = [0; 0x40];
        // MOD1 with updates every 42.7 us, MOD2 with the range of 360 degrees, MOD4.
        registers[Tle5012b::MOD1] = 0x4001;
        registers[0x08] = 0x0801;
        registers[0x0e] = 0x0080;
        Tle5012b {
            shaft,
            time,
            registers,
            latched: [0; 4],
            read_frame: None,
            was_reset: true,
            said: Vec::new(),
            bytes: 0,
        }
    }

    /// Ticks of its timer since power-up; then the ticks between two measurements.
    fn timer(&self) -> (u64, u64) {
        let ticks = self.time.now().since(Clock::EPOCH).max(0) as u64;
        let timer = u128::from(ticks) * u128::from(Tle5012b::TIMER_HZ) / u128::from(CLOCK_FREQ);
        (timer as u64, 16 << (self.registers[Tle5012b::MOD1] >> 14))
    }

    /// AVAL to FSYNC.
    fn measured(&self) -> [u16; 4] {
        let (timer, period) = self.timer();
        let frame = timer / period;
        let is_new = u16::from(self.read_frame != Some(frame)) << 15;
        let revolutions = self.shaft.turns().floor() as i64 as u16 & 0x1ff;
        let counter = (frame & 0x3f) as u16;
        let within = (timer % period) as u16 & 0x7f;
        [
            is_new | self.shaft.angle(15),
            is_new,
            is_new | counter << 9 | revolutions,
            within << 9 | Tle5012b::TEMPER as u16 & 0x1ff,
        ]
    }

    fn command(&self) -> Option<u16> {
        Some(u16::from_be_bytes(self.said.get(..2)?.try_into().ok()?))
    }

    /// The word that a read returns at this place after the command.
    fn word(&mut self, command: u16, place: usize) -> u16 {
        let address = (usize::from(command >> 4 & 0x3f) + place) & 0x3f;
        match address {
            Tle5012b::STAT => {
                // Bit 0 reports a reset. Bit 15 says that this is new.
                0x8000 | u16::from(std::mem::take(&mut self.was_reset))
            }
            Tle5012b::AVAL..=Tle5012b::FSYNC => {
                let measured = if command & 0x0400 != 0 { self.latched } else { self.measured() };
                if address == Tle5012b::AVAL {
                    let (timer, period) = self.timer();
                    self.read_frame = Some(timer / period);
                }
                measured[address - Tle5012b::AVAL]
            }
            address => self.registers[address],
        }
    }

    fn safety(&self) -> [u8; 2] {
        // No fault except a reset. The first sensor answers.
        let status = if self.was_reset { 0x7e } else { 0xfe };
        [status, !crc8(0x1d, 0xff, &self.said)]
    }
}

impl SpiChip for Tle5012b {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 1
    }

    fn select(&mut self, _rate_hz: u32) {
        self.said.clear();
        self.bytes = 0;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let place = self.bytes;
        self.bytes += 1;
        let Some(command) = self.command() else {
            self.said.push(byte);
            return byte;
        };
        let data = 2 + 2 * usize::from(command & 0xf);
        if place < data && command & 0x8000 == 0 {
            self.said.push(byte);
            return byte;
        }
        if place >= data {
            return self.safety()[(place - data) & 1];
        }
        if place.is_multiple_of(2) {
            let word = self.word(command, place / 2 - 1);
            self.said.extend(word.to_be_bytes());
        }
        self.said[place]
    }

    fn deselect(&mut self) {
        if self.bytes == 0 {
            self.latched = self.measured();
            return;
        }
        let Some(command) = self.command().filter(|command| command & 0x8000 == 0) else { return };
        let address = usize::from(command >> 4 & 0x3f);
        let locked = Tle5012b::LOCKED.contains(&address) && command >> 11 & 0xf != Tle5012b::LOCK;
        if let (Some(&[high, low]), false) = (self.said.get(2..4).and_then(|word| word.first_chunk()), locked) {
            self.registers[address] = u16::from_be_bytes([high, low]);
        }
    }
}
