// SPDX-License-Identifier: GPL-3.0-or-later
//! A move of one stepper as runs of steps.

use crate::Error;

/// Highest share by which the interval may shrink within one chord of a ramp. A tenth keeps the chord within half a
/// hundredth of the curve.
const CHORD: f64 = 0.1;
/// The same limit where intervals shrink by fewer than [`ADD_COARSE`] ticks per step. `add` is a whole number of ticks,
/// so its rounding matters there.
const CHORD_FINE: f64 = 0.02;
const ADD_COARSE: i64 = -8;
/// Longest interval between two steps, in ticks. With a much longer interval, the MCU would take the 32-bit clock of
/// the next step for a past one.
const INTERVAL_MAX: f64 = (1u32 << 30) as f64;

/// The content of one `queue_step`: `count` steps. The first is `interval` ticks after the step before. Each later
/// interval is longer by `add`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    /// Ticks to the first step.
    pub interval: u32,
    /// Number of steps, at least one.
    pub count: u16,
    /// Ticks by which each interval is longer than the one before.
    pub add: i16,
}

impl Run {
    /// Ticks from the step before the run to its last step.
    pub fn ticks(&self) -> u64 {
        let count = i64::from(self.count);
        let ramp = i64::from(self.add) * (count * (count - 1) / 2);
        (count * i64::from(self.interval) + ramp).max(0) as u64
    }

    /// The interval before the last step, in ticks.
    pub(super) fn last_interval(&self) -> u32 {
        let last = i64::from(self.interval) + i64::from(self.add) * (i64::from(self.count) - 1);
        last.max(0) as u32
    }

    fn reversed(&self) -> Run {
        Run { interval: self.last_interval(), count: self.count, add: -self.add }
    }
}

/// A move of one stepper. It accelerates, keeps its speed, and decelerates.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Profile {
    /// The move, in order.
    pub runs: Vec<Run>,
    /// Number of steps of all runs.
    pub steps: u32,
    /// Ticks from the start to the last step.
    pub ticks: u64,
}

impl Profile {
    /// A move of `steps` steps at up to `speed` steps/s with `acceleration` steps/s² (infinity for no limit). The clock
    /// runs at `frequency_hz`. Fails if a number is not positive. Also fails if the speed is below a step in about 20
    /// seconds or above a step per tick.
    pub fn trapezoid(steps: u32, speed: f64, acceleration: f64, frequency_hz: f64) -> Result<Profile, Error> {
        let cruise = (frequency_hz / speed).ceil();
        let positive = speed > 0.0 && acceleration > 0.0 && frequency_hz > 0.0;
        if steps == 0 || !positive || !(1.0..=INTERVAL_MAX).contains(&cruise) {
            return Err(Error::Plan {
                subject: format!("a move of {steps} steps at {speed} steps/s, {acceleration} steps/s²"),
                why: "choose at least one step, and a speed and acceleration that a clock of \
                      this frequency can express"
                    .to_owned(),
            });
        }
        let cruise = cruise as u32;
        // From rest, the ideal time of step i is sqrt(2 i / a).
        let tick_of = |step: u32| frequency_hz * (2.0 * f64::from(step) / acceleration).sqrt();
        let interval = |step: u32| {
            let ideal = (tick_of(step + 1) - tick_of(step)).min(INTERVAL_MAX);
            (ideal.round() as u32).max(cruise)
        };
        let ramp_steps = (speed * speed / (2.0 * acceleration)).min(f64::from(steps / 2)) as u32;
        let ramp = ramp(ramp_steps, interval);
        let peak = ramp.last().map_or(cruise, |run| run.last_interval());
        // A short move does not reach `speed`. Its middle keeps the highest speed that it reaches.
        let even = if ramp_steps < steps / 2 { cruise } else { peak };
        let mut runs = ramp.clone();
        let mut rest = steps - 2 * ramp_steps;
        while rest > 0 {
            let count = rest.min(u32::from(u16::MAX)) as u16;
            runs.push(Run { interval: even, count, add: 0 });
            rest -= u32::from(count);
        }
        runs.extend(ramp.iter().rev().map(Run::reversed));
        let ticks = runs.iter().map(Run::ticks).sum();
        Ok(Profile { runs, steps, ticks })
    }
}

