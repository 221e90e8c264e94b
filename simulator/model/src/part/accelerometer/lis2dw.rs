// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometers LIS2DW12 and LIS3DH, after their data sheets (ST, DocID 030828: "Digital interfaces", "FIFO",
//! "Register mapping"; DocID 17530 rev. 2: "Registers Description").
//!
//! Simulated: all registers; rates, ranges and resolutions, the FIFO and its status. Not simulated: filters, self test,
//! interrupts and the events that cause them, single conversions, the temperature.

use super::head::{Fifo, Head, Room, value};
use crate::engine::register_map::{Access, Register, RegisterChip, RegisterMap};

const WHO_AM_I: u8 = 0x0f;
const CTRL1: u8 = 0x20;
const CTRL2: u8 = 0x21;
/// CTRL_REG4 of a LIS3DH.
const CTRL4: u8 = 0x23;
/// CTRL_REG5 of a LIS3DH.
const CTRL5: u8 = 0x24;
const CTRL6: u8 = 0x25;
const STATUS: u8 = 0x27;
const OUT_X_L: u8 = 0x28;
const OUT_Z_H: u8 = 0x2d;
const FIFO_CTRL: u8 = 0x2e;
const FIFO_SAMPLES: u8 = 0x2f;

/// CTRL2: the address increments in a message.
const IF_ADD_INC: u8 = 0x04;
/// CTRL5 of a LIS3DH.
const FIFO_EN: u8 = 0x40;
/// CTRL1 of a LIS3DH.
const LP_EN: u8 = 0x08;
/// CTRL4 of a LIS3DH.
const HR: u8 = 0x08;
const FIFO_OVERRUN: u8 = 0x40;
const FIFO_THRESHOLD: u8 = 0x80;
/// FIFO_SRC_REG of a LIS3DH.
const FIFO_EMPTY: u8 = 0x20;
/// Entries of the FIFO.
const FIFO: usize = 32;

/// The differences between the two chips.
pub(super) struct Model {
    id: u8,
    /// Registers that do not start as zero.
    resets: &'static [Register<u8>],
    /// Samples a second, by the code in CTRL1.
    rate_hz: fn(ctrl1: u8) -> f64,
    /// Of its 16 bits.
    resolution_bits: fn(&Registers) -> u32,
    /// By the code of the range, of the left-justified value.
    lsb_per_g: [f64; 4],
    range: fn(&Registers) -> u8,
    room: fn(&Registers) -> Room,
    fifo_status: fn(&Fifo, threshold: u8) -> u8,
    /// The register that a message's first byte names, and whether it increments.
    register: fn(&Registers, first: u8, is_spi: bool) -> (u8, bool),
}

type Registers = RegisterMap<u8>;

const BYPASS: Room = Room { samples: 1, replaces: true };
const STOPS: Room = Room { samples: FIFO, replaces: false };
const STREAM: Room = Room { samples: FIFO, replaces: true };

pub(super) const LIS2DW: Model = Model {
    id: 0x44,
    resets: &[Register(CTRL2, Access::ReadWrite, 0xff, IF_ADD_INC)],
    rate_hz: |ctrl1| {
        let is_high_performance = ctrl1 >> 2 & 3 == 1;
        match ctrl1 >> 4 {
            0 => 0.0,
            1 if !is_high_performance => 1.6,
            1 | 2 => 12.5,
            7.. if !is_high_performance => 200.0,
            code @ 3..=9 => 12.5 * f64::from(1u32 << (code - 2)),
            _ => 1600.0,
        }
    },
    // The first low-power mode has 12 bits.
    resolution_bits: |registers| if registers.get(CTRL1) & 0x0f == 0 { 12 } else { 14 },
    // 0.244 mg/digit of 14 bits at 2 g.
    lsb_per_g: [4.0 / 0.000_244, 4.0 / 0.000_488, 4.0 / 0.000_976, 4.0 / 0.001_952],
    range: |registers| registers.get(CTRL6) >> 4 & 3,
    room: |registers| match registers.get(FIFO_CTRL) >> 5 {
        0 => BYPASS,
        1 => STOPS,
        _ => STREAM,
    },
    fifo_status: |fifo, threshold| {
        let entries = fifo.samples.len() as u8;
        let reached = if entries >= threshold { FIFO_THRESHOLD } else { 0 };
        reached | entries | if fifo.overrun { FIFO_OVERRUN } else { 0 }
    },
    register: |registers, first, _| (first & 0x7f, registers.get(CTRL2) & IF_ADD_INC != 0),
};

