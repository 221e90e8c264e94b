// SPDX-License-Identifier: GPL-3.0-or-later
//! Magnetic angle sensors on a motor's shaft, after their data sheets: A1333 (Allegro, "SPI Interface"),
//! AS5047D (ams, v1-10, "SPI Interface"), TLE5012B (Infineon, V2.1 and its user's manual, "SSC Data
//! Transfer"), MT6816 (MagnTek, rev. 1.3, "SPI Interface"), MT6826S (MagnTek, rev. 1.1, "SPI Interface").
//!
//! The magnet turns with the axis's motor. It is slightly off-center, which makes an error once per turn. Its angle to
//! the motor is arbitrary.
//!
//! Simulated: the frames with their parities and checksums, the registers of the angle and of the host's configuration,
//! frame errors where the chip has them, the TLE5012B's own clock and its latched values, the visible part of the
//! MT6826S's calibration. Not simulated: noise, the sensors' own delays and filters, faults of the magnet, outputs
//! other than SPI.

use serde::{Deserialize, Serialize};

mod a1333;
mod as5047d;
mod mt6816;
mod mt6826s;
mod shaft;
mod tle5012b;

use a1333::A1333;
use as5047d::As5047d;
use mt6816::Mt6816;
use mt6826s::Mt6826s;
use shaft::Shaft;
use tle5012b::Tle5012b;

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, Trouble, check};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::register_map::OnBus;
use crate::klippy::layout::{FULL_STEPS, Layout};
use crate::klippy::sections::Sections;

/// The sensor's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AngleChip {
    /// Allegro, with 15 bits.
    A1333,
    /// ams, with 14 bits.
    As5047d,
    /// Infineon, with 15 bits and its own clock.
    Tle5012b,
    /// MagnTek, with 14 bits.
    Mt6816,
    /// MagnTek, with 15 bits and its own calibration.
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AngleConfig {
    /// The sensor's type.
    pub chip: AngleChip,
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. klippy requires this pin for these sensors.
    pub select_pin: PinName,
    /// The axis with the motor that the sensor is on.
    pub axis: String,
    /// The angle that it measures at 0 mm.
    #[serde(default)]
    pub offset_degrees: f64,
    /// Highest error of the angle, because the magnet is off-center.
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

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        check(whose, "offset_degrees", self.offset_degrees, Bound::Any)?;
        check(whose, "eccentricity_degrees", self.eccentricity_degrees, Bound::NotNegative)?;
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let config = workshop.printer.axis(&self.axis);
        let Some((axis, config)) = workshop.axis(&self.axis).zip(config) else { return Ok(()) };
        let clock = workshop.clock.clone();
        let shaft = Shaft {
            axis,
            steps_per_turn: FULL_STEPS * f64::from(config.microsteps),
            offset: self.offset_degrees / 360.0,
            eccentricity: self.eccentricity_degrees / 360.0,
        };
        match self.chip {
            AngleChip::A1333 => workshop.solder_spi(self, A1333::new(shaft)),
            AngleChip::As5047d => workshop.solder_spi(self, As5047d::new(shaft)),
            AngleChip::Tle5012b => workshop.solder_spi(self, Tle5012b::new(shaft, clock)),
            AngleChip::Mt6816 => workshop.solder_spi(self, OnBus::new(Mt6816 { shaft, latched: 0 })),
            AngleChip::Mt6826s => workshop.solder_spi(self, Mt6826s::new(shaft)),
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("angle {}", self.axis));
        cfg.key("sensor_type", self.chip.name());
        cfg.spi(&self.bus, Some(&self.select_pin));
        cfg.comment("To measure with it, and for ANGLE_CALIBRATE; needs a driver on this stepper, and numpy:");
        cfg.offer(|cfg| cfg.key("stepper", layout.stepper(&self.axis)));
    }
}

#[cfg(test)]
mod tests {
    use super::shaft::even_parity;
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::crc::crc8;
    use crate::engine::motion::Axis;
    use crate::engine::spi::SpiChip;
    use pinion_firmware::time::{Clock, Ticks, VirtualClock};
    use std::sync::Arc;

