// SPDX-License-Identifier: GPL-3.0-or-later
//! Thermocouple and RTD converters on SPI: MAX31855, MAX31856, MAX31865, MAX6675.
//!
//! The MCU passes the chip's word on, and klippy converts it to degrees.

use crate::board::{Board, BusDevice, BusError, Range};
use crate::mcu::{
    Back, Command, Context, Enumeration, Feature, Finished, Job, JobSlot, Next, Object, Oid, Response, Timer,
    WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};
use crate::trouble::Trouble;

use super::ds18b20::CONFIG_DS18B20_OF_KALICO;
use super::spi::{Spi, spi_shutdown};

pub(super) const FEATURE: Feature = Feature {
    serves: "MAX31855, MAX31856, MAX31865 and MAX6675 sensors",

    commands: &[CONFIG_THERMOCOUPLE, QUERY_THERMOCOUPLE_AT_ONCE, QUERY_THERMOCOUPLE],
    responses: &[Reading::FORM],
    enumerations: &[Enumeration::new("thermocouple_type", types)],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `thermocouple_type` outside the enumeration.
    INVALID_TYPE = "Invalid thermocouple chip type";
    /// Faults, or values out of range, `max_invalid_count` times in a row.
    READER_FAULT = "Thermocouple reader fault";
}

response! {
    /// The value that the chip read `rest_ticks` before `next_clock`, and its fault bits.
    "thermocouple_result oid=%c next_clock=%u value=%u fault=%c"
    pub(super) struct Reading { oid: Oid, next_clock: Clock, value: u32, fault: u8 }
}

const TIMER: Timer = Timer::sampling(0);

/// A chip. Its number on the wire is its index in [`Chip::ALL`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Chip {
    Max31855,
    Max31856,
    Max31865,
    Max6675,
}

/// Data sheet 19-7534, register map.
#[derive(Clone, Copy)]
enum Max31856 {
    /// The first of three: LTCBH, LTCBM, LTCBL.
    LinearizedTemperature = 0x0c,
    FaultStatus = 0x0f,
}

/// Data sheet 19-6478, register map.
#[derive(Clone, Copy)]
enum Max31865 {
    /// The first of two, the high byte.
    Rtd = 0x01,
    FaultStatus = 0x07,
}

impl Chip {
    const ALL: [(Chip, &'static str); 4] = [
        (Chip::Max31855, "MAX31855"),
        (Chip::Max31856, "MAX31856"),
        (Chip::Max31865, "MAX31865"),
        (Chip::Max6675, "MAX6675"),
    ];

    fn name(self) -> &'static str {
        Chip::ALL.iter().find(|(chip, _)| *chip == self).map_or("", |(_, name)| name)
    }

    /// The message for a word: the word's register, and room for the word.
    fn word_message(self) -> &'static [u8] {
        match self {
            // These chips have no registers: each transfer is the one word.
            Chip::Max31855 => &[0; 4],
            Chip::Max6675 => &[0; 2],
            Chip::Max31856 => &[Max31856::LinearizedTemperature as u8, 0, 0, 0],
            Chip::Max31865 => &[Max31865::Rtd as u8, 0, 0],
        }
    }

    /// The register with the faults. `None`: they are in the word.
    fn fault_register(self) -> Option<u8> {
        match self {
            Chip::Max31855 | Chip::Max6675 => None,
            Chip::Max31856 => Some(Max31856::FaultStatus as u8),
            Chip::Max31865 => Some(Max31865::FaultStatus as u8),
        }
    }

    /// Returns the word of an answer to [`word_message`](Self::word_message), and the fault bits. `register` is the
    /// value of the fault register.
    fn decode(self, answer: &[u8], register: u8) -> (u32, u8) {
        // The byte that came back while the register was sent means nothing.
        let word = answer.iter().skip(usize::from(self.fault_register().is_some()));
        let value = word.fold(0, |value, byte| value << 8 | u32::from(*byte));
        let low = value as u8;
        let fault = match self {
            // Short to VCC, short to GND, open (data sheet 19-5793, table 2: D2 to D0).
            Chip::Max31855 => low & 0x07,
            Chip::Max31856 => register,
            // Bits 1 and 0 of the register are not used. D0 of the word is "any fault".
            Chip::Max31865 => register & !0x03 | low & 0x01,
            // Open (D2), and the device ID (D1), which reads 0 (data sheet 19-2235, table 2).
            Chip::Max6675 => low & 0x06,
        };
        (value, fault)
    }
}

