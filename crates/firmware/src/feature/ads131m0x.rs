// SPDX-License-Identifier: GPL-3.0-or-later
//! The ADCs ADS131M02 and ADS131M04 on SPI, for load cells (Texas Instruments SBAS853, SBAS890).
//!
//! A frame has words of 24 bits: the response to the last command, a sample of each channel, and a CRC
//! ("SPI Communication Frames"). The response to NULL is the STATUS register.

use crate::board::Pin;
use crate::mcu::DialectName::{Kalico, Master};
use crate::mcu::{Command, Context, Enumeration, Feature, JobSlot, Oid, command};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::Ticks;

use super::named;
use super::ready_adc::{CHANNELS_MAX, Frame, ReadyAdc, ReadyChip, Sample, configure_spi, signed_24};
use super::spi::spi_shutdown;
use crate::board::BusError;

pub(super) const FEATURE: Feature = Feature {
    serves: "ADS131M0x load cells",

    commands: &[
        CONFIG_ADS131M0X,
        CONFIG_ADS131M0X_OF_KALICO,
        ADS131M0X_ATTACH_TRIGGER_ANALOG,
        ADS131M0X_ATTACH_LOAD_CELL_PROBE,
        QUERY_ADS131M0X,
        QUERY_ADS131M0X_STATUS,
    ],
    enumerations: &[Enumeration::new("ads131m0x_error:", |_| {
        named(&[("SENSOR_ERROR_CRC", ERROR_CRC), ("SENSOR_ERROR_RESET", ERROR_RESET)])
    })
    .of(&[Master])],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// No chip has this number of channels, or the channel is not one of them.
    INVALID_CHANNELS = "Invalid ads131m0x channels configuration";
    /// Kalico: no chip has this number of channels.
    INVALID_CHANNEL_COUNT = "ads131m0x invalid sensor_channel_count";
    /// Kalico: the mask selects no channel, or one that the chip does not have.
    INVALID_CHANNEL_MASK = "ads131m0x invalid channel_mask";
}

/// The frame's CRC does not match its words.
const ERROR_CRC: u8 = 1;
/// The chip was reset after the measurements began, and lost klippy's settings.
const ERROR_RESET: u8 = 2;

const WORD_BYTES: usize = 3;
const FRAME_MAX: usize = frame_bytes(CHANNELS_MAX as u8);
/// RESET of the STATUS register, in its high byte.
const STATUS_RESET: u8 = 1 << 2;

/// Bytes of a frame: status, channels, CRC.
const fn frame_bytes(channels: u8) -> usize {
    (1 + channels as usize + 1) * WORD_BYTES
}

/// CRC-16/CCITT: polynomial 0x1021, initial value 0xffff ("CRC" in "SPI Communication Frames").
fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xffff, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte) << 8, |crc, _| crc << 1 ^ if crc & 0x8000 != 0 { 0x1021 } else { 0 })
    })
}

/// A decoded frame.
#[derive(Debug, PartialEq, Eq)]
enum Content {
    BadCrc {
        reset: bool,
    },
    /// Whether the chip was reset, and each channel's sample.
    Good {
        reset: bool,
        values: [i32; CHANNELS_MAX],
    },
}

fn decode(frame: &[u8]) -> Content {
    let Some((words, [crc_high, crc_low, _])) = frame.split_last_chunk::<WORD_BYTES>() else {
        return Content::BadCrc { reset: false };
    };
    let reset = words.first().is_some_and(|status| status & STATUS_RESET != 0);
    if crc16(words) != u16::from_be_bytes([*crc_high, *crc_low]) {
        return Content::BadCrc { reset };
    }
    let words = words.chunks_exact(WORD_BYTES).map(|word| [word[0], word[1], word[2]]);
    let mut values = [0; CHANNELS_MAX];
    for (value, word) in values.iter_mut().zip(words.skip(1)) {
        *value = signed_24(word);
    }
    Content::Good { reset, values }
}

/// The sampled channels. They also decide how errors are reported.
#[derive(Clone, Copy)]
enum Channels {
    /// One channel, for Klipper.
    One(u8),
    /// Every channel with its bit set, each with its own value, for Kalico.
    Mask(u8),
}

/// Kalico recognizes errors by these values.
const KALICO_ERROR_CRC: i32 = i32::MIN;
const KALICO_ERROR_RESET: i32 = 1 << 30;

struct Ads131m0x {
    spi: Oid,
    channels: Channels,
    /// Whether the chip was reset after the measurements began. Only the host can set it up again.
    was_reset: bool,
}

