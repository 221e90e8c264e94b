// SPDX-License-Identifier: GPL-3.0-or-later
//! The load cell ADCs HX711 and HX717 (Avia Semiconductor's data sheets, "Serial Interface" and "Reset and
//! Power-Down Sequence").
//!
//! The data line goes low when a conversion is ready. 24 pulses of the clock shift out its bits, the highest first. One
//! to four more pulses set the data line high and choose channel and gain of the next conversion. If the clock is high
//! for more than 60 us, the chip powers down. When the clock falls, the chip starts again with channel A and its
//! highest gain. It is ready after it has settled for four conversions.
//!
//! On an SPI bus, the data output (MOSI) is the clock and the data input (MISO) the data. The bus's clock times the
//! pulses.
//!
//! Simulated: all of this, by the clock. The chip shifts out the cell's load at the first pulse, not at the end of the
//! conversion before. Channel B is not connected and reads noise. The settling after a change of the gain is omitted.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::load_cell::{Cell, CellConfig};
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Trouble, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::seqlock::Seqlock;
use crate::engine::spi::{MISO, SpiChip};
use crate::engine::time::seconds;
use crate::engine::wire::{ControllerPin, Kind, Wire, input, output};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// Longest high pulse of the clock before the chip powers down.
const POWER_DOWN_S: f64 = 60e-6;
const SAMPLE_BITS: u64 = 24;
/// Number of conversions that the chip needs to settle after a start.
const SETTLING: u64 = 4;

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hx71xConfig {
    /// Which of the two it is.
    pub chip: Hx71xChip,
    /// Its data line.
    pub dout_pin: Option<PinName>,
    /// Its clock line.
    pub sclk_pin: Option<PinName>,
    /// An SPI bus with data lines for it, in place of the two pins. It has no other chip.
    pub bus: Option<String>,
    /// The rate that its pins are wired to.
    pub samples_per_s: u32,
    /// The load cell.
    pub cell: CellConfig,
}

/// The two chips.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hx71xChip {
    /// 10 or 80 samples a second.
    Hx711,
    /// 10, 20, 80 or 320 samples a second.
    Hx717,
}

impl Hx71xChip {
    fn name(self) -> &'static str {
        match self {
            Hx71xChip::Hx711 => "hx711",
            Hx71xChip::Hx717 => "hx717",
        }
    }

    fn rates(self) -> &'static [u32] {
        match self {
            Hx71xChip::Hx711 => &[10, 80],
            Hx71xChip::Hx717 => &[10, 20, 80, 320],
        }
    }

    /// The gain that this number of extra pulses chooses, relative to the highest gain; 0 for channel B.
    fn gain(self, pulses: u64) -> f64 {
        match (self, pulses) {
            (_, 3) => 0.5,
            (_, 2 | 4) => 0.0,
            _ => 1.0,
        }
    }
}

impl Part for Hx71xConfig {
    fn name(&self) -> String {
        self.chip.name().into()
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("dout_pin", self.dout_pin.as_ref()), ("sclk_pin", self.sclk_pin.as_ref())]
    }

    fn socket(&self) -> Option<Socket<'_>> {
        self.bus.as_ref().map(|bus| Socket::Spi { bus, select_pin: None })
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        if !self.chip.rates().contains(&self.samples_per_s) {
            let cause = format!("{} is not a rate of the chip", self.samples_per_s);
            return wrong(whose, "samples_per_s", &cause, &format!("give one of {:?}", self.chip.rates()));
        }
        for (key, pin) in self.pins() {
            match (pin, &self.bus) {
                (None, None) => return wrong(whose, key, "it has none", "add it, or `bus`"),
                (Some(_), Some(_)) => return wrong(whose, key, "it also has a bus", "remove one of them"),
                _ => {}
            }
        }
        self.cell.validate(whose)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let cell = Cell::new(&self.cell, workshop, self);
        let chip = Arc::new(Hx71x::new(self.chip, self.samples_per_s, cell));
        if let Some(bus) = &self.bus {
            let pin = PinName { name: format!("{bus}{MISO}"), inverted: false };
            workshop.wire(Some(&pin), ControllerPin { kind: Kind::Miso, of: bus.clone() });
            let clock = workshop.clock.clone();
            let now = clock.now();
            workshop.solder_spi(self, OnSpi { chip, clock, bit: 0.0, at: now });
            return Ok(());
        }
        workshop.wire(self.dout_pin.as_ref(), dout_pin(chip.clone()));
        workshop.wire(self.sclk_pin.as_ref(), sclk_pin(chip));
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        let keys = |cfg: &mut Sections| {
            cfg.key("sensor_type", self.chip.name());
            cfg.key_if("dout_pin", self.dout_pin.as_ref());
            cfg.key_if("sclk_pin", self.sclk_pin.as_ref());
            cfg.key_if("dout_pin", self.bus.as_ref().map(|bus| format!("{bus}{MISO}")));
            cfg.key_if("sclk_pin", self.bus.as_ref());
            cfg.key("sample_rate", self.samples_per_s);
            self.cell.calibration(cfg);
        };
        cfg.section("load_cell");
        keys(cfg);
        cfg.probe(layout, |cfg| {
            cfg.section("load_cell_probe");
            cfg.comment("Takes the place of [load_cell], too. The nozzle is the probe.");
            keys(cfg);
            cfg.key("z_offset", 0);
        });
    }
}