/// Approximates the intervals of the steps `0..steps` by runs with evenly changing intervals (chords of the curve). The
/// intervals shrink ever more slowly. `add` is rounded toward zero, so no run ends with a shorter interval than the
/// next one begins with.
fn ramp(steps: u32, interval: impl Fn(u32) -> u32) -> Vec<Run> {
    let mut runs = Vec::new();
    let mut at = 0;
    while at < steps {
        let first = interval(at);
        // The end of the longest chord with intervals that shrink by at most `part`, found by bisection.
        let chord = |part: f64| {
            let least = f64::from(first) * (1.0 - part);
            let (mut count, mut beyond) = (1, (steps - at).min(u32::from(u16::MAX)) + 1);
            while beyond - count > 1 {
                let middle = count + (beyond - count) / 2;
                if f64::from(interval(at + middle)) >= least {
                    count = middle;
                } else {
                    beyond = middle;
                }
            }
            let fall = i64::from(interval(at + count)) - i64::from(first);
            (count, fall / i64::from(count))
        };
        let (mut count, mut add) = chord(CHORD);
        if add > ADD_COARSE {
            (count, add) = chord(CHORD_FINE);
        }
        let (count, add) = match i16::try_from(add) {
            Ok(add) if count > 1 => (count, add),
            _ => (1, 0),
        };
        runs.push(Run { interval: first, count: count as u16, add });
        at += count;
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FREQUENCY_HZ: f64 = 50e6;

    /// The clocks of all steps, calculated with integers only, as in an MCU.
    fn step_clocks(profile: &Profile) -> Vec<u64> {
        let (mut clock, mut clocks) = (0u64, Vec::new());
        for run in &profile.runs {
            let mut interval = i64::from(run.interval);
            for _ in 0..run.count {
                assert!(interval > 0, "{run:?}");
                clock += interval as u64;
                clocks.push(clock);
                interval += i64::from(run.add);
            }
        }
        clocks
    }

    fn intervals(profile: &Profile) -> Vec<u64> {
        let clocks = step_clocks(profile);
        let before = std::iter::once(&0).chain(&clocks);
        clocks.iter().zip(before).map(|(clock, before)| clock - before).collect()
    }

    proptest! {
        #[test]
        fn a_profile_is_exact_and_never_too_fast(
            steps in 1u32..200_000,
            speed in 1.0f64..200_000.0,
            acceleration in 10.0f64..5e6,
        ) {
            let profile = Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).unwrap();
            let intervals = intervals(&profile);
            prop_assert_eq!(intervals.len() as u32, steps);
            prop_assert_eq!(profile.steps, steps);
            prop_assert_eq!(intervals.iter().sum::<u64>(), profile.ticks);
            let fastest = (FREQUENCY_HZ / speed) as u64;
            prop_assert!(intervals.iter().all(|interval| *interval >= fastest));
            // The intervals shrink, then grow, and are symmetric.
            let lowest = intervals.iter().min().unwrap();
            let bottom = intervals.iter().position(|i| i == lowest).unwrap();
            prop_assert!(intervals[..=bottom].is_sorted_by(|a, b| a >= b));
            prop_assert!(intervals[bottom..].is_sorted());
            prop_assert!(intervals.iter().eq(intervals.iter().rev()));
        }

        #[test]
        fn a_long_move_lasts_as_long_as_the_formula_says(
            speed in 500.0f64..50_000.0,
            acceleration in 5_000.0f64..1e6,
        ) {
            let ramp = speed * speed / (2.0 * acceleration);
            prop_assume!((50.0..40_000.0).contains(&ramp));
            let steps = (4.0 * ramp) as u32;
            let profile = Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).unwrap();
            let expected = 2.0 * speed / acceleration + 2.0 * ramp / speed;
            let seconds = profile.ticks as f64 / FREQUENCY_HZ;
            prop_assert!((seconds / expected - 1.0).abs() < 0.02, "{seconds} not {expected}");
            prop_assert!(profile.runs.len() < 400, "{} runs", profile.runs.len());
        }
    }

    #[test]
    fn a_run_counts_as_the_firmware_does() {
        let run = Run { interval: 1000, count: 4, add: -10 };
        assert_eq!(run.ticks(), 1000 + 990 + 980 + 970);
        assert_eq!(run.last_interval(), 970);
        assert_eq!(run.reversed(), Run { interval: 970, count: 4, add: 10 });
        assert_eq!(run.reversed().ticks(), run.ticks());
    }

    #[test]
    fn a_move_that_cannot_be_is_refused() {
        for (steps, speed, acceleration) in [
            (0, 100.0, 100.0),
            (1, 0.0, 100.0),
            (1, f64::NAN, 100.0),
            (1, 100.0, f64::NAN),
            (1, 100.0, -1.0),
            (1, 0.01, 100.0),
            (1, f64::INFINITY, 100.0),
        ] {
            assert!(Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).is_err());
        }
        let even = Profile::trapezoid(70_000, 1000.0, f64::INFINITY, FREQUENCY_HZ).unwrap();
        assert_eq!(even.runs.len(), 2);
    }
}
