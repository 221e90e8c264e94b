// SPDX-License-Identifier: GPL-3.0-or-later
//! An HX711 or HX717 on the data lines of an SPI controller: MOSI is the chip's clock, MISO its data. The controller
//! times the pulses, so a busy processor does not matter.
//!
//! A pulse is two bits of MOSI, `10`. At 500 kHz a bit is 2 us long. So the clock is high for 2 us and low for 2 us. The
//! data sheet has 0.2 to 50 us (T3), and at least 0.2 us (T4). Controllers round the rate down. From 20 kHz on they are
//! fast enough.
//!
//! The chip changes its data 0.1 us after the clock has risen (T2), and keeps them until it rises again. In SPI mode 0
//! the controller reads MISO in the middle of each bit: 1 us and 3 us after the clock has risen. So it reads each bit of
//! the sample twice. If the two differ, the sample is disturbed.
//!
//! Each byte ends low. So the clock is low while the controller pauses between two bytes, and the chip stays on. A
//! transfer of zeros makes no pulse. It shows whether a sample is ready.
//!
//! At the end of measurements the controller's output is left high. That switches the chip off, if the controller keeps
//! the level of the last bit. If not, the chip stays on and measures, with 1.5 mA. At the start a high pulse longer than
//! 60 us restarts the chip in any case.

use crate::board::BusDevice;
use crate::feature::spi::spi_shutdown;
use crate::shutdown::Shutdown;

use crate::mcu::DeviceWarning;
use crate::trouble::Trouble;

use super::{SUBJECT, Shifted};

/// Bits per second.
pub(super) const RATE_HZ: u32 = 500_000;
/// Four pulses.
const PULSES: u8 = 0b1010_1010;
/// Room for 28 pulses.
const WAVE_BYTES: usize = 7;
/// Bytes for which the clock is high, to switch the chip off: 128 us.
const HIGH_BYTES: usize = 8;
/// After this many polls without a sample the log says so. klippy wants ten polls for each sample, and the chip needs
/// four samples to start.
const LOOKS_MAX: u32 = 100;

/// Reads samples.
pub(super) struct Waves {
    device: Box<dyn BusDevice>,
    /// Pulses of a sample, and for gain and channel.
    pulses: u8,
    /// The clock's name in the log.
    name: String,
    /// Polls since the last sample.
    looks: u32,
    /// Whether there was a warning about a chip without samples.
    has_warned: bool,
    /// A warning for the log.
    pub(super) warning: Option<DeviceWarning>,
}

impl Waves {
    pub(super) fn new(device: Box<dyn BusDevice>, pulses: u8, name: String) -> Waves {
        Waves { device, pulses, name, looks: 0, has_warned: false, warning: None }
    }

    /// Reads a sample, if one is ready.
    pub(super) fn run(&mut self) -> Result<Option<Shifted>, Shutdown> {
        let mut poll = [0];
        self.exchange(&mut poll)?;
        // The last bit is the newest.
        if poll[0] & 1 != 0 {
            self.looks = self.looks.saturating_add(1);
            if self.looks > LOOKS_MAX && !std::mem::replace(&mut self.has_warned, true) {
                let trouble = Trouble::new("the chip has no sample").remedy("check its supply, its clock at MOSI and its data at MISO, or use another SPI bus, because an output that is high between transfers switches the chip off; said once");
                let trouble = trouble.of(format_args!("{} ({})", SUBJECT, self.name));
                self.warning = Some(DeviceWarning::new(SUBJECT, trouble));
            }
            return Ok(None);
        }
        self.looks = 0;
        let mut wave = wave(self.pulses);
        self.exchange(&mut wave)?;
        // Zeros are a wrong end of a sample.
        Ok(Some(Shifted { raw: bits(&wave, self.pulses).unwrap_or(0), too_long: false }))
    }

    /// Switches the chip off or starts it again.
    pub(super) fn power_down(&mut self, down: bool) -> Result<(), Shutdown> {
        let mut bytes = [0xff; HIGH_BYTES + 1];
        bytes[HIGH_BYTES] = 0;
        self.exchange(if down { &mut bytes[..HIGH_BYTES] } else { &mut bytes })
    }

    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), Shutdown> {
        self.device.exchange(bytes).map_err(spi_shutdown)
    }
}

/// The bytes of this many pulses. The rest is low.
fn wave(pulses: u8) -> [u8; WAVE_BYTES] {
    std::array::from_fn(|n| {
        let missing = 4usize.saturating_sub(usize::from(pulses).saturating_sub(4 * n));
        PULSES.checked_shl(2 * missing as u32).unwrap_or(0)
    })
}

/// The chip's bits, the last one lowest. `None` if the two readings of a bit differ.
fn bits(received: &[u8; WAVE_BYTES], pulses: u8) -> Option<u32> {
    (0..usize::from(pulses)).try_fold(0, |raw, pulse| {
        let both = received[pulse / 4] >> (6 - 2 * (pulse % 4)) & 0b11;
        (both == 0b00 || both == 0b11).then_some(raw << 1 | u32::from(both & 1))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_byte_ends_low_and_a_wave_has_its_pulses() {
        for pulses in 25..=28u8 {
            let wave = wave(pulses);
            assert!(wave.iter().all(|byte| byte & 1 == 0));
            assert_eq!(wave.iter().map(|byte| byte.count_ones()).sum::<u32>(), u32::from(pulses));
            let all = wave.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1));
            let levels: Vec<u8> = all.collect();
            assert!(levels.windows(2).all(|pair| pair != [1, 1]), "no pulse is longer than a bit");
            assert!(levels[2 * usize::from(pulses)..].iter().all(|level| *level == 0));
        }
    }

    #[test]
    fn each_bit_is_read_twice() {
        let mut received = [0b1100_1100, 0b0011_1111, 0xff, 0, 0, 0, 0xff];
        assert_eq!(bits(&received, 28), Some(0xa7f_000f));
        assert_eq!(bits(&received, 25), Some(0xa7f_000f >> 3));
        received[3] = 0b0010_0000;
        assert_eq!(bits(&received, 25), None);
        // Behind the last pulse nothing counts.
        received[3] = 0;
        received[6] = 0b1101_0101;
        assert_eq!(bits(&received, 25), Some(0xa7f_000f >> 3));
    }

    /// The data sheet's times in microseconds: T3 and T4 of the clock, T2 of the data.
    #[test]
    fn times_are_within_the_data_sheet() {
        let bit_us = 1e6 / f64::from(RATE_HZ);
        assert!((0.2..=50.0).contains(&bit_us), "T3, T4");
        assert!(bit_us / 2.0 > 0.1, "T2");
        assert!(HIGH_BYTES as f64 * 8.0 * bit_us > 60.0, "power-down");
    }
}
