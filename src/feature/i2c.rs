// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C devices.
//!
//! `i2c_transfer` answers with the status of the bus, and klippy decides what becomes of it. It is
//! over, and answered, before the next command runs: klippy configures chips by one transfer after
//! the other. A plain read is tried again ([`BusDevice::read_register`]); what writes is not.

#![forbid(unsafe_code)]

use crate::board::soft_i2c::SoftI2c;
use crate::board::{BusDevice, BusError, BusStatus, I2cConfig, OnWorker, Pin, Range};
use crate::mcu::{
    Bus, Command, Conversation, Done, Enumeration, Feature, Mcu, Object, Oid, Response, Talk, Ticket, command, response,
};
use crate::shutdown::{Shutdown, ShutdownReason, reason, shutdowns};
use crate::time::Ticks;
use crate::wire::block::PAYLOAD_MAX;

pub(super) const FEATURE: Feature = Feature {
    name: "i2c",
    commands: &[CONFIG_I2C, I2C_SET_BUS, I2C_SET_SW_BUS, I2C_TRANSFER],
    responses: &[TransferResponse::FORM],
    enumerations: &[
        Enumeration::new("i2c_bus", |board| board.i2c_buses()),
        Enumeration::new("i2c_bus_status", |_| statuses()),
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A sensor did not acknowledge a byte.
    I2C_NACK = "I2C NACK";
    /// A sensor did not acknowledge its address.
    I2C_START_NACK = "I2C START NACK";
    /// A sensor did not acknowledge its address when it was to be read from.
    I2C_START_READ_NACK = "I2C START READ NACK";
    /// A sensor's bus was not free, or the clock was held, for too long.
    I2C_TIMEOUT = "I2C Timeout";
}

response! {
    /// How the bus answered, and what a device sent.
    "i2c_response oid=%c i2c_bus_status=%c response=%*s"
    pub(super) struct TransferResponse<'a> { oid: Oid, i2c_bus_status: u8, response: &'a [u8] }
}

/// Bytes that fit an answer beside its id and oid of two bytes each, status and length.
const RESPONSE_MAX: usize = PAYLOAD_MAX - 6;

const SUCCESS: u8 = 0;

/// The number and the text of a status, from the firmware's i2ccmds.h and i2ccmds.c.
fn on_wire(status: BusStatus) -> (u8, ShutdownReason) {
    match status {
        BusStatus::Nack => (1, I2C_NACK),
        BusStatus::Timeout => (2, I2C_TIMEOUT),
        BusStatus::StartNack => (3, I2C_START_NACK),
        BusStatus::StartReadNack => (4, I2C_START_READ_NACK),
    }
}

/// The dictionary's enumeration `i2c_bus_status`.
fn statuses() -> Vec<Range> {
    let names = ["SUCCESS", "NACK", "BUS_TIMEOUT", "START_NACK", "START_READ_NACK"];
    names.iter().zip(SUCCESS.into()..).map(|(name, first)| Range { name: (*name).into(), first, count: 1 }).collect()
}

/// The stop of a machine whose sensor can not be talked to (the firmware's `i2c_shutdown_on_err`).
pub(super) fn i2c_shutdown(error: BusError) -> Shutdown {
    Shutdown::because(on_wire(error.status).1, error.detail)
}

/// Bytes to a device, and bytes from it.
struct Transfer {
    write: [u8; PAYLOAD_MAX],
    write_len: usize,
    read: [u8; u8::MAX as usize],
    read_len: usize,
}

impl Transfer {
    fn load(&mut self, write: &[u8], read_len: usize) {
        self.write_len = write.len().min(PAYLOAD_MAX);
        self.write[..self.write_len].copy_from_slice(&write[..self.write_len]);
        self.read_len = read_len;
        self.read = [0; u8::MAX as usize];
    }

    /// What the answer has room for, as in the firmware.
    fn response(&self) -> &[u8] {
        &self.read[..self.read_len.min(RESPONSE_MAX)]
    }
}

impl Talk for Transfer {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        let read = &mut self.read[..self.read_len];
        match &self.write[..self.write_len] {
            [] if !read.is_empty() => chip.read_register(&[], read),
            write => chip.write_read(write, read),
        }
    }
}

