// SPDX-License-Identifier: GPL-3.0-or-later
//! Magnetic angle sensors on a motor's shaft, after their data sheets: A1333 (Allegro, "SPI Interface"),
//! AS5047D (ams, v1-10, "SPI Interface"), TLE5012B (Infineon, V2.1 and its user's manual, "SSC Data
//! Transfer"), MT6816 (MagnTek, rev. 1.3, "SPI Interface"), MT6826S (MagnTek, rev. 1.1, "SPI Interface").
//!
//! The magnet turns with the axis' motor. It is not quite in the middle, which makes an error once in a
//! turn, and stands at any angle to the motor.
//!
//! Simulated: the frames with their parities and check sums, the registers of the angle and of what a
//! host sets up, errors of frames where the chip has them, the TLE5012B's own clock and what it latches,
//! the MT6826S' calibration as far as it tells of it. Not simulated: noise, the sensors' own delays and
//! filters, faults of the magnet, other outputs than SPI.

#![forbid(unsafe_code)]

use std::f64::consts::TAU;
use std::sync::Arc;

use serde::Deserialize;

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, SimError, check};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::physics::Axis;
use crate::engine::spi::SpiChip;
use crate::klippy::layout::{FULL_STEPS, Layout};
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// Which of the sensors it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AngleChip {
    /// Allegro's, with 15 bits.
    A1333,
    /// Of ams, with 14 bits.
    As5047d,
    /// Infineon's, with 15 bits and a clock of its own.
    Tle5012b,
    /// MagnTek's, with 14 bits.
    Mt6816,
    /// MagnTek's, with 15 bits and a calibration of its own.
    Mt6826s,
}

impl AngleChip {
    fn name(self) -> &'static str {
        match self {
            AngleChip::A1333 => "a1333",
            AngleChip::As5047d => "as5047d",
            AngleChip::Tle5012b => "tle5012b",
            AngleChip::Mt6816 => "mt6816",
            AngleChip::Mt6826s => "mt6826s",
        }
    }
}

/// The sensor's description.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AngleConfig {
    /// Which one it is.
    pub chip: AngleChip,
    /// Its SPI bus.
    pub bus: String,
    /// Low selects it. klippy wants one for these sensors.
    pub select_pin: PinName,
    /// The axis on whose motor it sits.
    pub axis: String,
    /// The angle that it measures at 0 mm.
    #[serde(default)]
    pub offset_degrees: f64,
    /// By how much the angle is wrong at most, as the magnet is not in the middle.
    #[serde(default)]
    pub eccentricity_degrees: f64,
}

impl Part for AngleConfig {
    fn name(&self) -> String {
        format!("{} {}", self.chip.name(), self.axis)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: Some(&self.select_pin) })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), SimError> {
        check(whose, "offset_degrees", self.offset_degrees, Bound::Any)?;
        check(whose, "eccentricity_degrees", self.eccentricity_degrees, Bound::NotNegative)?;
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), SimError> {
        let config = workshop.printer.axis(&self.axis);
        let Some((axis, config)) = workshop.axis(&self.axis).zip(config) else { return Ok(()) };
        let time = workshop.time.clone();
        let shaft = Shaft {
            axis,
            steps_per_turn: FULL_STEPS * f64::from(config.microsteps),
            offset: self.offset_degrees / 360.0,
            eccentricity: self.eccentricity_degrees / 360.0,
        };
        match self.chip {
            AngleChip::A1333 => workshop.solder_spi(self, A1333 { shaft, frame: Frame::default(), address: 0 }),
            AngleChip::As5047d => workshop.solder_spi(self, As5047d::new(shaft)),
            AngleChip::Tle5012b => workshop.solder_spi(self, Tle5012b::new(shaft, time)),
            AngleChip::Mt6816 => workshop.solder_spi(self, Mt6816 { shaft, latched: 0, place: None, address: 0 }),
            AngleChip::Mt6826s => workshop.solder_spi(self, Mt6826s::new(shaft)),
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("angle {}", self.axis));
        cfg.key("sensor_type", self.chip.name());
        cfg.comment("Take it out for Kalico, whose Linux firmware has no angle sensors.");
        cfg.spi(&self.bus, Some(&self.select_pin));
        cfg.comment("To measure with it, and for ANGLE_CALIBRATE; needs a driver on this stepper, and numpy:");
        cfg.offer(|cfg| cfg.key("stepper", layout.stepper(&self.axis)));
    }
}

