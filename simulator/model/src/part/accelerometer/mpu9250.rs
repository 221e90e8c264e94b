// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometers in the MPU-9250 and the ICM-20948, after their data sheets (InvenSense, RM-MPU-9250A-00 rev. 1.6:
//! "Register Map"; DS-000189 rev. 1.3: "Register Descriptions").
//!
//! Simulated: identification, sleep, rates, ranges, the FIFO with accelerations alone, its count and its overflow. Other
//! registers hold what is written. Not simulated: gyroscope, magnetometer, temperature, filters, interrupts.

use super::head::{Fifo, Head, Room, SAMPLE, value};
use crate::engine::register_map::{Access, Register, RegisterChip, RegisterMap};

const SLEEP: u8 = 0x40;
const RESET: u8 = 0x80;
/// USER_CTRL.
const FIFO_EN: u8 = 0x40;
/// Bytes of the FIFO.
const FIFO: usize = 512;
/// LSB per g at the smallest range. Each further range halves it.
const LSB_PER_G: f64 = 16384.0;

/// The registers of a chip.
pub(super) struct Map {
    who_am_i: (u8, u8),
    pwr_mgmt_1: u8,
    user_ctrl: u8,
    /// In USER_CTRL.
    fifo_reset: u8,
    fifo_en: u8,
    /// The acceleration in FIFO_EN.
    accel: u8,
    fifo_count: u8,
    fifo_r_w: u8,
    /// INT_STATUS and its bit of an overflow. A read clears it.
    overflow: (u8, u8),
    /// It selects a bank of registers.
    bank_sel: Option<u8>,
    /// The bank and the register of the range, and the range's place in it.
    accel_config: (usize, u8, u8),
    rate_hz: fn(&Registers) -> f64,
    /// Whether a full FIFO keeps its oldest.
    keeps_oldest: fn(&Registers) -> bool,
}

/// By bank.
type Registers = [RegisterMap<u8>; 4];

impl Map {
    /// The registers at power-up: the best clock, and an ICM-20948 sleeps.
    fn resets(&self) -> Registers {
        let power = if self.bank_sel.is_some() { SLEEP | 1 } else { 1 };
        let mut banks = [(); 4].map(|()| RegisterMap::holding(0..0x80, &[]));
        banks[0].add(&[
            Register(self.who_am_i.0, Access::Read, 0, self.who_am_i.1),
            Register(self.pwr_mgmt_1, Access::ReadWrite, 0xff, power),
            // The reset of the FIFO clears itself.
            Register(self.user_ctrl, Access::ReadWrite, !self.fifo_reset, 0),
            Register(self.overflow.0, Access::ClearOnRead, 0, 0),
        ]);
        banks
    }
}

pub(super) const MPU9250: Map = Map {
    who_am_i: (0x75, 0x71),
    pwr_mgmt_1: 0x6b,
    user_ctrl: 0x6a,
    fifo_reset: 0x04,
    fifo_en: 0x23,
    accel: 0x08,
    fifo_count: 0x72,
    fifo_r_w: 0x74,
    overflow: (0x3a, 0x10),
    bank_sel: None,
    accel_config: (0, 0x1c, 3),
    // accel_fchoice_b of ACCEL_CONFIG_2 goes past the filter; else SMPLRT_DIV divides.
    rate_hz: |registers| {
        if registers[0].get(0x1d) & 8 != 0 { 4000.0 } else { 1000.0 / (1.0 + f64::from(registers[0].get(0x19))) }
    },
    // FIFO_MODE of CONFIG.
    keeps_oldest: |registers| registers[0].get(0x1a) & 0x40 != 0,
};

pub(super) const ICM20948: Map = Map {
    who_am_i: (0x00, 0xea),
    pwr_mgmt_1: 0x06,
    user_ctrl: 0x03,
    fifo_reset: 0x04,
    fifo_en: 0x67,
    accel: 0x10,
    fifo_count: 0x70,
    fifo_r_w: 0x72,
    overflow: (0x1b, 0x1f),
    bank_sel: Some(0x7f),
    accel_config: (2, 0x14, 1),
    // ACCEL_FCHOICE of ACCEL_CONFIG uses the filter, and ACCEL_SMPLRT_DIV divides.
    rate_hz: |registers| {
        let divider = u16::from_be_bytes([registers[2].get(0x10), registers[2].get(0x11)]);
        if registers[2].get(0x14) & 1 == 0 { 4500.0 } else { 1125.0 / (1.0 + f64::from(divider)) }
    },
    // FIFO_MODE.
    keeps_oldest: |registers| registers[0].get(0x69) & 1 != 0,
};

pub(super) struct Mpu {
    map: &'static Map,
    head: Head,
    registers: Registers,
    bank: usize,
    fifo: Fifo,
    is_sampling: bool,
}

impl Mpu {
    pub(super) fn new(map: &'static Map, head: Head) -> Mpu {
        let registers = map.resets();
        Mpu { map, head, registers, bank: 0, fifo: Fifo::new(FIFO / SAMPLE), is_sampling: false }
    }

    fn get(&self, register: u8) -> u8 {
        self.registers[0].get(register)
    }

