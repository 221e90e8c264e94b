// SPDX-License-Identifier: GPL-3.0-or-later
//! The load cell ADC ADS1220 on SPI (Texas Instruments SBAS501, "SPI Programming").
//!
//! DRDY goes low when a conversion is over. The next 24 clocks shift it out, the highest bit first, independent of the
//! sent bytes. The sent bytes are commands, which read and write the four registers.
//!
//! Simulated: the commands, the rates of all modes, single conversions, gains, the cell between AIN0 and AIN1 either
//! way round. The chip shifts out the cell's load at the first clock. Not simulated: other inputs (they read 0), the
//! temperature sensor, the current sources, the filter of 50 and 60 Hz.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::load_cell::{Cell, CellConfig};
use super::ready::{Conversions, ReadyLine, ready_pin};
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::spi::SpiChip;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// CPOL is 0 and CPHA is 1.
const MODE: u8 = 1;
/// The rate in klippy's configuration: enough for a weight, and little work for a busy computer.
const RATE: u32 = 45;

/// By DR: samples a second in normal mode, in duty cycle mode, in turbo mode.
const RATES: [[f64; 3]; 7] = [
    [20.0, 5.0, 40.0],
    [45.0, 11.25, 90.0],
    [90.0, 22.5, 180.0],
    [175.0, 44.0, 350.0],
    [330.0, 82.5, 660.0],
    [600.0, 150.0, 1200.0],
    [1000.0, 250.0, 2000.0],
];

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ads1220Config {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// Low while a conversion waits.
    pub drdy_pin: PinName,
    /// The load cell. Its counts are valid for a gain of 128.
    pub cell: CellConfig,
}

impl Part for Ads1220Config {
    fn name(&self) -> String {
        "ads1220".into()
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("drdy_pin", Some(&self.drdy_pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        self.cell.validate(whose)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let drdy = ReadyLine::new("data ready of ads1220");
        workshop.wire(Some(&self.drdy_pin), ready_pin(drdy.clone()));
        let cell = Cell::new(&self.cell, workshop, self);
        workshop.solder_spi(self, Ads1220::new(cell, drdy, workshop.clock.clone()));
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section("load_cell ads1220");
        cfg.key("sensor_type", "ads1220");
        cfg.spi(&self.bus, self.select_pin.as_ref());
        cfg.key("data_ready_pin", &self.drdy_pin);
        cfg.key("sample_rate", RATE);
        self.cell.calibration(cfg);
    }
}

/// The meaning of the next bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Talk {
    Command,
    /// The register to start from, and the number of registers to send or to take in.
    Read(usize, u8),
    Write(usize, u8),
}

struct Ads1220 {
    cell: Cell,
    clock: Arc<dyn TimeSource>,
    drdy: Arc<ReadyLine>,
    conversions: Conversions,
    registers: [u8; 4],
    talk: Talk,
    /// The conversion that is being shifted out; the next field counts its remaining bytes.
    data: [u8; 3],
    left: usize,
    /// Number of readings so far.
    readings: u64,
}

impl Ads1220 {
    fn new(cell: Cell, drdy: Arc<ReadyLine>, clock: Arc<dyn TimeSource>) -> Ads1220 {
        Ads1220 {
            cell,
            clock,
            drdy,
            conversions: Conversions::NONE,
            registers: [0; 4],
            talk: Talk::Command,
            data: [0; 3],
            left: 0,
            readings: 0,
        }
    }

    /// Starts the conversions.
    fn begin(&mut self) {
        let [_, second, ..] = self.registers;
        let mode = usize::from(second >> 3 & 3).min(2);
        let rate = RATES[usize::from(second >> 5).min(RATES.len() - 1)][mode];
        let period = f64::from(CLOCK_FREQ) / rate;
        let first = Clock::from_ticks(self.clock.now().ticks() + period as u64);
        self.set(Conversions { first, period, seen: 0, reported: true });
    }

    fn set(&mut self, conversions: Conversions) {
        self.conversions = conversions;
        self.drdy.set(conversions);
    }

    /// Number of finished conversions. In single-shot mode it is at most one.
    fn over(&self) -> u64 {
        let over = self.conversions.over(self.clock.now());
        let goes_on = self.registers[1] & 4 != 0;
        if goes_on { over } else { over.min(1) }
    }

    /// Latches the waiting conversion.
    fn latch(&mut self) {
        let over = self.over();
        if over <= self.conversions.seen {
            return;
        }
        self.readings += 1;
        let gain = f64::from(1u8 << (self.registers[0] >> 1 & 7)) / 128.0;
        let gain = match self.registers[0] >> 4 {
            0 => gain,
            6 => -gain,
            _ => 0.0,
        };
        let counts = self.cell.counts(gain, self.readings);
        let [_, data @ ..] = counts.to_be_bytes();
        self.data = data;
        self.left = 3;
        // The line reports a single conversion once.
        let reported = self.registers[1] & 4 != 0;
        self.set(Conversions { seen: over, reported, ..self.conversions });
    }