fn types(_board: &dyn Board) -> Vec<Range> {
    Chip::ALL.iter().zip(0..).map(|((_, name), first)| Range { name: (*name).into(), first, count: 1 }).collect()
}

/// One reading of the chip.
struct Read(Chip);

impl Job for Read {
    type Device = dyn BusDevice;
    /// The word, and the fault bits.
    type Out = (u32, u8);
    type Failure = BusError;

    fn run(&mut self, chip: &mut Self::Device) -> Result<(u32, u8), BusError> {
        let template = self.0.word_message();
        let mut buffer = [0; 4];
        let word = &mut buffer[..template.len()];
        word.copy_from_slice(template);
        chip.exchange(word)?;
        let mut faults = [0; 2];
        if let Some(register) = self.0.fault_register() {
            faults[0] = register;
            chip.exchange(&mut faults)?;
        }
        Ok(self.0.decode(word, faults[1]))
    }
}

struct Thermocouple {
    spi: Oid,
    chip: Chip,
    read: JobSlot<Read>,
    rest_ticks: Ticks,
    min_value: u32,
    max_value: u32,
    max_invalid_count: u8,
    invalid_count: u8,
    /// When the next read is due.
    next_clock: Clock,
}

impl Thermocouple {
    fn query(
        &mut self,
        context: &mut Context,
        clock: WireClock,
        rest_ticks: Ticks,
        (min_value, max_value): (u32, u32),
        max_invalid_count: u8,
    ) -> Result<(), Shutdown> {
        let at = context.instant(clock);
        context.cancel(TIMER);
        self.read.drop_pending();
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        self.rest_ticks = rest_ticks;
        (self.min_value, self.max_value) = (min_value, max_value);
        self.max_invalid_count = max_invalid_count;
        self.invalid_count = 0;
        context.schedule(TIMER, at)
    }

    fn check(&mut self, context: &Context, value: u32, fault: u8) -> Result<(), Shutdown> {
        // This is Kalico's way to say that only the host checks the values.
        if self.max_invalid_count == 0 && context.takes(&CONFIG_DS18B20_OF_KALICO) {
            return Ok(());
        }
        if fault == 0 && (self.min_value..=self.max_value).contains(&value) {
            self.invalid_count = 0;
            return Ok(());
        }
        self.invalid_count = self.invalid_count.saturating_add(1);
        if self.invalid_count < self.max_invalid_count {
            return Ok(());
        }
        let times = std::mem::take(&mut self.invalid_count);
        let name = self.chip.name();
        let trouble = match fault {
            0 => Trouble::new(format!(
                "the {name} read 0x{value:x} where 0x{:x} to 0x{:x} is allowed, {times} times in a row: a heater past its limits, or a sensor that is broken or unplugged",
                self.min_value, self.max_value
            )),
            fault => Trouble::new(format!("the {name} reports fault bits 0x{fault:02x}, {times} times in a row"))
                .remedy("check the sensor and its wires (klippy's log names the fault)"),
        };
        context.try_shut_down(Shutdown::because(READER_FAULT, trouble))
    }
}

impl Object for Thermocouple {
    fn kind(&self) -> &'static str {
        "thermocouple"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let next = at + self.rest_ticks;
        // A chip that is still being read misses this one.
        if self.read.is_here() {
            self.next_clock = next;
            self.read.send_to(context, self.spi)?;
        }
        Ok(Next::At(next))
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, is_wanted: true, .. }) = self.read.back(finished) else { return Ok(()) };
        match result {
            Ok((value, fault)) => {
                context.send(Reading { oid: context.oid(), next_clock: self.next_clock, value, fault });
                self.check(context, value, fault)
            }
            Err(error) => context.try_shut_down(spi_shutdown(error.clone())),
        }
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.read.drop_pending();
    }
}