impl Ads131m0x {
    fn judge(&mut self, content: Content) -> Sample {
        self.was_reset |= match (self.channels, &content) {
            // Kalico also takes this bit from a damaged frame. So it sees a floating bus as a reset.
            (Channels::Mask(_), Content::BadCrc { reset }) | (_, Content::Good { reset, .. }) => *reset,
            (Channels::One(_), Content::BadCrc { .. }) => false,
        };
        match (self.channels, content) {
            (Channels::One(_), Content::BadCrc { .. }) => error_sample(ERROR_CRC),
            (Channels::One(_), Content::Good { .. }) if self.was_reset => error_sample(ERROR_RESET),
            (Channels::One(channel), Content::Good { values, .. }) => {
                Sample::Value(values.get(usize::from(channel)).copied().unwrap_or_default())
            }
            (Channels::Mask(_), _) if self.was_reset => self.each(KALICO_ERROR_RESET),
            (Channels::Mask(_), Content::BadCrc { .. }) => self.each(KALICO_ERROR_CRC),
            (Channels::Mask(mask), Content::Good { values, .. }) => {
                let mut sampled = [0; CHANNELS_MAX];
                let chosen = values.iter().enumerate().filter(|(channel, _)| mask & 1 << channel != 0);
                sampled.iter_mut().zip(chosen).for_each(|(place, (_, value))| *place = *value);
                Sample::Channels { values: sampled, count: self.channels(), sum: Some(sampled.iter().sum()) }
            }
        }
    }

    /// The same error in the place of each channel's value.
    fn each(&self, error: i32) -> Sample {
        Sample::Channels { values: [error; CHANNELS_MAX], count: self.channels(), sum: None }
    }
}

fn error_sample(code: u8) -> Sample {
    Sample::Error { code: Some(code), value: i32::from(code) << 24 }
}

impl ReadyChip for Ads131m0x {
    const NAME: &'static str = "ADS131M0x";
    type Reading = Frame<FRAME_MAX>;

    fn read(&mut self, context: &mut Context, reading: &mut JobSlot<Self::Reading>) -> Result<(), Shutdown> {
        reading.send_to(context, self.spi)
    }

    fn stop(failure: &BusError) -> Shutdown {
        spi_shutdown(failure.clone())
    }

    fn sample(&mut self, frame: Frame<FRAME_MAX>, _late: bool) -> Sample {
        self.judge(decode(frame.received()))
    }

    fn channels(&self) -> usize {
        match self.channels {
            Channels::One(_) => 1,
            Channels::Mask(mask) => mask.count_ones() as usize,
        }
    }

    fn switch(&mut self, _context: &mut Context, on: bool) -> Result<(), Shutdown> {
        if on {
            self.was_reset = false;
        }
        Ok(())
    }
}

type Sensor = ReadyAdc<Ads131m0x>;

const CONFIG_ADS131M0X: Command = command!(
    "config_ads131m0x oid=%c spi_oid=%c channel=%c num_channels=%c data_ready_pin=%u",
    |context, oid: Oid, spi_oid: Oid, channel: u8, num_channels: u8, data_ready_pin: Pin| {
        if !(2..=CHANNELS_MAX as u8).contains(&num_channels) || channel >= num_channels {
            return Err(Shutdown::by_host(
                INVALID_CHANNELS,
                format_args!(
                    "the host asks for channel {channel} of {num_channels}, but a chip has 2 to {CHANNELS_MAX} channels"
                ),
            ));
        }
        let chip = Ads131m0x { spi: spi_oid, channels: Channels::One(channel), was_reset: false };
        configure_spi(context, oid, (spi_oid, data_ready_pin), chip, frame_bytes(num_channels))
    }
)
.of(&[Master]);

const CONFIG_ADS131M0X_OF_KALICO: Command = command!(
    "config_ads131m0x oid=%c spi_oid=%c data_ready_pin=%u sensor_channel_count=%c channel_mask=%c",
    |context, oid: Oid, spi_oid: Oid, data_ready_pin: Pin, sensor_channel_count: u8, channel_mask: u8| {
        if !(1..=CHANNELS_MAX as u8).contains(&sensor_channel_count) {
            return Err(Shutdown::by_host(
                INVALID_CHANNEL_COUNT,
                format_args!("{sensor_channel_count} channels is outside 1 to {CHANNELS_MAX}"),
            ));
        }
        if channel_mask == 0 || channel_mask >> sensor_channel_count != 0 {
            return Err(Shutdown::by_host(
                INVALID_CHANNEL_MASK,
                format_args!("channel_mask {channel_mask:#x} is for a chip with {sensor_channel_count} channels"),
            ));
        }
        let chip = Ads131m0x { spi: spi_oid, channels: Channels::Mask(channel_mask), was_reset: false };
        configure_spi(context, oid, (spi_oid, data_ready_pin), chip, frame_bytes(sensor_channel_count))
    }
)
.of(&[Kalico]);

