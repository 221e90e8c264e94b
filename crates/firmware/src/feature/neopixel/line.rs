// SPDX-License-Identifier: GPL-3.0-or-later
//! WS2812 LEDs on a GPIO line, pulse by pulse.
//!
//! The times are those of the firmware's src/neopixel.c, which says what chips really need: a short pulse below 500 ns,
//! a long one above 650 ns, 5 us from pulse to pulse at most, 1.25 us on average, 200 ns between two edges. The firmware
//! shuts out interrupts during a pulse. A program on Linux cannot. So each pulse is measured by the clock. The clock is
//! read before and after each edge. So a pulse is surely longer than its shortest time and shorter than its longest. If a
//! pulse missed its times, the frame is broken off, and sent again after the reset time. Until
//! then the LEDs may show wrong colors.
//!
//! A call of the kernel takes longer than a short pulse. So a line without registers is refused.

#![forbid(unsafe_code)]

use std::sync::Arc;

use log::warn;

use crate::board::{Line, Pin};
use crate::feature::pace::Pace;
use crate::mcu::Mcu;
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, Ticks};

use super::INVALID_SIZE;

/// All chains on lines share this worker.
pub(super) const WORKER: &str = "neopixel";
/// Highest number of bytes in a chain: klippy's limit (`MAX_MCU_SIZE` of neopixel.py). A frame takes 5 ms, and 20 ms at
/// most. For this long the worker keeps its processor busy.
const SIZE_MAX: usize = 500;
/// Shortest time that the line is high for a 0: 220 ns (Worldsemi WS2812B-V5, "Data transfer time": T0H). The clock
/// counts full ticks, so that the real time may be one tick shorter.
const SHORT: Ticks = Ticks(12);
/// Longest time that the line may be high for a 0: 500 ns. The real time may be one tick longer.
const SHORT_MAX: Ticks = Ticks(24);
/// Shortest time that the line is high for a 1: 780 ns.
const LONG: Ticks = Ticks(40);
/// Shortest time from pulse to pulse: 1.26 us.
const BIT_MIN: Ticks = Ticks(63);
/// Shortest time that the line is low between two pulses: 200 ns.
const LOW_MIN: Ticks = Ticks(11);
/// Longest time from pulse to pulse, whatever the host allows: 4.9 us.
const BIT_MAX: Ticks = Ticks(245);
/// How often a frame is sent if pulses missed their times. klippy itself sends it eight times.
const TRIES: u32 = 3;

/// Sends frames.
pub(super) struct Pulses {
    line: Arc<dyn Line>,
    pace: Pace,
    /// Longest time from pulse to pulse.
    bit_max: Ticks,
    /// How long the line is low between two frames.
    reset: Ticks,
    /// When the LEDs have taken the last frame.
    free_at: Clock,
    /// The line's name in the log.
    name: String,
    /// Whether the log already has a line about frames that missed their times.
    told: bool,
}

impl Pulses {
    /// # Errors
    ///
    /// "Not an output pin" if the line has no registers, "Invalid neopixel data_size".
    pub(super) fn new(
        mcu: &Mcu,
        pin: Pin,
        line: Arc<dyn Line>,
        size: usize,
        bit_max: Ticks,
        reset: Ticks,
    ) -> Result<Pulses, Shutdown> {
        let name = mcu.name(pin);
        if !line.is_fast() {
            let cause = format!("{name} cannot drive LEDs: their pulses are too short for a program on Linux");
            return Err(Shutdown::because(reason::NOT_OUTPUT, cause).remedy(
                "connect them to the data output (MOSI) of an SPI controller and name its device, such as \"pin: spidev0.0\", or to a line that is written through registers (pinion pins lists them)",
            ));
        }
        if size > SIZE_MAX {
            let cause = format!("a chain of {size} bytes is too long for a line, which takes {SIZE_MAX}");
            return Err(Shutdown::because(INVALID_SIZE, cause).remedy("lower chain_count").of(&name));
        }
        let pace = Pace::new(mcu);
        let free_at = pace.now() + reset;
        Ok(Pulses { line, pace, bit_max: bit_max.min(BIT_MAX), reset, free_at, name, told: false })
    }

