// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C devices.
//!
//! `i2c_transfer` answers with the status of the bus, and klippy decides. The older `i2c_read`, `i2c_write`
//! and `i2c_modify_bits` have no status: a failure stops the MCU. A transfer is finished and answered before the next
//! command runs, because klippy configures chips with one transfer after the other. A plain read is retried
//! ([`BusDevice::read_register`](crate::board::BusDevice::read_register)). A transfer that writes is not.

use crate::board::soft_i2c::SoftI2c;
use crate::board::{BusError, BusStatus, I2cConfig, Pin, Range};
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{
    Back, Bus, Chip, Command, Context, Device, Enumeration, Feature, Finished, Hosts, Job, JobSlot, Object, Oid,
    Report, Response, Tolerance, command, response,
};
use crate::shutdown::{Shutdown, ShutdownReason, reason, shutdowns};
use crate::time::{CLOCK_FREQ, Clock, Ticks};
use pinion_protocol::block::PAYLOAD_MAX;

pub(super) const FEATURE: Feature = Feature {
    serves: "I2C devices",

    commands: &[
        CONFIG_I2C_WITH_BUS,
        CONFIG_I2C,
        I2C_SET_BUS,
        I2C_SET_SOFTWARE_BUS,
        I2C_SET_SW_BUS,
        I2C_WRITE,
        I2C_READ,
        I2C_MODIFY_BITS,
        I2C_TRANSFER,
    ],
    responses: &[ReadResponse::FORM, TransferResponse::FORM],
    enumerations: &[
        Enumeration::new("i2c_bus", |board| board.i2c_buses()),
        Enumeration::new("i2c_bus_status", |_| statuses()).of(&[Master]),
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A sensor did not acknowledge a byte.
    I2C_NACK = "I2C NACK";
    /// A sensor did not acknowledge its address.
    I2C_START_NACK = "I2C START NACK";
    /// A sensor did not acknowledge its address for a read.
    I2C_START_READ_NACK = "I2C START READ NACK";
    /// A sensor's bus was not free, or the clock was held, for too long.
    I2C_TIMEOUT = "I2C Timeout";
    /// Up to v0.12: writing to a device failed.
    I2C_WRITE_FAILED = "Unable write i2c device";
    /// Up to v0.12: reading from a device or a sensor failed.
    I2C_READ_FAILED = "Unable to read i2c device";
    /// v0.12: a device on a software bus did not acknowledge.
    SOFT_I2C_NACK = "soft_i2c NACK";
    /// `i2c_modify_bits` with an odd number of bytes. Each byte of bits to clear needs one of bits to set.
    ODD_BITS = "i2c_modify_bits: Odd number of bits!";
}

/// The hosts whose messages have no status. Newer ones also look these messages up, and prefer them.
const STOPS_ON_FAILURE: Hosts = Hosts::of(&[V0_11, V0_12, V0_13, Kalico]).unless(I2C_TRANSFER.format);

response! {
    /// The bytes that a device sent.
    "i2c_read_response oid=%c response=%*s" => STOPS_ON_FAILURE;
    pub(super) struct ReadResponse<'a> { oid: Oid, response: &'a [u8] }
}

response! {
    /// The status of the bus, and the bytes that a device sent.
    "i2c_response oid=%c i2c_bus_status=%c response=%*s" => Hosts::of(&[Master]);
    pub(super) struct TransferResponse<'a> { oid: Oid, i2c_bus_status: u8, response: &'a [u8] }
}

/// Highest number of bytes in a response. Its id and oid take two bytes each, its status and length one each.
const RESPONSE_MAX: usize = PAYLOAD_MAX - 6;

const SUCCESS: u8 = 0;

/// The number and the text of a status, from Klipper's i2ccmds.h and i2ccmds.c.
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

/// The shutdown for a sensor that cannot be reached (Klipper's `i2c_shutdown_on_err`).
pub(super) fn i2c_shutdown(context: &Context, error: BusError) -> Shutdown {
    let reason = if context.takes(&I2C_MODIFY_BITS) { I2C_READ_FAILED } else { on_wire(error.status).1 };
    Shutdown::because(reason, error.trouble)
}

