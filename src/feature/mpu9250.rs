// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer MPU9250 and its kin (MPU9255, MPU9515, MPU6500, MPU6050) on I2C.
//!
//! Registers after its register map (InvenSense, RM-MPU-9250A-00, rev. 1.6).

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::mcu::{Command, Feature, Oid, command};
use crate::time::Ticks;

use super::fifo_sensor::{BusType, FifoChip, Fill, Reading, configure, query, query_status};

pub(super) const FEATURE: Feature =
    Feature { name: "mpu9250", commands: &[CONFIG_MPU9250, QUERY_MPU9250, QUERY_MPU9250_STATUS], ..Feature::EMPTY };

const INT_STATUS: u8 = 0x3a;
const FIFO_OFLOW_INT: u8 = 0x10;
const FIFO_COUNTH: u8 = 0x72;
const FIFO_R_W: u8 = 0x74;

/// Asks InvenSense's chips for the bytes in their FIFO: 13 bits, the high ones first.
pub(super) fn fifo_count(chip: &mut dyn BusDevice, register: u8) -> Result<Fill, BusError> {
    let mut count = [0; 2];
    BusType::I2c.read(chip, register, &mut count)?;
    Ok(Fill { bytes: u16::from_be_bytes(count) & 0x1fff, overflowed: false })
}

#[derive(Clone, Copy)]
struct Mpu9250;

impl FifoChip for Mpu9250 {
    const NAME: &'static str = "MPU9250";
    const SAMPLE_BYTES: usize = 6;
    const HAS_OVERFLOW_REGISTER: bool = true;

    fn bus_type(self) -> BusType {
        BusType::I2c
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        let read = |chip: &mut dyn BusDevice, block: &mut [u8]| BusType::I2c.read(chip, FIFO_R_W, block);
        reading.block(chip, |chip| fifo_count(chip, FIFO_COUNTH), read)
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        fifo_count(chip, FIFO_COUNTH).map(Some)
    }

    fn overflowed(self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        let mut status = [0];
        BusType::I2c.read(chip, INT_STATUS, &mut status)?;
        Ok(status[0] & FIFO_OFLOW_INT != 0)
    }
}

const CONFIG_MPU9250: Command = command!("config_mpu9250 oid=%c i2c_oid=%c", |mcu, oid: Oid, i2c_oid: Oid| {
    configure(mcu, oid, i2c_oid, Mpu9250)
});

const QUERY_MPU9250: Command = command!("query_mpu9250 oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
    query::<Mpu9250>(mcu, oid, rest_ticks)
});

const QUERY_MPU9250_STATUS: Command =
    command!("query_mpu9250_status oid=%c", |mcu, oid: Oid| query_status::<Mpu9250>(mcu, oid));