    fn command(&mut self, byte: u8) {
        let first = usize::from(byte >> 2 & 3);
        let count = (byte & 3) + 1;
        match byte >> 4 {
            0 if byte >> 1 == 1 => self.set(Conversions::NONE),
            0 if byte >> 1 == 3 => {
                self.registers = [0; 4];
                self.left = 0;
                self.set(Conversions::NONE);
            }
            0 if byte >> 1 == 4 => self.begin(),
            2 => self.talk = Talk::Read(first, count),
            4 => self.talk = Talk::Write(first, count),
            // RDATA requests the data, which comes in any case.
            _ => {}
        }
    }
}

impl SpiChip for Ads1220 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == MODE
    }

    fn select(&mut self, _rate_hz: u32) {
        self.talk = Talk::Command;
        self.latch();
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        match self.talk {
            Talk::Read(register, left) => {
                self.talk = if left == 1 { Talk::Command } else { Talk::Read((register + 1) % 4, left - 1) };
                return self.registers[register];
            }
            Talk::Write(register, left) => {
                self.talk = if left == 1 { Talk::Command } else { Talk::Write((register + 1) % 4, left - 1) };
                self.registers[register] = byte;
            }
            Talk::Command => self.command(byte),
        }
        // The data is shifted out at the same time as commands come in. After the data the line is high.
        if self.left == 0 {
            return 0xff;
        }
        self.left -= 1;
        self.data[2 - self.left]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::bed::Bed;
    use pinion_firmware::time::VirtualClock;

    struct Bench {
        clock: VirtualClock,
        drdy: Arc<ReadyLine>,
        chip: Ads1220,
    }

    impl Bench {
        fn new() -> Bench {
            let config = CellConfig {
                stiffness_g_per_mm: 4000.0,
                counts_per_gram: 100.0,
                zero_counts: -300.0,
                weight_g: 128.0,
                noise_counts: 0.0,
            };
            let cell = Cell::over(config, Bed::under(Default::default(), None, None, None));
            let clock = VirtualClock::at(Clock::from_ticks(0));
            let drdy = ReadyLine::new("drdy");
            let chip = Ads1220::new(cell, drdy.clone(), Arc::new(clock.clone()));
            Bench { clock, drdy, chip }
        }

        fn transfer(&mut self, bytes: &[u8]) -> Vec<u8> {
            self.chip.select(256_000);
            let received = bytes.iter().map(|byte| self.chip.exchange(*byte)).collect();
            self.chip.deselect();
            received
        }

        fn wait_us(&mut self, us: u64) {
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + us * 50));
        }

        fn is_ready(&self) -> bool {
            !self.drdy.level(self.clock.now())
        }

        fn sample(&mut self) -> i32 {
            let bytes = self.transfer(&[0; 3]);
            i32::from_be_bytes([bytes[0], bytes[1], bytes[2], 0]) >> 8
        }
    }

    #[test]
    fn registers_are_read_and_written_in_a_row_and_reset() {
        let mut bench = Bench::new();
        assert_eq!(bench.transfer(&[0x43, 1, 2, 3, 4]), [0xff; 5]);
        assert_eq!(bench.transfer(&[0x23, 0, 0, 0, 0])[1..], [1, 2, 3, 4]);
        bench.transfer(&[0x40 | 2 << 2 | 1, 7, 8]);
        assert_eq!(bench.transfer(&[0x20 | 2 << 2 | 1, 0, 0])[1..], [7, 8]);
        bench.transfer(&[0x06]);
        assert_eq!(bench.transfer(&[0x23, 0, 0, 0, 0])[1..], [0; 4]);
    }

    #[test]
    fn conversions_come_at_the_rate_of_the_mode_and_each_is_reported_once() {
        let mut bench = Bench::new();
        bench.wait_us(1_000_000);
        assert!(!bench.is_ready(), "it was not started");
        // Turbo mode, 180 per second, continuous; a gain of 128.
        bench.transfer(&[0x43, 0x0e, 2 << 5 | 2 << 3 | 4, 0, 0]);
        bench.transfer(&[0x08]);
        bench.wait_us(5_555);
        assert!(!bench.is_ready());
        bench.wait_us(1);
        assert!(bench.is_ready());
        assert_eq!(bench.sample(), 12_500);
        assert!(!bench.is_ready());
        assert_eq!(bench.sample(), -1, "the line is high");
        let ready = (0..10_000).filter(|_| {
            bench.wait_us(100);
            bench.is_ready() && bench.sample() == 12_500
        });
        assert_eq!(ready.count(), 180);
    }

    #[test]
    fn gains_inputs_and_single_conversions() {
        let mut bench = Bench::new();
        for (first, counts) in [(0x0e, 12_500), (0x0c, 6_250), (0x00, 98), (0x6e, -12_500), (0x1e, 0)] {
            bench.transfer(&[0x41, first, 0]);
            bench.transfer(&[0x08]);
            bench.wait_us(50_000);
            assert!(bench.is_ready());
            assert_eq!(bench.sample(), counts, "{first:#x}");
            bench.wait_us(500_000);
            assert!(!bench.is_ready(), "one only");
        }
    }
}