/// The command of a transfer.
#[derive(Clone, Copy)]
enum Purpose {
    /// `i2c_transfer`. Its answer has the status of the bus.
    Transfer,
    /// `i2c_write`.
    Write,
    /// `i2c_read`.
    Read,
    /// `i2c_modify_bits`: reads bytes, changes bits in them, and writes them to where they were read from. `bits` has
    /// `len` bytes of bits to clear, then as many bytes of bits to set.
    Modify { bits: [u8; PAYLOAD_MAX], len: usize },
}

impl Purpose {
    fn modify(clear_set: &[u8]) -> Purpose {
        let mut bits = [0; PAYLOAD_MAX];
        let len = clear_set.len().min(PAYLOAD_MAX);
        bits[..len].copy_from_slice(&clear_set[..len]);
        Purpose::Modify { bits, len: len / 2 }
    }
}

/// Bytes to a device, and bytes from it.
struct Transfer {
    purpose: Purpose,
    /// Whether the changed bytes are being written.
    writes_back: bool,
    write: [u8; PAYLOAD_MAX],
    write_len: usize,
    read: [u8; u8::MAX as usize],
    read_len: usize,
}

impl Transfer {
    fn new(purpose: Purpose, write: &[u8], read_len: usize) -> Transfer {
        let mut bytes = [0; PAYLOAD_MAX];
        let write_len = write.len().min(PAYLOAD_MAX);
        bytes[..write_len].copy_from_slice(&write[..write_len]);
        Transfer { purpose, writes_back: false, write: bytes, write_len, read: [0; u8::MAX as usize], read_len }
    }

    /// The bytes that select the answer. Of a write, only the register or command: its data may differ each time.
    fn question(&self) -> &[u8] {
        let len = if self.read_len == 0 { self.write_len.min(1) } else { self.write_len };
        &self.write[..len]
    }

    /// Whether it changes what the device holds, by what it reads: an expander's outputs.
    fn is_change(&self) -> bool {
        matches!(self.purpose, Purpose::Modify { .. })
    }

    /// The bytes for which the answer has room, as in Klipper's C.
    fn response(&self) -> &[u8] {
        &self.read[..self.read_len.min(RESPONSE_MAX)]
    }
}

impl Job for Transfer {
    type Device = Chip;
    type Out = ();
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<(), BusError> {
        let read = &mut self.read[..self.read_len];
        match &self.write[..self.write_len] {
            [] if !read.is_empty() => chip.read_register(&[], read),
            write => chip.write_read(write, read),
        }?;
        let Purpose::Modify { bits, len } = self.purpose else { return Ok(()) };
        let (clear, set) = bits.split_at(len);
        let changed = read.iter().zip(clear.iter().zip(set)).map(|(byte, (clear, set))| byte & !clear | set);
        for (place, byte) in self.write[self.write_len..].iter_mut().zip(changed) {
            *place = byte;
        }
        let end = (self.write_len + len).min(PAYLOAD_MAX);
        self.writes_back = true;
        chip.write_read(&self.write[..end], &mut [])
    }
}

const KIND: &str = "I2C device";

/// An I2C device.
pub(super) struct I2c {
    bus: Option<Bus>,
    /// Whether the bus is a software bus on lines.
    on_lines: bool,
    transfer: JobSlot<Transfer>,
    /// Whether the last transfer failed. Only the first failure is logged: an unplugged display fails many times a
    /// second.
    failing: bool,
    /// The last answers, if the user tolerates failures.
    tolerance: Option<(Tolerance, Answers)>,
}

/// The last answers of a device, to be repeated while it fails.
struct Answers(Vec<Answer>);

struct Answer {
    question: [u8; PAYLOAD_MAX],
    question_len: usize,
    read: [u8; u8::MAX as usize],
    /// 0: the question is a write.
    read_len: usize,
    /// When the question first failed since its last answer.
    failing_since: Option<Clock>,
}

