// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometers LIS2DW and LIS3DH, on SPI or I2C.
//!
//! Registers from their data sheets (ST, LIS2DW12 rev. 8: "FIFO_SAMPLES"; LIS3DH rev. 2: "FIFO_SRC_REG", "SPI read",
//! "I2C operation").

use crate::board::{BusDevice, BusError};
use crate::mcu::DialectName::{Kalico, Master, V0_12, V0_13};
use crate::mcu::{Command, Enumeration, Feature, Hosts, Oid, Response, WireClock, command};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::Ticks;

use super::fifo_sensor::{BLOCK_BYTES, BusType, FifoChip, FifoSensor, Fill, Reading, configure};
use super::named;
use super::sensor_bulk::{Words, own_words};

pub(super) const FEATURE: Feature = Feature {
    serves: "LIS2DW and LIS3DH accelerometers",

    commands: &[CONFIG_LIS2DW_ON_SPI, CONFIG_LIS2DW, QUERY_LIS2DW_AT, QUERY_LIS2DW, QUERY_LIS2DW_STATUS],
    responses: &[OwnData::FORM, OwnStatus::FORM],
    enumerations: &[
        Enumeration::new("lis_chip_type", |_| named(&[("LIS2DW", 0), ("LIS3DH", 1)])).of(&[V0_13, Master, Kalico])
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `lis_chip_type` outside the enumeration.
    INVALID_MODEL = "model type invalid";
}

own_words! {
    "lis2dw_data oid=%c sequence=%hu data=%*s",
    "lis2dw_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%c fifo=%c limit_count=%hu" => Hosts::of(&[V0_12]);
    data_max: BLOCK_BYTES, sample_bytes: SAMPLE_BYTES, fifo: u8
}

#[derive(Clone, Copy)]
enum Register {
    /// The first of the six data registers. The FIFO is read through them.
    OutXL = 0x28,
    FifoCtrl = 0x2e,
    /// FIFO_SAMPLES of the LIS2DW, FIFO_SRC_REG of the LIS3DH.
    FifoStatus = 0x2f,
}

/// Continuous mode of FIFO_CTRL. 0 switches the FIFO off and empties it.
const CONTINUOUS: u8 = 0xc0;
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

    /// Decodes the status register.
    fn fill(self, status: u8) -> Fill {
        let samples = match self {
            // DIFF5:0 counts to 32.
            Model::Lis2dw => status & 0x3f,
            // EMPTY, and FSS4:0.
            Model::Lis3dh if status & 0x20 != 0 => 0,
            Model::Lis3dh => status & 0x1f,
        };
        // A wire that reads as all ones says 63 samples. Klipper's C keeps the bytes of that modulo 256: two blocks.
        let bytes = samples.wrapping_mul(SAMPLE_BYTES as u8);
        Fill { bytes: bytes.into(), overflowed: status & 0x40 != 0 }
    }
}

#[derive(Clone, Copy)]
struct Lis2dw {
    bus_type: BusType,
    model: Model,
}

impl Lis2dw {
    /// The number of the first data register. The LIS3DH needs a bit in it to continue with the next registers. The
    /// LIS2DW continues without it.
    fn data_registers(self) -> u8 {
        let goes_on = match (self.model, self.bus_type) {
            (Model::Lis2dw, _) => 0,
            (Model::Lis3dh, BusType::Spi) => 0x40,
            (Model::Lis3dh, BusType::I2c) => 0x80,
        };
        Register::OutXL as u8 | goes_on
    }

    fn ask_fill(self, chip: &mut dyn BusDevice) -> Result<Fill, BusError> {
        let mut status = [0];
        self.bus_type.read_register(chip, Register::FifoStatus as u8, &mut status)?;
        Ok(self.model.fill(status[0]))
    }
}

impl FifoChip for Lis2dw {
    const NAME: &'static str = "LIS2DW";
    const SAMPLE_BYTES: usize = SAMPLE_BYTES;
    const OWN_WORDS: Option<&'static Words> = Some(&OWN_WORDS);

    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.send(&[Register::FifoCtrl as u8, CONTINUOUS])
    }

    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.send(&[Register::FifoCtrl as u8, 0])
    }

    fn bus_type(self) -> BusType {
        self.bus_type
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        let read =
            |chip: &mut dyn BusDevice, block: &mut [u8]| self.bus_type.read_once(chip, self.data_registers(), block);
        reading.block(chip, |chip| self.ask_fill(chip), read)
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        self.ask_fill(chip).map(Some)
    }
}

type Sensor = FifoSensor<Lis2dw>;

const CONFIG_LIS2DW_ON_SPI: Command = command!("config_lis2dw oid=%c spi_oid=%c", |context, oid: Oid, spi_oid: Oid| {
    configure(context, oid, spi_oid, Lis2dw { bus_type: BusType::Spi, model: Model::Lis2dw })
})
.of(&[V0_12]);

const CONFIG_LIS2DW: Command = command!(
    "config_lis2dw oid=%c bus_oid=%c bus_oid_type=%c lis_chip_type=%c",
    |context, oid: Oid, bus_oid: Oid, bus_oid_type: u8, lis_chip_type: u8| {
        let chip = Lis2dw { bus_type: BusType::of(bus_oid_type)?, model: Model::of(lis_chip_type)? };
        configure(context, oid, bus_oid, chip)
    }
)
.of(&[V0_13, Master, Kalico]);

const QUERY_LIS2DW_AT: Command = command!(
    "query_lis2dw oid=%c clock=%u rest_ticks=%u",
    Sensor,
    |sensor, context, clock: WireClock, rest_ticks: Ticks| { sensor.query_at(context, clock, rest_ticks) }
)
.of(&[V0_12]);

const QUERY_LIS2DW: Command =
    command!("query_lis2dw oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_LIS2DW_STATUS: Command = command!("query_lis2dw_status oid=%c", Sensor, |sensor, context| sensor
    .ask_status(context))
.of(&[V0_12, V0_13, Master, Kalico]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_status_register() {
        for (model, status, bytes, overflowed) in [
            (Model::Lis2dw, 0x00, 0, false),
            (Model::Lis2dw, 0x07, 7 * 6, false),
            // FTH, the threshold's flag, means nothing here.
            (Model::Lis2dw, 0x80 | 31, 31 * 6, false),
            (Model::Lis2dw, 0xc0 | 32, 32 * 6, true),
            // Nothing answers: 63 samples are 378 bytes, 122 modulo 256.
            (Model::Lis2dw, 0xff, 122, true),
            (Model::Lis3dh, 0x20, 0, false),
            (Model::Lis3dh, 0x1f, 31 * 6, false),
            (Model::Lis3dh, 0xc0 | 31, 31 * 6, true),
            (Model::Lis3dh, 0x80 | 9, 9 * 6, false),
        ] {
            let fill = Fill { bytes, overflowed };
            assert_eq!(model.fill(status), fill, "{model:?} {status:#x}");
        }
    }
}