pub(super) const LIS3DH: Model = Model {
    id: 0x33,
    // The axes are enabled.
    resets: &[Register(CTRL1, Access::ReadWrite, 0xff, 0x07)],
    rate_hz: |ctrl1| match (ctrl1 >> 4, ctrl1 & LP_EN != 0) {
        (0, _) => 0.0,
        (1, _) => 1.0,
        (2, _) => 10.0,
        (code @ 3..=7, _) => 25.0 * f64::from(1u32 << (code - 3)),
        (8, _) => 1600.0,
        (_, true) => 5376.0,
        (_, false) => 1344.0,
    },
    resolution_bits: |registers| match (registers.get(CTRL1) & LP_EN, registers.get(CTRL4) & HR) {
        (0, 0) => 10,
        (0, _) => 12,
        _ => 8,
    },
    // 1, 2, 4 and 11.72 mg/digit of 12 bits.
    lsb_per_g: [16.0 / 0.001, 16.0 / 0.002, 16.0 / 0.004, 16.0 / 0.011_72],
    range: |registers| registers.get(CTRL4) >> 4 & 3,
    room: |registers| match registers.get(FIFO_CTRL) >> 6 {
        _ if registers.get(CTRL5) & FIFO_EN == 0 => BYPASS,
        0 => BYPASS,
        1 => STOPS,
        _ => STREAM,
    },
    fifo_status: |fifo, threshold| {
        let entries = fifo.samples.len() as u8;
        let reached = if entries > threshold { FIFO_THRESHOLD } else { 0 };
        let empty = if entries == 0 { FIFO_EMPTY } else { 0 };
        // Five bits: 31 and the overrun are 32 entries.
        let full = if usize::from(entries) == FIFO { FIFO_OVERRUN } else { 0 };
        reached | empty | full | entries.min(FIFO as u8 - 1)
    },
    register: |_, first, is_spi| (first & 0x3f, first & if is_spi { 0x40 } else { 0x80 } != 0),
};

pub(super) struct Lis {
    model: &'static Model,
    head: Head,
    registers: Registers,
    fifo: Fifo,
}

impl Lis {
    pub(super) fn new(model: &'static Model, head: Head) -> Lis {
        let mut registers = RegisterMap::holding(0..0x80, model.resets);
        registers.add(&[Register(WHO_AM_I, Access::Read, 0, model.id)]);
        Lis { model, head, registers, fifo: Fifo::new(FIFO) }
    }

    fn catch_up(&mut self) {
        let bits = (self.model.resolution_bits)(&self.registers);
        let lsb_per_g = self.model.lsb_per_g[usize::from((self.model.range)(&self.registers))];
        let room = (self.model.room)(&self.registers);
        self.head.catch_up(&mut self.fifo, room, |g| g.map(|g| value(g * lsb_per_g, bits)));
    }
}

impl RegisterChip for Lis {
    const SPI_MODES: &'static [u8] = &[0, 3];

    fn register(&mut self, first: u8, is_spi: bool) -> (u8, bool) {
        (self.model.register)(&self.registers, first, is_spi)
    }

    fn begin(&mut self) {
        self.catch_up();
    }

    fn read(&mut self, register: u8) -> u8 {
        match register {
            OUT_X_L..=OUT_Z_H => {
                let place = usize::from(register - OUT_X_L);
                self.fifo.front()[place / 2].to_le_bytes()[place % 2]
            }
            // New data of all axes.
            STATUS => {
                if self.fifo.samples.is_empty() {
                    0
                } else {
                    0x0f
                }
            }
            FIFO_SAMPLES => (self.model.fifo_status)(&self.fifo, self.registers.get(FIFO_CTRL) & 0x1f),
            _ => self.registers.read(register),
        }
    }

    fn write(&mut self, register: u8, value: u8) {
        self.registers.write(register, value);
        match register {
            CTRL1 => {
                let rate_hz = (self.model.rate_hz)(value);
                self.head.measure((rate_hz > 0.0).then_some(rate_hz));
            }
            FIFO_CTRL | CTRL5 if (self.model.room)(&self.registers).samples == 1 => self.fifo.clear(),
            _ => {}
        }
    }

    fn next(&mut self, register: u8) -> u8 {
        if register != OUT_Z_H {
            return (register + 1) & 0x7f;
        }
        self.fifo.pop();
        // With the FIFO a long read goes around in the data.
        if (self.model.room)(&self.registers).samples == 1 { register + 1 } else { OUT_X_L }
    }
}