impl Answers {
    /// Highest number of different questions.
    const MAX: usize = 16;

    fn new() -> Answers {
        Answers(Vec::with_capacity(Answers::MAX))
    }

    fn of(&mut self, transfer: &Transfer) -> Option<&mut Answer> {
        let same = |answer: &&mut Answer| {
            answer.read_len == transfer.read_len && &answer.question[..answer.question_len] == transfer.question()
        };
        self.0.iter_mut().find(same)
    }

    /// The answer to this question, made if it is new. Of too many, the oldest one that does not fail is forgotten.
    fn of_any(&mut self, transfer: &Transfer) -> Option<&mut Answer> {
        if self.of(transfer).is_none() {
            if self.0.len() == Answers::MAX {
                self.0.remove(self.0.iter().position(|answer| answer.failing_since.is_none())?);
            }
            let Transfer { write, read, read_len, .. } = *transfer;
            let question_len = transfer.question().len();
            self.0.push(Answer { question: write, question_len, read, read_len, failing_since: None });
        }
        self.of(transfer)
    }

    /// Keeps an answer. The question fails no more.
    fn keep(&mut self, transfer: &Transfer) {
        if transfer.is_change() {
            return;
        }
        if let Some(answer) = self.of_any(transfer) {
            answer.read = transfer.read;
            answer.failing_since = None;
        }
    }

    /// Repeats the last answer to this question, and returns when it first failed. `None` if there is no answer, or if
    /// the device is written and not read. A write to a device that is read has nothing to repeat.
    fn repeat(&mut self, transfer: &mut Transfer, now: Clock) -> Option<Clock> {
        let is_read = self.0.iter().any(|answer| answer.read_len > 0);
        let answer = match transfer.read_len {
            _ if transfer.is_change() => return None,
            0 if is_read => self.of_any(transfer)?,
            0 => return None,
            _ => self.of(transfer)?,
        };
        transfer.read = answer.read;
        Some(*answer.failing_since.get_or_insert(now))
    }

    fn is_failing(&self) -> bool {
        self.0.iter().any(|answer| answer.failing_since.is_some())
    }
}

impl I2c {
    fn new() -> I2c {
        let transfer = JobSlot::new(Transfer::new(Purpose::Transfer, &[], 0));
        I2c { bus: None, on_lines: false, transfer, failing: false, tolerance: None }
    }

    fn set_bus(&mut self, context: &mut Context, bus: u32, rate_hz: u32, address: u32) -> Result<(), Shutdown> {
        let config = I2cConfig { bus, address: seven_bits(address), rate_hz };
        let opened = context.board()?.i2c(config)?;
        self.bus = Some(context.bus(opened)?);
        let tolerance = context.tolerance(&Device::I2c(bus, config.address));
        self.tolerance = tolerance.map(|tolerance| (tolerance, Answers::new()));
        Ok(())
    }

    fn set_lines(&mut self, context: &mut Context, pins: [Pin; 2], pulse: Ticks, address: u32) -> Result<(), Shutdown> {
        let rate_hz = CLOCK_FREQ.checked_div(pulse.0.saturating_mul(2)).unwrap_or(CLOCK_FREQ);
        let config = I2cConfig { bus: 0, address: seven_bits(address), rate_hz };
        if let Some(opened) = context.board()?.i2c_on_lines(pins, config) {
            self.bus = Some(context.bus(opened)?);
            return Ok(());
        }
        let [scl, sda] = pins;
        let lines = (context.shared_wire(scl)?, context.shared_wire(sda)?);
        let name = format!("scl {} sda {} address {:#04x}", context.name(scl), context.name(sda), seven_bits(address));
        let device = SoftI2c::new(lines.0, lines.1, seven_bits(address), pulse, context.clock(), name);
        self.bus = Some(context.software_bus(Box::new(device))?);
        self.on_lines = true;
        Ok(())
    }