/// What a sensor measures.
struct Shaft {
    axis: Arc<Axis>,
    steps_per_turn: f64,
    /// In turns.
    offset: f64,
    eccentricity: f64,
}

impl Shaft {
    /// The turns of the motor.
    fn turns(&self) -> f64 {
        self.axis.position_steps() as f64 / self.steps_per_turn
    }

    /// The angle that the sensor finds: of so many bits.
    fn angle(&self, bits: u32) -> u16 {
        let angle = (self.turns() + self.offset).rem_euclid(1.0);
        let measured = angle + self.eccentricity * (TAU * angle).sin();
        let steps = f64::from(1u32 << bits);
        // One turn is none.
        (measured.rem_euclid(1.0) * steps) as u16 & ((1u32 << bits) - 1) as u16
    }
}

/// 1 where that makes the number of ones even.
fn even_parity(word: u16) -> u16 {
    (word.count_ones() & 1) as u16
}

/// A cyclic redundancy check of 8 bits.
fn crc8(polynomial: u8, start: u8, bytes: &[u8]) -> u8 {
    bytes.iter().fold(start, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 != 0 { (crc << 1) ^ polynomial } else { crc << 1 })
    })
}

/// A frame of 16 bits both ways.
#[derive(Default)]
struct Frame {
    out: u16,
    into: u16,
    bytes: usize,
}

impl Frame {
    fn begin(&mut self, out: u16) {
        *self = Frame { out, into: 0, bytes: 0 };
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let [high, low] = self.out.to_be_bytes();
        self.out = u16::from(low) << 8;
        self.into = self.into << 8 | u16::from(byte);
        self.bytes += 1;
        high
    }

    fn whole(&self) -> Option<u16> {
        (self.bytes == 2).then_some(self.into)
    }
}

/// A frame has a zero, whether to write, six bits of address and eight of data. What is read comes with the
/// next frame, as it is when that begins.
struct A1333 {
    shaft: Shaft,
    frame: Frame,
    /// What is read.
    address: u8,
}

impl A1333 {
    const ANG: u8 = 0x20;
    const STA: u8 = 0x22;
    const ANG15: u8 = 0x32;

    fn register(&self) -> u16 {
        match self.address {
            A1333::ANG => {
                // Odd parity in bit 12.
                let angle = self.shaft.angle(12);
                angle | (even_parity(angle) ^ 1) << 12
            }
            // Its identifier, and nothing to report.
            A1333::STA => 0x8000,
            A1333::ANG15 => self.shaft.angle(15),
            _ => 0,
        }
    }
}

impl SpiChip for A1333 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.frame.begin(self.register());
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.frame.exchange(byte)
    }

    fn deselect(&mut self) {
        // To write needs a code that no host here has.
        if let Some(frame) = self.frame.whole().filter(|frame| frame & 0x4000 == 0) {
            self.address = (frame >> 8 & 0x3f) as u8;
        }
    }
}

/// A frame has its even parity, whether to read, and 14 bits of address; an answer its parity, whether an error
/// is to be told, and 14 bits of data. What is read is latched as the frame ends, and comes with the next.
struct As5047d {
    shaft: Shaft,
    frame: Frame,
    answer: u16,
    /// Where the next frame's data goes.
    writes: Option<u16>,
    errors: u16,
    /// SETTINGS1 and SETTINGS2.
    settings: [u16; 2],
}

