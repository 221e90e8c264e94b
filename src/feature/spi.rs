// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices, with a chip select line of our own or without, and messages that they get at
//! a shutdown.
//!
//! `spi_send` and `spi_transfer` are over, and answered, before the next command runs: displays
//! set their D/C line by the commands around a `spi_send`, and klippy takes the acknowledgement of
//! a query for the end of the wait for its answer.

#![forbid(unsafe_code)]

use std::fmt;

use crate::board::{BusDevice, BusError, ChipSelect, OnWorker, Pin, SpiConfig};
use crate::mcu::{
    Bus, Command, Conversation, Done, Enumeration, Feature, Mcu, Object, Oid, Response, Safe, Talk, Ticket, command,
    response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::wire::block::PAYLOAD_MAX;

pub(super) const FEATURE: Feature = Feature {
    name: "spi",
    commands: &[CONFIG_SPI, CONFIG_SPI_WITHOUT_CS, SPI_SET_BUS, SPI_TRANSFER, SPI_SEND, CONFIG_SPI_SHUTDOWN],
    responses: &[TransferResponse::FORMAT],
    enumerations: &[Enumeration { name: "spi_bus", values: |board| board.spi_buses() }],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// An SPI mode above 3, or a second bus for one device.
    INVALID_SPI = "Invalid spi config";
    /// An SPI transfer failed.
    SPI_TRANSFER_FAILED = "Unable to issue spi ioctl";
}

response! {
    /// What an SPI device sent back.
    "spi_transfer_response oid=%c response=%*s"
    pub(super) struct TransferResponse<'a> { oid: Oid, response: &'a [u8] }
}

/// Bytes to a device, and what came back; those of a message block fit.
struct Transfer {
    bytes: [u8; PAYLOAD_MAX],
    len: usize,
}

impl Transfer {
    fn new(data: &[u8]) -> Box<Conversation<Transfer>> {
        let mut transfer = Transfer { bytes: [0; PAYLOAD_MAX], len: 0 };
        transfer.load(data);
        Conversation::new(transfer)
    }

    fn load(&mut self, data: &[u8]) {
        self.len = data.len().min(PAYLOAD_MAX);
        self.bytes[..self.len].copy_from_slice(&data[..self.len]);
    }

    fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Talk for Transfer {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        chip.exchange(&mut self.bytes[..self.len])
    }
}

pub(super) struct Spi {
    bus: Option<Bus>,
    /// Before the bus is known; then the worker drives it.
    chip_select: Option<ChipSelect>,
    /// Here while no command's transfer is under way.
    transfer: Option<Box<Conversation<Transfer>>>,
}

// What a transfer is for.
const SEND: u8 = 0;
const TRANSFER: u8 = 1;

impl Spi {
    fn new(chip_select: Option<ChipSelect>) -> Spi {
        Spi { bus: None, chip_select, transfer: Some(Transfer::new(&[])) }
    }

    fn set_bus(&mut self, mcu: &mut Mcu, bus: u32, mode: u8, rate_hz: u32) -> Result<(), Shutdown> {
        if mode > 3 {
            return Err(invalid(format_args!("mode {mode} is none of 0 to 3")));
        }
        if self.bus.is_some() {
            return Err(invalid("it has a bus already"));
        }
        // The firmware would open it even then; here steps would wait for the files.
        if mcu.is_finalized() {
            return Err(invalid("it gets a bus after finalize_config"));
        }
        let chip_select = self.chip_select.take();
        let OnWorker { bus, device } = mcu.board()?.spi(SpiConfig { bus, mode, rate_hz, chip_select })?;
        self.bus = Some(Bus::new(mcu.worker(&bus)?, device));
        Ok(())
    }

    fn transfer(&mut self, mcu: &mut Mcu, oid: Oid, tag: u8, data: &[u8]) -> Result<(), Shutdown> {
        let Some(bus) = &self.bus else {
            // A device without a bus echoes, as in the firmware.
            answer(mcu, oid, tag, data);
            return Ok(());
        };
        // Commands wait for each other, so it is here.
        let Some(mut transfer) = self.transfer.take() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "a transfer came amid another one"));
        };
        transfer.talk.load(data);
        mcu.converse_on(bus, Ticket { oid, tag }, transfer)
    }
}