/// The state that the clock line has set. Only the thread that drives the line changes it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    /// Whether the clock is high, and since when.
    high: bool,
    rise: Clock,
    /// When the chip started to convert.
    start: Clock,
    /// Number of conversions that were read or skipped.
    taken: u64,
    /// Pulses since the start of the last sample; 0 after a power-up.
    pulses: u64,
    /// The number of extra pulses that chose the gain of the sample: 1 to 4.
    gain: u64,
    sample: u32,
}

impl State {
    fn words(self) -> [u64; 5] {
        let small = u64::from(self.high) | self.gain << 1 | self.pulses << 4;
        [small, self.rise.ticks(), self.start.ticks(), self.taken, self.sample.into()]
    }

    fn of([small, rise, start, taken, sample]: [u64; 5]) -> State {
        State {
            high: small & 1 != 0,
            rise: Clock::from_ticks(rise),
            start: Clock::from_ticks(start),
            taken,
            pulses: small >> 4,
            gain: small >> 1 & 7,
            sample: sample as u32,
        }
    }
}

struct Hx71x {
    chip: Hx71xChip,
    samples_per_s: f64,
    cell: Cell,
    state: Seqlock<5>,
}

impl Hx71x {
    fn new(chip: Hx71xChip, samples_per_s: u32, cell: Cell) -> Hx71x {
        let start = Clock::from_ticks(0);
        let state = State { high: false, rise: start, start, taken: 0, pulses: 0, gain: 1, sample: 0 };
        Hx71x { chip, samples_per_s: samples_per_s.into(), cell, state: Seqlock::new(state.words()) }
    }

    /// Number of finished conversions since the start that were not taken.
    fn waiting(&self, state: &State, at: Clock) -> u64 {
        let conversions = (seconds(state.start, at) * self.samples_per_s) as u64;
        conversions.saturating_sub(SETTLING - 1).saturating_sub(state.taken)
    }

    fn is_off(state: &State, at: Clock) -> bool {
        state.high && seconds(state.rise, at) > POWER_DOWN_S
    }

    /// The clock line gets a level.
    fn clock(&self, high: bool, at: Clock) {
        let mut state = State::of(self.state.load());
        if high == state.high {
            return;
        }
        if high {
            state.rise = at;
            self.pulse(&mut state, at);
        } else if Hx71x::is_off(&state, at) {
            state = State { start: at, taken: 0, pulses: 0, gain: 1, ..state };
        }
        state.high = high;
        self.state.store(state.words());
    }

    fn pulse(&self, state: &mut State, at: Clock) {
        let is_over = state.pulses == 0 || state.pulses > SAMPLE_BITS;
        let waiting = self.waiting(state, at);
        if is_over && waiting > 0 {
            if state.pulses > 0 {
                state.gain = (state.pulses - SAMPLE_BITS).min(4);
            }
            state.pulses = 0;
            state.taken += waiting;
            let gain = self.chip.gain(state.gain);
            state.sample = self.cell.counts(gain, state.start.ticks().wrapping_add(state.taken)) as u32;
        } else if state.pulses == 0 {
            // No conversion is ready to shift out.
            return;
        }
        // Further pulses only keep the line high.
        state.pulses = (state.pulses + 1).min(SAMPLE_BITS + 4);
    }

    /// The data line.
    fn data(&self, at: Clock) -> bool {
        let state = State::of(self.state.load());
        match state.pulses {
            _ if Hx71x::is_off(&state, at) => true,
            1..=SAMPLE_BITS => state.sample >> (SAMPLE_BITS - state.pulses) & 1 != 0,
            _ => self.waiting(&state, at) == 0,
        }
    }
}