impl As5047d {
    const READ: u16 = 1 << 14;
    const FRAMING: u16 = 1;
    const INVALID: u16 = 1 << 1;
    const PARITY: u16 = 1 << 2;

    fn new(shaft: Shaft) -> As5047d {
        As5047d { shaft, frame: Frame::default(), answer: 0, writes: None, errors: 0, settings: [0x01, 0] }
    }

    /// What is at an address; none if there is no such register.
    fn register(&mut self, address: u16) -> Option<u16> {
        match address {
            0x0000 | 0x0003 | 0x0016 | 0x0017 => Some(0),
            0x0001 => Some(std::mem::take(&mut self.errors)),
            0x0018 | 0x0019 => Some(self.settings[usize::from(address & 1)]),
            // DIAAGC: the loop of the offset is finished, gain in the middle.
            0x3ffc => Some(0x0180),
            // MAG: of a magnet that fits.
            0x3ffd => Some(0x1200),
            // ANGLEUNC and ANGLECOM, which differ while the motor turns fast.
            0x3ffe | 0x3fff => Some(self.shaft.angle(14)),
            _ => None,
        }
    }

    fn take_in(&mut self, frame: u16) -> u16 {
        if even_parity(frame) != 0 {
            self.errors |= As5047d::PARITY;
            return 0;
        }
        let address = frame & 0x3fff;
        if let Some(setting) = self.writes.take() {
            self.settings[usize::from(setting & 1)] = frame & 0xff;
            return frame & 0xff;
        }
        let value = self.register(address);
        if frame & As5047d::READ == 0 && matches!(address, 0x0018 | 0x0019) {
            self.writes = Some(address);
        }
        value.unwrap_or_else(|| {
            self.errors |= As5047d::INVALID;
            0
        })
    }
}

impl SpiChip for As5047d {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 1
    }

    fn select(&mut self, _rate_hz: u32) {
        self.frame.begin(self.answer);
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.frame.exchange(byte)
    }

    fn deselect(&mut self) {
        // Reading the error flags clears them: the answer tells of those before.
        let had_errors = self.errors != 0;
        let data = match self.frame.whole() {
            Some(frame) => self.take_in(frame),
            None => {
                self.errors |= As5047d::FRAMING;
                0
            }
        };
        let answer = data | u16::from(had_errors || self.errors != 0) << 14;
        self.answer = answer | even_parity(answer) << 15;
    }
}

/// One wire both ways: a command word (read, lock, whether to read what was latched, address, count), so many
/// data words, and the chip's safety word with a check sum. An empty selection latches angle, revolutions and
/// clock.
struct Tle5012b {
    shaft: Shaft,
    time: Arc<dyn TimeSource>,
    registers: [u16; 0x40],
    /// AVAL to FSYNC as they were latched.
    latched: [u16; 4],
    /// The frame whose angle was read.
    read_frame: Option<u64>,
    /// Since power-up nobody has read STAT.
    was_reset: bool,
    /// The bytes of the command and the data.
    said: Vec<u8>,
    bytes: usize,
}

impl Tle5012b {
    const STAT: usize = 0x00;
    const AVAL: usize = 0x02;
    const FSYNC: usize = 0x05;
    const MOD1: usize = 0x06;
    /// Registers that need the lock code to be written.
    const LOCKED: std::ops::RangeInclusive<usize> = 0x05..=0x11;
    const LOCK: u16 = 0b1010;
    /// Of its timer.
    const TIMER_HZ: u64 = 750_000;
    /// TEMPER at 25 degrees: 2.776 for each degree from -152 at 0 on.
    const TEMPER: i16 = -83;

