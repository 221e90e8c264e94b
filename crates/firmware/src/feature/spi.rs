// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices, with or without a GPIO line as chip select, and the messages that they get at a shutdown.
//!
//! A `spi_send` or `spi_transfer` is finished and answered before the next command runs. klippy relies on that. For
//! displays it sets the D/C line with the commands before and after a `spi_send`. It also stops waiting for an answer
//! when the acknowledgement of the query arrives. Only a `spi_send` behind a `spi_send` to the same device does not
//! wait. The worker runs them in their order. After a failure, or when the MCU stops, the rest is not sent.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use crate::board::soft_spi::SoftSpi;
use crate::board::{BusError, ChipSelect, Pin, SpiConfig};
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{
    Back, Bus, Chip, Command, Context, Enumeration, Feature, Finished, Hosts, Job, JobSlot, Object, Oid, Response,
    Safe, command, response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{CLOCK_FREQ, Ticks};
use pinion_protocol::block::PAYLOAD_MAX;

pub(super) const FEATURE: Feature = Feature {
    serves: "SPI devices",

    commands: &[
        CONFIG_SPI_OF_V0_10,
        CONFIG_SPI,
        CONFIG_SPI_WITHOUT_CS,
        SPI_SET_BUS,
        SPI_SET_SOFTWARE_BUS,
        SPI_SET_SW_BUS,
        SPI_TRANSFER,
        SPI_SEND,
        CONFIG_SPI_SHUTDOWN,
    ],
    responses: &[TransferResponse::FORM],
    enumerations: &[Enumeration::new("spi_bus", |board| board.spi_buses())],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// An SPI mode above 3, or a second bus for one device.
    INVALID_SPI = "Invalid spi config";
    /// An SPI transfer failed.
    pub(super) SPI_TRANSFER_FAILED = "Unable to issue spi ioctl";
}

response! {
    /// The bytes that an SPI device sent back.
    "spi_transfer_response oid=%c response=%*s"
    pub(super) struct TransferResponse<'a> { oid: Oid, response: &'a [u8] }
}

/// The bytes for a device, and afterwards the bytes that came back. There is room for the bytes of a message block.
#[derive(Clone)]
pub(super) struct Transfer {
    bytes: [u8; PAYLOAD_MAX],
    len: usize,
    /// Whether the bytes that come back are read.
    reads: bool,
    /// Its round, if others may follow it at once, and the number of the round.
    round: Option<(Round, u32)>,
}

impl Transfer {
    /// An empty transfer, for a later load.
    const EMPTY: Transfer = Transfer { bytes: [0; PAYLOAD_MAX], len: 0, reads: true, round: None };

    /// A slot with an empty transfer.
    pub(super) fn slot(number: u8) -> JobSlot<Transfer> {
        JobSlot::numbered(number, Transfer::EMPTY)
    }

    /// Loads bytes to exchange for the bytes that come back.
    pub(super) fn load(&mut self, data: &[u8]) {
        self.len = data.len().min(PAYLOAD_MAX);
        self.bytes[..self.len].copy_from_slice(&data[..self.len]);
        self.reads = true;
    }

