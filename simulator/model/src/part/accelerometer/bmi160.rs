// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer in the BMI160, after its data sheet (Bosch, BST-BMI160-DS000-09: "Register Description", "FIFO").
//!
//! Simulated: identification, the accelerometer's power mode, rates, ranges, the FIFO without headers and its length. Other
//! registers hold what is written. Not simulated: gyroscope, headers, filters, interrupts, the choice of the bus by its
//! first message.

use super::head::{Fifo, Head, Room, SAMPLE, value};
use crate::engine::register_map::{Access, Register, RegisterChip, RegisterMap};

const CHIP_ID: u8 = 0x00;
const ID: u8 = 0xd1;
const PMU_STATUS: u8 = 0x03;
const FIFO_LENGTH: u8 = 0x22;
const FIFO_DATA: u8 = 0x24;
const ACC_CONF: u8 = 0x40;
const ACC_RANGE: u8 = 0x41;
const FIFO_CONFIG_1: u8 = 0x47;
const CMD: u8 = 0x7e;

/// Commands.
const ACC_SUSPEND: u8 = 0x10;
const ACC_NORMAL: u8 = 0x11;
const FIFO_FLUSH: u8 = 0xb0;
/// FIFO_CONFIG_1: accelerations without headers.
const FIFO_ACC: u8 = 0x40;
const FIFO_HEADER: u8 = 0x10;
/// The accelerometer in PMU_STATUS.
const NORMAL: u8 = 0x10;
/// Bytes of the FIFO.
const FIFO: usize = 1024;
/// The registers that do not only hold what is written, or do not start as zero.
const REGISTERS: &[Register<u8>] = &[
    Register(CHIP_ID, Access::Read, 0, ID),
    Register(PMU_STATUS, Access::Read, 0, 0),
    Register(ACC_CONF, Access::ReadWrite, 0xff, 0x28),
    Register(ACC_RANGE, Access::ReadWrite, 0xff, 0x03),
    Register(0x45, Access::ReadWrite, 0xff, 0x88), // FIFO_DOWNS
    Register(0x46, Access::ReadWrite, 0xff, 0x80), // FIFO_CONFIG_0
    Register(FIFO_CONFIG_1, Access::ReadWrite, 0xff, FIFO_HEADER),
];

pub(super) struct Bmi160 {
    head: Head,
    registers: RegisterMap<u8>,
    fifo: Fifo,
}

impl Bmi160 {
    pub(super) fn new(head: Head) -> Bmi160 {
        Bmi160 {
            head,
            registers: RegisterMap::holding(ACC_CONF.into()..0x80, REGISTERS),
            fifo: Fifo::new(FIFO / SAMPLE),
        }
    }

    fn catch_up(&mut self) {
        let room = Room { samples: FIFO / SAMPLE, replaces: true };
        let lsb_per_g = match self.registers.get(ACC_RANGE) & 0x0f {
            0x05 => 8192.0,
            0x08 => 4096.0,
            0x0c => 2048.0,
            _ => 16384.0,
        };
        self.head.catch_up(&mut self.fifo, room, |g| g.map(|g| value(g * lsb_per_g, 16)));
        if self.registers.get(FIFO_CONFIG_1) & (FIFO_ACC | FIFO_HEADER) != FIFO_ACC {
            self.fifo.clear();
        }
    }

    fn set_up(&mut self) {
        // Code 8 is 100 samples a second, and each code doubles it.
        let rate_hz = 100.0 * f64::from(1u32 << (self.registers.get(ACC_CONF) & 0x0f)) / 256.0;
        let is_on = self.registers.get(PMU_STATUS) & NORMAL != 0;
        self.head.measure(is_on.then_some(rate_hz));
    }
}

impl RegisterChip for Bmi160 {
    const SPI_MODES: &'static [u8] = &[0, 3];

    fn begin(&mut self) {
        self.catch_up();
    }

    fn read(&mut self, register: u8) -> u8 {
        let [low, high] = self.fifo.bytes().to_le_bytes();
        match register {
            FIFO_LENGTH => low,
            register if register == FIFO_LENGTH + 1 => high,
            FIFO_DATA => self.fifo.next_byte(i16::to_le_bytes),
            _ => self.registers.read(register),
        }
    }

    fn write(&mut self, register: u8, value: u8) {
        match (register, value) {
            (CMD, ACC_NORMAL | ACC_SUSPEND) => {
                self.registers.set(PMU_STATUS, if value == ACC_NORMAL { NORMAL } else { 0 });
                self.set_up();
            }
            (CMD, FIFO_FLUSH) => self.fifo.clear(),
            _ => {
                self.registers.write(register, value);
                if register == ACC_CONF {
                    self.set_up();
                }
            }
        }
    }

    fn next(&mut self, register: u8) -> u8 {
        // The FIFO's bytes all come from one register.
        if register == FIFO_DATA { register } else { (register + 1) & 0x7f }
    }
}

#[cfg(test)]
mod tests {
    use super::super::head::TURN_ON_S;
    use super::super::tests::{Bench, READ};
    use super::*;

    /// klippy's writes before a measurement.
    const KLIPPY: [(u8, u8); 6] =
        [(CMD, 0x11), (ACC_CONF, 0x2c), (ACC_RANGE, 0x0c), (0x45, 0), (FIFO_CONFIG_1, 0x40), (CMD, 0xb0)];

    #[test]
    fn klippys_settings_give_its_samples_on_both_buses() {
        for is_spi in [true, false] {
            let mut bench = Bench::new(0.0, Bmi160::new);
            assert_eq!(bench.read(CHIP_ID), ID);
            for (register, value) in KLIPPY {
                if is_spi { bench.write(register, value) } else { bench.i2c_write(register, value) }
            }
            assert_eq!(bench.read(ACC_CONF), 0x2c, "klippy reads it back");
            bench.write(ACC_CONF - 1, 0x55);
            assert_eq!(bench.read(ACC_CONF - 1), 0, "no settings are below");
            bench.wait(TURN_ON_S + 10.5 / 1600.0);
            let length = |bench: &mut Bench<Bmi160>| u16::from_le_bytes(bench.i2c_read(FIFO_LENGTH));
            assert_eq!(length(&mut bench), 60);
            let bytes: [u8; 48] = if is_spi {
                let mut message = [0; 49];
                message[0] = FIFO_DATA | READ;
                bench.exchange(message)[1..].try_into().unwrap()
            } else {
                bench.i2c_read(FIFO_DATA)
            };
            for sample in bytes.as_chunks::<6>().0 {
                let [x, y, z] = [0, 2, 4].map(|at| i16::from_le_bytes([sample[at], sample[at + 1]]));
                assert_eq!([x, y, z], [0, 0, 2048]);
            }
            assert_eq!(length(&mut bench), 12);
            bench.wait(1.0);
            assert_eq!(length(&mut bench), 1020, "it is full");
            bench.write(CMD, ACC_SUSPEND);
            bench.write(CMD, FIFO_FLUSH);
            bench.wait(1.0);
            assert_eq!(length(&mut bench), 0, "it is switched off");
        }
    }
}