    fn new(shaft: Shaft, time: Arc<dyn TimeSource>) -> Tle5012b {
        let mut registers = [0; 0x40];
        // MOD1 with updates each 42.7 us, MOD2 with the range of 360 degrees, MOD4.
        registers[Tle5012b::MOD1] = 0x4001;
        registers[0x08] = 0x0801;
        registers[0x0e] = 0x0080;
        Tle5012b {
            shaft,
            time,
            registers,
            latched: [0; 4],
            read_frame: None,
            was_reset: true,
            said: Vec::new(),
            bytes: 0,
        }
    }

    /// Ticks of its timer since power-up, and those from one measurement to the next.
    fn timer(&self) -> (u64, u64) {
        let ticks = self.time.now().since(Clock::EPOCH).max(0) as u64;
        let timer = u128::from(ticks) * u128::from(Tle5012b::TIMER_HZ) / u128::from(CLOCK_FREQ);
        (timer as u64, 16 << (self.registers[Tle5012b::MOD1] >> 14))
    }

    /// AVAL to FSYNC.
    fn measured(&self) -> [u16; 4] {
        let (timer, period) = self.timer();
        let frame = timer / period;
        let is_new = u16::from(self.read_frame != Some(frame)) << 15;
        let revolutions = self.shaft.turns().floor() as i64 as u16 & 0x1ff;
        let counter = (frame & 0x3f) as u16;
        let within = (timer % period) as u16 & 0x7f;
        [
            is_new | self.shaft.angle(15),
            is_new,
            is_new | counter << 9 | revolutions,
            within << 9 | Tle5012b::TEMPER as u16 & 0x1ff,
        ]
    }

    fn command(&self) -> Option<u16> {
        Some(u16::from_be_bytes(self.said.get(..2)?.try_into().ok()?))
    }

    /// The word of a read at this place behind the command.
    fn word(&mut self, command: u16, place: usize) -> u16 {
        let address = (usize::from(command >> 4 & 0x3f) + place) & 0x3f;
        match address {
            Tle5012b::STAT => {
                // Bit 0 tells of a reset, bit 15 that this is new.
                0x8000 | u16::from(std::mem::take(&mut self.was_reset))
            }
            Tle5012b::AVAL..=Tle5012b::FSYNC => {
                let measured = if command & 0x0400 != 0 { self.latched } else { self.measured() };
                if address == Tle5012b::AVAL {
                    let (timer, period) = self.timer();
                    self.read_frame = Some(timer / period);
                }
                measured[address - Tle5012b::AVAL]
            }
            address => self.registers[address],
        }
    }

    fn safety(&self) -> [u8; 2] {
        // All is well but for a reset; and which sensor answers: the first.
        let status = if self.was_reset { 0x7e } else { 0xfe };
        [status, !crc8(0x1d, 0xff, &self.said)]
    }
}

impl SpiChip for Tle5012b {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 1
    }

    fn select(&mut self, _rate_hz: u32) {
        self.said.clear();
        self.bytes = 0;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let place = self.bytes;
        self.bytes += 1;
        let Some(command) = self.command() else {
            self.said.push(byte);
            return byte;
        };
        let data = 2 + 2 * usize::from(command & 0xf);
        if place < data && command & 0x8000 == 0 {
            self.said.push(byte);
            return byte;
        }
        if place >= data {
            return self.safety()[(place - data) & 1];
        }
        if place.is_multiple_of(2) {
            let word = self.word(command, place / 2 - 1);
            self.said.extend(word.to_be_bytes());
        }
        self.said[place]
    }

    fn deselect(&mut self) {
        if self.bytes == 0 {
            self.latched = self.measured();
            return;
        }
        let Some(command) = self.command().filter(|command| command & 0x8000 == 0) else { return };
        let address = usize::from(command >> 4 & 0x3f);
        let locked = Tle5012b::LOCKED.contains(&address) && command >> 11 & 0xf != Tle5012b::LOCK;
        if let (Some(&[high, low]), false) = (self.said.get(2..4).and_then(|word| word.first_chunk()), locked) {
            self.registers[address] = u16::from_be_bytes([high, low]);
        }
    }
}

