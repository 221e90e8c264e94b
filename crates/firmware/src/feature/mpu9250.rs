// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer MPU9250 and its kin (MPU9255, MPU9515, MPU6500, MPU6050) on I2C.
//!
//! Registers after its register map (InvenSense, RM-MPU-9250A-00, rev. 1.6).

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::mcu::{
    Command, Feature, Generation::V0_12, Generation::V0_13, Oid, Response, WireClock, command, response, since, until,
};
use crate::time::{Clock, Ticks};

use super::fifo_sensor::{BLOCK_BYTES, BusType, FifoChip, Fill, Reading, configure, query, query_at, query_status};
use super::sensor_bulk::{BulkData, Status, Words};

pub(super) const FEATURE: Feature = Feature {
    name: "mpu9250",
    commands: &[CONFIG_MPU9250, QUERY_MPU9250_AT, QUERY_MPU9250, QUERY_MPU9250_STATUS],
    responses: &[OwnData::FORM, OwnStatus::FORM],
    ..Feature::EMPTY
};

response! {
    /// Samples.
    "mpu9250_data oid=%c sequence=%hu data=%*s" => until(V0_12);
    pub(super) struct OwnData<'a> { oid: Oid, sequence: u16, data: &'a [u8] }
}

response! {
    /// How many samples there were, of them `fifo` in the chip.
    "mpu9250_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%c fifo=%u limit_count=%hu" => until(V0_12);
    pub(super) struct OwnStatus {
        oid: Oid,
        clock: Clock,
        query_ticks: u32,
        next_sequence: u16,
        buffered: u8,
        fifo: u32,
        limit_count: u16
    }
}

const OWN_WORDS: Words = Words {
    data_max: BLOCK_BYTES,
    data: |mcu, BulkData { oid, sequence, data }| mcu.send(OwnData { oid, sequence, data }),
    status: |mcu, Status { oid, clock, query_ticks, next_sequence, in_message, in_sensor, possible_overflows }| {
        let fifo = in_sensor / SAMPLE_BYTES as u32;
        let (buffered, limit_count) = (in_message, possible_overflows);
        mcu.send(OwnStatus { oid, clock, query_ticks, next_sequence, buffered, fifo, limit_count });
    },
};

const SAMPLE_BYTES: usize = 6;
const FIFO_EN: u8 = 0x23;
/// ACCEL, of FIFO_EN.
const ACCEL: u8 = 0x08;
const USER_CTRL: u8 = 0x6a;
/// FIFO_RST and FIFO_EN, of USER_CTRL.
const FIFO_RESET: u8 = 0x04;
const FIFO_ENABLED: u8 = 0x40;

/// Where one of InvenSense's chips has its FIFO, and what tells that it overflowed.
pub(super) struct FifoRegisters {
    pub(super) int_status: u8,
    /// The bits of it that tell of an overflow.
    pub(super) overflow: u8,
    pub(super) count: u8,
    pub(super) data: u8,
}

impl FifoRegisters {
    pub(super) fn read(&self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        let read = |chip: &mut dyn BusDevice, block: &mut [u8]| BusType::I2c.read(chip, self.data, block);
        reading.block(chip, |chip| self.fill(chip), read)
    }

    /// Asks for the bytes in the FIFO: 13 bits, the high ones first.
    pub(super) fn fill(&self, chip: &mut dyn BusDevice) -> Result<Fill, BusError> {
        let mut count = [0; 2];
        BusType::I2c.read(chip, self.count, &mut count)?;
        Ok(Fill { bytes: u16::from_be_bytes(count) & 0x1fff, overflowed: false })
    }

    pub(super) fn overflowed(&self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        let mut status = [0];
        BusType::I2c.read(chip, self.int_status, &mut status)?;
        Ok(status[0] & self.overflow != 0)
    }
}

/// INT_STATUS with FIFO_OFLOW_INT, FIFO_COUNTH, FIFO_R_W.
const FIFO: FifoRegisters = FifoRegisters { int_status: 0x3a, overflow: 0x10, count: 0x72, data: 0x74 };

#[derive(Clone, Copy)]
struct Mpu9250;

impl FifoChip for Mpu9250 {
    const NAME: &'static str = "MPU9250";
    const SAMPLE_BYTES: usize = SAMPLE_BYTES;
    const HAS_OVERFLOW_REGISTER: bool = true;
    const OWN_WORDS: Option<&'static Words> = Some(&OWN_WORDS);

    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.write_read(&[FIFO_EN, 0], &mut [])?;
        chip.write_read(&[USER_CTRL, FIFO_RESET], &mut [])?;
        chip.write_read(&[USER_CTRL, FIFO_ENABLED], &mut [])?;
        // Reading it clears the flag of an overflow.
        self.overflowed(chip)?;
        chip.write_read(&[FIFO_EN, ACCEL], &mut [])
    }

    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.write_read(&[FIFO_EN, 0], &mut [])
    }

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

const CONFIG_MPU9250: Command = command!("config_mpu9250 oid=%c i2c_oid=%c", |mcu, oid: Oid, i2c_oid: Oid| {
    configure(mcu, oid, i2c_oid, Mpu9250)
});

const QUERY_MPU9250_AT: Command =
    command!("query_mpu9250 oid=%c clock=%u rest_ticks=%u", |mcu, oid: Oid, clock: WireClock, rest_ticks: Ticks| {
        query_at::<Mpu9250>(mcu, oid, clock, rest_ticks)
    })
    .of(until(V0_12));

const QUERY_MPU9250: Command = command!("query_mpu9250 oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
    query::<Mpu9250>(mcu, oid, rest_ticks)
})
.of(since(V0_13));

const QUERY_MPU9250_STATUS: Command =
    command!("query_mpu9250_status oid=%c", |mcu, oid: Oid| query_status::<Mpu9250>(mcu, oid));
