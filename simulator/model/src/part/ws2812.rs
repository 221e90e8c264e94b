// SPDX-License-Identifier: GPL-3.0-or-later
//! A strip of WS2812B lights ("neopixels") on the data output (MOSI) of an SPI bus, after their data
//! sheet (Worldsemi WS2812B: "Data transfer time", "Sequence chart", "Cascade method").
//!
//! A bit is a pulse: 0.4 us high for 0, 0.8 us for 1, each within 0.15 us. Each light keeps the first bits that it
//! receives and passes on the rest. When the line has been low for 50 us, all lights show their bits. The strip hears
//! everything on its bus, at the bus's rate, even transfers for other devices.
//!
//! A pulse outside the data sheet's tolerance counts as the nearer value. The display of the colors mentions these
//! pulses, because real strips differ in how they read them.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Trouble, check_lights, wrong};
use crate::description::printer::Printer;
use crate::engine::look::{Colour, Look};
use crate::engine::spi::MosiListener;
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// High times of a 0 and of a 1 (T0H, T1H), and how far they may be off.
const ZERO_HIGH_NS: f64 = 400.0;
const ONE_HIGH_NS: f64 = 800.0;
const TOLERANCE_NS: f64 = 150.0;
/// Shortest low times after a 0 and after a 1 (T0L, T1L). A longer one is a pause.
const ZERO_LOW_NS: f64 = 850.0 - TOLERANCE_NS;
const ONE_LOW_NS: f64 = 450.0 - TOLERANCE_NS;
/// How long the line must be low before the lights show their bits (RES).
const RESET_NS: f64 = 50_000.0;

/// A strip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ws2812Config {
    /// For example `strip`.
    pub name: String,
    /// The SPI bus with the data output for this strip.
    pub bus: String,
    /// How many lights it has.
    pub count: u32,
    /// The order in which a light receives its colors: letters of `RGB` or `RGBW`.
    #[serde(default = "default_color_order")]
    pub color_order: String,
}

fn default_color_order() -> String {
    "GRB".into()
}

impl Part for Ws2812Config {
    fn name(&self) -> String {
        format!("ws2812 {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Mosi { bus: &self.bus })
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        check_lights(whose, self.count)?;
        let mut letters: Vec<char> = self.color_order.chars().collect();
        letters.sort_unstable();
        if letters != ['B', 'G', 'R'] && letters != ['B', 'G', 'R', 'W'] {
            let cause = format!("`{}` is not an order of colors", self.color_order);
            return wrong(whose, "color_order", &cause, "such as GRB or GRBW");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let strip = Arc::new(Strip::new(self));
        workshop.listen(self, Input { strip: strip.clone(), clock: workshop.clock.clone() });
        workshop.show(strip);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("neopixel {}", self.name));
        cfg.key("pin", &self.bus);
        cfg.key("chain_count", self.count);
        cfg.key("color_order", &self.color_order);
    }
}

/// The lights, and their view of the line.
struct Strip {
    name: String,
    color_order: Vec<u8>,
    state: Mutex<State>,
}

struct State {
    lights: Vec<Colour>,
    /// Number of pulses outside the data sheet's tolerance in the colors that are shown.
    odd_pulses: u32,
    /// The line's level, how long it has lasted, and the time up to which that is known.
    high: bool,
    level_ns: f64,
    until: Clock,
    /// The last pulse was a 1.
    one: bool,
    /// The bits received since the last reset; the next field counts them.
    taken: Vec<u8>,
    bits: usize,
    odd: u32,
}

impl Strip {
    fn new(config: &Ws2812Config) -> Strip {
        // The limits of the description keep this small.
        let count = config.count as usize;
        let state = State {
            lights: vec![Colour::default(); count],
            odd_pulses: 0,
            high: false,
            level_ns: RESET_NS,
            until: Clock::from_ticks(0),
            one: false,
            taken: vec![0; count * config.color_order.len()],
            bits: 0,
            odd: 0,
        };
        Strip {
            name: config.name.clone(),
            color_order: config.color_order.clone().into_bytes(),
            state: Mutex::new(state),
        }
    }

