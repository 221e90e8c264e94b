// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer ADXL345 on SPI.
//!
//! Registers from its data sheet (Analog Devices, rev. G: "FIFO", "Register Map"). A sample is read together with the
//! next two registers, FIFO_CTL and FIFO_STATUS. FIFO_CTL must still hold klippy's value: this shows glitches on the
//! wires. FIFO_STATUS has the number of samples, so no separate query comes first.

use crate::board::{BusDevice, BusError};
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{Command, Feature, Hosts, Oid, Response, WireClock, command};
use crate::time::Ticks;

use super::fifo_sensor::{BusType, FifoChip, FifoSensor, Fill, Reading, configure};
use super::sensor_bulk::{Words, own_words};

pub(super) const FEATURE: Feature = Feature {
    serves: "ADXL345 accelerometers",

    commands: &[CONFIG_ADXL345, QUERY_ADXL345_AT, QUERY_ADXL345, QUERY_ADXL345_STATUS],
    responses: &[OwnData::FORM, OwnStatus::FORM],
    ..Feature::EMPTY
};

own_words! {
    "adxl345_data oid=%c sequence=%hu data=%*s",
    "adxl345_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%c fifo=%c limit_count=%hu" => Hosts::of(&[V0_11, V0_12]);
    data_max: 50, sample_bytes: SAMPLE_BYTES, fifo: u8
}

/// "Register Map".
#[derive(Clone, Copy)]
enum Register {
    PowerCtl = 0x2d,
    /// The first of the six data registers; FIFO_CTL and FIFO_STATUS follow them.
    DataX0 = 0x32,
    FifoStatus = 0x39,
}

/// The Measure bit of POWER_CTL.
const MEASURE: u8 = 0x08;
/// Bits of a message's first byte.
const READ: u8 = 0x80;
const MULTIPLE_BYTES: u8 = 0x40;
/// FIFO_CTL as klippy sets it (`SET_FIFO_CTL`): stream mode.
const STREAM: u8 = 0x90;
/// Highest number of samples, in the FIFO and the output registers.
const FIFO_MAX: u8 = 32;
/// With this many samples, the chip may have dropped some.
const FULL: u8 = 31;
const SAMPLE_BYTES: usize = 5;

/// The number of samples in FIFO_STATUS, without its trigger bit.
fn entries(fifo_status: u8) -> u8 {
    fifo_status & 0x7f
}

/// Returns one sample in klippy's format, and the number of samples in the FIFO. The format has 13 bits of each axis in
/// five bytes. An invalid sample has all bits set. Bit 7 of its last byte reports the error to klippy.
fn decode(message: &[u8; 9]) -> ([u8; SAMPLE_BYTES], u8) {
    let [_, x_low, x_high, y_low, y_high, z_low, z_high, fifo_ctl, fifo_status] = *message;
    let extends_sign = |high: u8| matches!(high & 0xf0, 0x00 | 0xf0);
    let filled = entries(fifo_status);
    if ![x_high, y_high, z_high].into_iter().all(extends_sign) || fifo_ctl != STREAM || filled > FIFO_MAX {
        return ([0xff; SAMPLE_BYTES], 0);
    }
    let xz_high = (x_high & 0x1f) | (z_high << 5);
    let yz_high = (y_high & 0x1f) | ((z_high << 2) & 0x60);
    ([x_low, y_low, z_low, xz_high, yz_high], filled)
}

#[derive(Clone, Copy)]
struct Adxl345;

