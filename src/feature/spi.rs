// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices, with a chip select line of our own or without, and messages that they get at
//! a shutdown.

#![forbid(unsafe_code)]

use std::fmt;

use crate::board::{Buffer, ChipSelect, Pin, SpiConfig};
use crate::mcu::{Command, DeviceId, Feature, Line, Mcu, Object, Oid, Response, Ticket, command, response};
use crate::shutdown::{Reason, Shutdown};

pub(super) const FEATURE: Feature = Feature {
    name: "spi",
    commands: &[CONFIG_SPI, CONFIG_SPI_WITHOUT_CS, SPI_SET_BUS, SPI_TRANSFER, SPI_SEND, CONFIG_SPI_SHUTDOWN],
    responses: &[TransferResponse::FORMAT],
    constants: &[],
};

response! {
    /// What an SPI device sent back.
    "spi_transfer_response oid=%c response=%*s"
    pub(super) struct TransferResponse<'a> { oid: Oid, response: &'a [u8] }
}

/// A device before its bus is known, and after.
enum Spi {
    /// Claimed so that its chip select is idle.
    Selected { line: Line, active_high: bool },
    /// Without a line of our own.
    Plain,
    /// On its bus; the worker drives the chip select.
    Attached(DeviceId),
}

/// What a completion is for.
const SEND: u8 = 0;
const TRANSFER: u8 = 1;

impl Spi {
    fn set_bus(&mut self, mcu: &mut Mcu, bus: u32, mode: u8, rate_hz: u32) -> Result<(), Shutdown> {
        if mode > 3 {
            return Err(invalid(format_args!("mode {mode} is none of 0 to 3")));
        }
        if matches!(self, Spi::Attached(_)) {
            return Err(invalid("it has a bus already"));
        }
        // The firmware would open it even then; here steps would wait for the files.
        if mcu.is_finalized() {
            return Err(invalid("it gets a bus after finalize_config"));
        }
        let chip_select = match std::mem::replace(self, Spi::Plain) {
            Spi::Selected { line, active_high } => Some(ChipSelect { line: line.into_output(), active_high }),
            _ => None,
        };
        let attachment = mcu.board.spi(SpiConfig { bus, mode, rate_hz, chip_select })?;
        *self = Spi::Attached(mcu.attach(attachment)?);
        Ok(())
    }

    fn transfer(&self, mcu: &mut Mcu, oid: Oid, tag: u8, data: &[u8]) -> Result<(), Shutdown> {
        let data = Buffer::new(data);
        match self {
            Spi::Attached(device) => mcu.submit(*device, Ticket { oid, tag }, data),
            // A device without a bus echoes, as in the firmware.
            _ => {
                answer(mcu, oid, tag, &data);
                Ok(())
            }
        }
    }
}

#[cold]
fn invalid(what: impl fmt::Display) -> Shutdown {
    Shutdown::by_host(Reason::InvalidSpi, what)
}

fn answer(mcu: &mut Mcu, oid: Oid, tag: u8, data: &Buffer) {
    if tag == TRANSFER {
        mcu.send(TransferResponse { oid, response: data.as_slice() });
    }
}

impl Object for Spi {
    fn kind(&self) -> &'static str {
        "SPI device"
    }

    fn completed(&mut self, mcu: &mut Mcu, ticket: Ticket, result: Result<Buffer, Shutdown>) -> Result<(), Shutdown> {
        match result {
            Ok(data) => {
                answer(mcu, ticket.oid, ticket.tag, &data);
                Ok(())
            }
            Err(shutdown) => mcu.device_failed(shutdown),
        }
    }
}

/// What a device is told at a shutdown.
struct SpiShutdown {
    spi: Oid,
    message: Buffer,
}

impl Object for SpiShutdown {
    fn kind(&self) -> &'static str {
        "SPI shutdown message"
    }

    fn shutdown(&mut self, mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        mcu.with::<Spi, _>(self.spi, |spi, mcu| spi.transfer(mcu, self.spi, SEND, self.message.as_slice()))
    }
}

const CONFIG_SPI: Command =
    command!("config_spi oid=%c pin=%u cs_active_high=%c", |mcu, oid: Oid, pin: Pin, cs_active_high: bool| {
        mcu.vacant(oid)?;
        let line = mcu.output(pin, !cs_active_high, !cs_active_high)?;
        mcu.assign(oid, Spi::Selected { line, active_high: cs_active_high })
    });

const CONFIG_SPI_WITHOUT_CS: Command =
    command!("config_spi_without_cs oid=%c", |mcu, oid: Oid| mcu.assign(oid, Spi::Plain));

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
        mcu.assign(oid, SpiShutdown { spi: spi_oid, message: Buffer::new(shutdown_msg) })
    }
);