    /// The lights at this instant. Only workers and viewers wait here.
    fn at(&self, now: Clock) -> MutexGuard<'_, State> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        // An idle output stays at the level of its last bit.
        let rest = now.since(state.until).max(0) as f64;
        if rest > 0.0 {
            state.level_ns += rest * 1e9 / f64::from(CLOCK_FREQ);
            state.until = now;
        }
        state.take_over(&self.color_order);
        state
    }

    /// The line has a level for this time.
    fn level(&self, state: &mut State, high: bool, ns: f64) {
        if state.high == high {
            state.level_ns += ns;
        } else {
            if state.high {
                state.pulse_ends()
            } else {
                state.pulse_begins()
            }
            (state.high, state.level_ns) = (high, ns);
        }
        state.take_over(&self.color_order);
    }
}

impl State {
    fn pulse_begins(&mut self) {
        let least_ns = if self.one { ONE_LOW_NS } else { ZERO_LOW_NS };
        self.odd += u32::from(self.bits > 0 && self.level_ns < least_ns);
    }

    fn pulse_ends(&mut self) {
        let off = |nominal_ns: f64| (self.level_ns - nominal_ns).abs();
        self.one = off(ONE_HIGH_NS) < off(ZERO_HIGH_NS);
        self.odd += u32::from(off(ZERO_HIGH_NS).min(off(ONE_HIGH_NS)) > TOLERANCE_NS);
        // Surplus bits leave the strip at its end.
        if let Some(byte) = self.taken.get_mut(self.bits / 8) {
            *byte = *byte << 1 | u8::from(self.one);
            self.bits += 1;
        }
    }

    /// If the line has been low for long enough, the lights with all of their bits show them.
    fn take_over(&mut self, color_order: &[u8]) {
        if self.high || self.level_ns < RESET_NS || self.bits == 0 {
            return;
        }
        let whole = self.bits / 8 / color_order.len();
        for (light, bytes) in self.lights.iter_mut().zip(self.taken.chunks(color_order.len())).take(whole) {
            for (part, value) in color_order.iter().zip(bytes) {
                match part {
                    b'R' => light.red = *value,
                    b'G' => light.green = *value,
                    b'B' => light.blue = *value,
                    _ => light.white = *value,
                }
            }
        }
        (self.odd_pulses, self.odd, self.bits) = (self.odd, 0, 0);
    }
}

impl Sight for Strip {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, now: Clock) -> Look {
        let state = self.at(now);
        Look::Lights { colours: state.lights.clone(), odd_pulses: state.odd_pulses }
    }
}

/// The strip's end of the data line.
struct Input {
    strip: Arc<Strip>,
    clock: Arc<dyn TimeSource>,
}

