// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer BMI160, on SPI or I2C.
//!
//! Registers from its data sheet (Bosch, BST-BMI160-DS000: "Register (0x22-0x23) FIFO_LENGTH", "Register (0x24)
//! FIFO_DATA"). klippy configures the FIFO for bare samples of the accelerometer.

use crate::board::{BusDevice, BusError};
use crate::mcu::DialectName::Master;
use crate::mcu::{Command, Feature, Oid, command};
use crate::time::Ticks;

use super::fifo_sensor::{BusType, FifoChip, FifoSensor, Fill, Reading, configure};

pub(super) const FEATURE: Feature = Feature {
    serves: "BMI160 accelerometers",
    commands: &[CONFIG_BMI160, QUERY_BMI160, QUERY_BMI160_STATUS],
    ..Feature::EMPTY
};

#[derive(Clone, Copy)]
enum Register {
    FifoLength = 0x22,
    FifoData = 0x24,
}

/// Size of the FIFO in bytes.
const FIFO_BYTES: u16 = 1024;

/// Decodes FIFO_LENGTH, low byte first.
fn fill(length: [u8; 2]) -> Fill {
    let bytes = u16::from_le_bytes(length);
    Fill { bytes, overflowed: bytes > FIFO_BYTES }
}

#[derive(Clone, Copy)]
struct Bmi160 {
    bus_type: BusType,
}

impl Bmi160 {
    fn ask_fill(self, chip: &mut dyn BusDevice) -> Result<Fill, BusError> {
        let mut length = [0; 2];
        self.bus_type.read_register(chip, Register::FifoLength as u8, &mut length)?;
        Ok(fill(length))
    }
}

impl FifoChip for Bmi160 {
    const NAME: &'static str = "BMI160";
    const SAMPLE_BYTES: usize = 6;

    fn bus_type(self) -> BusType {
        self.bus_type
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        let read =
            |chip: &mut dyn BusDevice, block: &mut [u8]| self.bus_type.read_once(chip, Register::FifoData as u8, block);
        reading.block(chip, |chip| self.ask_fill(chip), read)
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        self.ask_fill(chip).map(Some)
    }
}

type Sensor = FifoSensor<Bmi160>;

const CONFIG_BMI160: Command =
    command!("config_bmi160 oid=%c bus_oid=%c bus_oid_type=%c", |context, oid: Oid, bus_oid: Oid, bus_oid_type: u8| {
        configure(context, oid, bus_oid, Bmi160 { bus_type: BusType::of(bus_oid_type)? })
    })
    .of(&[Master]);

const QUERY_BMI160: Command =
    command!("query_bmi160 oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[Master]);

const QUERY_BMI160_STATUS: Command =
    command!("query_bmi160_status oid=%c", Sensor, |sensor, context| sensor.ask_status(context)).of(&[Master]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_of_the_fifo() {
        for (length, bytes, overflowed) in [
            ([0, 0], 0, false),
            ([0x30, 0], 48, false),
            ([0x00, 0x04], 1024, false),
            ([0x01, 0x04], 1025, true),
            ([0xff, 0xff], 65535, true),
        ] {
            assert_eq!(fill(length), Fill { bytes, overflowed });
        }
    }
}
