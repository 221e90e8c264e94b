// SPDX-License-Identifier: GPL-3.0-or-later
//! The ADCs ADS131M02 and ADS131M04 on SPI, for load cells (Texas Instruments SBAS853, SBAS890).
//!
//! A frame has words of 24 bits: the response to the last command, a sample of each channel, and a CRC
//! ("SPI Communication Frames"). The response to NULL is the STATUS register.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{Command, Conversation, Enumeration, Feature, Mcu, Oid, Ticket, command};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::Ticks;

use super::named;
use super::ready_adc::{Frame, ReadyChip, Sample, attach, configure_spi, query, query_status, signed_24, spi_result};

pub(super) const FEATURE: Feature = Feature {
    name: "ads131m0x",
    commands: &[CONFIG_ADS131M0X, ADS131M0X_ATTACH_TRIGGER_ANALOG, QUERY_ADS131M0X, QUERY_ADS131M0X_STATUS],
    enumerations: &[Enumeration::new("ads131m0x_error:", |_| {
        named(&[("SENSOR_ERROR_CRC", ERROR_CRC), ("SENSOR_ERROR_RESET", ERROR_RESET)])
    })],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A number of channels that no chip has, or a channel beyond them.
    INVALID_CHANNELS = "Invalid ads131m0x channels configuration";
}

/// The frame's CRC does not fit its words.
const ERROR_CRC: u8 = 1;
/// The chip was reset since the measurements began, and with it what klippy had set.
const ERROR_RESET: u8 = 2;

const WORD_BYTES: usize = 3;
const CHANNELS_MAX: u8 = 4;
const FRAME_MAX: usize = frame_bytes(CHANNELS_MAX);
/// RESET of the STATUS register, in its high byte.
const STATUS_RESET: u8 = 1 << 2;

/// Bytes of a frame: status, channels, CRC.
const fn frame_bytes(channels: u8) -> usize {
    (1 + channels as usize + 1) * WORD_BYTES
}

/// CRC-16/CCITT: polynomial 0x1021, from 0xffff on ("CRC" in "SPI Communication Frames").
fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xffff, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte) << 8, |crc, _| crc << 1 ^ if crc & 0x8000 != 0 { 0x1021 } else { 0 })
    })
}

/// What a frame says.
#[derive(Debug, PartialEq, Eq)]
enum Content {
    BadCrc,
    /// Whether the chip was reset, and the channel's sample.
    Good {
        reset: bool,
        value: i32,
    },
}

fn decode(frame: &[u8], channel: u8) -> Content {
    let Some((words, [crc_high, crc_low, _])) = frame.split_last_chunk::<WORD_BYTES>() else {
        return Content::BadCrc;
    };
    if crc16(words) != u16::from_be_bytes([*crc_high, *crc_low]) {
        return Content::BadCrc;
    }
    let mut words = words.chunks_exact(WORD_BYTES).map(|word| [word[0], word[1], word[2]]);
    let [status, ..] = words.next().unwrap_or_default();
    let value = words.nth(usize::from(channel)).map_or(0, signed_24);
    Content::Good { reset: status & STATUS_RESET != 0, value }
}

struct Ads131m0x {
    spi: Oid,
    channel: u8,
    /// Whether it was reset since the measurements began: that is for the host to mend.
    was_reset: bool,
}

impl Ads131m0x {
    fn judge(&mut self, content: Content) -> Sample {
        let error = |code: u8| Sample::Error { code: Some(code), value: i32::from(code) << 24 };
        match content {
            Content::BadCrc => error(ERROR_CRC),
            Content::Good { reset, value } => {
                self.was_reset |= reset;
                if self.was_reset { error(ERROR_RESET) } else { Sample::Value(value) }
            }
        }
    }
}

impl ReadyChip for Ads131m0x {
    const NAME: &'static str = "ADS131M0x";
    type Reading = Conversation<Frame<FRAME_MAX>>;