/// The data line.
fn dout_pin(chip: Arc<Hx71x>) -> impl Wire {
    input(format!("data of {}", chip.chip.name()), move |at| chip.data(at))
}

/// The clock line.
fn sclk_pin(chip: Arc<Hx71x>) -> impl Wire {
    output(format!("clock of {}", chip.chip.name()), move |on, at| chip.clock(on, at))
}

/// The chip on an SPI bus. The bus's bits have this length in ticks. The next bit begins at or after `at`.
struct OnSpi {
    chip: Arc<Hx71x>,
    clock: Arc<dyn TimeSource>,
    bit: f64,
    at: Clock,
}

impl SpiChip for OnSpi {
    /// The clock line of the bus does not lead to the chip.
    fn knows_mode(&self, _mode: u8) -> bool {
        true
    }

    fn select(&mut self, rate_hz: u32) {
        self.bit = f64::from(CLOCK_FREQ) / f64::from(rate_hz.max(1));
        // The simulated bus needs no time for its bits, but a real one does.
        self.at = self.at.max(self.clock.now());
    }

    /// The output gets its level at the beginning of each bit. The input is read in its middle, as in mode 0.
    fn exchange(&mut self, byte: u8) -> u8 {
        let begin = self.at.ticks();
        let at = |bits: f64| Clock::from_ticks(begin + (bits * self.bit) as u64);
        let received = (0..8).fold(0, |received, place| {
            self.chip.clock(byte >> (7 - place) & 1 != 0, at(f64::from(place)));
            received << 1 | u8::from(self.chip.data(at(f64::from(place) + 0.5)))
        });
        self.at = at(8.0);
        received
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::bed::Bed;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::VirtualClock;

    struct Bench {
        z: Arc<Axis>,
        chip: Hx71x,
        now: Clock,
    }

    const COUNTS_PER_GRAM: f64 = 100.0;

    impl Bench {
        fn new(weight_g: f64, noise_counts: f64) -> Bench {
            let z = Arc::new(Axis::new(&DefaultPrinter::read().axes[2]));
            z.set_enabled(true);
            let config = CellConfig {
                stiffness_g_per_mm: 4000.0,
                counts_per_gram: COUNTS_PER_GRAM,
                zero_counts: -5000.0,
                weight_g,
                noise_counts,
            };
            let cell = Cell::over(config, Bed::under(Default::default(), None, None, Some(z.clone())));
            Bench { z, chip: Hx71x::new(Hx71xChip::Hx711, 80, cell), now: Clock::from_ticks(0) }
        }

        fn wait(&mut self, seconds: f64) {
            self.now = Clock::from_ticks(self.now.ticks() + (seconds * f64::from(CLOCK_FREQ)).round() as u64);
        }

        fn is_ready(&self) -> bool {
            !self.chip.data(self.now)
        }

        /// The bits that these pulses shift out, the last one lowest.
        fn shift(&mut self, pulses: u32) -> u32 {
            (0..pulses).fold(0, |bits, _| {
                self.chip.clock(true, self.now);
                self.wait(1e-6);
                self.chip.clock(false, self.now);
                let bit = self.chip.data(self.now);
                self.wait(1e-6);
                bits << 1 | u32::from(bit)
            })
        }

        /// The next sample, read with 24 pulses and `further` more.
        fn sample(&mut self, further: u32) -> i32 {
            while !self.is_ready() {
                self.wait(1e-4);
            }
            let bits = self.shift(24 + further);
            assert_eq!(bits & ((1 << further) - 1), (1 << further) - 1, "the line is high after the sample");
            ((bits >> further) << 8) as i32 >> 8
        }
    }

    #[test]
    fn conversions_come_at_the_chip_s_rate_after_it_has_settled() {
        let mut bench = Bench::new(0.0, 0.0);
        bench.wait(0.0499);
        assert!(!bench.is_ready());
        assert_eq!(bench.shift(3), 7, "nothing to shift out");
        bench.wait(0.0002);
        assert!(bench.is_ready());
        assert_eq!(bench.sample(1), -5000);
        assert!(!bench.is_ready());
        bench.wait(0.0120);
        assert!(!bench.is_ready());
        bench.wait(0.0005);
        assert!(bench.is_ready());
        // The next sample replaces an unread one.
        bench.wait(0.1);
        bench.sample(1);
        assert!(!bench.is_ready());
    }

    #[test]
    fn it_counts_the_weight_and_the_nozzle_in_the_bed() {
        let mut bench = Bench::new(250.0, 0.0);
        let zero = -5000 + 250 * 100;
        assert_eq!(bench.sample(1), zero);
        // From 12 mm to 0.1 mm below the bed.
        bench.z.set_forward(false);
        for _ in 0..4840 {
            bench.z.edge(true, bench.now);
        }
        assert_eq!(bench.sample(1), zero + 40_000);
        bench.z.set_forward(true);
        for _ in 0..40 {
            bench.z.edge(true, bench.now);
        }
        assert_eq!(bench.sample(1), zero);
    }

    #[test]
    fn further_pulses_choose_the_gain_of_the_next_sample() {
        let mut bench = Bench::new(0.0, 0.0);
        assert_eq!(bench.sample(3), -5000);
        assert_eq!(bench.sample(2), -2500);
        assert_eq!(bench.sample(1), 0, "channel B");
        assert_eq!(bench.sample(1), -5000);
    }

    #[test]
    fn a_clock_that_stays_high_switches_it_off_and_a_falling_one_starts_it_anew() {
        let mut bench = Bench::new(0.0, 0.0);
        bench.sample(3);
        bench.chip.clock(true, bench.now);
        bench.wait(1.0);
        assert!(!bench.is_ready(), "off");
        bench.chip.clock(false, bench.now);
        bench.wait(0.0499);
        assert!(!bench.is_ready(), "it settles");
        bench.wait(0.0002);
        assert!(bench.is_ready());
        assert_eq!(bench.sample(1), -5000, "the highest gain again");
        // In the middle of a sample.
        while !bench.is_ready() {
            bench.wait(1e-4);
        }
        bench.shift(5);
        bench.chip.clock(true, bench.now);
        bench.wait(70e-6);
        bench.chip.clock(false, bench.now);
        assert_eq!(bench.shift(20), (1 << 20) - 1, "all ones");
    }

    #[test]
    fn a_reading_beyond_the_range_stays_at_its_end_and_noise_is_seeded() {
        assert_eq!(Bench::new(1e6, 0.0).sample(1), 0x7f_ffff);
        assert_eq!(Bench::new(-1e6, 0.0).sample(1), -0x80_0000);
        let readings = || {
            let mut bench = Bench::new(0.0, 50.0);
            (0..200).map(|_| bench.sample(1)).collect::<Vec<i32>>()
        };
        let (some, same) = (readings(), readings());
        assert_eq!(some, same);
        let mean = some.iter().sum::<i32>() as f64 / 200.0;
        let variance = some.iter().map(|value| (f64::from(*value) - mean).powi(2)).sum::<f64>() / 200.0;
        assert!((mean + 5000.0).abs() < 15.0, "{mean}");
        assert!((30.0..70.0).contains(&variance.sqrt()), "{}", variance.sqrt());
    }

    #[test]
    fn a_state_is_the_same_after_it_was_stored() {
        let at = Clock::from_ticks;
        let state = State { high: true, rise: at(7), start: at(9), taken: 5, pulses: 28, gain: 4, sample: 0xff_1234 };
        assert_eq!(State::of(state.words()), state);
    }

    /// Pulses of one bit at 500 kHz, and a clock that stays high.
    #[test]
    fn on_an_spi_bus_the_data_output_is_its_clock() {
        let Bench { chip, .. } = Bench::new(0.0, 0.0);
        let clock = VirtualClock::at(Clock::from_ticks(0));
        let time = Arc::new(clock.clone());
        let mut spi = OnSpi { chip: Arc::new(chip), clock: time, bit: 0.0, at: Clock::from_ticks(0) };
        let mut exchange = |ms: u64, sent: &[u8]| {
            clock.set(Clock::from_ticks(ms * u64::from(CLOCK_FREQ) / 1000));
            spi.select(500_000);
            sent.iter().map(|byte| spi.exchange(*byte)).collect::<Vec<u8>>()
        };
        const WAVE: [u8; 7] = [0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0x80];
        assert_eq!(exchange(49, &[0]), [0xff], "it settles");
        assert_eq!(exchange(51, &[0]), [0]);
        // -5000 is FFEC78. Each bit is there twice. The last bits are those behind the pulses.
        assert_eq!(exchange(52, &WAVE), [0xff, 0xff, 0xfc, 0xf0, 0x3f, 0xc0, 0xff]);
        assert_eq!(exchange(53, &[0]), [0xff]);
        assert_eq!(exchange(64, &[0]), [0]);
        exchange(65, &[0xff; 8]);
        assert_eq!(exchange(66, &[0]), [0xff], "off, and started again");
        assert_eq!(exchange(115, &[0]), [0xff]);
        assert_eq!(exchange(117, &[0]), [0]);
    }
}
