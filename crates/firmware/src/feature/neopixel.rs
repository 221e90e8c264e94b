// SPDX-License-Identifier: GPL-3.0-or-later
//! Chains of WS2812 LEDs ("neopixels") on the data output (MOSI) of an SPI controller.
//!
//! A data bit of the chain is a pulse: a short one is 0, a long one is 1. These times are too short for a program on
//! Linux. The SPI controller's clock keeps them. Four of its bits make one bit of the chain. `1000` stands for 0,
//! `1110` for 1. At 3.2 MHz these are 312.5 and 937.5 ns high, of 1250 ns. The data sheet has 400 and 800 ns, 150 more
//! or less, of 1250 ns (Worldsemi WS2812B, "Data transfer time"). Each byte on the wire ends low. So a pause of the
//! controller between two bytes does not change a bit. A controller that only has a lower rate, down to 2 MHz, also
//! works. Only the short pulse is critical. It must be below 500 ns (the firmware's src/neopixel.c says what chips
//! really need).
//!
//! The firmware gives up a frame if a bit comes more than `bit_max_ticks` after the one before. klippy then sends the
//! frame again. Pinion cannot see whether a controller pauses during a message. The log names a controller that is
//! known to pause. A frame counts as sent if its driver took it.

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError, Mosi, Pin};
use crate::mcu::{
    Back, Bus, Command, Conversation, Done, Feature, Object, Oid, Response, Slot, Talk, Turn, command, response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{CLOCK_FREQ, Ticks};

use super::spi::spi_shutdown;

pub(super) const FEATURE: Feature = Feature {
    commands: &[CONFIG_NEOPIXEL, NEOPIXEL_UPDATE, NEOPIXEL_SEND],
    responses: &[Sent::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// The chain has more bytes than the format or the SPI driver has room for.
    INVALID_SIZE = "Invalid neopixel data_size";
    /// `neopixel_update` past the end of the chain.
    INVALID_UPDATE = "Invalid neopixel update command";
}

response! {
    /// The colors are on their way to the LEDs, or could not be sent. klippy sends again after a failure.
    "neopixel_result oid=%c success=%c"
    pub(super) struct Sent { oid: Oid, success: bool }
}

/// Bits per second of the SPI bus.
const RATE_HZ: u32 = 3_200_000;
/// Bytes of the SPI bus for one byte of the chain.
const WIRE_BYTES: usize = 4;
/// Shortest time that the line is low before and after the colors. klippy asks for 50 us. Newer WS2812B need 280 us to
/// take their colors (Worldsemi WS2812B-V5, "Data transfer time": RES). If the data output idles high, this is all the
/// low time that they get.
const RESET_MIN: Ticks = Ticks::from_us(300);
/// Lowest size and position that are refused, as in the firmware.
const SIZE_LIMIT: u16 = 0x8000;

/// The bytes of the SPI bus for one byte of the chain.
fn encode(byte: u8) -> [u8; WIRE_BYTES] {
    let half = |bit: u8| if byte >> bit & 1 == 1 { 0b1110 } else { 0b1000 };
    [(7, 6), (5, 4), (3, 2), (1, 0)].map(|(first, second)| half(first) << 4 | half(second))
}

/// How many bytes keep the line low for at least `ticks`.
fn low_bytes(ticks: Ticks) -> usize {
    let bits = u64::from(ticks.0) * u64::from(RATE_HZ);
    usize::try_from(bits.div_ceil(u64::from(CLOCK_FREQ) * 8)).unwrap_or(usize::MAX)
}

/// The chain's colors on their way to the LEDs.
struct Frame {
    data: Vec<u8>,
    /// Low for the reset time, the colors, low for the reset time. Low before, because the controller may leave its
    /// output high while it rests. Low after, because the LEDs then take the colors.
    message: Vec<u8>,
    low_bytes: usize,
}

impl Talk for Frame {
    type Answer = ();

    fn talk(&mut self, line: &mut dyn BusDevice) -> Result<(), BusError> {
        let colours = self.message.iter_mut().skip(self.low_bytes);
        for (wire, byte) in colours.zip(self.data.iter().copied().flat_map(encode)) {
            *wire = byte;
        }
        line.send(&self.message)
    }
}

struct Neopixel {
    bus: Bus,
    data: Vec<u8>,
    frame: Slot<Conversation<Frame>>,
    /// Whether the log already has a line about failed sending.
    failing: bool,
}

impl Neopixel {
    fn update(&mut self, pos: u16, bytes: &[u8]) -> Result<(), Shutdown> {
        let size = self.data.len();
        let pos = usize::from(pos);
        let part = self.data.get_mut(pos..pos + bytes.len());
        let part = part.ok_or_else(|| {
            let what = format_args!("bytes {pos} to {} of a chain of {size}", pos + bytes.len());
            Shutdown::by_host(INVALID_UPDATE, what)
        })?;
        part.copy_from_slice(bytes);
        Ok(())
    }

    fn send(&mut self, turn: &mut Turn) -> Result<(), Shutdown> {
        // Commands wait for each other, so the conversation is here.
        let Some(frame) = self.frame.here() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "neopixel_send came amid another one"));
        };
        frame.talk.data.copy_from_slice(&self.data);
        self.frame.converse_on(turn, &self.bus)
    }
}

