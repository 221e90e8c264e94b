// SPDX-License-Identifier: GPL-3.0-or-later
//! A strip of APA102 lights ("dotstars") on two lines, clock and data, after their data sheet (Shiji
//! APA102: "Series data structure").
//!
//! The strip takes a bit at each rising edge of the clock. A start frame is 32 zeros. A light's frame is three ones, 5
//! bits of brightness, and blue, green, red with 8 bits each. Not simulated: each light passes data on half a clock
//! later, so a host sends ones at the end. Here the last light gets its color with its last bit.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Trouble, check_lights, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::look::{Colour, Look};
use crate::engine::wire::{Kind, Wire, output};
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

/// Bits of a frame.
const FRAME: u32 = 32;
/// The first bits of a light's frame.
const MARK: u32 = 0xe000_0000;
/// Full brightness.
const BRIGHTEST: u32 = 31;

/// A strip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Apa102Config {
    /// For example `dots`.
    pub name: String,
    /// The data line.
    pub data_pin: PinName,
    /// The clock line.
    pub clock_pin: PinName,
    /// How many lights it has.
    pub count: u32,
}

impl Part for Apa102Config {
    fn name(&self) -> String {
        format!("apa102 {}", self.name)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("data_pin", Some(&self.data_pin)), ("clock_pin", Some(&self.clock_pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        check_lights(whose, self.count)?;
        if self.data_pin.inverted || self.clock_pin.inverted {
            return wrong(whose, "data_pin", "klippy's lines to such a strip have no polarity", "remove the `!`");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let strip = Arc::new(Strip::new(self));
        workshop.wire(Some(&self.data_pin), DataPin(strip.clone()));
        workshop.wire(Some(&self.clock_pin), clock_pin(strip.clone()));
        workshop.show(strip);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("dotstar {}", self.name));
        cfg.key("data_pin", &self.data_pin);
        cfg.key("clock_pin", &self.clock_pin);
        cfg.key("chain_count", self.count);
    }
}

/// The lights and their shift register. One thread drives the lines. Any thread may read.
struct Strip {
    name: String,
    data: AtomicBool,
    clocked: AtomicBool,
    /// The last 32 bits; the next field counts the bits that belong to a light's frame.
    shift: AtomicU32,
    bits: AtomicU32,
    /// The light of the next frame; no light before the first start frame.
    next: AtomicU32,
    /// Each light's last frame.
    lights: Vec<AtomicU32>,
}

impl Strip {
    fn new(config: &Apa102Config) -> Strip {
        Strip {
            name: config.name.clone(),
            data: AtomicBool::new(false),
            clocked: AtomicBool::new(false),
            shift: AtomicU32::new(u32::MAX),
            bits: AtomicU32::new(0),
            next: AtomicU32::new(config.count),
            lights: (0..config.count).map(|_| AtomicU32::new(MARK)).collect(),
        }
    }

    /// A rising edge of the clock.
    fn take(&self) {
        let load = |word: &AtomicU32| word.load(Ordering::Relaxed);
        let shift = load(&self.shift) << 1 | u32::from(self.data.load(Ordering::Relaxed));
        self.shift.store(shift, Ordering::Relaxed);
        let bits = load(&self.bits) + 1;
        let (next, bits) = match shift {
            // A start frame, however long.
            0 => (0, 0),
            // A light's frame begins with a one. The zeros before it still belong to the start frame.
            _ if bits == 1 && shift & 1 == 0 => (load(&self.next), 0),
            _ if bits == FRAME => {
                let next = load(&self.next);
                if let Some(light) = self.lights.get(next as usize).filter(|_| shift & MARK == MARK) {
                    light.store(shift, Ordering::Relaxed);
                }
                (next.saturating_add(1), 0)
            }
            _ => (load(&self.next), bits),
        };
        self.next.store(next, Ordering::Relaxed);
        self.bits.store(bits, Ordering::Relaxed);
    }
}

impl Sight for Strip {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, _now: Clock) -> Look {
        let lights = self.lights.iter().map(|light| {
            let [head, blue, green, red] = light.load(Ordering::Relaxed).to_be_bytes();
            let dimmed = |part: u8| (u32::from(part) * u32::from(head & 0x1f) / BRIGHTEST) as u8;
            Colour { red: dimmed(red), green: dimmed(green), blue: dimmed(blue), white: 0 }
        });
        Look::Lights { colours: lights.collect(), odd_pulses: 0 }
    }
}

/// The data line. klippy also names it as its input, where nothing answers.
struct DataPin(Arc<Strip>);

impl Wire for DataPin {
    fn kind(&self) -> Kind {
        Kind::Shared
    }

    fn describe(&self) -> String {
        format!("data of lights {}", self.0.name)
    }

    fn drive(&self, on: bool, _at: Clock) {
        self.0.data.store(on, Ordering::Relaxed);
    }
}

/// The clock line.
fn clock_pin(strip: Arc<Strip>) -> impl Wire {
    output(format!("clock of lights {}", strip.name), move |on, _| {
        if on && !strip.clocked.swap(on, Ordering::Relaxed) {
            strip.take();
        }
        strip.clocked.store(on, Ordering::Relaxed);
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strip(count: u32) -> Arc<Strip> {
        let pin = |name: &str| PinName::try_from(name.to_owned()).unwrap();
        let config = Apa102Config { name: "dots".into(), data_pin: pin("d"), clock_pin: pin("c"), count };
        Arc::new(Strip::new(&config))
    }

    fn send(strip: &Arc<Strip>, words: &[u32]) {
        let at = Clock::from_ticks(0);
        let (data, clock) = (DataPin(strip.clone()), clock_pin(strip.clone()));
        for bit in words.iter().flat_map(|word| (0..32).rev().map(move |bit| word >> bit & 1 != 0)) {
            data.drive(bit, at);
            clock.drive(true, at);
            clock.drive(false, at);
        }
    }

    #[test]
    fn lights_take_their_frames_after_a_start_frame() {
        let strip = strip(3);
        let look = || strip.look(Clock::from_ticks(0)).to_string();
        send(&strip, &[0xff03_0201, 0, 0xff03_0201, 0xff00_0000, 0xf0ff_00ff, 0xff44_4444, u32::MAX]);
        assert_eq!(look(), "#010203 off #830083", "the last one at 16 of 31, and a fourth that is not there");
        // Black at the lowest brightness is not a start frame. A frame without its mark is not a light's frame.
        send(&strip, &[0, 0xe000_0000, 0x9fff_ffff, 0xffff_ffff, u32::MAX]);
        assert_eq!(look(), "off off #ffffff");
    }

    #[test]
    fn a_start_frame_may_be_longer() {
        let strip = strip(1);
        send(&strip, &[0, 0, 0x0000_07f8, 0x0810_1807]);
        assert_eq!(strip.look(Clock::from_ticks(0)).to_string(), "#030201", "21 zeros more");
    }
}
