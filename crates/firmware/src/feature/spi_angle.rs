// SPDX-License-Identifier: GPL-3.0-or-later
//! Magnetic angle sensors on SPI: A1333, AS5047D, TLE5012B, MT6816, MT6826S.
//!
//! Every `rest_ticks` the host gets one entry, an angle or an error. klippy (`extras/angle.py`) counts entries to know
//! when each was due. An entry says by how much it came later (for the TLE5012B: the chip's own clock). A sensor gets
//! one request at a time. Its latched measurement is read before a transfer of the host latches a new one.

use crate::mcu::DialectName::{Master, V0_11, V0_12, V0_13};
use crate::mcu::{
    Back, Command, Context, DialectName, Enumeration, Feature, Finished, Hold, Hosts, JobSlot, Next, Object, Oid,
    Response, Timer, WireClock, command, response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Clock, Ticks};

use super::named;
use super::sensor_bulk::{BulkData, SensorBulk, Status, Words};
use super::spi::{Spi, Transfer, spi_shutdown};

pub(super) const FEATURE: Feature = Feature {
    serves: "angle sensors",

    commands: &[CONFIG_SPI_ANGLE, QUERY_SPI_ANGLE, SPI_ANGLE_TRANSFER],
    responses: &[OwnData::FORM, OwnEnd::FORM, TransferResponse::FORM],
    enumerations: &[
        Enumeration::new("spi_angle_type", |_| named(&TYPES[..TYPES_OF_V0_12])).of(&[V0_11, V0_12]),
        Enumeration::new("spi_angle_type", |_| named(&TYPES)).of(&[V0_13, Master]),
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

/// The hosts that know these sensors. Kalico has them only for other boards.
const KNOWN: &[DialectName] = &[V0_11, V0_12, V0_13, Master];

const TYPES: [(&str, u8); 5] = [("a1333", 0), ("as5047d", 1), ("tle5012b", 2), ("mt6816", 3), ("mt6826s", 4)];
/// How many of them v0.12 knows.
const TYPES_OF_V0_12: usize = 3;

shutdowns! {
    /// A `spi_angle_type` outside the enumeration.
    INVALID_CHIP = "Invalid spi_angle chip type";
    /// The SPI device has no chip select line of its own.
    NEEDS_CS = "angle sensor requires cs pin";
}

response! {
    /// Entries.
    "spi_angle_data oid=%c sequence=%hu data=%*s" => OwnEnd::FORM.hosts.with(OwnEnd::FORM.format);
    pub(super) struct OwnData<'a> { oid: Oid, sequence: u16, data: &'a [u8] }
}

response! {
    /// The measurements have ended. The last message has the number before this one.
    "spi_angle_end oid=%c sequence=%hu" => Hosts::of(&[V0_11, V0_12]);
    pub(super) struct OwnEnd { oid: Oid, sequence: u16 }
}

/// The messages up to v0.12.
const OWN_WORDS: Words = Words {
    data_max: 48,
    data: |context, BulkData { oid, sequence, data }| context.send(OwnData { oid, sequence, data }),
    status: |context, Status { oid, next_sequence, .. }| context.send(OwnEnd { oid, sequence: next_sequence }),
};

response! {
    /// The bytes that a sensor sent back, and when it latched them. There are none if the bus was too slow for a time.
    "spi_angle_transfer_response oid=%c clock=%u response=%*s" => Hosts::of(KNOWN);
    pub(super) struct TransferResponse<'a> { oid: Oid, clock: Clock, response: &'a [u8] }
}

/// Longest transfer. A longer one says too little about when the sensor latched.
const TRANSFER_MAX: Ticks = Ticks::from_us(50);
/// The time field of an entry that is an error.
const TIME_ERROR: u8 = 0xff;
/// Longest time for which the TLE5012B's 6-bit frame counter is unambiguous, with some margin: 32 times 32 periods of
/// its 750 kHz timer, in whole microseconds.
const FRAMES_MAX: Ticks = Ticks::from_us((32 * 32 * 1_000_000u64 / 750_000) as u32);
const ENTRY_BYTES: usize = 3;
const MESSAGE_MAX: usize = 10;

const TIMER: Timer = Timer::sampling(0);