/// A byte with the address and whether to read, then as many registers as the host clocks out. The angle is
/// latched as the chip is selected.
struct Mt6816 {
    shaft: Shaft,
    latched: u16,
    /// Of the register that goes out next; none until the address came.
    place: Option<u8>,
    address: u8,
}

impl SpiChip for Mt6816 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.latched = self.shaft.angle(14);
        self.place = None;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let Some(place) = self.place else {
            self.address = byte & 0x7f;
            // What is written programs the chip, which is done in a factory.
            self.place = (byte & 0x80 != 0).then_some(self.address);
            return 0xff;
        };
        self.place = Some(place.wrapping_add(1) & 0x7f);
        let angle = self.latched << 2;
        let [high, low] = (angle | even_parity(angle)).to_be_bytes();
        match place {
            0x03 => high,
            0x04 => low,
            _ => 0,
        }
    }
}

/// Four bits of command and twelve of address, then data: to read as many registers as the host clocks out.
/// The angle is latched as the chip is selected.
struct Mt6826s {
    shaft: Shaft,
    latched: u16,
    head: u16,
    bytes: usize,
    registers: [u8; 0x156],
    /// Where the motor stood as a calibration began.
    calibrates_from: Option<f64>,
}

impl Mt6826s {
    const READ: u16 = 0x3;
    const WRITE: u16 = 0x6;
    const ANGLE: usize = 0x003;
    const CRC: usize = 0x006;
    const AUTOCAL_FREQ: usize = 0x00e;
    const AUTOCAL_STATUS: usize = 0x113;
    const AUTOCAL_KEY: usize = 0x155;
    const AUTOCAL_START: u8 = 0x5e;
    /// Turns that its calibration takes.
    const AUTOCAL_TURNS: f64 = 16.0;

    fn new(shaft: Shaft) -> Mt6826s {
        let mut registers = [0; 0x156];
        // To be calibrated at 100 to 200 turns in a minute.
        registers[Mt6826s::AUTOCAL_FREQ] = 5 << 4;
        Mt6826s { shaft, latched: 0, head: 0, bytes: 0, registers, calibrates_from: None }
    }

    fn register(&self, address: usize) -> u8 {
        let [high, low] = (self.latched << 1).to_be_bytes();
        // The magnet and the supply are well.
        let angle = [high, low, 0];
        match address {
            Mt6826s::ANGLE..Mt6826s::CRC => angle[address - Mt6826s::ANGLE],
            Mt6826s::CRC => crc8(0x07, 0, &angle),
            Mt6826s::AUTOCAL_STATUS => match self.calibrates_from {
                None => 0,
                Some(from) if (self.shaft.turns() - from).abs() < Mt6826s::AUTOCAL_TURNS => 1 << 6,
                Some(_) => 3 << 6,
            },
            _ => self.registers.get(address).copied().unwrap_or(0),
        }
    }
}