impl MosiListener for Input {
    fn hear(&mut self, rate_hz: u32, bytes: &[u8]) {
        let mut state = self.strip.at(self.clock.now());
        let bit_ns = 1e9 / f64::from(rate_hz.max(1));
        for bit in bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 != 0)) {
            self.strip.level(&mut state, bit, bit_ns);
        }
        // The simulated bus needs no time for its bits, but a real one does.
        let took = bytes.len() as f64 * 8.0 * bit_ns * f64::from(CLOCK_FREQ) / 1e9;
        state.until = Clock::from_ticks(state.until.ticks().saturating_add(took as u64));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::VirtualClock;

    struct Bench {
        clock: VirtualClock,
        input: Input,
    }

    impl Bench {
        fn new(count: u32, color_order: &str) -> Bench {
            let clock = VirtualClock::at(Clock::from_ticks(1_000_000));
            let config =
                Ws2812Config { name: "strip".into(), bus: "spi".into(), count, color_order: color_order.into() };
            let strip = Arc::new(Strip::new(&config));
            Bench { input: Input { strip, clock: Arc::new(clock.clone()) }, clock }
        }

        /// Sends pulses at 20 MHz. Each has a high and a low time in units of 50 ns.
        fn pulses(&mut self, pulses: impl Iterator<Item = (usize, usize)>) {
            let bits: Vec<u8> = pulses.flat_map(|(high, low)| [vec![1; high], vec![0; low]].concat()).collect();
            let bytes: Vec<u8> = bits
                .chunks(8)
                .map(|chunk| chunk.iter().zip((0..8).rev()).fold(0, |byte, (bit, place)| byte | bit << place))
                .collect();
            self.input.hear(20_000_000, &bytes);
        }

        /// Sends bytes with the data sheet's timing.
        fn send(&mut self, bytes: &[u8]) {
            let bits = bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 != 0));
            self.pulses(bits.map(|one| if one { (16, 9) } else { (8, 17) }));
        }

        fn wait_us(&self, us: u64) {
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + us * u64::from(CLOCK_FREQ) / 1_000_000));
        }

        fn look(&self) -> String {
            self.input.strip.look(self.clock.now()).to_string()
        }
    }

    #[test]
    fn lights_take_what_is_theirs_and_show_it_after_a_reset() {
        let mut bench = Bench::new(2, "GRB");
        assert_eq!(bench.look(), "off off");
        bench.send(&[0x20, 0x10, 0x30, 0x02, 0x01, 0x03, 0xff, 0xff, 0xff]);
        // 72 bits of 1.25 us, and less than 50 us.
        bench.wait_us(90 + 45);
        assert_eq!(bench.look(), "off off");
        bench.wait_us(6);
        assert_eq!(bench.look(), "#102030 #010203");
        // A message for the first light only.
        bench.send(&[0, 0xff, 0]);
        bench.wait_us(500);
        assert_eq!(bench.look(), "#ff0000 #010203");
    }

    #[test]
    fn a_pause_is_no_reset_and_half_a_light_shows_nothing() {
        let mut bench = Bench::new(2, "GRB");
        bench.send(&[1, 2]);
        bench.wait_us(20 + 40);
        bench.send(&[3, 4, 5]);
        bench.wait_us(1000);
        assert_eq!(bench.look(), "#020103 off");
    }

    #[test]
    fn a_white_part_and_a_reset_within_one_message() {
        let mut bench = Bench::new(1, "RGBW");
        bench.send(&[1, 2, 3, 4]);
        // 60 us low, and then other colors, which are not shown yet.
        bench.pulses([(0, 1200)].into_iter());
        bench.send(&[5, 6, 7, 8]);
        assert_eq!(bench.look(), "#010203+04");
    }

    #[test]
    fn the_edges_of_the_data_sheets_times() {
        for (pulse, one, odd) in [
            ((5, 20), false, 0),
            ((11, 14), false, 0),
            ((13, 12), true, 0),
            ((19, 6), true, 0),
            ((4, 20), false, 24),
            ((20, 12), true, 24),
            // A low time before the next pulse that is too short. There are 23 of them.
            ((8, 13), false, 23),
            ((16, 5), true, 23),
        ] {
            let mut bench = Bench::new(1, "GRB");
            bench.pulses(std::iter::repeat_n(pulse, 24));
            bench.wait_us(1000);
            let light = if one { "#ffffff" } else { "off" };
            let odd_pulses = format!(" ({odd} pulses are not the data sheet's)");
            assert_eq!(bench.look(), format!("{light}{}", if odd > 0 { &odd_pulses } else { "" }), "{pulse:?}");
        }
    }

    #[test]
    fn what_a_bus_says_to_another_chip_shows_as_colours() {
        let mut bench = Bench::new(1, "GRB");
        bench.input.hear(1_000_000, &[0xaa; 6]);
        bench.wait_us(1000);
        assert_eq!(bench.look(), "#ffffff (24 pulses are not the data sheet's)");
    }
}