/// Why there is no angle. klippy's log counts these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// The measurement before was not finished in time.
    Overflow = 0,
    /// The measurement came too late: an entry cannot hold the lateness.
    Schedule = 1,
    /// The transfer took too long.
    SpiTime = 2,
    /// A checksum or parity bit is wrong.
    Crc = 3,
    /// The angle was already reported.
    Duplicate = 4,
    /// The sensor reports that it has no angle.
    NoAngle = 5,
}

/// The sensors, in the order of `spi_angle_type`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Chip {
    A1333,
    As5047d,
    Tle5012b,
    Mt6816,
    Mt6826s,
}

/// An angle of 16 bits. `frame` is the TLE5012B's own clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Angle {
    angle: u16,
    frame: Option<u8>,
}

/// A cyclic redundancy check of 8 bits.
fn crc8(polynomial: u8, start: u8, bytes: &[u8]) -> u8 {
    bytes.iter().fold(start, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 != 0 { (crc << 1) ^ polynomial } else { crc << 1 })
    })
}

fn is_odd(bytes: [u8; 2]) -> bool {
    u16::from_be_bytes(bytes).count_ones() % 2 == 1
}

impl Chip {
    /// The sensor with this number.
    fn of(number: u8) -> Result<Chip, Shutdown> {
        const CHIPS: [Chip; 5] = [Chip::A1333, Chip::As5047d, Chip::Tle5012b, Chip::Mt6816, Chip::Mt6826s];
        CHIPS.get(usize::from(number)).copied().ok_or_else(|| {
            Shutdown::by_host(INVALID_CHIP, format_args!("spi_angle_type {number} is not in the dictionary"))
        })
    }

    /// The transfer before the message. Its end is when the sensor latches. The TLE5012B latches at the end of an empty
    /// transfer, which selects it for at least 1 us. The AS5047D latches at the end of the transfer that asks for the
    /// angle (ANGLECOM). The next transfer brings this angle.
    fn preface(self, purpose: &Purpose) -> Option<&'static [u8]> {
        match (self, purpose) {
            (Chip::Tle5012b, _) => Some(&[]),
            (Chip::As5047d, Purpose::Measurement { .. }) => Some(&[0x7f, 0xfe]),
            _ => None,
        }
    }

    /// The message that brings the angle.
    fn message(self) -> &'static [u8] {
        match self {
            // Asks for the angle register. The next transfer brings it.
            Chip::A1333 => &[0x32, 0x00],
            // No operation.
            Chip::As5047d => &[0xc0, 0x00],
            // Three latched registers from AVAL on, and the safety word.
            Chip::Tle5012b => &[0x84, 0x23, 0, 0, 0, 0, 0, 0, 0, 0],
            // Two registers from 3 on.
            Chip::Mt6816 => &[0x83, 0x00, 0x00],
            // Four registers from 3 on.
            Chip::Mt6826s => &[0x30, 0x03, 0, 0, 0, 0],
        }
    }

    /// Whether the value is from the transfer's end, for a transfer without a preface. (For the MT6816 and MT6826S this
    /// is so only in measurements.)
    fn latches_at_end(self, purpose: &Purpose) -> bool {
        match purpose {
            Purpose::Measurement { .. } => matches!(self, Chip::Mt6816 | Chip::Mt6826s),
            Purpose::Transfer { .. } => self == Chip::As5047d,
        }
    }

    /// Decodes the angle from a message's reply.
    fn decode(self, reply: &[u8; MESSAGE_MAX]) -> Result<Angle, Fault> {
        let [b0, b1, b2, b3, b4, b5, b6, .., b8, b9] = *reply;
        let word = |high: u8, low: u8| u16::from_be_bytes([high, low]);
        let check = |wrong: bool, fault: Fault| if wrong { Err(fault) } else { Ok(()) };
        let (angle, frame) = match self {
            Chip::A1333 => {
                check(b0 & 0x80 != 0, Fault::Crc)?;
                (word(b0, b1) << 1, None)
            }
            Chip::As5047d => {
                check(is_odd([b0, b1]), Fault::Crc)?;
                check(b0 & 0x40 != 0, Fault::NoAngle)?;
                (word(b0, b1) << 2, None)
            }
            Chip::Tle5012b => {
                // SAE J1850. It also covers the command.
                let crc = crc8(0x1d, crc8(0x1d, 0xff, &self.message()[..2]), &reply[2..8]);
                check(!crc != b9, Fault::Crc)?;
                check(b8 & 0x10 == 0, Fault::NoAngle)?;
                check(b2 & 0x80 == 0, Fault::Duplicate)?;
                (word(b2, b3) << 1, Some((b6 >> 1) & 0x3f))
            }
            Chip::Mt6816 => {
                check(is_odd([b1, b2]), Fault::Crc)?;
                check(b2 & 0x02 != 0, Fault::NoAngle)?;
                (word(b1, b2) & 0xfffc, None)
            }
            Chip::Mt6826s => {
                check(crc8(0x07, 0, &[b2, b3, b4]) != b5, Fault::Crc)?;
                check(b4 & 0x02 != 0, Fault::NoAngle)?;
                (word(b2, b3), None)
            }
        };
        Ok(Angle { angle, frame })
    }
}