impl FifoChip for Adxl345 {
    const NAME: &'static str = "ADXL345";
    const SAMPLE_BYTES: usize = SAMPLE_BYTES;
    const OWN_WORDS: Option<&'static Words> = Some(&OWN_WORDS);
    const KEEPS_SAMPLES: bool = true;

    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.send(&[Register::PowerCtl as u8, MEASURE])
    }

    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.send(&[Register::PowerCtl as u8, 0])
    }

    fn bus_type(self) -> BusType {
        BusType::Spi
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        while reading.has_room(SAMPLE_BYTES) {
            let mut message = [Register::DataX0 as u8 | READ | MULTIPLE_BYTES, 0, 0, 0, 0, 0, 0, 0, 0];
            chip.exchange(&mut message)?;
            let (sample, filled) = decode(&message);
            reading.push(&sample, filled, FULL);
            if !reading.has_more() {
                break;
            }
        }
        Ok(())
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        let mut message = [Register::FifoStatus as u8 | READ, 0];
        chip.exchange(&mut message)?;
        let filled = entries(message[1]);
        let bytes = u16::from(filled) * SAMPLE_BYTES as u16;
        Ok((filled <= FIFO_MAX).then_some(Fill { bytes, overflowed: false }))
    }
}

type Sensor = FifoSensor<Adxl345>;

const CONFIG_ADXL345: Command = command!("config_adxl345 oid=%c spi_oid=%c", |context, oid: Oid, spi_oid: Oid| {
    configure(context, oid, spi_oid, Adxl345)
});

const QUERY_ADXL345_AT: Command = command!(
    "query_adxl345 oid=%c clock=%u rest_ticks=%u",
    Sensor,
    |sensor, context, clock: WireClock, rest_ticks: Ticks| { sensor.query_at(context, clock, rest_ticks) }
)
.of(&[V0_11, V0_12]);

const QUERY_ADXL345: Command =
    command!("query_adxl345 oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_ADXL345_STATUS: Command =
    command!("query_adxl345_status oid=%c", Sensor, |sensor, context| sensor.ask_status(context));

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// klippy's conversion of a sample (`_convert_samples` of extras/adxl345.py).
    fn accelerations([x_low, y_low, z_low, xz_high, yz_high]: [u8; SAMPLE_BYTES]) -> Option<[i16; 3]> {
        let signed = |value: u16| ((value << 3) as i16) >> 3;
        let x = u16::from(x_low) | u16::from(xz_high & 0x1f) << 8;
        let y = u16::from(y_low) | u16::from(yz_high & 0x1f) << 8;
        let z = u16::from(z_low) | u16::from(xz_high & 0xe0) << 3 | u16::from(yz_high & 0x60) << 6;
        (yz_high & 0x80 == 0).then(|| [x, y, z].map(signed))
    }

    /// A sample of the chip in full resolution: 13 bits with the sign extended.
    fn message([x, y, z]: [i16; 3], fifo_ctl: u8, fifo_status: u8) -> [u8; 9] {
        let ([x0, x1], [y0, y1], [z0, z1]) = (x.to_le_bytes(), y.to_le_bytes(), z.to_le_bytes());
        [0, x0, x1, y0, y1, z0, z1, fifo_ctl, fifo_status]
    }

    proptest! {
        #[test]
        fn klippy_gets_what_the_chip_measured(x in -4096i16..4096, y in -4096i16..4096, z in -4096i16..4096) {
            let (sample, filled) = decode(&message([x, y, z], STREAM, 7));
            prop_assert_eq!(accelerations(sample), Some([x, y, z]));
            prop_assert_eq!(filled, 7);
        }
    }

    #[test]
    fn what_can_not_be_a_sample_is_an_error() {
        let good = [1, -1, 255];
        for (message, filled) in [
            (message(good, STREAM, 0), Some(0)),
            (message(good, STREAM, 32), Some(32)),
            // Bit 7 of FIFO_STATUS is the trigger bit.
            (message(good, STREAM, 0x80 | 3), Some(3)),
            (message(good, STREAM, 33), None),
            (message(good, 0x00, 3), None),
            (message(good, STREAM | 1, 3), None),
            (message([0x1000, 0, 0], STREAM, 3), None),
            (message([0, -0x1001, 0], STREAM, 3), None),
            (message([0, 0, 0x7000], STREAM, 3), None),
            ([0x00; 9], None),
            ([0xff; 9], None),
        ] {
            let (sample, told) = decode(&message);
            assert_eq!(accelerations(sample).is_some(), filled.is_some(), "{message:02x?}");
            assert_eq!(told, filled.unwrap_or(0), "{message:02x?}");
        }
    }
}
