// SPDX-License-Identifier: GPL-3.0-or-later
//! WS2812 LEDs on the data output (MOSI) of an SPI controller, whose clock keeps the times of the pulses.
//!
//! Four bits of SPI make one bit of the chain. `1000` stands for 0, `1110` for 1. At 3.2 MHz these are 312.5 and
//! 937.5 ns high, of 1250 ns. The data sheet has 400 and 800 ns, 150 more or less, of 1250 ns (Worldsemi WS2812B, "Data
//! transfer time"). Each byte on the wire ends low. So a pause of the controller between two bytes does not change a
//! bit. A controller that only has a lower rate, down to 2 MHz, also works. Only the short pulse is critical. It must
//! be below 500 ns (Klipper's src/neopixel.c has the needs of real chips).
//!
//! Klipper's C gives up a frame if a bit comes more than `bit_max_ticks` after the one before. Pinion cannot see
//! whether a controller pauses during a message. The log names a controller that is known to pause. A frame counts as
//! sent if its driver took it.

use crate::board::BusDevice;
use crate::feature::spi::spi_shutdown;
use crate::shutdown::Shutdown;
use crate::time::{CLOCK_FREQ, Ticks};

use super::INVALID_SIZE;

/// Bits per second of the SPI bus.
pub(super) const RATE_HZ: u32 = 3_200_000;
/// Bytes of the SPI bus for one byte of the chain.
const WIRE_BYTES: usize = 4;

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

/// The controller, and its message for a frame.
pub(super) struct Waves {
    device: Box<dyn BusDevice>,
    /// Low for the reset time, the colors, low for the reset time. Low before, because the controller may leave its
    /// output high while it rests: then this is all the low time that the LEDs get. Low after, because the LEDs then
    /// take the colors.
    message: Vec<u8>,
    low_bytes: usize,
}

impl Waves {
    /// # Errors
    ///
    /// "Invalid neopixel data_size" if the message is longer than the driver's `message_max`.
    pub(super) fn new(
        device: Box<dyn BusDevice>,
        size: usize,
        reset: Ticks,
        message_max: usize,
    ) -> Result<Waves, Shutdown> {
        let low_bytes = low_bytes(reset);
        let len = low_bytes.saturating_mul(2).saturating_add(size * WIRE_BYTES);
        if len > message_max {
            let cause =
                format!("a chain of {size} bytes makes a message of {len}, and its driver takes {message_max} at once");
            return Err(Shutdown::because(INVALID_SIZE, cause)
                .remedy("lower chain_count, or raise the kernel's parameter spidev.bufsiz"));
        }
        Ok(Waves { device, message: vec![0; len], low_bytes })
    }

    pub(super) fn send(&mut self, colors: &[u8]) -> Result<(), Shutdown> {
        let wires = self.message.iter_mut().skip(self.low_bytes);
        for (wire, byte) in wires.zip(colors.iter().copied().flat_map(encode)) {
            *wire = byte;
        }
        self.device.send(&self.message).map_err(spi_shutdown)
    }
}

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