/// An entry for an angle that was latched `late` ticks after it was due.
fn entry(measured: Result<Angle, Fault>, late: u32, time_shift: u8) -> [u8; ENTRY_BYTES] {
    let timed = measured.and_then(|Angle { angle, frame }| match frame {
        Some(_) if late > FRAMES_MAX.0 => Err(Fault::Schedule),
        Some(frame) => Ok((frame, angle)),
        None => {
            // Rounded.
            let shift = u32::from(time_shift).min(63);
            let half = (1u64 << shift) >> 1;
            let time = u8::try_from((u64::from(late) + half) >> shift).ok().filter(|time| *time != TIME_ERROR);
            time.map(|time| (time, angle)).ok_or(Fault::Schedule)
        }
    });
    let (time, value) = timed.unwrap_or_else(|fault| (TIME_ERROR, fault as u16));
    let [low, high] = value.to_le_bytes();
    [time, low, high]
}

/// The purpose of a request to a sensor.
enum Purpose {
    /// A measurement of the timer, with its due time. `None`: it is from an earlier query, and no longer counts.
    Measurement { due: Option<Clock> },
    /// A transfer of the host. Commands wait until its `hold` is released. `None`: the MCU has stopped.
    Transfer { hold: Option<Hold> },
}

/// A request under way.
struct Asking {
    purpose: Purpose,
    /// When the preface ended. `None`: it has not ended, or there is no preface.
    latched: Option<Clock>,
}

/// The next measurement.
struct Upcoming {
    due: Clock,
    /// How many measurements before it were skipped, because there was no time for them.
    missed: u16,
}

const KIND: &str = "angle sensor";

// The numbers of the jobs.
const MEASUREMENT: u8 = 0;
const TRANSFER: u8 = 1;

struct SpiAngle {
    chip: Chip,
    spi: Oid,
    bulk: SensorBulk,
    rest_ticks: Ticks,
    time_shift: u8,
    /// A sensor gets one request at a time.
    asking: Option<Asking>,
    upcoming: Option<Upcoming>,
    /// The host's transfer waits for the request under way. Commands wait for the transfer.
    asked: Option<Hold>,
    /// For measurements, and prefaces of transfers.
    measurement: JobSlot<Transfer>,
    /// For transfers of the host.
    transfer: JobSlot<Transfer>,
}

impl SpiAngle {
    /// Begins the next request, if none is under way. The host goes first.
    fn go_on(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        if self.asking.is_some() {
            return Ok(());
        }
        let purpose = if let Some(hold) = self.asked.take() {
            Purpose::Transfer { hold: Some(hold) }
        } else if let Some(Upcoming { due, missed }) = self.upcoming.take() {
            for _ in 0..missed {
                self.bulk.add(context, &entry(Err(Fault::Overflow), 0, 0));
            }
            Purpose::Measurement { due: Some(due) }
        } else {
            return Ok(());
        };
        let preface = self.chip.preface(&purpose);
        let asking = self.asking.insert(Asking { purpose, latched: None });
        let begun = match (preface, &asking.purpose) {
            (Some(preface), _) => self.say(context, preface),
            (None, Purpose::Measurement { .. }) => self.say(context, self.chip.message()),
            (None, Purpose::Transfer { .. }) => self.transfer.send_to(context, self.spi),
        };
        if begun.is_err() {
            self.over(context);
        }
        begun
    }

    fn say(&mut self, context: &mut Context, message: &[u8]) -> Result<(), Shutdown> {
        // Nothing else is under way, so the job is here.
        if let Some(measurement) = self.measurement.here() {
            measurement.load(message);
        }
        self.measurement.send_to(context, self.spi)
    }