#[cfg(test)]
mod tests {
    use super::super::head::TURN_ON_S;
    use super::super::tests::{Bench, READ};
    use super::*;

    /// A chip, its rate, 1 g, and registers with their values.
    type Measurement = (&'static Model, f64, i16, &'static [(u8, u8)]);

    /// klippy's writes before a measurement.
    const KLIPPY: [Measurement; 2] = [
        (&LIS2DW, 1600.0, 2048, &[(CTRL2, 0x06), (CTRL6, 0x34), (FIFO_CTRL, 0xc0), (CTRL1, 0x94)]),
        (&LIS3DH, 1344.0, 1360, &[(CTRL1, 0x97), (CTRL2, 0), (CTRL4, 0x38), (CTRL5, 0x40), (FIFO_CTRL, 0x80)]),
    ];

    #[test]
    fn klippys_settings_give_its_samples_on_both_buses() {
        for (model, rate_hz, one_g, writes) in KLIPPY {
            for is_spi in [true, false] {
                let mut bench = Bench::new(0.0, |head| Lis::new(model, head));
                let id = if is_spi { bench.read(WHO_AM_I) } else { bench.i2c_read::<1>(WHO_AM_I)[0] };
                assert_eq!(id, model.id);
                for (register, value) in writes {
                    if is_spi {
                        bench.write(*register, *value)
                    } else {
                        bench.i2c_write(*register, *value)
                    }
                    assert_eq!(bench.read(*register), *value, "{register:#04x} is read back");
                }
                bench.wait(TURN_ON_S + 8.5 / rate_hz);
                let status = |bench: &mut Bench<Lis>| {
                    if is_spi { bench.read(FIFO_SAMPLES) } else { bench.i2c_read::<1>(FIFO_SAMPLES)[0] }
                };
                assert_eq!(status(&mut bench) & 0x3f, 8, "{rate_hz}");
                // As the firmware reads eight samples.
                let bytes: [u8; 48] = if is_spi {
                    let many = if model.id == LIS3DH.id { 0x40 } else { 0 };
                    let mut message = [0; 49];
                    message[0] = OUT_X_L | READ | many;
                    bench.exchange(message)[1..].try_into().unwrap()
                } else {
                    bench.i2c_read(OUT_X_L | if model.id == LIS3DH.id { 0x80 } else { 0 })
                };
                for sample in bytes.as_chunks::<6>().0 {
                    let [x, y, z] = [0, 2, 4].map(|at| i16::from_le_bytes([sample[at], sample[at + 1]]));
                    assert_eq!([x, y, z], [0, 0, one_g]);
                }
                assert_eq!(status(&mut bench) & 0x1f, 0);
            }
        }
    }

    #[test]
    fn a_full_fifo_says_so() {
        for (model, rate_hz, _, writes) in KLIPPY {
            let mut bench = Bench::new(0.0, |head| Lis::new(model, head));
            writes.iter().for_each(|(register, value)| bench.write(*register, *value));
            bench.wait(TURN_ON_S + 31.5 / rate_hz);
            assert_eq!(bench.read(FIFO_SAMPLES) & 0x7f, 31);
            bench.wait(2.0 / rate_hz);
            assert_ne!(bench.read(FIFO_SAMPLES) & FIFO_OVERRUN, 0);
            bench.write(FIFO_CTRL, 0);
            assert_eq!(bench.read(FIFO_SAMPLES) & 0x1f, 0, "emptied by the bypass mode");
            bench.write(CTRL1, 0);
            bench.wait(1.0);
            assert_eq!(bench.read(STATUS), 0, "it is switched off");
        }
    }

    #[test]
    fn it_feels_the_motor() {
        let mut bench = Bench::new(0.0, |head| Lis::new(&LIS2DW, head));
        KLIPPY[0].3.iter().for_each(|(register, value)| bench.write(*register, *value));
        let mut largest = 0;
        for n in 0..400 {
            if n < 40 {
                bench.step();
            }
            bench.wait(1.0 / 1600.0);
            let [_, low, high] = bench.exchange([OUT_X_L | READ, 0, 0]);
            bench.exchange([OUT_Z_H | READ, 0]);
            largest = largest.max(i16::from_le_bytes([low, high]).unsigned_abs());
        }
        assert!(largest > 500, "{largest}");
    }
}
