// SPDX-License-Identifier: GPL-3.0-or-later
//! InvenSense's accelerometers on I2C: the MPU9250 and similar chips (MPU9255, MPU9515, MPU6500, MPU6050), and the
//! ICM20948.
//!
//! Registers from their register maps (InvenSense, RM-MPU-9250A-00, rev. 1.6; DS-000189, rev. 1.3).

use crate::board::{BusDevice, BusError};
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{Command, Feature, Hosts, Oid, Response, WireClock, command};
use crate::time::Ticks;

use super::fifo_sensor::{BLOCK_BYTES, BusType, FifoChip, FifoSensor, Fill, Reading, configure};
use super::sensor_bulk::{Words, own_words};

pub(super) const FEATURE: Feature = Feature {
    serves: "MPU9250 and other MPU accelerometers",
    commands: &[CONFIG_MPU9250, QUERY_MPU9250_AT, QUERY_MPU9250, QUERY_MPU9250_STATUS],
    responses: &[OwnData::FORM, OwnStatus::FORM],
    ..Feature::EMPTY
};

pub(super) const ICM20948: Feature = Feature {
    serves: "ICM20948 accelerometers",
    commands: &[CONFIG_ICM20948, QUERY_ICM20948, QUERY_ICM20948_STATUS],
    ..Feature::EMPTY
};

own_words! {
    "mpu9250_data oid=%c sequence=%hu data=%*s",
    "mpu9250_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%c fifo=%u limit_count=%hu" => Hosts::of(&[V0_11, V0_12]);
    data_max: BLOCK_BYTES, sample_bytes: SAMPLE_BYTES, fifo: u32
}

const SAMPLE_BYTES: usize = 6;

/// Registers of the MPU9250.
#[derive(Clone, Copy)]
enum Register {
    FifoEn = 0x23,
    UserCtrl = 0x6a,
}

/// ACCEL of FIFO_EN.
const ACCEL: u8 = 0x08;
/// FIFO_RST and FIFO_EN of USER_CTRL.
const FIFO_RESET: u8 = 0x04;
const FIFO_ENABLED: u8 = 0x40;

/// A chip's registers for its FIFO and for overflows.
struct FifoRegisters {
    /// Reading it clears the flags.
    int_status: u8,
    /// The bits of it that report an overflow.
    overflow: u8,
    /// Two bytes, the high one first.
    count: u8,
    data: u8,
}

/// A chip of this family.
trait Mpu: Copy + Send + 'static {
    const NAME: &'static str;
    const FIFO: FifoRegisters;
    const OWN_WORDS: Option<&'static Words> = None;
}

#[derive(Clone, Copy)]
struct Mpu9250;

impl Mpu for Mpu9250 {
    const NAME: &'static str = "MPU9250";
    /// INT_STATUS with FIFO_OFLOW_INT, FIFO_COUNTH, FIFO_R_W.
    const FIFO: FifoRegisters = FifoRegisters { int_status: 0x3a, overflow: 0x10, count: 0x72, data: 0x74 };
    const OWN_WORDS: Option<&'static Words> = Some(&OWN_WORDS);
}

#[derive(Clone, Copy)]
struct Icm20948;

impl Mpu for Icm20948 {
    const NAME: &'static str = "ICM20948";
    /// INT_STATUS_2 with FIFO_OVERFLOW_INT, FIFO_COUNTH, FIFO_R_W, all of bank 0.
    const FIFO: FifoRegisters = FifoRegisters { int_status: 0x1b, overflow: 0x0f, count: 0x70, data: 0x72 };
}

/// Asks for the number of bytes in the FIFO: 13 bits.
fn ask_fill<M: Mpu>(chip: &mut dyn BusDevice) -> Result<Fill, BusError> {
    let mut count = [0; 2];
    chip.read_register(&[M::FIFO.count], &mut count)?;
    Ok(Fill { bytes: u16::from_be_bytes(count) & 0x1fff, overflowed: false })
}

impl<M: Mpu> FifoChip for M {
    const NAME: &'static str = M::NAME;
    const SAMPLE_BYTES: usize = SAMPLE_BYTES;
    const HAS_OVERFLOW_REGISTER: bool = true;
    const OWN_WORDS: Option<&'static Words> = M::OWN_WORDS;

    /// Hosts that leave this to the MCU know only the MPU9250.
    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.write_read(&[Register::FifoEn as u8, 0], &mut [])?;
        chip.write_read(&[Register::UserCtrl as u8, FIFO_RESET], &mut [])?;
        chip.write_read(&[Register::UserCtrl as u8, FIFO_ENABLED], &mut [])?;
        // Reading it clears the flag of an overflow.
        self.overflowed(chip)?;
        chip.write_read(&[Register::FifoEn as u8, ACCEL], &mut [])
    }

    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.write_read(&[Register::FifoEn as u8, 0], &mut [])
    }

    fn bus_type(self) -> BusType {
        BusType::I2c
    }

    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError> {
        reading.block(chip, |chip| ask_fill::<M>(chip), |chip, block| chip.write_read(&[M::FIFO.data], block))
    }

    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        ask_fill::<M>(chip).map(Some)
    }

    fn overflowed(self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        let mut status = [0];
        chip.write_read(&[M::FIFO.int_status], &mut status)?;
        Ok(status[0] & M::FIFO.overflow != 0)
    }
}

type Mpu9250Sensor = FifoSensor<Mpu9250>;

const CONFIG_MPU9250: Command = command!("config_mpu9250 oid=%c i2c_oid=%c", |context, oid: Oid, i2c_oid: Oid| {
    configure(context, oid, i2c_oid, Mpu9250)
});

const QUERY_MPU9250_AT: Command = command!(
    "query_mpu9250 oid=%c clock=%u rest_ticks=%u",
    Mpu9250Sensor,
    |sensor, context, clock: WireClock, rest_ticks: Ticks| { sensor.query_at(context, clock, rest_ticks) }
)
.of(&[V0_11, V0_12]);

const QUERY_MPU9250: Command =
    command!("query_mpu9250 oid=%c rest_ticks=%u", Mpu9250Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_MPU9250_STATUS: Command =
    command!("query_mpu9250_status oid=%c", Mpu9250Sensor, |sensor, context| sensor.ask_status(context));

type Icm20948Sensor = FifoSensor<Icm20948>;

const CONFIG_ICM20948: Command = command!("config_icm20948 oid=%c i2c_oid=%c", |context, oid: Oid, i2c_oid: Oid| {
    configure(context, oid, i2c_oid, Icm20948)
})
.of(&[V0_13, Master, Kalico]);

const QUERY_ICM20948: Command =
    command!("query_icm20948 oid=%c rest_ticks=%u", Icm20948Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_ICM20948_STATUS: Command =
    command!("query_icm20948_status oid=%c", Icm20948Sensor, |sensor, context| sensor.ask_status(context))
        .of(&[V0_13, Master, Kalico]);