    /// Processes the end of a job. Returns true if the request is finished.
    fn take_in(&mut self, context: &mut Context, began: Clock, ended: Clock) -> Result<bool, Shutdown> {
        let Some(Asking { purpose, latched }) = &mut self.asking else { return Ok(true) };
        let too_slow = ended.since(began) > i64::from(TRANSFER_MAX.0);
        let has_preface = self.chip.preface(purpose).is_some();
        if has_preface && latched.is_none() {
            *latched = Some(ended);
            match purpose {
                // The TLE5012B latches at an edge, so the length of its preface does not matter.
                Purpose::Measurement { due } if self.chip == Chip::As5047d && too_slow => {
                    let due = *due;
                    self.measured(context, due, Err(Fault::SpiTime), ended);
                    return Ok(true);
                }
                Purpose::Measurement { .. } => self.say(context, self.chip.message())?,
                Purpose::Transfer { .. } => self.transfer.send_to(context, self.spi)?,
            }
            return Ok(false);
        }
        let too_slow = too_slow && !has_preface;
        let latched = latched.unwrap_or(if self.chip.latches_at_end(purpose) { ended } else { began });
        match (purpose, self.measurement.here(), self.transfer.here()) {
            (Purpose::Transfer { .. }, _, Some(transfer)) => {
                let response = if too_slow { &[] } else { transfer.bytes() };
                context.send(TransferResponse { oid: context.oid(), clock: latched, response });
            }
            (Purpose::Measurement { due }, Some(measurement), _) => {
                let due = *due;
                let mut reply = [0; MESSAGE_MAX];
                reply.iter_mut().zip(measurement.bytes()).for_each(|(to, from)| *to = *from);
                let measured = if too_slow { Err(Fault::SpiTime) } else { self.chip.decode(&reply) };
                self.measured(context, due, measured, latched);
            }
            _ => {}
        }
        Ok(true)
    }

    fn measured(&mut self, context: &mut Context, due: Option<Clock>, measured: Result<Angle, Fault>, latched: Clock) {
        if let Some(due) = due {
            let late = latched.wire().wrapping_sub(due.wire());
            self.bulk.add(context, &entry(measured, late, self.time_shift));
        }
    }

    /// Ends the request under way, and releases the commands that wait for it.
    fn over(&mut self, context: &mut Context) {
        if let Some(Asking { purpose: Purpose::Transfer { hold: Some(hold) }, .. }) = self.asking.take() {
            context.release(hold);
        }
    }

    /// Ends the measurements.
    fn end(&mut self) {
        if let Some(Asking { purpose: Purpose::Measurement { due }, .. }) = &mut self.asking {
            *due = None;
        }
        self.upcoming = None;
    }

    fn query(&mut self, context: &mut Context, at: Clock, rest_ticks: Ticks, time_shift: u8) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.end();
        if rest_ticks == Ticks(0) {
            if context.speaks::<OwnEnd>() {
                self.bulk.flush(context);
                let now = context.now();
                self.bulk.send_status(context, (now, now), 0);
            }
            return Ok(());
        }
        self.rest_ticks = rest_ticks;
        self.time_shift = time_shift;
        self.bulk.reset();
        context.schedule(TIMER, at)
    }

    fn ask(&mut self, context: &mut Context, data: &[u8]) -> Result<(), Shutdown> {
        // Commands wait for each other, so the job is here. One from before a stop may still be under way.
        let Some(transfer) = self.transfer.here() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "spi_angle_transfer came during another one"));
        };
        transfer.load(data);
        // A timer may have begun the request under way. The transfer behind it then does not hold commands by itself.
        self.asked = Some(context.hold());
        self.go_on(context)
    }
}