    /// A shaft at this many 3200ths of a turn. 60 mm are one and a half turns.
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
        // 1.5 turns plus the offset are 0.75 of a turn, where the sine is -1.
        assert_eq!(shaft(0).angle(14), (0.74f64 * 16384.0) as u16);
        assert_eq!(shaft(-800).angle(14), 8192, "and 0 at half a turn");
        assert_eq!(shaft(-1600).angle(14), (0.26f64 * 16384.0) as u16);
    }

    #[test]
    fn an_a1333_sends_the_angle_of_the_next_frame() {
        let mut chip = A1333::new(shaft(1));
        assert_eq!(transfer(&mut chip, &[0x32, 0]), [0, 0]);
        // Half a turn and 10.24 of 32768.
        assert_eq!(transfer(&mut chip, &[0x20, 0]), (0x4000u16 + 10).to_be_bytes());
        assert_eq!(transfer(&mut chip, &[0x00, 0x20, 0]), [0x18, 0x01, 0x00], "odd parity");
        assert_eq!(transfer(&mut chip, &[0x20, 0]), 0x1801u16.to_be_bytes(), "a frame of 24 bits names no register");
        assert!(!chip.knows_mode(0));
    }

    #[test]
    fn an_as5047d_checks_parities_and_reports_errors_until_they_are_read() {
        let mut chip = As5047d::new(shaft(2));
        let mut ask = |frame: u16| {
            let answer = transfer(&mut chip, &frame.to_be_bytes());
            u16::from_be_bytes(answer.try_into().unwrap())
        };
        ask(0xffff);
        // Half a turn and 10.24 of 16384, with three ones and the parity.
        assert_eq!(ask(0x7ffe), 0xa00a);
        assert_eq!(ask(0x7fff), 0xa00a, "the one of the frame before");
        // That frame had a wrong parity.
        assert_eq!(ask(0x4001), 0x4000 | 0x8000);
        assert_eq!(ask(0xc000), 0x4004, "which was reported, and is cleared");
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
        // STAT reports the reset once.
        let answer = transfer(&mut chip, &[0x80, 0x01, 0, 0, 0, 0]);
        assert_eq!(answer[..4], [0x80, 0x01, 0x80, 0x01]);
        let answer = transfer(&mut chip, &[0x80, 0x01, 0, 0, 0, 0]);
        assert_eq!(answer[2..5], [0x80, 0x00, 0xfe]);
        assert_eq!(answer[5], crc(&answer[..4]));
        // MOD1 can only be written with the lock code. The answer repeats the sent words.
        transfer(&mut chip, &[0x00, 0x61, 0x80, 0x00, 0, 0]);
        assert_eq!(transfer(&mut chip, &[0xd0, 0x61, 0, 0, 0, 0])[2..4], [0x40, 0x01]);
        let answer = transfer(&mut chip, &[0x50, 0x61, 0x40, 0x00, 0, 0]);
        assert_eq!((&answer[..4], answer[5]), (&[0x50, 0x61, 0x40, 0x00][..], crc(&answer[..4])));
        assert_eq!(transfer(&mut chip, &[0xd0, 0x61, 0, 0, 0, 0])[2..4], [0x40, 0x00]);
        // 1001 us are 750 of its timer: 23 measurements and 14.
        clock.set(Clock::EPOCH + Ticks::from_us(1001));
        transfer(&mut chip, &[]);
        clock.set(Clock::EPOCH + Ticks::from_ms(5));
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
        let mut chip = OnBus::new(Mt6816 { shaft: shaft(2), latched: 0 });
        let angle = 0x200au16 << 2;
        assert_eq!(transfer(&mut chip, &[0x83, 0, 0])[1..], (angle | even_parity(angle)).to_be_bytes());
        assert_eq!(transfer(&mut chip, &[0x84, 0])[1..], [(angle | even_parity(angle)) as u8]);

        let mut chip = Mt6826s::new(shaft(1));
        let answer = transfer(&mut chip, &[0x30, 0x03, 0, 0, 0, 0]);
        assert_eq!(answer[2..5], [0x80, 0x14, 0]);
        assert_eq!(answer[5], crc8(0x07, 0, [0x80, 0x14, 0]));
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