    /// Loads bytes to send. The bytes that come back are ignored.
    pub(super) fn load_to_send(&mut self, data: &[u8]) {
        self.load(data);
        self.reads = false;
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Job for Transfer {
    type Device = Chip;
    type Out = ();
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<(), BusError> {
        let bytes = &mut self.bytes[..self.len];
        if self.reads {
            return chip.exchange(bytes).inspect_err(|_| Round::end_of(&self.round));
        }
        // A transfer that reads is never skipped, because the host waits for its answer.
        match &self.round {
            Some((round, number)) if *number != round.number() => Ok(()),
            round => chip.send(bytes).inspect_err(|_| Round::end_of(round)),
        }
    }
}

/// Highest number of transfers of one device under way. With this many, the core wakes up only for one of several.
const UNDER_WAY_MAX: usize = 8;

/// Numbers the transfers that may be sent together. A failure or a stop takes the next number. Transfers that still wait
/// are then not sent.
#[derive(Clone, Default)]
struct Round(Arc<AtomicU32>);

impl Round {
    fn number(&self) -> u32 {
        self.0.load(Ordering::Acquire)
    }

    fn end(&self) {
        self.0.fetch_add(1, Ordering::AcqRel);
    }

    /// Ends the round of a transfer that failed.
    fn end_of(round: &Option<(Round, u32)>) {
        if let Some((round, _)) = round {
            round.end();
        }
    }
}

/// An SPI device.
pub(super) struct Spi {
    bus: Option<Bus>,
    chip_select: Option<ChipSelect>,
    transfers: [JobSlot<Transfer>; UNDER_WAY_MAX],
    /// The next of them. They return in the order in which they were sent.
    next: usize,
    round: Round,
}

impl Spi {
    fn new(chip_select: Option<ChipSelect>) -> Spi {
        let round = Round::default();
        let transfers = std::array::from_fn(|number| {
            let round = Some((round.clone(), 0));
            JobSlot::numbered(number as u8, Transfer { round, ..Transfer::EMPTY })
        });
        Spi { bus: None, chip_select, transfers, next: 0, round }
    }

    /// Whether the device has a chip select line of its own.
    pub(super) fn has_chip_select(&self) -> bool {
        self.chip_select.is_some()
    }

    /// Checks that the device may get a bus, with this mode.
    fn may_have_bus(&self, context: &Context, mode: u8) -> Result<(), Shutdown> {
        if mode > 3 {
            return Err(invalid(format_args!("mode {mode} is outside 0 to 3")));
        }
        if self.bus.is_some() {
            return Err(invalid("the device already has a bus"));
        }
        // Klipper's C opens a bus even then. Here the core would have to wait for the files, and steps with it.
        if context.is_finalized() {
            return Err(invalid("it gets a bus after finalize_config"));
        }
        Ok(())
    }

    fn set_bus(&mut self, context: &mut Context, bus: u32, mode: u8, rate_hz: u32) -> Result<(), Shutdown> {
        self.may_have_bus(context, mode)?;
        let chip_select = self.chip_select.clone();
        let opened = context.board()?.spi(SpiConfig { bus, mode, rate_hz, chip_select })?;
        self.bus = Some(context.bus(opened)?);
        Ok(())
    }

    fn set_lines(&mut self, context: &mut Context, pins: [Pin; 3], mode: u8, pulse: Ticks) -> Result<(), Shutdown> {
        self.may_have_bus(context, mode)?;
        let rate_hz = CLOCK_FREQ.checked_div(pulse.0).unwrap_or(CLOCK_FREQ);
        let config = SpiConfig { bus: 0, mode, rate_hz, chip_select: self.chip_select.clone() };
        if let Some(opened) = context.board()?.spi_on_lines(pins, &config) {
            self.bus = Some(context.bus(opened)?);
            return Ok(());
        }
        let [miso, mosi, sclk] = pins;
        // Klipper's order. It matters if one line is both MISO and MOSI: the line then drives.
        let device = SoftSpi {
            miso: context.shared_input(miso)?,
            mosi: context.shared_output(mosi, false)?,
            sclk: context.shared_output(sclk, false)?,
            mode,
            pulse,
            chip_select: self.chip_select.clone(),
            clock: context.clock(),
        };
        self.bus = Some(context.software_bus(Box::new(device))?);
        Ok(())
    }

    /// Starts a transfer: with an answer for `spi_transfer`, without one for `spi_send`.
    fn transfer(&mut self, context: &mut Context, answers: bool, data: &[u8]) -> Result<(), Shutdown> {
        let Some(bus) = &self.bus else {
            // A device without a bus echoes, as in Klipper's C.
            if answers {
                context.send(TransferResponse { oid: context.oid(), response: data });
            }
            return Ok(());
        };
        let slot = &mut self.transfers[self.next];
        // It is here, unless a bus has been hanging since before a stop.
        let Some(transfer) = slot.here() else {
            return Err(Shutdown::by_host(
                reason::WORKER_OVERFLOW,
                "the messages from before the stop are still being sent",
            ));
        };
        if let Some((round, number)) = &mut transfer.round {
            *number = round.number();
        }
        if answers {
            transfer.load(data)
        } else {
            transfer.load_to_send(data)
        }
        slot.send(context, bus.chip())?;
        self.next = (self.next + 1) % UNDER_WAY_MAX;
        if !answers {
            context.let_join(UNDER_WAY_MAX as u32);
        }
        Ok(())
    }
}

#[cold]
fn invalid(what: impl fmt::Display) -> Shutdown {
    Shutdown::by_host(INVALID_SPI, what)
}

/// The shutdown for a failed SPI transfer. It does not convert every `BusError`: an I2C bus has its own texts
/// (`i2c_shutdown`).
pub(super) fn spi_shutdown(error: BusError) -> Shutdown {
    Shutdown::because(SPI_TRANSFER_FAILED, error.trouble)
}

impl Object for Spi {
    fn kind(&self) -> &'static str {
        "SPI device"
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let kind = self.kind();
        let slot = &mut self.transfers[usize::from(number)];
        if let Some(Back { result: Err(error), .. }) = slot.back(finished) {
            return context.device_failed(kind, spi_shutdown(error.clone()));
        }
        if let Some(transfer) = slot.here().filter(|transfer| transfer.reads) {
            context.send(TransferResponse { oid: context.oid(), response: transfer.bytes() });
        }
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.round.end();
    }

    fn bus(&self) -> Option<&Bus> {
        self.bus.as_ref()
    }
}

/// The message for a device at a shutdown.
struct SpiShutdown {
    spi: Oid,
    message: JobSlot<Transfer>,
    bytes: Box<[u8]>,
}

impl Object for SpiShutdown {
    fn kind(&self) -> &'static str {
        "SPI shutdown message"
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.message.back(finished) else { return Ok(()) };
        match result {
            Ok(()) => {
                context.is_safe();
                Ok(())
            }
            Err(error) => {
                let failure = spi_shutdown(error.clone());
                context.device_failed(self.kind(), failure)
            }
        }
    }