    /// Sends the colors. False if no try had its times.
    pub(super) fn send(&mut self, colors: &[u8]) -> Result<bool, Shutdown> {
        for _ in 0..TRIES {
            self.pace.until(self.free_at);
            // A byte takes eight bits, and some.
            self.pace.until_between_ticks(Ticks(10 * BIT_MIN.0 * colors.len() as u32));
            let sent = self.frame(colors);
            self.line.write(false)?;
            self.free_at = self.pace.now() + self.reset;
            if sent? {
                return Ok(true);
            }
        }
        if !std::mem::replace(&mut self.told, true) {
            warn!(
                "LEDs at {}: a pulse missed its time in every try to send a frame: this computer is too slow or too busy for them: run Pinion with -r, or connect them to an SPI controller (docs/guide/pins.md); said once",
                self.name
            );
        }
        Ok(false)
    }

    /// Sends the pulses until one misses its times. Returns whether none did.
    fn frame(&self, colors: &[u8]) -> Result<bool, Shutdown> {
        let bits = colors.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1));
        // The first call is slower than the others. Without this one, the first pulse would be longer.
        self.line.write(false)?;
        let mut next = self.pace.now();
        let mut last = None;
        for one in bits {
            self.pace.spin_until(next);
            let rises = self.pace.now();
            self.line.write(true)?;
            let risen = self.pace.now();
            self.pace.spin_until(risen + if one { LONG } else { SHORT });
            self.line.write(false)?;
            let fallen = self.pace.now();
            let late = |from: Clock, to: Clock, limit: Ticks| to.since(from) > i64::from(limit.0);
            let high_max = if one { self.bit_max } else { SHORT_MAX };
            if late(rises, fallen, high_max) || last.is_some_and(|last| late(last, risen, self.bit_max)) {
                return Ok(false);
            }
            next = (rises + BIT_MIN).max(fallen + LOW_MIN);
            last = Some(rises);
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    use crate::board::Direction;
    use crate::time::{TimeSource, VirtualClock};

    /// A line that records its edges in nanoseconds. Each takes a tick. `late` has the edges at which the program is
    /// interrupted before or after the edge, and for how many ticks.
    struct Wire {
        clock: VirtualClock,
        edges: Mutex<Vec<(u64, bool)>>,
        late: Mutex<Vec<(usize, When, u32)>>,
    }

    #[derive(Clone, Copy, Debug, PartialEq)]
    enum When {
        Before,
        After,
    }

    impl Wire {
        fn interrupt(&self, edge: usize, when: When) {
            let late = self.late.lock().unwrap();
            let ticks = late.iter().filter(|(at, is, _)| *at == edge && *is == when).map(|(.., ticks)| *ticks).sum();
            self.clock.set(self.clock.now() + Ticks(ticks));
        }
    }

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let edge = self.edges.lock().unwrap().len();
            if self.edges.lock().unwrap().last().is_none_or(|(_, was)| *was != level) && (level || edge > 0) {
                self.interrupt(edge, When::Before);
                self.edges.lock().unwrap().push((20 * self.clock.now().ticks(), level));
                self.clock.set(self.clock.now() + Ticks(1));
                self.interrupt(edge, When::After);
            }
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            Ok(false)
        }

        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    fn pulses(late: Vec<(usize, When, u32)>) -> (Arc<Wire>, Pulses) {
        let clock = VirtualClock::at(Clock::EPOCH);
        let wire = Arc::new(Wire { clock: clock.clone(), edges: Mutex::default(), late: Mutex::new(late) });
        let pulses = Pulses {
            line: wire.clone(),
            pace: Pace::of(Arc::new(clock)),
            bit_max: Ticks::from_us(4),
            reset: Ticks::from_us(300),
            free_at: Clock::EPOCH,
            name: "gpio18".into(),
            told: false,
        };
        (wire, pulses)
    }

    /// What a chain understands, by the limits that the firmware's src/neopixel.c names: the bits between two resets.
    /// `None`: a pulse or a pause that has no certain meaning.
    fn understood(edges: &[(u64, bool)]) -> Vec<Option<Vec<bool>>> {
        let mut frames = vec![];
        let mut bits = Some(vec![]);
        for pulse in edges.chunks(2) {
            let &[(rises, true), (falls, false)] = pulse else { panic!("{edges:?}") };
            let next = edges.iter().map(|(at, _)| *at).find(|at| *at > falls).unwrap_or(u64::MAX);
            let bit = match falls - rises {
                200..500 => Some(false),
                650.. => Some(true),
                _ => None,
            };
            bits = bits.and_then(|mut bits: Vec<bool>| {
                bits.push(bit?);
                Some(bits)
            });
            if next - falls >= 280_000 {
                frames.push(bits.replace(vec![]));
            } else if next - falls < 200 || next - rises > 5000 {
                bits = None;
            }
        }
        frames
    }

    fn bits(colors: &[u8]) -> Vec<bool> {
        colors.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1)).collect()
    }

    const COLORS: [u8; 6] = [0xff, 0, 0xa5, 0, 0x01, 0x81];

    #[test]
    fn pulses_are_within_the_data_sheet_and_frames_are_apart() {
        let (wire, mut pulses) = pulses(vec![]);
        for colors in [COLORS, [0x55; 6]] {
            assert_eq!(pulses.send(&colors), Ok(true));
        }
        let edges = wire.edges.lock().unwrap().clone();
        assert_eq!(understood(&edges), [Some(bits(&COLORS)), Some(bits(&[0x55; 6]))]);
        for pulse in edges.windows(3).filter(|three| three[0].1 && three[2].0 - three[0].0 < 100_000) {
            // WS2812B-V5: T0H, T1H; the firmware: 1250 ns a bit.
            let high = pulse[1].0 - pulse[0].0;
            assert!((220..=380).contains(&high) || (580..=1000).contains(&high), "{high}");
            assert!((1250..1300).contains(&(pulse[2].0 - pulse[0].0)), "{pulse:?}");
        }
    }

    /// Whatever is interrupted and for how long: a frame that counts as sent was understood.
    #[test]
    fn a_frame_that_missed_its_times_is_sent_again() {
        let mut again = 0;
        for edge in 0..96 {
            for when in [When::Before, When::After] {
                for ticks in [1, 5, 8, 9, 10, 20, 100, 140, 180, 200, 1000, 20_000] {
                    let (wire, mut pulses) = pulses(vec![(edge, when, ticks)]);
                    assert_eq!(pulses.send(&COLORS), Ok(true));
                    let edges = wire.edges.lock().unwrap();
                    let last = understood(&edges).pop().unwrap();
                    assert_eq!(last, Some(bits(&COLORS)), "edge {edge}, {when:?}, {ticks}");
                    assert!(!edges.last().unwrap().1, "the line is left low");
                    again += u32::from(edges.len() > 96);
                }
            }
        }
        assert!((500..2000).contains(&again), "{again} of 2304 frames");
    }

    #[test]
    fn a_frame_that_never_has_its_times_is_reported_to_the_host() {
        // A zero of each try is high for 2 us.
        let (wire, mut pulses) = pulses((0..200).map(|edge| (edge, When::After, 100)).collect());
        assert_eq!(pulses.send(&[0; 3]), Ok(false));
        assert_eq!(wire.edges.lock().unwrap().len(), 2 * TRIES as usize, "each is broken off after one pulse");
        assert!(pulses.told);
        wire.late.lock().unwrap().clear();
        assert_eq!(pulses.send(&[0; 3]), Ok(true));
    }
}
