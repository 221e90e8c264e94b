// SPDX-License-Identifier: GPL-3.0-or-later
//! WS2812 LEDs on a GPIO line, pulse by pulse.
//!
//! The times are from Klipper's src/neopixel.c, which has the needs of real chips: a short pulse below 500 ns,
//! a long one above 650 ns, 5 us from pulse to pulse at most, 1.25 us on average, 200 ns between two edges. Klipper's C
//! shuts out interrupts during a pulse. A program on Linux cannot. So each pulse is measured by the clock. The clock is
//! read before and after each edge, and its step is part of the limits. So a pulse is surely longer than its shortest
//! time and shorter than its longest. After a pulse with a late edge, the frame is aborted and sent again after the
//! reset time. Until then the LEDs may show wrong colors.
//!
//! A call of the kernel takes longer than a short pulse. So a line without registers is refused. A line behind a bus that
//! holds writes back is refused, too: the pulse at the line is not the pulse that was measured.

use std::sync::Arc;

use crate::board::{Line, Pin};
use crate::feature::pace::Pace;
use crate::mcu::Context;
use crate::mcu::DeviceWarning;
use crate::shutdown::{Shutdown, reason};
use crate::time::{Clock, NS_PER_TICK, Ticks, TimeSource};

use super::INVALID_SIZE;

/// The remedies.
const TO_SPI: &str =
    "connect them to the data output (MOSI) of an SPI controller and name its device, such as \"pin: spidev0.0\"";
const OR_TO_FAST_LINE: &str =
    ", or to a line that is written through registers (pinion pins lists them), but not on a Raspberry Pi 5";
const OR_BY_THE_KERNEL: &str = "; for LEDs without the host there is the kernel's overlay ws2812-pio";

/// All chains on lines share this worker.
pub(super) const WORKER: &str = "neopixel";
/// Highest number of bytes in a chain: klippy's limit (`MAX_MCU_SIZE` of neopixel.py). A frame takes 5 ms, and 20 ms at
/// most. For this long the worker keeps its processor busy.
const SIZE_MAX: usize = 500;
/// Time from pulse to pulse unless one is late. The 1.25 us of the data sheet are reached on average.
const BIT: Ticks = Ticks(63);
/// How often a frame is sent if an edge is late. klippy itself sends it eight times.
const TRIES: u32 = 3;

/// The limits of measured times. The real ones are surely within the data sheet (Worldsemi WS2812B-V5, "Data transfer
/// time").
struct Limits {
    /// Shortest time that the line is high for a 0: 220 ns (T0H).
    short: Ticks,
    /// Longest time that the line may be high for a 0: 500 ns.
    short_max: Ticks,
    /// Shortest time that the line is high for a 1: 780 ns.
    long: Ticks,
    /// Shortest time that the line is low between two pulses: 200 ns.
    low: Ticks,
    /// Longest time from pulse to pulse: the host's limit, 5 us at most.
    bit_max: Ticks,
}

impl Limits {
    /// The limits on this clock. `bit_max` is the host's limit. `None` if the clock is too coarse for a short pulse.
    fn of(clock: &dyn TimeSource, bit_max: Ticks) -> Option<Limits> {
        let bit_max_ns = bit_max.0.saturating_mul(NS_PER_TICK as u32).min(5000);
        let limits = Limits {
            short: clock.at_least(220),
            short_max: clock.at_most(500),
            long: clock.at_least(780),
            low: clock.at_least(200),
            bit_max: clock.at_most(bit_max_ns),
        };
        (limits.short < limits.short_max).then_some(limits)
    }
}

/// The first words of the warning.
const WARNING: &str = "LEDs at";

/// Sends frames.
pub(super) struct Pulses {
    line: Arc<dyn Line>,
    pace: Pace,
    limits: Limits,
    /// How long the line is low between two frames.
    reset: Ticks,
    /// When the LEDs have taken the last frame.
    free_at: Clock,
    /// The line's name in the log.
    name: String,
    /// Whether there was a warning about frames with late edges.
    has_warned: bool,
    /// A warning for the log.
    pub(super) warning: Option<DeviceWarning>,
}