impl Object for SpiAngle {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let missed = self.upcoming.take().map_or(0, |upcoming| upcoming.missed.saturating_add(1));
        self.upcoming = Some(Upcoming { due: at, missed });
        self.go_on(context)?;
        Ok(Next::At(at + self.rest_ticks))
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let slot = if number == TRANSFER { &mut self.transfer } else { &mut self.measurement };
        let Some(Back { result, began, ended, .. }) = slot.back(finished) else { return Ok(()) };
        let is_over = match result {
            Ok(()) => self.take_in(context, began, ended),
            Err(error) => context.device_failed(KIND, spi_shutdown(error.clone())).map(|()| true),
        };
        if !matches!(is_over, Ok(false)) {
            self.over(context);
        }
        is_over?;
        self.go_on(context)
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.end();
        // A stopped MCU is not held.
        let under_way = match &mut self.asking {
            Some(Asking { purpose: Purpose::Transfer { hold }, .. }) => hold.take(),
            _ => None,
        };
        for hold in self.asked.take().into_iter().chain(under_way) {
            context.release(hold);
        }
    }
}

const CONFIG_SPI_ANGLE: Command = command!(
    "config_spi_angle oid=%c spi_oid=%c spi_angle_type=%c",
    |context, oid: Oid, spi_oid: Oid, spi_angle_type: u8| {
        let chip = Chip::of(spi_angle_type)?;
        context.vacant(oid)?;
        if !context.with::<Spi, _>(spi_oid, |spi, _| Ok(spi.has_chip_select()))? {
            let cause = "its SPI device has no chip select line of its own";
            return Err(Shutdown::because(NEEDS_CS, cause).remedy("set cs_pin to a GPIO line, not to None"));
        }
        let sensor = SpiAngle {
            chip,
            spi: spi_oid,
            bulk: SensorBulk::with_own(context, &OWN_WORDS),
            rest_ticks: Ticks(0),
            time_shift: 0,
            asking: None,
            upcoming: None,
            asked: None,
            measurement: Transfer::slot(MEASUREMENT),
            transfer: Transfer::slot(TRANSFER),
        };
        context.assign(oid, sensor)
    }
)
.of(KNOWN);

const QUERY_SPI_ANGLE: Command = command!(
    "query_spi_angle oid=%c clock=%u rest_ticks=%u time_shift=%c",
    SpiAngle,
    |sensor, context, clock: WireClock, rest_ticks: Ticks, time_shift: u8| {
        let at = context.instant(clock);
        sensor.query(context, at, rest_ticks, time_shift)
    }
)
.of(KNOWN);

