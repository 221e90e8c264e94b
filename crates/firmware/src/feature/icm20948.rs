// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer ICM20948 on I2C.
//!
//! Registers of its bank 0 after its data sheet (InvenSense, DS-000189, rev. 1.3).

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::mcu::{Command, Feature, Generation::V0_13, Oid, command, since};
use crate::time::Ticks;

use super::fifo_sensor::{BusType, FifoChip, Fill, Reading, configure, query, query_status};
use super::mpu9250::FifoRegisters;

pub(super) const FEATURE: Feature =
    Feature { name: "icm20948", commands: &[CONFIG_ICM20948, QUERY_ICM20948, QUERY_ICM20948_STATUS], ..Feature::EMPTY };

/// INT_STATUS_2 with FIFO_OVERFLOW_INT, FIFO_COUNTH, FIFO_R_W.
const FIFO: FifoRegisters = FifoRegisters { int_status: 0x1b, overflow: 0x0f, count: 0x70, data: 0x72 };

#[derive(Clone, Copy)]
struct Icm20948;

impl FifoChip for Icm20948 {
    const NAME: &'static str = "ICM20948";
    const SAMPLE_BYTES: usize = 6;
    const HAS_OVERFLOW_REGISTER: bool = true;

    fn bus_type(self) -> BusType {
        BusType::I2c
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        FIFO.read(chip, reading)
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        FIFO.fill(chip).map(Some)
    }

    fn overflowed(self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        FIFO.overflowed(chip)
    }
}

const CONFIG_ICM20948: Command = command!("config_icm20948 oid=%c i2c_oid=%c", |mcu, oid: Oid, i2c_oid: Oid| {
    configure(mcu, oid, i2c_oid, Icm20948)
})
.of(since(V0_13));

const QUERY_ICM20948: Command = command!("query_icm20948 oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
    query::<Icm20948>(mcu, oid, rest_ticks)
})
.of(since(V0_13));

const QUERY_ICM20948_STATUS: Command =
    command!("query_icm20948_status oid=%c", |mcu, oid: Oid| query_status::<Icm20948>(mcu, oid)).of(since(V0_13));