impl Pulses {
    /// # Errors
    ///
    /// "Not an output pin" if the line has no registers or the clock is too coarse, "Invalid neopixel data_size".
    pub(super) fn new(
        context: &Context,
        pin: Pin,
        line: Arc<dyn Line>,
        size: usize,
        bit_max: Ticks,
        reset: Ticks,
    ) -> Result<Pulses, Shutdown> {
        let name = context.name(pin);
        let refused = |why: &str, or: &str| {
            let cause = format!("{name} cannot drive LEDs: {why}");
            Shutdown::because(reason::NOT_OUTPUT, cause).remedy(format!("{TO_SPI}{or}"))
        };
        if line.is_posted() {
            let why = "its chip is behind PCIe, which may shorten or join their pulses";
            return Err(refused(why, OR_BY_THE_KERNEL));
        }
        if !line.is_fast() {
            let why = "their pulses are too short for a program on Linux";
            return Err(refused(why, OR_TO_FAST_LINE));
        }
        let clock = context.clock();
        let Some(limits) = Limits::of(&*clock, bit_max) else {
            let why = format!("the computer's clock has steps of {} ns, too long for their pulses", clock.step_ns());
            return Err(refused(&why, ""));
        };
        if size > SIZE_MAX {
            let cause = format!("a chain of {size} bytes is too long for a line, which takes {SIZE_MAX}");
            return Err(Shutdown::because(INVALID_SIZE, cause).remedy("lower chain_count").of(&name));
        }
        let pace = Pace::between_ticks(context);
        let free_at = pace.now() + reset;
        Ok(Pulses { line, pace, limits, reset, free_at, name, has_warned: false, warning: None })
    }

    /// Sends the colors. False if an edge was late in each try.
    pub(super) fn send(&mut self, colors: &[u8]) -> Result<bool, Shutdown> {
        for _ in 0..TRIES {
            self.pace.until(self.free_at);
            // A byte takes eight bits, and some.
            self.pace.until_between_ticks(Ticks(10 * BIT.0 * colors.len() as u32));
            let sent = self.frame(colors);
            self.line.write(false)?;
            self.free_at = self.pace.now() + self.reset;
            if sent? {
                return Ok(true);
            }
        }
        if !std::mem::replace(&mut self.has_warned, true) {
            let text = format!(
                "{WARNING} {}: a pulse missed its time in every try to send a frame: this computer is too slow or too busy for them: run Pinion with -r, or connect them to an SPI controller (docs/guide/pins.md); said once",
                self.name
            );
            self.warning = Some(DeviceWarning::new(WARNING, text));
        }
        Ok(false)
    }