    /// The guardian cannot send the message: it holds no chips on a bus.
    fn is_guarded(&self) -> bool {
        false
    }

    fn make_safe(&mut self, context: &mut Context) -> Result<Safe, Shutdown> {
        let has_bus = context.with::<Spi, _>(self.spi, |spi, _| Ok(spi.bus.is_some()))?;
        if !has_bus {
            return Ok(Safe::Now);
        }
        if let Some(message) = self.message.here() {
            message.load_to_send(&self.bytes);
            self.message.send_to(context, self.spi)?;
        }
        Ok(Safe::Later)
    }
}

fn configure(context: &mut Context, oid: Oid, pin: Pin, active_high: bool) -> Result<(), Shutdown> {
    context.vacant(oid)?;
    let line = context.shared_output(pin, !active_high)?;
    let chip_select = ChipSelect { line, active_high, clock: context.clock() };
    context.assign_on(pin, oid, Spi::new(Some(chip_select)))
}

const CONFIG_SPI_OF_V0_10: Command =
    command!("config_spi oid=%c pin=%u", |context, oid: Oid, pin: Pin| configure(context, oid, pin, false)).of(&[]);

const CONFIG_SPI: Command =
    command!("config_spi oid=%c pin=%u cs_active_high=%c", |context, oid: Oid, pin: Pin, cs_active_high: bool| {
        configure(context, oid, pin, cs_active_high)
    });

const CONFIG_SPI_WITHOUT_CS: Command =
    command!("config_spi_without_cs oid=%c", |context, oid: Oid| context.assign(oid, Spi::new(None)));

const SPI_SET_BUS: Command = command!(
    "spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u",
    Spi,
    |spi, context, spi_bus: u32, mode: u32, rate: u32| {
        let mode = u8::try_from(mode).unwrap_or(u8::MAX);
        spi.set_bus(context, spi_bus, mode, rate)
    }
);

const SPI_SET_SOFTWARE_BUS: Command = command!(
    "spi_set_software_bus oid=%c miso_pin=%u mosi_pin=%u sclk_pin=%u mode=%u rate=%u",
    Spi,
    |spi, context, miso_pin: Pin, mosi_pin: Pin, sclk_pin: Pin, mode: u32, rate: u32| {
        let mode = mode as u8;
        let pins = [miso_pin, mosi_pin, sclk_pin];
        // Klipper's C ignored the rate and was as fast as its system calls. Lines that are written through mapped
        // registers would be too fast for a chip.
        let pulse = Ticks(CLOCK_FREQ.checked_div(rate).unwrap_or(0));
        spi.set_lines(context, pins, mode, pulse)
    }
)
.hosts(Hosts::of(&[V0_11, V0_12, V0_13]).unless(SPI_SET_SW_BUS.format));

const SPI_SET_SW_BUS: Command = command!(
    "spi_set_sw_bus oid=%c miso_pin=%u mosi_pin=%u sclk_pin=%u mode=%u pulse_ticks=%u",
    Spi,
    |spi, context, miso_pin: Pin, mosi_pin: Pin, sclk_pin: Pin, mode: u32, pulse_ticks: Ticks| {
        // The mode has one byte, as in Klipper's C.
        let mode = mode as u8;
        let pins = [miso_pin, mosi_pin, sclk_pin];
        spi.set_lines(context, pins, mode, pulse_ticks)
    }
)
.of(&[Master, Kalico]);

const SPI_TRANSFER: Command =
    command!("spi_transfer oid=%c data=%*s", Spi, |spi, context, data: &[u8]| spi.transfer(context, true, data));

const SPI_SEND: Command =
    command!("spi_send oid=%c data=%*s", Spi, |spi, context, data: &[u8]| spi.transfer(context, false, data)).joining();

const CONFIG_SPI_SHUTDOWN: Command = command!(
    "config_spi_shutdown oid=%c spi_oid=%c shutdown_msg=%*s",
    |context, oid: Oid, spi_oid: Oid, shutdown_msg: &[u8]| {
        context.require::<Spi>(spi_oid)?;
        context.assign(oid, SpiShutdown { spi: spi_oid, message: Transfer::slot(0), bytes: shutdown_msg.into() })
    }
);
