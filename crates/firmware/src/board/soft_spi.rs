// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI on GPIO lines, bit by bit.

use std::sync::Arc;

use super::{BusDevice, BusError, ChipSelect, Line};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks, TimeSource};

/// A chip on lines that other chips may share.
pub struct SoftSpi {
    /// From the chip. It may be the same line as `mosi` if nothing comes back.
    pub miso: Arc<dyn Line>,
    /// To the chip.
    pub mosi: Arc<dyn Line>,
    /// The clock.
    pub sclk: Arc<dyn Line>,
    /// 0 to 3: clock polarity in bit 1, clock phase in bit 0.
    pub mode: u8,
    /// Shortest time for one bit. Driving the lines adds to it.
    pub pulse: Ticks,
    /// A line that selects the chip.
    pub chip_select: Option<ChipSelect>,
    /// The clock that paces the bits.
    pub clock: Arc<dyn TimeSource>,
}

impl SoftSpi {
    fn idles_high(&self) -> bool {
        self.mode & 2 != 0
    }

    /// Sets the clock to its idle level. A chip with another polarity may have used it before.
    fn prepare(&self) -> Result<(), Shutdown> {
        self.sclk.write(self.idles_high())?;
        self.clock.spin_until(self.clock.now() + self.pulse);
        Ok(())
    }

    /// Selects the chip while `shift` sends `count` bytes, beginning at the time that `shift` receives.
    fn converse(&self, count: usize, shift: impl FnOnce(Clock) -> Result<(), Shutdown>) -> Result<(), BusError> {
        let select = |selected| self.chip_select.as_ref().map_or(Ok(()), |line| line.select(selected));
        let begin = || self.clock.now() + Ticks(self.pulse.0 / 2);
        let conversed = self.prepare().and_then(|()| match count {
            0 => self.chip_select.as_ref().map_or(Ok(()), ChipSelect::pulse),
            _ => {
                let shifted = select(true).and_then(|()| shift(begin()));
                // Deselect after a failure too.
                let deselected = select(false);
                shifted.and(deselected)
            }
        });
        conversed.map_err(BusError::from)
    }

    /// Sends one byte, and returns the received byte if `read`.
    fn byte(&self, sent: u8, read: bool, end: &mut Clock) -> Result<u8, Shutdown> {
        (0..8).rev().try_fold(0, |received, bit| {
            let bit = self.bit(sent >> bit & 1 != 0, read, end)?;
            Ok(received << 1 | u8::from(bit))
        })
    }

    /// Sends one bit. Its first half begins at `end`. Sets `end` to the beginning of the next bit.
    fn bit(&self, sent: bool, read: bool, end: &mut Clock) -> Result<bool, Shutdown> {
        let first_half = Ticks(self.pulse.0 / 2);
        let second_half = Ticks(self.pulse.0 - first_half.0);
        let active = !self.idles_high();
        self.clock.spin_until(*end);
        let received = if self.mode & 1 != 0 {
            // Data changes at the clock edge away from idle, and is read at the edge back to idle.
            self.sclk.write(active)?;
            self.mosi.write(sent)?;
            self.clock.spin_until(self.clock.now() + second_half);
            self.sclk.write(!active)?;
            read && self.miso.read()?
        } else {
            self.mosi.write(sent)?;
            self.sclk.write(active)?;
            self.clock.spin_until(self.clock.now() + second_half);
            let received = read && self.miso.read()?;
            self.sclk.write(!active)?;
            received
        };
        *end = self.clock.now() + first_half;
        Ok(received)
    }
}