    /// Starts a transfer for the running command.
    fn transfer(&mut self, context: &mut Context, transfer: Transfer) -> Result<(), Shutdown> {
        let Some(bus) = &self.bus else {
            // Klipper's C answers the same for a device without a bus.
            let status = BusStatus::Nack;
            if let Purpose::Transfer = transfer.purpose {
                let i2c_bus_status = on_wire(status).0;
                context.send(TransferResponse { oid: context.oid(), i2c_bus_status, response: transfer.response() });
                return Ok(());
            }
            let error = BusError::new(status, "it has no bus: a fault of the host, which did not send i2c_set_bus");
            return Err(self.failure(context, matches!(transfer.purpose, Purpose::Write), error));
        };
        // Commands wait for each other, so the job is here.
        let Some(present) = self.transfer.here() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "a transfer came during another one"));
        };
        *present = transfer;
        self.transfer.send(context, bus.chip())
    }

    /// The shutdown for a failed transfer, depending on whether it was writing or reading.
    fn failure(&self, context: &Context, writing: bool, error: BusError) -> Shutdown {
        match writing {
            _ if !context.takes(&I2C_MODIFY_BITS) => i2c_shutdown(context, error),
            _ if self.on_lines => Shutdown::because(SOFT_I2C_NACK, error.trouble),
            true => Shutdown::because(I2C_WRITE_FAILED, error.trouble),
            false => i2c_shutdown(context, error),
        }
    }
}

impl Object for I2c {
    fn kind(&self) -> &'static str {
        KIND
    }

    /// Reports the result of a transfer to the host. If the answer has no status, a failure stops the MCU.
    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.transfer.back(finished) else { return Ok(()) };
        let mut result = result.map_err(BusError::clone);
        let Some(transfer) = self.transfer.here() else { return Ok(()) };
        if let Some((tolerance, answers)) = &mut self.tolerance {
            match &mut result {
                Ok(()) => {
                    answers.keep(transfer);
                    if !answers.is_failing() {
                        tolerance.works(context, KIND, I2C_NACK);
                    }
                }
                Err(error) => match answers.repeat(transfer, context.now()) {
                    Some(since)
                        if tolerance.bears(context, KIND, since, |context| i2c_shutdown(context, error.clone())) =>
                    {
                        result = Ok(());
                    }
                    None if transfer.read_len == 0 || transfer.is_change() => {
                        error.trouble.remedy = Some("tolerate is only for a device that is read".into());
                    }
                    _ => {}
                },
            }
        }
        let response = transfer.response();
        match (transfer.purpose, &result) {
            (Purpose::Transfer, result) => {
                let i2c_bus_status = result.as_ref().map_or_else(|error| on_wire(error.status).0, |()| SUCCESS);
                context.send(TransferResponse { oid: context.oid(), i2c_bus_status, response });
            }
            (Purpose::Read, Ok(())) => context.send(ReadResponse { oid: context.oid(), response }),
            _ => {}
        }
        let failed_before = std::mem::replace(&mut self.failing, result.is_err());
        let Err(error) = result else { return Ok(()) };
        if let Purpose::Transfer = transfer.purpose {
            if !failed_before {
                let trouble = i2c_shutdown(context, error);
                context.warn(KIND, trouble);
            }
            return Ok(());
        }
        // v0.11 wrote the register in a transfer of its own before the read.
        let of_register =
            context.takes(&CONFIG_I2C_WITH_BUS) && transfer.write_len > 0 && error.status != BusStatus::StartReadNack;
        let writing = matches!(transfer.purpose, Purpose::Write) || transfer.writes_back || of_register;
        let failure = self.failure(context, writing, error);
        context.device_failed(KIND, failure)
    }

    fn bus(&self) -> Option<&Bus> {
        self.bus.as_ref()
    }

    fn report(&self) -> Report {
        let repeats = self.tolerance.as_ref().is_some_and(|(tolerance, _)| tolerance.is_used());
        Report { repeats, ..Report::default() }
    }
}