    fn read(&mut self, mcu: &mut Mcu, ticket: Ticket, reading: Box<Self::Reading>) -> Result<(), Shutdown> {
        mcu.converse(self.spi, ticket, reading)
    }

    fn result(reading: &mut Self::Reading) -> Result<(), Shutdown> {
        spi_result(reading)
    }

    fn sample(&mut self, reading: &Self::Reading, _late: bool) -> Sample {
        self.judge(decode(reading.talk.received(), self.channel))
    }

    fn switch(&mut self, _mcu: &mut Mcu, _oid: Oid, on: bool) -> Result<(), Shutdown> {
        if on {
            self.was_reset = false;
        }
        Ok(())
    }
}

const CONFIG_ADS131M0X: Command = command!(
    "config_ads131m0x oid=%c spi_oid=%c channel=%c num_channels=%c data_ready_pin=%u",
    |mcu, oid: Oid, spi_oid: Oid, channel: u8, num_channels: u8, data_ready_pin: Pin| {
        if !(2..=CHANNELS_MAX).contains(&num_channels) || channel >= num_channels {
            return Err(Shutdown::by_host(
                INVALID_CHANNELS,
                format_args!("channel {channel} of {num_channels} is wanted of a chip that has 2 to {CHANNELS_MAX}"),
            ));
        }
        let chip = Ads131m0x { spi: spi_oid, channel, was_reset: false };
        configure_spi(mcu, oid, (spi_oid, data_ready_pin), chip, frame_bytes(num_channels))
    }
);

const ADS131M0X_ATTACH_TRIGGER_ANALOG: Command = command!(
    "ads131m0x_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    |mcu, oid: Oid, trigger_analog_oid: Oid| attach::<Ads131m0x>(mcu, oid, trigger_analog_oid)
);

const QUERY_ADS131M0X: Command =
    command!("query_ads131m0x oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
        query::<Ads131m0x>(mcu, oid, rest_ticks)
    });

const QUERY_ADS131M0X_STATUS: Command =
    command!("query_ads131m0x_status oid=%c", |mcu, oid: Oid| query_status::<Ads131m0x>(mcu, oid));

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The check value of CRC-16/CCITT-FALSE (also CRC-16/IBM-3740) in the catalogue of CRCs.
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
        assert_eq!(decode(&good, 0), Content::Good { reset: false, value: 8_388_607 });
        assert_eq!(decode(&good, 1), Content::Good { reset: false, value: -8_388_608 });
        let reset = frame(STATUS_RESET, [[0, 0, 1], [0xff, 0xff, 0xff]]);
        assert_eq!(decode(&reset, 1), Content::Good { reset: true, value: -1 });
        assert_eq!(decode(&[], 0), Content::BadCrc);
        // A chip that is unplugged, or has no supply.
        assert_eq!(decode(&[0; 12], 0), Content::BadCrc);
        assert_eq!(decode(&[0xff; 12], 0), Content::BadCrc);
    }

    proptest! {
        #[test]
        fn one_bit_that_is_wrong_is_seen(words: [[u8; 3]; 2], bit in 0usize..11 * 8) {
            let mut frame = frame(0, words);
            frame[bit / 8] ^= 1 << (bit % 8);
            prop_assert_eq!(decode(&frame, 0), Content::BadCrc);
        }
    }

    #[test]
    fn a_reset_lasts_until_measurements_begin_anew() {
        let mut chip = Ads131m0x { spi: Oid::new(0), channel: 0, was_reset: false };
        let error = |code: u8, value: i32| Sample::Error { code: Some(code), value };
        assert_eq!(chip.judge(Content::Good { reset: false, value: 5 }), Sample::Value(5));
        assert_eq!(chip.judge(Content::BadCrc), error(1, 0x0100_0000));
        assert_eq!(chip.judge(Content::Good { reset: true, value: 5 }), error(2, 0x0200_0000));
        assert_eq!(chip.judge(Content::Good { reset: false, value: 5 }), error(2, 0x0200_0000));
        assert_eq!(chip.judge(Content::BadCrc), error(1, 0x0100_0000));
    }
}