impl Object for Neopixel {
    fn kind(&self) -> &'static str {
        "neopixel"
    }

    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.frame.back(done) else { return Ok(()) };
        turn.send(Sent { oid: turn.oid(), success: result.is_ok() });
        // No color is worth a print. klippy tries eight times for each change, so only the first failure is logged.
        let known = std::mem::replace(&mut self.failing, result.is_err());
        if let (Err(error), false) = (result, known) {
            let trouble = spi_shutdown(error.clone());
            turn.warn(self.kind(), trouble);
        }
        Ok(())
    }
}

const CONFIG_NEOPIXEL: Command = command!(
    "config_neopixel oid=%c pin=%u data_size=%hu bit_max_ticks=%u reset_min_ticks=%u",
    |mcu, oid: Oid, pin: Pin, data_size: u16, bit_max_ticks: Ticks, reset_min_ticks: Ticks| {
        // The head of this file says why.
        let _ = bit_max_ticks;
        mcu.vacant(oid)?;
        if data_size >= SIZE_LIMIT {
            return Err(Shutdown::by_host(INVALID_SIZE, format_args!("a chain of {data_size} bytes")));
        }
        let Mosi { line, message_max, pauses } = mcu.board()?.mosi(pin, RATE_HZ)?;
        if let Some(trouble) = pauses {
            log::warn!("{trouble}");
        }
        let size = usize::from(data_size);
        let low_bytes = low_bytes(reset_min_ticks.max(RESET_MIN));
        let len = low_bytes.saturating_mul(2).saturating_add(size * WIRE_BYTES);
        if len > message_max {
            let cause =
                format!("a chain of {size} bytes makes a message of {len}, and its driver takes {message_max} at once");
            return Err(Shutdown::because(INVALID_SIZE, cause)
                .remedy("lower chain_count, or raise the kernel's parameter spidev.bufsiz")
                .of(&mcu.name(pin)));
        }
        let frame = Frame { data: vec![0; size], message: vec![0; len], low_bytes };
        let chain = Neopixel { bus: mcu.bus(line)?, data: vec![0; size], frame: Slot::talking(frame), failing: false };
        mcu.assign_on(pin, oid, chain)
    }
);

const NEOPIXEL_UPDATE: Command =
    command!("neopixel_update oid=%c pos=%hu data=%*s", Neopixel, |chain, _, pos: u16, data: &[u8]| chain
        .update(pos, data));

const NEOPIXEL_SEND: Command = command!("neopixel_send oid=%c", Neopixel, |chain, turn| chain.send(turn));

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_of_the_chain() {
        assert_eq!(encode(0x00), [0x88; 4]);
        assert_eq!(encode(0xff), [0xee; 4]);
        assert_eq!(encode(0x93), [0xe8, 0x8e, 0x88, 0xee]);
    }

    /// High and low times of each bit, from the data sheet (WS2812B: T0H, T1H, T0L, T1L).
    #[test]
    fn pulses_are_within_the_data_sheet() {
        let bit_ns = 1e9 / f64::from(RATE_HZ);
        for byte in [0x00, 0xff, 0xa5] {
            let wire = encode(byte).into_iter().flat_map(|wire| (0..8).rev().map(move |bit| wire >> bit & 1));
            for (n, pulse) in wire.collect::<Vec<u8>>().chunks(4).enumerate() {
                let high = f64::from(pulse.iter().sum::<u8>()) * bit_ns;
                let low = 4. * bit_ns - high;
                let (want_high, want_low) = if byte >> (7 - n) & 1 == 1 { (800., 450.) } else { (400., 850.) };
                assert!((high - want_high).abs() <= 150. && (low - want_low).abs() <= 150., "{high} {low}");
                assert!(pulse.is_sorted_by(|a, b| a >= b), "one pulse, and it comes first");
            }
        }
    }

    #[test]
    fn the_line_is_low_for_the_reset_time() {
        // 50 us are 160 bits.
        assert_eq!(low_bytes(Ticks::from_us(50)), 20);
        assert_eq!(low_bytes(Ticks(1)), 1);
        assert_eq!(low_bytes(Ticks(0)), 0);
    }
}