const CONFIG_I2C: Command = command!("config_i2c oid=%c", |context, oid: Oid| context.assign(oid, I2c::new()))
    .of(&[V0_12, V0_13, Master, Kalico]);

const CONFIG_I2C_WITH_BUS: Command = command!(
    "config_i2c oid=%c i2c_bus=%u rate=%u address=%u",
    |context, oid: Oid, i2c_bus: u32, rate: u32, address: u32| {
        context.vacant(oid)?;
        let mut i2c = I2c::new();
        i2c.set_bus(context, i2c_bus, rate, address)?;
        context.assign(oid, i2c)
    }
)
.of(&[V0_11]);

const I2C_SET_BUS: Command = command!(
    "i2c_set_bus oid=%c i2c_bus=%u rate=%u address=%u",
    I2c,
    |i2c, context, i2c_bus: u32, rate: u32, address: u32| i2c.set_bus(context, i2c_bus, rate, address)
)
.of(&[V0_12, V0_13, Master, Kalico]);

/// Half a period at 100 kHz. Klipper's C used this rate for every requested rate.
const SOFTWARE_PULSE: Ticks = Ticks::from_us(5);

const I2C_SET_SOFTWARE_BUS: Command = command!(
    "i2c_set_software_bus oid=%c scl_pin=%u sda_pin=%u rate=%u address=%u",
    I2c,
    |i2c, context, scl_pin: Pin, sda_pin: Pin, rate: u32, address: u32| {
        let _ = rate;
        i2c.set_lines(context, [scl_pin, sda_pin], SOFTWARE_PULSE, address)
    }
)
.hosts(Hosts::of(&[V0_12, V0_13]).unless(I2C_SET_SW_BUS.format));

const I2C_SET_SW_BUS: Command = command!(
    "i2c_set_sw_bus oid=%c scl_pin=%u sda_pin=%u pulse_ticks=%u address=%u",
    I2c,
    |i2c, context, scl_pin: Pin, sda_pin: Pin, pulse_ticks: Ticks, address: u32| i2c.set_lines(
        context,
        [scl_pin, sda_pin],
        pulse_ticks,
        address
    )
)
.of(&[Master, Kalico]);

const I2C_WRITE: Command = command!("i2c_write oid=%c data=%*s", I2c, |i2c, context, data: &[u8]| i2c
    .transfer(context, Transfer::new(Purpose::Write, data, 0)))
.hosts(STOPS_ON_FAILURE);

const I2C_READ: Command =
    command!("i2c_read oid=%c reg=%*s read_len=%u", I2c, |i2c, context, reg: &[u8], read_len: u32| i2c
        .transfer(context, Transfer::new(Purpose::Read, reg, one_byte(read_len))))
    .hosts(STOPS_ON_FAILURE);

const I2C_MODIFY_BITS: Command = command!(
    "i2c_modify_bits oid=%c reg=%*s clear_set_bits=%*s",
    I2c,
    |i2c, context, reg: &[u8], clear_set_bits: &[u8]| {
        if clear_set_bits.len() % 2 != 0 {
            let what = format_args!("the host sends {} bytes to clear and set", clear_set_bits.len());
            return Err(Shutdown::by_host(ODD_BITS, what));
        }

        let purpose = Purpose::modify(clear_set_bits);
        i2c.transfer(context, Transfer::new(purpose, reg, clear_set_bits.len() / 2))
    }
)
.of(&[V0_11, V0_12]);

const I2C_TRANSFER: Command =
    command!("i2c_transfer oid=%c write=%*s read_len=%u", I2c, |i2c, context, write: &[u8], read_len: u32| {
        i2c.transfer(context, Transfer::new(Purpose::Transfer, write, one_byte(read_len)))
    })
    .of(&[Master]);

/// A count of bytes has one byte, as in Klipper's C.
fn one_byte(count: u32) -> usize {
    usize::from(count as u8)
}

/// An address has 7 bits. Klipper's C drops the others.
fn seven_bits(address: u32) -> u8 {
    (address & 0x7f) as u8
}