#[cold]
fn invalid(what: impl fmt::Display) -> Shutdown {
    Shutdown::by_host(INVALID_SPI, what)
}

fn answer(mcu: &mut Mcu, oid: Oid, tag: u8, response: &[u8]) {
    if tag == TRANSFER {
        mcu.send(TransferResponse { oid, response });
    }
}

impl From<BusError> for Shutdown {
    fn from(error: BusError) -> Shutdown {
        Shutdown::because(SPI_TRANSFER_FAILED, error.detail)
    }
}

impl Object for Spi {
    fn kind(&self) -> &'static str {
        "SPI device"
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let tag = done.tag;
        let Some(mut transfer) = done.errand::<Conversation<Transfer>>() else { return Ok(()) };
        let result = std::mem::replace(&mut transfer.result, Ok(()));
        if result.is_ok() {
            answer(mcu, oid, tag, transfer.talk.bytes());
        }
        self.transfer = Some(transfer);
        result.or_else(|error| mcu.device_failed(oid, self.kind(), error.into()))
    }

    fn bus(&self) -> Option<&Bus> {
        self.bus.as_ref()
    }
}

/// What a device is told at a shutdown.
struct SpiShutdown {
    spi: Oid,
    /// Here while it is not on its way.
    message: Option<Box<Conversation<Transfer>>>,
    bytes: Box<[u8]>,
}

impl Object for SpiShutdown {
    fn kind(&self) -> &'static str {
        "SPI shutdown message"
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let Some(mut message) = done.errand::<Conversation<Transfer>>() else { return Ok(()) };
        let result = std::mem::replace(&mut message.result, Ok(()));
        self.message = Some(message);
        match result {
            Ok(()) => {
                mcu.is_safe(oid);
                Ok(())
            }
            Err(error) => mcu.device_failed(oid, self.kind(), error.into()),
        }
    }

    fn make_safe(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<Safe, Shutdown> {
        let has_bus = mcu.with::<Spi, _>(self.spi, |spi, _| Ok(spi.bus.is_some()))?;
        if !has_bus {
            return Ok(Safe::Now);
        }
        if let Some(mut message) = self.message.take() {
            message.talk.load(&self.bytes);
            mcu.converse(self.spi, Ticket { oid, tag: 0 }, message)?;
        }
        Ok(Safe::Later)
    }
}

const CONFIG_SPI: Command =
    command!("config_spi oid=%c pin=%u cs_active_high=%c", |mcu, oid: Oid, pin: Pin, cs_active_high: bool| {
        mcu.vacant(oid)?;
        let line = mcu.shared_output(pin, !cs_active_high)?;
        mcu.assign_on(pin, oid, Spi::new(Some(ChipSelect { line, active_high: cs_active_high })))
    });

const CONFIG_SPI_WITHOUT_CS: Command =
    command!("config_spi_without_cs oid=%c", |mcu, oid: Oid| mcu.assign(oid, Spi::new(None)));

const SPI_SET_BUS: Command =
    command!("spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u", |mcu, oid: Oid, spi_bus: u32, mode: u32, rate: u32| {
        let mode = u8::try_from(mode).unwrap_or(u8::MAX);
        mcu.with::<Spi, _>(oid, |spi, mcu| spi.set_bus(mcu, spi_bus, mode, rate))
    });

const SPI_TRANSFER: Command = command!("spi_transfer oid=%c data=%*s", |mcu, oid: Oid, data: &[u8]| {
    mcu.with::<Spi, _>(oid, |spi, mcu| spi.transfer(mcu, oid, TRANSFER, data))
});

const SPI_SEND: Command = command!("spi_send oid=%c data=%*s", |mcu, oid: Oid, data: &[u8]| {
    mcu.with::<Spi, _>(oid, |spi, mcu| spi.transfer(mcu, oid, SEND, data))
});

const CONFIG_SPI_SHUTDOWN: Command = command!(
    "config_spi_shutdown oid=%c spi_oid=%c shutdown_msg=%*s",
    |mcu, oid: Oid, spi_oid: Oid, shutdown_msg: &[u8]| {
        mcu.with::<Spi, _>(spi_oid, |_, _| Ok(()))?;
        mcu.assign(oid, SpiShutdown { spi: spi_oid, message: Some(Transfer::new(&[])), bytes: shutdown_msg.into() })
    }
);
