// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometers LIS2DW and LIS3DH, on SPI or I2C.
//!
//! Registers after their data sheets (ST, LIS2DW12 rev. 8: "FIFO_SAMPLES"; LIS3DH rev. 2:
//! "FIFO_SRC_REG", "SPI read", "I2C operation").

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::mcu::{Command, Enumeration, Feature, Oid, command};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::Ticks;

use super::fifo_sensor::{BusType, FifoChip, Fill, Reading, configure, query, query_status};
use super::named;

pub(super) const FEATURE: Feature = Feature {
    name: "lis2dw",
    commands: &[CONFIG_LIS2DW, QUERY_LIS2DW, QUERY_LIS2DW_STATUS],
    enumerations: &[Enumeration::new("lis_chip_type", |_| named(&[("LIS2DW", 0), ("LIS3DH", 1)]))],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `lis_chip_type` that the enumeration does not have.
    INVALID_MODEL = "model type invalid";
}

/// OUT_X_L, the first of the six data registers, which the FIFO is read through.
const OUT_X_L: u8 = 0x28;
/// FIFO_SAMPLES of the LIS2DW, FIFO_SRC_REG of the LIS3DH.
const FIFO_STATUS: u8 = 0x2f;
const SAMPLE_BYTES: usize = 6;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Model {
    Lis2dw,
    Lis3dh,
}

impl Model {
    /// The model with this number (`lis_chip_type`).
    fn of(number: u8) -> Result<Model, Shutdown> {
        match number {
            0 => Ok(Model::Lis2dw),
            1 => Ok(Model::Lis3dh),
            _ => Err(Shutdown::by_host(
                INVALID_MODEL,
                format_args!("lis_chip_type {number} is neither LIS2DW nor LIS3DH"),
            )),
        }
    }

    /// What the status register says.
    fn fill(self, status: u8) -> Fill {
        let samples = match self {
            // DIFF5:0 counts to 32.
            Model::Lis2dw => status & 0x3f,
            // EMPTY, and FSS4:0.
            Model::Lis3dh if status & 0x20 != 0 => 0,
            Model::Lis3dh => status & 0x1f,
        };
        Fill { bytes: u16::from(samples) * SAMPLE_BYTES as u16, overflowed: status & 0x40 != 0 }
    }
}

#[derive(Clone, Copy)]
struct Lis2dw {
    bus_type: BusType,
    model: Model,
}

impl Lis2dw {
    /// The number of the first data register, with what the LIS3DH wants in it to go on to the next
    /// ones; the LIS2DW does so by itself.
    fn data_registers(self) -> u8 {
        match (self.model, self.bus_type) {
            (Model::Lis2dw, _) => OUT_X_L,
            (Model::Lis3dh, BusType::Spi) => OUT_X_L | 0x40,
            (Model::Lis3dh, BusType::I2c) => OUT_X_L | 0x80,
        }
    }

    fn ask_fill(self, chip: &mut dyn BusDevice) -> Result<Fill, BusError> {
        let mut status = [0];
        self.bus_type.read(chip, FIFO_STATUS, &mut status)?;
        Ok(self.model.fill(status[0]))
    }
}

impl FifoChip for Lis2dw {
    const NAME: &'static str = "LIS2DW";
    const SAMPLE_BYTES: usize = SAMPLE_BYTES;

    fn bus_type(self) -> BusType {
        self.bus_type
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        let read = |chip: &mut dyn BusDevice, block: &mut [u8]| self.bus_type.read(chip, self.data_registers(), block);
        reading.block(chip, |chip| self.ask_fill(chip), read)
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        self.ask_fill(chip).map(Some)
    }
}

const CONFIG_LIS2DW: Command = command!(
    "config_lis2dw oid=%c bus_oid=%c bus_oid_type=%c lis_chip_type=%c",
    |mcu, oid: Oid, bus_oid: Oid, bus_oid_type: u8, lis_chip_type: u8| {
        let chip = Lis2dw { bus_type: BusType::of(bus_oid_type)?, model: Model::of(lis_chip_type)? };
        configure(mcu, oid, bus_oid, chip)
    }
);

const QUERY_LIS2DW: Command = command!("query_lis2dw oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
    query::<Lis2dw>(mcu, oid, rest_ticks)
});

const QUERY_LIS2DW_STATUS: Command =
    command!("query_lis2dw_status oid=%c", |mcu, oid: Oid| query_status::<Lis2dw>(mcu, oid));

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_status_register() {
        for (model, status, samples, overflowed) in [
            (Model::Lis2dw, 0x00, 0, false),
            (Model::Lis2dw, 0x07, 7, false),
            // FTH, the threshold's flag, says nothing here.
            (Model::Lis2dw, 0x80 | 31, 31, false),
            (Model::Lis2dw, 0xc0 | 32, 32, true),
            (Model::Lis3dh, 0x20, 0, false),
            (Model::Lis3dh, 0x1f, 31, false),
            (Model::Lis3dh, 0xc0 | 31, 31, true),
            (Model::Lis3dh, 0x80 | 9, 9, false),
        ] {
            let fill = Fill { bytes: samples * 6, overflowed };
            assert_eq!(model.fill(status), fill, "{model:?} {status:#x}");
        }
    }
}