const CONFIG_THERMOCOUPLE: Command = command!(
    "config_thermocouple oid=%c spi_oid=%c thermocouple_type=%c",
    |context, oid: Oid, spi_oid: Oid, thermocouple_type: u8| {
        let Some((chip, _)) = Chip::ALL.get(usize::from(thermocouple_type)).copied() else {
            let what = format_args!("there is no thermocouple_type {thermocouple_type}");
            return Err(Shutdown::by_host(INVALID_TYPE, what));
        };
        context.require::<Spi>(spi_oid)?;
        let object = Thermocouple {
            spi: spi_oid,
            chip,
            read: JobSlot::new(Read(chip)),
            rest_ticks: Ticks(0),
            min_value: 0,
            max_value: 0,
            max_invalid_count: 0,
            invalid_count: 0,
            next_clock: Clock::EPOCH,
        };
        context.assign(oid, object)
    }
);

const QUERY_THERMOCOUPLE: Command = command!(
    "query_thermocouple oid=%c clock=%u rest_ticks=%u min_value=%u max_value=%u max_invalid_count=%c",
    Thermocouple,
    |sensor, context, clock: WireClock, rest_ticks: Ticks, min_value: u32, max_value: u32, max_invalid_count: u8| {
        sensor.query(context, clock, rest_ticks, (min_value, max_value), max_invalid_count)
    }
);

/// The form before September 2022. The first value outside the limits stops the MCU.
const QUERY_THERMOCOUPLE_AT_ONCE: Command = command!(
    "query_thermocouple oid=%c clock=%u rest_ticks=%u min_value=%u max_value=%u",
    Thermocouple,
    |sensor, context, clock: WireClock, rest_ticks: Ticks, min_value: u32, max_value: u32| {
        sensor.query(context, clock, rest_ticks, (min_value, max_value), 1)
    }
)
.of(&[]);

#[cfg(test)]
mod tests {
    use super::*;

    /// Words from the data sheets' tables. For chips with registers, a byte without meaning comes first.
    #[test]
    fn words_and_faults() {
        type Case = (Chip, &'static [u8], u8, (u32, u8));
        let cases: &[Case] = &[
            // +1600 C and a cold junction of +127 C.
            (Chip::Max31855, &[0x64, 0x00, 0x7f, 0x00], 0, (0x6400_7f00, 0)),
            // -250 C, -55 C.
            (Chip::Max31855, &[0xf0, 0x60, 0xc9, 0x00], 0, (0xf060_c900, 0)),
            (Chip::Max31855, &[0x00, 0x01, 0x00, 0x01], 0, (0x0001_0001, 1)),
            (Chip::Max31855, &[0x00, 0x01, 0x00, 0x02], 0, (0x0001_0002, 2)),
            (Chip::Max31855, &[0x00, 0x01, 0x00, 0x04], 0, (0x0001_0004, 4)),
            // Bit 3 is reserved.
            (Chip::Max31855, &[0x00, 0x00, 0x00, 0x08], 0, (0x0000_0008, 0)),
            // +1600 C.
            (Chip::Max31856, &[0xff, 0x64, 0x00, 0x00], 0, (0x64_0000, 0)),
            (Chip::Max31856, &[0xff, 0xff, 0xff, 0xe0], 0x81, (0xff_ffe0, 0x81)),
            // 100 Ohm of 400.
            (Chip::Max31865, &[0xff, 0x40, 0x00], 0, (0x4000, 0)),
            (Chip::Max31865, &[0xff, 0x40, 0x01], 0x80, (0x4001, 0x81)),
            (Chip::Max31865, &[0xff, 0x40, 0x00], 0x03, (0x4000, 0)),
            (Chip::Max31865, &[0xff, 0x40, 0x02], 0x04, (0x4002, 0x04)),
            // 1023.75 C.
            (Chip::Max6675, &[0x7f, 0xf8], 0, (0x7ff8, 0)),
            (Chip::Max6675, &[0x00, 0x04], 0, (0x0004, 4)),
            (Chip::Max6675, &[0x00, 0x02], 0, (0x0002, 2)),
            (Chip::Max6675, &[0x00, 0x01], 0, (0x0001, 0)),
        ];
        for (chip, answer, register, expected) in cases {
            assert_eq!(chip.decode(answer, *register), *expected, "{chip:?} {answer:02x?}");
        }
    }
}
