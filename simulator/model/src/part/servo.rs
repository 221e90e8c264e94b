// SPDX-License-Identifier: GPL-3.0-or-later
//! A hobby servo. The width of its pulses sets its angle.
//!
//! Simulated: the pulse widths, measured between the instants of the edges, the stops at both ends, the speed of the
//! turn. A servo without pulses stays where it is. Not simulated: the load, and a refresh rate that is too low or too
//! high.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::description::whole;
use crate::engine::look::Look;
use crate::engine::seqlock::Seqlock;
use crate::engine::time::seconds;
use crate::engine::wire::{Wire, output};
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

/// The servo's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServoConfig {
    /// For example `arm`.
    pub name: String,
    /// High during a pulse.
    pub pin: PinName,
    /// The pulse for 0 degrees.
    #[serde(default = "whole::<1000, _>")]
    pub min_pulse_us: f64,
    /// The pulse for the other stop.
    #[serde(default = "whole::<2000, _>")]
    pub max_pulse_us: f64,
    /// The angle of the other stop.
    #[serde(default = "whole::<180, _>")]
    pub travel_degrees: f64,
    /// Its speed.
    #[serde(default = "whole::<500, _>")]
    pub degrees_per_s: f64,
}

impl Part for ServoConfig {
    fn name(&self) -> String {
        format!("servo {}", self.name)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("pin", Some(&self.pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        check(whose, "min_pulse_us", self.min_pulse_us, Bound::AboveZero)?;
        check(whose, "max_pulse_us", self.max_pulse_us, Bound::AboveZero)?;
        check(whose, "travel_degrees", self.travel_degrees, Bound::AboveZero)?;
        check(whose, "degrees_per_s", self.degrees_per_s, Bound::AboveZero)?;
        if self.max_pulse_us <= self.min_pulse_us {
            let cause = format!("{} is not above min_pulse_us", self.max_pulse_us);
            return wrong(whose, "max_pulse_us", &cause, "raise it");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let servo = Arc::new(Servo::new(self, workshop.clock.now()));
        workshop.wire(Some(&self.pin), pulse_pin(servo.clone()));
        workshop.show(servo);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("servo {}", self.name));
        cfg.key("pin", &self.pin);
        cfg.key("minimum_pulse_width", self.min_pulse_us / 1e6);
        cfg.key("maximum_pulse_width", self.max_pulse_us / 1e6);
        cfg.key("maximum_servo_angle", self.travel_degrees);
    }
}

/// Means that there is no pulse now.
const NO_PULSE: u64 = u64::MAX;

struct Servo {
    config: ServoConfig,
    name: String,
    /// When the current pulse began.
    pulse: AtomicU64,
    /// The start of the turn, its first angle and its target.
    turn: Seqlock<3>,
}

impl Servo {
    /// A servo at its first stop.
    fn new(config: &ServoConfig, now: Clock) -> Servo {
        let stop = 0f64.to_bits();
        Servo {
            name: config.name(),
            config: config.clone(),
            pulse: AtomicU64::new(NO_PULSE),
            turn: Seqlock::new([now.ticks(), stop, stop]),
        }
    }

    fn degrees(&self, now: Clock) -> f64 {
        let [since, from, to] = self.turn.load();
        let (from, to) = (f64::from_bits(from), f64::from_bits(to));
        let far = self.config.degrees_per_s * seconds(Clock::from_ticks(since), now);
        from + (to - from).clamp(-far, far)
    }

    fn edge(&self, on: bool, at: Clock) {
        let began = self.pulse.swap(if on { at.ticks() } else { NO_PULSE }, Ordering::Relaxed);
        if on || began == NO_PULSE {
            return;
        }
        let width_us = seconds(Clock::from_ticks(began), at) * 1e6;
        let ServoConfig { min_pulse_us, max_pulse_us, travel_degrees, .. } = self.config;
        // The servo ignores a pulse that is much too short or too long.
        if (min_pulse_us / 2.0..=max_pulse_us * 1.5).contains(&width_us) {
            let share = (width_us - min_pulse_us) / (max_pulse_us - min_pulse_us);
            let to = share.clamp(0.0, 1.0) * travel_degrees;
            self.turn.store([at.ticks(), self.degrees(at).to_bits(), to.to_bits()]);
        }
    }
}

impl Sight for Servo {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, now: Clock) -> Look {
        Look::Angle { degrees: self.degrees(now) }
    }
}

/// The servo's input.
fn pulse_pin(servo: Arc<Servo>) -> impl Wire {
    output(format!("pulse of {}", servo.name), move |on, at| servo.edge(on, at))
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::CLOCK_FREQ;

    #[test]
    fn it_turns_to_the_angle_of_the_pulses_at_its_own_pace() {
        let config = ServoConfig {
            name: "arm".into(),
            pin: PinName { name: "servo".into(), inverted: false },
            min_pulse_us: 500.0,
            max_pulse_us: 2500.0,
            travel_degrees: 180.0,
            degrees_per_s: 300.0,
        };
        let servo = Arc::new(Servo::new(&config, Clock::EPOCH));
        let pin = pulse_pin(servo.clone());
        let at = |us: f64| Clock::from_ticks((us * f64::from(CLOCK_FREQ) / 1e6) as u64);
        let pulses = |first: u32, width_us: f64| {
            for n in first..first + 50 {
                let start_us = f64::from(n) * 20_000.0;
                pin.drive(true, at(start_us));
                pin.drive(false, at(start_us + width_us));
            }
            at(f64::from(first + 50) * 20_000.0)
        };
        // The first level of a line is not a pulse.
        pin.settle(false, Clock::EPOCH);
        assert_eq!(servo.look(at(1e6)).to_string(), "0.0 degrees");
        let now = pulses(50, 1500.0);
        assert_eq!(servo.look(now).to_string(), "90.0 degrees");
        assert_eq!(servo.degrees(at(50.0 * 20_000.0 + 1500.0 + 100_000.0)), 90.0, "there long ago");
        let now = pulses(100, 2500.0);
        assert_eq!(servo.degrees(now), 180.0);
        // It cannot turn beyond its stop. Wrong widths move nothing.
        assert_eq!(servo.degrees(pulses(150, 2700.0)), 180.0);
        assert_eq!(servo.degrees(pulses(200, 5000.0)), 180.0);
        assert_eq!(servo.degrees(pulses(250, 100.0)), 180.0);
        // A single pulse turns it all the way, at its speed.
        pin.drive(true, at(300.0 * 20_000.0));
        let end_us = 300.0 * 20_000.0 + 500.0;
        pin.drive(false, at(end_us));
        assert!((servo.degrees(at(end_us + 200_000.0)) - 120.0).abs() < 1e-6);
        assert_eq!(servo.degrees(at(end_us + 600_000.0)), 0.0);
    }
}