const SPI_ANGLE_TRANSFER: Command =
    command!("spi_angle_transfer oid=%c data=%*s", SpiAngle, |sensor, context, data: &[u8]| sensor.ask(context, data))
        .of(KNOWN);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn reply(bytes: &[u8]) -> [u8; MESSAGE_MAX] {
        let mut reply = [0; MESSAGE_MAX];
        reply[..bytes.len()].copy_from_slice(bytes);
        reply
    }

    fn angle(angle: u16) -> Result<Angle, Fault> {
        Ok(Angle { angle, frame: None })
    }

    #[test]
    fn check_sums_are_those_of_the_data_sheets() {
        // The catalog's check values of CRC-8/SAE-J1850 and CRC-8/SMBUS.
        assert_eq!(!crc8(0x1d, 0xff, b"123456789"), 0x4b);
        assert_eq!(crc8(0x07, 0, b"123456789"), 0xf4);
    }

    #[test]
    fn angles_and_faults_of_each_chip() {
        for (chip, bytes, expected) in [
            // 15 bits after a zero.
            (Chip::A1333, &[0x00, 0x00][..], angle(0)),
            (Chip::A1333, &[0x7f, 0xff], angle(0xfffe)),
            (Chip::A1333, &[0x40, 0x01], angle(0x8002)),
            (Chip::A1333, &[0xff, 0xff], Err(Fault::Crc)),
            // Even parity, error flag, 14 bits.
            (Chip::As5047d, &[0x00, 0x00], angle(0)),
            (Chip::As5047d, &[0xa0, 0x00], angle(0x8000)),
            (Chip::As5047d, &[0x3f, 0xff], angle(0xfffc)),
            (Chip::As5047d, &[0x20, 0x00], Err(Fault::Crc)),
            (Chip::As5047d, &[0xc0, 0x00], Err(Fault::NoAngle)),
            (Chip::As5047d, &[0xff, 0xff], Err(Fault::NoAngle)),
            // 14 bits, no magnet, parity.
            (Chip::Mt6816, &[0, 0x00, 0x00], angle(0)),
            (Chip::Mt6816, &[0, 0x80, 0x01], angle(0x8000)),
            (Chip::Mt6816, &[0, 0xff, 0xfc], angle(0xfffc)),
            (Chip::Mt6816, &[0, 0x80, 0x00], Err(Fault::Crc)),
            (Chip::Mt6816, &[0, 0x80, 0x02], Err(Fault::NoAngle)),
            // 15 bits, status, checksum.
            (Chip::Mt6826s, &[0, 0, 0x00, 0x00, 0x00, 0x00], angle(0)),
            (Chip::Mt6826s, &[0, 0, 0x12, 0x34, 0x00, crc8(7, 0, &[0x12, 0x34, 0])], angle(0x1234)),
            (Chip::Mt6826s, &[0, 0, 0x12, 0x34, 0x02, crc8(7, 0, &[0x12, 0x34, 2])], Err(Fault::NoAngle)),
            (Chip::Mt6826s, &[0, 0, 0x12, 0x34, 0x00, 0x00], Err(Fault::Crc)),
            (Chip::Mt6826s, &[0xff; 6], Err(Fault::Crc)),
        ] {
            assert_eq!(chip.decode(&reply(bytes)), expected, "{chip:?} {bytes:02x?}");
        }
    }

    #[test]
    fn the_tle5012b_tells_its_frame() {
        let tle = |aval: u16, frame: u8, status: u8| {
            let [high, low] = aval.to_be_bytes();
            let mut reply = [0x84, 0x23, high, low, 0x12, 0x34, frame << 1, 0x56, status, 0];
            let crc = crc8(0x1d, 0xff, &reply[..8]);
            reply[9] = !crc;
            reply
        };
        let decode = |reply: [u8; 10]| Chip::Tle5012b.decode(&reply);
        assert_eq!(decode(tle(0x8000 | 0x1234, 63, 0xff)), Ok(Angle { angle: 0x2468, frame: Some(63) }));
        assert_eq!(decode(tle(0xffff, 0, 0x10)), Ok(Angle { angle: 0xfffe, frame: Some(0) }));
        assert_eq!(decode(tle(0x1234, 5, 0xff)), Err(Fault::Duplicate));
        assert_eq!(decode(tle(0x8000, 5, 0xef)), Err(Fault::NoAngle));
        for bit in 0..48 {
            let mut reply = tle(0x9234, 5, 0xff);
            reply[2 + bit / 8] ^= 1 << (bit % 8);
            assert_eq!(decode(reply), Err(Fault::Crc), "bit {bit}");
        }
        assert_eq!(decode([0xff; 10]), Err(Fault::Crc));
        assert_eq!(decode([0x00; 10]), Err(Fault::Crc));
    }

    #[test]
    fn an_entry_has_the_time_in_steps_of_the_shift() {
        for (late, shift, time) in [
            (0, 0, Some(0)),
            (254, 0, Some(254)),
            (255, 0, None),
            (511, 9, Some(1)),
            (255, 9, Some(0)),
            (256, 9, Some(1)),
            (254 * 512 + 255, 9, Some(254)),
            (254 * 512 + 256, 9, None),
            (u32::MAX, 24, None),
            (u32::MAX, 25, Some(128)),
            (u32::MAX, 255, Some(0)),
        ] {
            let expected = time.map_or([0xff, 1, 0], |time| [time, 0x34, 0x12]);
            assert_eq!(entry(angle(0x1234), late, shift), expected, "{late} {shift}");
        }
        let framed = Ok(Angle { angle: 0x1234, frame: Some(63) });
        assert_eq!(entry(framed, 68_250, 9), [63, 0x34, 0x12]);
        assert_eq!(entry(framed, 68_251, 9), [0xff, 1, 0]);
        assert_eq!(entry(Err(Fault::NoAngle), 0, 9), [0xff, 5, 0]);
    }

    proptest! {
        /// klippy must never read an angle from an entry if the sensor reported none.
        #[test]
        fn a_fault_is_never_an_angle(late: u32, shift: u8, bytes: [u8; MESSAGE_MAX], which in 0u8..5) {
            let measured = Chip::of(which).unwrap().decode(&bytes);
            let [time, low, high] = entry(measured, late, shift);
            match measured {
                Ok(Angle { angle, .. }) if time != TIME_ERROR => prop_assert_eq!([low, high], angle.to_le_bytes()),
                _ => prop_assert_eq!((time, high), (TIME_ERROR, 0)),
            }
        }
    }
}