impl SpiChip for Mt6826s {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 3
    }

    fn select(&mut self, _rate_hz: u32) {
        self.latched = self.shaft.angle(15);
        (self.head, self.bytes) = (0, 0);
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let place = self.bytes;
        self.bytes += 1;
        if place < 2 {
            self.head = self.head << 8 | u16::from(byte);
            return 0xff;
        }
        let address = usize::from(self.head & 0xfff) + place - 2;
        match self.head >> 12 {
            Mt6826s::READ => return self.register(address),
            Mt6826s::WRITE if place == 2 => {
                if let Some(register) = self.registers.get_mut(address) {
                    *register = byte;
                }
                if address == Mt6826s::AUTOCAL_KEY && byte == Mt6826s::AUTOCAL_START {
                    self.calibrates_from = Some(self.shaft.turns());
                }
            }
            _ => {}
        }
        0xff
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::{Ticks, VirtualClock};

    /// A shaft at this many 3200th of a turn: 60 mm are one turn and a half.
    fn shaft(steps: i64) -> Shaft {
        let mut config = DefaultPrinter::read();
        config.axes[0].start_mm = 60.0 + steps as f64 / 80.0;
        let axis = Arc::new(Axis::new(&config.axes[0]));
        Shaft { axis, steps_per_turn: 3200.0, offset: 0.0, eccentricity: 0.0 }
    }

    fn transfer(chip: &mut dyn SpiChip, bytes: &[u8]) -> Vec<u8> {
        chip.select(1_000_000);
        let answer = bytes.iter().map(|byte| chip.exchange(*byte)).collect();
        chip.deselect();
        answer
    }

    #[test]
    fn a_magnet_that_is_not_in_the_middle_errs_once_in_a_turn() {
        let shaft = |steps| Shaft { offset: 0.25, eccentricity: 0.01, ..shaft(steps) };
        // 1.5 turns and the offset are 0.75 of a turn, where the sine is -1.
        assert_eq!(shaft(0).angle(14), (0.74f64 * 16384.0) as u16);
        assert_eq!(shaft(-800).angle(14), 8192, "and 0 at half a turn");
        assert_eq!(shaft(-1600).angle(14), (0.26f64 * 16384.0) as u16);
    }

    #[test]
    fn an_a1333_tells_the_angle_of_the_next_frame() {
        let mut chip = A1333 { shaft: shaft(1), frame: Frame::default(), address: 0 };
        assert_eq!(transfer(&mut chip, &[0x32, 0]), [0, 0]);
        // Half a turn and 10.24 of 32768.
        assert_eq!(transfer(&mut chip, &[0x20, 0]), (0x4000u16 + 10).to_be_bytes());
        assert_eq!(transfer(&mut chip, &[0x00, 0]), 0x1801u16.to_be_bytes(), "odd parity");
        assert!(!chip.knows_mode(0));
    }

    #[test]
    fn an_as5047d_checks_parities_and_tells_errors_until_they_are_read() {
        let mut chip = As5047d::new(shaft(2));
        let mut ask = |frame: u16| {
            let answer = transfer(&mut chip, &frame.to_be_bytes());
            u16::from_be_bytes(answer.try_into().unwrap())
        };
        ask(0xffff);
        // Half a turn and 10.24 of 16384: three ones and the parity.
        assert_eq!(ask(0x7ffe), 0xa00a);
        assert_eq!(ask(0x7fff), 0xa00a, "the one of the frame before");
        // That had a wrong parity.
        assert_eq!(ask(0x4001), 0x4000 | 0x8000);
        assert_eq!(ask(0xc000), 0x4004, "which was told, and is cleared");
        assert_eq!(ask(0xc000), 0x0000);
        // SETTINGS1.
        ask(0x0018);
        ask(0x0006);
        assert_eq!(ask(0xc000) & 0x3fff, 6);
        ask(0x4018 | 0x8000);
        assert_eq!(ask(0xc000), 6);
        assert_eq!(ask(0xc555), 0);
        assert_eq!(ask(0x4001) & 0x7fff, 0x4000, "no such register");
        assert_eq!(ask(0xc000) & 7, 2);
        assert_eq!(transfer(&mut chip, &[0xc0]).len(), 1);
        let mut ask = |frame: u16| transfer(&mut chip, &frame.to_be_bytes());
        ask(0x4001);
        assert_eq!(ask(0xc000)[1] & 7, 1, "a frame of 8 bits");
    }

    #[test]
    fn a_tle5012b_latches_the_angle_with_its_clock() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let mut chip = Tle5012b::new(shaft(1), Arc::new(clock.clone()));
        let crc = |bytes: &[u8]| !crc8(0x1d, 0xff, bytes);
        // STAT tells of the reset, once.
        let answer = transfer(&mut chip, &[0x80, 0x01, 0, 0, 0, 0]);
        assert_eq!(answer[..4], [0x80, 0x01, 0x80, 0x01]);
        let answer = transfer(&mut chip, &[0x80, 0x01, 0, 0, 0, 0]);
        assert_eq!(answer[2..5], [0x80, 0x00, 0xfe]);
        assert_eq!(answer[5], crc(&answer[..4]));
        // MOD1 is written with the lock code only, and what comes back is what was said.
        transfer(&mut chip, &[0x00, 0x61, 0x80, 0x00, 0, 0]);
        assert_eq!(transfer(&mut chip, &[0xd0, 0x61, 0, 0, 0, 0])[2..4], [0x40, 0x01]);
        let answer = transfer(&mut chip, &[0x50, 0x61, 0x40, 0x00, 0, 0]);
        assert_eq!((&answer[..4], answer[5]), (&[0x50, 0x61, 0x40, 0x00][..], crc(&answer[..4])));
        assert_eq!(transfer(&mut chip, &[0xd0, 0x61, 0, 0, 0, 0])[2..4], [0x40, 0x00]);
        // 1001 us are 750 of its timer: 23 measurements and 14.
        clock.set(Clock::EPOCH + Ticks::from_us(1001));
        transfer(&mut chip, &[]);
        clock.set(Clock::EPOCH + Ticks::from_us(5000));
        let read = |chip: &mut Tle5012b| transfer(chip, &[0x84, 0x24, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        let answer = read(&mut chip);
        assert_eq!(answer[2..4], (0x8000u16 | 0x400a).to_be_bytes());
        assert_eq!(answer[6..8], (0x8000u16 | 23 << 9 | 1).to_be_bytes(), "in its second turn");
        assert_eq!(answer[8..10], (14u16 << 9 | 0x1ad).to_be_bytes());
        assert_eq!((answer[10], answer[11]), (0xfe, crc(&answer[..10])));
        transfer(&mut chip, &[]);
        assert_eq!(read(&mut chip)[2] & 0x80, 0, "nothing new");
    }

    #[test]
    fn an_mt6816_and_an_mt6826s_go_on_from_the_register_that_was_named() {
        let mut chip = Mt6816 { shaft: shaft(2), latched: 0, place: None, address: 0 };
        let angle = 0x200au16 << 2;
        assert_eq!(transfer(&mut chip, &[0x83, 0, 0])[1..], (angle | even_parity(angle)).to_be_bytes());
        assert_eq!(transfer(&mut chip, &[0x84, 0])[1..], [(angle | even_parity(angle)) as u8]);

        let mut chip = Mt6826s::new(shaft(1));
        let answer = transfer(&mut chip, &[0x30, 0x03, 0, 0, 0, 0]);
        assert_eq!(answer[2..5], [0x80, 0x14, 0]);
        assert_eq!(answer[5], crc8(0x07, 0, &[0x80, 0x14, 0]));
        transfer(&mut chip, &[0x60, 0x0d, 0x05]);
        assert_eq!(transfer(&mut chip, &[0x30, 0x0d, 0])[2], 5);
        assert_eq!(transfer(&mut chip, &[0x30, 0x0e, 0])[2], 0x50);
    }

    #[test]
    fn an_mt6826s_calibrates_itself_in_sixteen_turns() {
        let mut chip = Mt6826s::new(shaft(0));
        chip.shaft.steps_per_turn = 100.0;
        chip.shaft.axis.set_enabled(true);
        chip.shaft.axis.set_forward(true);
        let status = |chip: &mut Mt6826s| transfer(chip, &[0x31, 0x13, 0])[2] >> 6;
        assert_eq!(status(&mut chip), 0);
        transfer(&mut chip, &[0x61, 0x55, 0x5e]);
        for turn in 1..=16 {
            for _ in 0..100 {
                chip.shaft.axis.edge(true, Clock::EPOCH);
            }
            assert_eq!(status(&mut chip), if turn < 16 { 1 } else { 3 });
        }
    }
}