    fn catch_up(&mut self) {
        let room = Room { samples: FIFO / SAMPLE, replaces: !(self.map.keeps_oldest)(&self.registers) };
        let (bank, register, shift) = self.map.accel_config;
        let range = self.registers[bank].get(register) >> shift & 3;
        let lsb_per_g = LSB_PER_G / f64::from(1u32 << range);
        self.head.catch_up(&mut self.fifo, room, |g| g.map(|g| value(g * lsb_per_g, 16)));
        if std::mem::take(&mut self.fifo.overrun) {
            let (register, bits) = self.map.overflow;
            self.registers[0].set(register, self.get(register) | bits);
        }
    }

    /// Starts or stops the FIFO according to the registers.
    fn set_up(&mut self) {
        let feeds = self.get(self.map.user_ctrl) & FIFO_EN != 0 && self.get(self.map.fifo_en) & self.map.accel != 0;
        let samples = feeds && self.get(self.map.pwr_mgmt_1) & SLEEP == 0;
        if samples != self.is_sampling {
            self.is_sampling = samples;
            self.head.measure(samples.then(|| (self.map.rate_hz)(&self.registers)));
        }
    }
}

impl RegisterChip for Mpu {
    fn begin(&mut self) {
        self.catch_up();
    }

    fn read(&mut self, register: u8) -> u8 {
        let [high, low] = self.fifo.bytes().to_be_bytes();
        match register {
            _ if self.bank != 0 => self.registers[self.bank].read(register),
            _ if register == self.map.fifo_count => high,
            _ if register == self.map.fifo_count + 1 => low,
            _ if register == self.map.fifo_r_w => self.fifo.next_byte(i16::to_be_bytes),
            _ => self.registers[0].read(register),
        }
    }

    fn write(&mut self, register: u8, value: u8) {
        if Some(register) == self.map.bank_sel {
            self.bank = usize::from(value >> 4 & 3);
            return;
        }
        self.registers[self.bank].write(register, value);
        if self.bank == 0 && register == self.map.user_ctrl && value & self.map.fifo_reset != 0 {
            self.fifo.clear();
        }
        if self.bank == 0 && register == self.map.pwr_mgmt_1 && value & RESET != 0 {
            self.registers = self.map.resets();
            self.fifo.clear();
            self.bank = 0;
        }
        self.set_up();
    }

    fn next(&mut self, register: u8) -> u8 {
        // The FIFO's bytes all come from one register.
        if self.bank == 0 && register == self.map.fifo_r_w { register } else { (register + 1) & 0x7f }
    }
}

#[cfg(test)]
mod tests {
    use super::super::head::TURN_ON_S;
    use super::super::tests::Bench;
    use super::*;

    /// A chip, its rate, 1 g, and registers with their values.
    type Measurement = (&'static Map, f64, i16, &'static [(u8, u8)]);

    /// klippy's writes before a measurement.
    const KLIPPY: [Measurement; 2] = [
        (
            &MPU9250,
            4000.0,
            4096,
            &[
                (0x6b, 0),
                (0x6c, 7),
                (0x19, 0),
                (0x1a, 1),
                (0x1c, 0x10),
                (0x1d, 8),
                (0x23, 0),
                (0x6a, 4),
                (0x6a, 0x40),
                (0x23, 8),
            ],
        ),
        (
            &ICM20948,
            4500.0,
            2048,
            &[
                (0x06, 1),
                (0x07, 7),
                (0x10, 0),
                (0x11, 0),
                (0x7f, 0x20),
                (0x14, 6),
                (0x7f, 0),
                (0x67, 0),
                (0x03, 0x0e),
                (0x03, 0x40),
                (0x67, 0x10),
            ],
        ),
    ];

    fn count(bench: &mut Bench<Mpu>, map: &Map) -> u16 {
        u16::from_be_bytes(bench.i2c_read(map.fifo_count))
    }

    #[test]
    fn klippys_settings_give_its_samples() {
        for (map, rate_hz, one_g, writes) in KLIPPY {
            let mut bench = Bench::new(0.0, |head| Mpu::new(map, head));
            assert_eq!(bench.i2c_read(map.who_am_i.0), [map.who_am_i.1]);
            writes.iter().for_each(|(register, value)| bench.i2c_write(*register, *value));
            bench.wait(TURN_ON_S + 10.5 / rate_hz);
            assert_eq!(count(&mut bench, map), 60);
            let bytes: [u8; 48] = bench.i2c_read(map.fifo_r_w);
            for sample in bytes.as_chunks::<6>().0 {
                let [x, y, z] = [0, 2, 4].map(|at| i16::from_be_bytes([sample[at], sample[at + 1]]));
                assert_eq!([x, y, z], [0, 0, one_g]);
            }
            assert_eq!(count(&mut bench, map), 12);
            assert_eq!(bench.i2c_read(map.overflow.0), [0]);
            bench.wait(1.0);
            assert_eq!(count(&mut bench, map), 510, "it is full");
            assert_ne!(bench.i2c_read(map.overflow.0), [0]);
            assert_eq!(bench.i2c_read(map.overflow.0), [0], "a read clears it");
            bench.i2c_write(map.pwr_mgmt_1, RESET);
            assert_eq!(bench.i2c_read(map.pwr_mgmt_1), [map.resets()[0].get(map.pwr_mgmt_1)]);
            assert_eq!(count(&mut bench, map), 0, "a reset empties it");
            writes.iter().for_each(|(register, value)| bench.i2c_write(*register, *value));
            bench.i2c_write(map.pwr_mgmt_1, SLEEP);
            bench.i2c_write(map.user_ctrl, FIFO_EN | map.fifo_reset);
            bench.wait(1.0);
            assert_eq!(count(&mut bench, map), 0, "it sleeps");
        }
    }
}