    /// Sends the pulses until an edge is late. True if none was late.
    fn frame(&self, colors: &[u8]) -> Result<bool, Shutdown> {
        let bits = colors.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1));
        // The first call is slower than the others. Without this one, the first pulse would be longer.
        self.line.write(false)?;
        let Limits { short, short_max, long, low, bit_max } = self.limits;
        let mut next = self.pace.now();
        let mut last = None;
        for one in bits {
            self.pace.spin_until(next);
            let rises = self.pace.now();
            self.line.write(true)?;
            let risen = self.pace.now();
            self.pace.spin_until(risen + if one { long } else { short });
            self.line.write(false)?;
            let fallen = self.pace.now();
            let late = |from: Clock, to: Clock, limit: Ticks| to.since(from) > i64::from(limit.0);
            let high_max = if one { bit_max } else { short_max };
            if late(rises, fallen, high_max) || last.is_some_and(|last| late(last, risen, bit_max)) {
                return Ok(false);
            }
            next = (rises + BIT).max(fallen + low);
            last = Some(rises);
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
    use std::time::Duration;

    use crate::board::Direction;

    /// A clock with steps of a 64th of this many nanoseconds. Each read of it takes 10 ns of the real time.
    struct Stepped {
        real_ns: AtomicU64,
        step: u64,
    }

    /// Steps of 1 ns, and the steps of a clock of 19.2 MHz.
    const FINE: u64 = 64;
    const COARSE: u64 = 64 * 10_000 / 192;

    impl TimeSource for Stepped {
        fn now(&self) -> Clock {
            let steps = 64 * self.real_ns.fetch_add(10, SeqCst) / self.step;
            Clock::from_ticks(steps * self.step / 64 / NS_PER_TICK)
        }

        fn instant_of(&self, _: Duration) -> Clock {
            Clock::EPOCH
        }

        fn duration_of(&self, _: Clock) -> Duration {
            Duration::ZERO
        }

        fn step_ns(&self) -> u32 {
            self.step.div_ceil(64) as u32
        }
    }

    /// A line that records its edges in nanoseconds. Each takes 20 ns. `late` has the edges at which the program is
    /// interrupted before or after the edge, and for how many ticks.
    struct Wire {
        clock: Arc<Stepped>,
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
            let ticks: u32 =
                late.iter().filter(|(at, is, _)| *at == edge && *is == when).map(|(.., ticks)| *ticks).sum();
            self.clock.real_ns.fetch_add(NS_PER_TICK * u64::from(ticks), SeqCst);
        }
    }

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let edge = self.edges.lock().unwrap().len();
            if self.edges.lock().unwrap().last().is_none_or(|(_, was)| *was != level) && (level || edge > 0) {
                self.interrupt(edge, When::Before);
                self.edges.lock().unwrap().push((self.clock.real_ns.fetch_add(20, SeqCst), level));
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
        pulses_on(Stepped { real_ns: AtomicU64::new(0), step: FINE }, late)
    }

    fn pulses_on(clock: Stepped, late: Vec<(usize, When, u32)>) -> (Arc<Wire>, Pulses) {
        let clock = Arc::new(clock);
        let wire = Arc::new(Wire { clock: clock.clone(), edges: Mutex::default(), late: Mutex::new(late) });
        let pulses = Pulses {
            line: wire.clone(),
            limits: Limits::of(&*clock, Ticks::from_us(4)).unwrap(),
            pace: Pace::of(clock),
            reset: Ticks::from_us(300),
            free_at: Clock::EPOCH,
            name: "gpio18".into(),
            has_warned: false,
            warning: None,
        };
        (wire, pulses)
    }

    /// The bits that a chain understands, by the limits that Klipper's src/neopixel.c names: the bits between two
    /// resets.
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
            // WS2812B-V5: T0H, T1H; Klipper's C: 1250 ns a bit.
            let high = pulse[1].0 - pulse[0].0;
            assert!((220..=380).contains(&high) || (580..=1000).contains(&high), "{high}");
            assert!((1250..1300).contains(&(pulse[2].0 - pulse[0].0)), "{pulse:?}");
        }
    }

    /// A frame that counts as sent was understood, for interruptions at any place and of any length.
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

    /// A clock of 19.2 MHz shows 250 ns for a pulse of 199 ns, and for one of 300 ns.
    #[test]
    fn pulses_are_surely_within_their_times_on_a_coarse_clock() {
        let mut sent = 0;
        for phase in 0..60 {
            for ticks in [0, 1, 2, 3, 4, 5, 6, 7, 8] {
                for edge in [40, 41] {
                    let clock = Stepped { real_ns: AtomicU64::new(7 * phase), step: COARSE };
                    let (wire, mut pulses) = pulses_on(clock, vec![(edge, When::After, ticks)]);
                    if pulses.send(&COLORS).unwrap() {
                        let last = understood(&wire.edges.lock().unwrap()).pop().unwrap();
                        assert_eq!(last, Some(bits(&COLORS)), "phase {phase}, edge {edge}, {ticks}");
                        sent += 1;
                    }
                }
            }
        }
        assert!(sent > 500, "{sent} of 1080 frames");
        let limits = |step, bit_max_us| {
            let clock = Stepped { real_ns: AtomicU64::new(0), step };
            let limits = Limits::of(&clock, Ticks::from_us(bit_max_us))?;
            let Limits { short, short_max, long, low, bit_max } = limits;
            Some([short, short_max, long, low, bit_max].map(|limit| limit.0))
        };
        assert_eq!(limits(FINE, 4), Some([12, 24, 40, 11, 199]));
        assert_eq!(limits(COARSE, 4), Some([15, 21, 43, 14, 196]));
        assert_eq!(limits(COARSE, 100), Some([15, 21, 43, 14, 246]), "whatever the host allows");
        assert_eq!(limits(64 * 150, 4), None);
    }

    #[test]
    fn a_frame_that_never_has_its_times_is_reported_to_the_host() {
        // A zero of each try is high for 2 us.
        let (wire, mut pulses) = pulses((0..200).map(|edge| (edge, When::After, 100)).collect());
        assert_eq!(pulses.send(&[0; 3]), Ok(false));
        assert_eq!(wire.edges.lock().unwrap().len(), 2 * TRIES as usize, "each is broken off after one pulse");
        assert!(pulses.has_warned);
        wire.late.lock().unwrap().clear();
        assert_eq!(pulses.send(&[0; 3]), Ok(true));
    }
}