const ADS131M0X_ATTACH_TRIGGER_ANALOG: Command = command!(
    "ads131m0x_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    Sensor,
    |sensor, context, trigger_analog_oid: Oid| sensor.attached.attach(context, trigger_analog_oid)
)
.of(&[Master]);

const ADS131M0X_ATTACH_LOAD_CELL_PROBE: Command = command!(
    "ads131m0x_attach_load_cell_probe oid=%c load_cell_probe_oid=%c",
    Sensor,
    |sensor, context, load_cell_probe_oid: Oid| sensor.attached.attach_probe(context, load_cell_probe_oid)
)
.of(&[Kalico]);

const QUERY_ADS131M0X: Command =
    command!("query_ads131m0x oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[Master, Kalico]);

const QUERY_ADS131M0X_STATUS: Command = command!("query_ads131m0x_status oid=%c", Sensor, |sensor, context| sensor
    .query_status(context))
.of(&[Master, Kalico]);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BAD: Content = Content::BadCrc { reset: false };

    /// The check value of CRC-16/CCITT-FALSE (also CRC-16/IBM-3740) in the catalog of CRCs.
    #[test]
    fn the_crc_is_the_one_of_the_data_sheet() {
        assert_eq!(crc16(b"123456789"), 0x29b1);
        assert_eq!(crc16(&[]), 0xffff);
    }

    /// A frame of two channels.
    fn frame(status: u8, channels: [[u8; 3]; 2]) -> [u8; 12] {
        let [[a, b, c], [d, e, f]] = channels;
        let mut frame = [status, 0x03, 0, a, b, c, d, e, f, 0, 0, 0];
        let [high, low] = crc16(&frame[..9]).to_be_bytes();
        (frame[9], frame[10]) = (high, low);
        frame
    }

    #[test]
    fn each_channel_has_its_word() {
        let good = frame(0x05 & !STATUS_RESET, [[0x7f, 0xff, 0xff], [0x80, 0, 0]]);
        assert_eq!(decode(&good), Content::Good { reset: false, values: [8_388_607, -8_388_608, 0, 0] });
        let reset = frame(STATUS_RESET, [[0, 0, 1], [0xff, 0xff, 0xff]]);
        assert_eq!(decode(&reset), Content::Good { reset: true, values: [1, -1, 0, 0] });
        assert_eq!(decode(&[]), BAD);
        // A chip that is unplugged, or has no supply.
        assert_eq!(decode(&[0; 12]), BAD);
        assert_eq!(decode(&[0xff; 12]), Content::BadCrc { reset: true });
    }

    proptest! {
        #[test]
        fn one_bit_that_is_wrong_is_seen(words: [[u8; 3]; 2], bit in 0usize..11 * 8) {
            let mut frame = frame(0, words);
            frame[bit / 8] ^= 1 << (bit % 8);
            let is_seen = matches!(decode(&frame), Content::BadCrc { .. });
            prop_assert!(is_seen);
        }
    }

    #[test]
    fn a_reset_lasts_until_measurements_begin_anew() {
        let mut chip = Ads131m0x { spi: Oid::new(0), channels: Channels::One(0), was_reset: false };
        let good = |reset: bool| Content::Good { reset, values: [5, 6, 7, 8] };
        let error = |code: u8, value: i32| Sample::Error { code: Some(code), value };
        assert_eq!(chip.judge(good(false)), Sample::Value(5));
        assert_eq!(chip.judge(Content::BadCrc { reset: true }), error(1, 0x0100_0000), "it may be the damage");
        assert_eq!(chip.judge(good(false)), Sample::Value(5));
        assert_eq!(chip.judge(good(true)), error(2, 0x0200_0000));
        assert_eq!(chip.judge(good(false)), error(2, 0x0200_0000));
        assert_eq!(chip.judge(BAD), error(1, 0x0100_0000));
    }

    #[test]
    fn kalico_gets_each_channel_of_its_mask() {
        let mut chip = Ads131m0x { spi: Oid::new(0), channels: Channels::Mask(0b1010), was_reset: false };
        let good = |reset: bool| Content::Good { reset, values: [5, 6, 7, -8] };
        let both = |values: [i32; 4], sum| Sample::Channels { values, count: 2, sum };
        assert_eq!(chip.judge(good(false)), both([6, -8, 0, 0], Some(-2)));
        assert_eq!(chip.judge(BAD), both([i32::MIN; 4], None));
        assert_eq!(chip.judge(Content::BadCrc { reset: true }), both([1 << 30; 4], None));
        // A reset takes precedence over a CRC error.
        assert_eq!(chip.judge(BAD), both([1 << 30; 4], None));
    }
}