impl BusDevice for SoftSpi {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.converse(bytes.len(), |mut end| {
            bytes.iter_mut().try_for_each(|byte| self.byte(*byte, true, &mut end).map(|received| *byte = received))
        })
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.converse(bytes.len(), |mut end| {
            bytes.iter().try_for_each(|byte| self.byte(*byte, false, &mut end).map(|_| ()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Direction;
    use crate::time::VirtualClock;
    use proptest::prelude::*;
    use std::sync::Mutex;

    /// A shift register on the wires, as a data sheet describes it. It reads data at one edge of the clock and shifts
    /// data out at the other edge.
    #[derive(Default)]
    struct Wires {
        mode: u8,
        sclk: bool,
        mosi: bool,
        miso: bool,
        selected: bool,
        /// Bits that the chip still has to send. The next one is the last.
        to_send: Vec<bool>,
        taken: Vec<bool>,
        /// When the clock changed while the chip was selected.
        edges: Vec<u64>,
    }

    impl Wires {
        fn shift_out(&mut self) {
            self.miso = self.to_send.pop().unwrap_or(true);
        }

        fn select(&mut self, selected: bool) {
            self.selected = selected;
            if selected {
                assert_eq!(self.sclk, self.mode & 2 != 0, "the clock idles");
                if self.mode & 1 == 0 {
                    self.shift_out();
                }
            }
        }

        fn clock(&mut self, level: bool, at: u64) {
            if level == self.sclk {
                return;
            }
            self.sclk = level;
            if !self.selected {
                return;
            }
            self.edges.push(at);
            let leading = level != (self.mode & 2 != 0);
            let takes = leading == (self.mode & 1 == 0);
            if takes {
                self.taken.push(self.mosi);
            } else {
                self.shift_out();
            }
        }
    }

    #[derive(Clone, Copy)]
    enum Which {
        Sclk,
        Mosi,
        Miso,
        Select,
    }

    struct Wire(Which, Arc<Mutex<Wires>>, VirtualClock);

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let mut wires = self.1.lock().unwrap();
            match self.0 {
                Which::Sclk => wires.clock(level, self.2.now().ticks()),
                Which::Mosi => wires.mosi = level,
                Which::Miso => panic!("nobody drives MISO"),
                Which::Select => wires.select(level),
            }
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            let wires = self.1.lock().unwrap();
            Ok(match self.0 {
                Which::Miso => wires.miso,
                _ => wires.mosi,
            })
        }

        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    fn bits(bytes: &[u8]) -> Vec<bool> {
        bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 != 0)).collect()
    }

    /// A chip with this mode, and its wires.
    fn chip(mode: u8, pulse: Ticks, answer: &[u8], loop_back: bool) -> (SoftSpi, Arc<Mutex<Wires>>) {
        let clock = VirtualClock::at(Clock::EPOCH);
        let to_send = bits(answer).into_iter().rev().collect();
        let wires = Arc::new(Mutex::new(Wires { mode, to_send, ..Wires::default() }));
        let wire = |which| -> Arc<dyn Line> { Arc::new(Wire(which, wires.clone(), clock.clone())) };
        let spi = SoftSpi {
            miso: wire(if loop_back { Which::Mosi } else { Which::Miso }),
            mosi: wire(Which::Mosi),
            sclk: wire(Which::Sclk),
            mode,
            pulse,
            chip_select: Some(ChipSelect {
                line: wire(Which::Select),
                active_high: true,
                clock: Arc::new(clock.clone()),
            }),
            clock: Arc::new(clock.clone()),
        };
        (spi, wires)
    }

    proptest! {
        #[test]
        fn what_is_sent_and_received_is_a_shift_registers(
            mode in 0u8..4,
            pulse in 0u32..1000,
            exchange in proptest::collection::vec(any::<(u8, u8)>(), 0..20),
        ) {
            let (sent, answer): (Vec<u8>, Vec<u8>) = exchange.into_iter().unzip();
            let (mut spi, wires) = chip(mode, Ticks(pulse), &answer, false);
            let mut bytes = sent.clone();
            spi.exchange(&mut bytes).unwrap();
            prop_assert_eq!(&bytes, &answer);
            let wires = wires.lock().unwrap();
            prop_assert_eq!(&wires.taken, &bits(&sent));
            prop_assert!(!wires.selected);
            prop_assert_eq!(wires.edges.len(), sent.len() * 16);
            // Both halves of a bit are long enough.
            let half = u64::from(pulse / 2);
            prop_assert!(wires.edges.windows(2).all(|pair| pair[1] - pair[0] >= half));
            prop_assert!(wires.edges.windows(3).all(|three| three[2] - three[0] >= u64::from(pulse)));
        }
    }

    #[test]
    fn what_is_only_sent_leaves_miso_alone() {
        let (mut spi, wires) = chip(0, Ticks(10), &[], false);
        struct Deaf;
        impl Line for Deaf {
            fn write(&self, _level: bool) -> Result<(), Shutdown> {
                panic!("nobody drives MISO")
            }
            fn read(&self) -> Result<bool, Shutdown> {
                panic!("nobody reads MISO")
            }
            fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
                Ok(())
            }
        }
        spi.miso = Arc::new(Deaf);
        spi.send(&[0x3a, 0xc5]).unwrap();
        assert_eq!(wires.lock().unwrap().taken, bits(&[0x3a, 0xc5]));
    }

    #[test]
    fn an_empty_exchange_selects_the_chip_for_a_microsecond_without_a_clock() {
        let (mut spi, wires) = chip(1, Ticks(10), &[], false);
        let clock = spi.clock.clone();
        let began = clock.now();
        spi.exchange(&mut []).unwrap();
        // 10 ticks for the idle clock, then 1 us.
        assert_eq!(clock.now().since(began), 60);
        let wires = wires.lock().unwrap();
        assert!(wires.edges.is_empty() && !wires.selected);
    }

    #[test]
    fn a_line_that_is_miso_and_mosi_reads_what_it_sends() {
        let (mut spi, wires) = chip(0, Ticks(10), &[], true);
        let mut bytes = [0x3a, 0xc5];
        spi.exchange(&mut bytes).unwrap();
        assert_eq!(bytes, [0x3a, 0xc5]);
        assert_eq!(wires.lock().unwrap().taken, bits(&[0x3a, 0xc5]));
    }
}