/// An I2C device.
pub(super) struct I2c {
    bus: Option<Bus>,
    /// Here while no command's transfer is under way.
    transfer: Option<Box<Conversation<Transfer>>>,
    /// Whether the last transfer failed: a display that is unplugged fails many times a second.
    failing: bool,
}

impl I2c {
    fn new() -> I2c {
        let transfer = Transfer { write: [0; PAYLOAD_MAX], write_len: 0, read: [0; u8::MAX as usize], read_len: 0 };
        I2c { bus: None, transfer: Some(Conversation::new(transfer)), failing: false }
    }

    fn transfer(&mut self, mcu: &mut Mcu, oid: Oid, write: &[u8], read_len: u8) -> Result<(), Shutdown> {
        // Commands wait for each other, so it is here.
        let Some(mut transfer) = self.transfer.take() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "a transfer came amid another one"));
        };
        transfer.talk.load(write, read_len.into());
        let Some(bus) = &self.bus else {
            // As the firmware answers for a device without a bus.
            let (i2c_bus_status, _) = on_wire(BusStatus::Nack);
            mcu.send(TransferResponse { oid, i2c_bus_status, response: transfer.talk.response() });
            self.transfer = Some(transfer);
            return Ok(());
        };
        mcu.converse_on(bus, Ticket { oid, tag: 0 }, transfer)
    }
}

impl Object for I2c {
    fn kind(&self) -> &'static str {
        "I2C device"
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let Some(mut transfer) = done.errand::<Conversation<Transfer>>() else { return Ok(()) };
        let result = std::mem::replace(&mut transfer.result, Ok(()));
        let i2c_bus_status = result.as_ref().map_or_else(|error| on_wire(error.status).0, |()| SUCCESS);
        mcu.send(TransferResponse { oid, i2c_bus_status, response: transfer.talk.response() });
        self.transfer = Some(transfer);
        let failed_before = std::mem::replace(&mut self.failing, result.is_err());
        match result {
            Err(error) if !failed_before => mcu.warn(oid, self.kind(), i2c_shutdown(error)),
            _ => {}
        }
        Ok(())
    }

    fn bus(&self) -> Option<&Bus> {
        self.bus.as_ref()
    }
}

const CONFIG_I2C: Command = command!("config_i2c oid=%c", |mcu, oid: Oid| mcu.assign(oid, I2c::new()));

const I2C_SET_BUS: Command = command!(
    "i2c_set_bus oid=%c i2c_bus=%u rate=%u address=%u",
    |mcu, oid: Oid, i2c_bus: u32, rate: u32, address: u32| {
        mcu.with::<I2c, _>(oid, |i2c, mcu| {
            let config = I2cConfig { bus: i2c_bus, address: seven_bits(address), rate_hz: rate };
            let OnWorker { bus, device } = mcu.board()?.i2c(config)?;
            i2c.bus = Some(Bus::new(mcu.worker(&bus)?, device));
            Ok(())
        })
    }
);

const I2C_SET_SW_BUS: Command = command!(
    "i2c_set_sw_bus oid=%c scl_pin=%u sda_pin=%u pulse_ticks=%u address=%u",
    |mcu, oid: Oid, scl_pin: Pin, sda_pin: Pin, pulse_ticks: Ticks, address: u32| {
        mcu.with::<I2c, _>(oid, |i2c, mcu| {
            let (scl, sda) = (mcu.shared_wire(scl_pin)?, mcu.shared_wire(sda_pin)?);
            let name =
                format!("scl {} sda {} address {:#04x}", mcu.name(scl_pin), mcu.name(sda_pin), seven_bits(address));
            let device = SoftI2c::new(scl, sda, seven_bits(address), pulse_ticks, mcu.clock(), name);
            i2c.bus = Some(mcu.software_bus(Box::new(device))?);
            Ok(())
        })
    }
);

const I2C_TRANSFER: Command =
    command!("i2c_transfer oid=%c write=%*s read_len=%u", |mcu, oid: Oid, write: &[u8], read_len: u32| {
        // Of one byte, as in the firmware.
        mcu.with::<I2c, _>(oid, |i2c, mcu| i2c.transfer(mcu, oid, write, read_len as u8))
    });

/// An address has 7 bits; the firmware drops the others.
fn seven_bits(address: u32) -> u8 {
    (address & 0x7f) as u8
}
