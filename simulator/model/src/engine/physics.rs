// SPDX-License-Identifier: GPL-3.0-or-later
//! Everything that the pins heat, spin and light.
//!
//! One thread drives a pin, mostly the core. Any thread may read. Nothing here locks, blocks or allocates: a state
//! changes only when a pin changes. The reader calculates the exact state between two changes.

use std::sync::Arc;

use super::seqlock::Seqlock;
use super::time::seconds;
use crate::description::heater::{FanConfig, HeaterConfig};
use crate::description::sensor::Sensor;
use pinion_firmware::time::Clock;

/// A heater, the mass that it heats, and the sensor in it.
///
/// The mass follows `C dT/dt = P - L (T - Ta)` with the power `P` on or off. So from one change to the next
/// `T(t) = T∞ + (T0 - T∞) exp(-t L/C)` with `T∞ = Ta + P/L`. The sensor follows the mass: `τ dS/dt = T - S`, a second
/// exponential. A fan that blows at the heater adds to `L` while the fan has power.
#[derive(Debug)]
pub struct Heater {
    pub name: String,
    pub sensor: Option<Sensor>,
    pub noise_counts: f64,
    ambient_celsius: f64,
    watts: f64,
    heat_capacity_j_per_k: f64,
    /// Loss to the surroundings without the fan; the next field is the fan's addition.
    loss_w_per_k: f64,
    cooling_w_per_k: f64,
    sensor_lag_s: f64,
    /// The time of the last change, the temperatures of the mass and the sensor then, the share of its power, and whether
    /// the fan blows.
    state: Seqlock<5>,
}

/// A heater at one instant.
#[derive(Clone, Copy, Debug)]
pub struct Heat {
    /// Temperature of the heated mass.
    pub celsius: f64,
    /// Temperature of the sensor.
    pub sensor_celsius: f64,
    /// Whether power is on.
    pub on: bool,
    /// The share of its power: between 0 and 1 only by a hardware PWM.
    share: f64,
}

impl Heater {
    /// `cooling_w_per_k` is the loss that a fan adds.
    pub fn new(config: &HeaterConfig, sensor: Option<Sensor>, cooling_w_per_k: f64, now: Clock) -> Heater {
        let start = config.start_celsius().to_bits();
        let power = f64::from(u8::from(config.pin.is_none()));
        Heater {
            name: config.name.clone(),
            sensor,
            noise_counts: config.noise_counts,
            ambient_celsius: config.ambient_celsius,
            watts: config.heater_watts,
            heat_capacity_j_per_k: config.heat_capacity_j_per_k,
            loss_w_per_k: config.loss_w_per_k,
            cooling_w_per_k,
            sensor_lag_s: config.sensor_lag_s,
            state: Seqlock::new([now.ticks(), start, start, power.to_bits(), 0]),
        }
    }

    /// The heater's state, and whether a fan blows at it.
    fn state_at(&self, now: Clock) -> (Heat, bool) {
        let [since, celsius, sensor_celsius, share, blown] = self.state.load();
        let (share, blown) = (f64::from_bits(share), blown != 0);
        let elapsed_s = seconds(Clock::from_ticks(since), now);
        let loss_w_per_k = self.loss_w_per_k + if blown { self.cooling_w_per_k } else { 0.0 };
        let time_constant_s = self.heat_capacity_j_per_k / loss_w_per_k;
        let end = self.ambient_celsius + share * self.watts / loss_w_per_k;
        let mass_k = f64::from_bits(celsius) - end;
        let decay = (-elapsed_s / time_constant_s).exp();
        let celsius = end + mass_k * decay;
        let sensor_celsius = if self.sensor_lag_s > 0.0 {
            // One part of the sensor's distance decays with the mass, the other part with the sensor's own lag.
            let slow_k = mass_k * time_constant_s / (time_constant_s - self.sensor_lag_s);
            let fast_k = f64::from_bits(sensor_celsius) - end - slow_k;
            end + slow_k * decay + fast_k * (-elapsed_s / self.sensor_lag_s).exp()
        } else {
            celsius
        };
        (Heat { celsius, sensor_celsius, on: share > 0.0, share }, blown)
    }

    pub fn at(&self, now: Clock) -> Heat {
        self.state_at(now).0
    }

    pub fn switch(&self, on: bool, now: Clock) {
        self.power(f64::from(u8::from(on)), now);
    }

    /// It gets this share of its power from now on.
    pub fn power(&self, share: f64, now: Clock) {
        let (heat, blown) = self.state_at(now);
        self.store(Heat { share, ..heat }, blown, now);
    }

    /// Its fan has power from now on, or no longer has it.
    fn blow(&self, blown: bool, now: Clock) {
        self.store(self.at(now), blown, now);
    }

    fn store(&self, heat: Heat, blown: bool, now: Clock) {
        let Heat { celsius, sensor_celsius, share, .. } = heat;
        self.state.store([now.ticks(), celsius.to_bits(), sensor_celsius.to_bits(), share.to_bits(), blown.into()]);
    }
}

/// A fan. Its speed follows its power as a heater's temperature does: `n(t) = n∞ + (n0 - n∞) exp(-t/τ)`. The angle is
/// the integral of the speed.
#[derive(Debug)]
pub struct Fan {
    pub name: String,
    max_rpm: f64,
    spin_up_s: f64,
    pulses_per_revolution: f64,
    /// The heater that it cools.
    cools: Option<Arc<Heater>>,
    /// The time of the last change, the speed (rpm) and the angle (revolutions) then, the [`Switch`]es, and the share of
    /// its power.
    state: Seqlock<5>,
}

/// All of these must be on for a fan to have power.
#[derive(Clone, Copy, Debug)]
pub enum Switch {
    /// Its pin.
    Power = 1,
    /// Its enable pin.
    Enable = 2,
}

impl Fan {
    const POWERED: u64 = Switch::Power as u64 | Switch::Enable as u64;

    pub fn new(config: &FanConfig, cools: Option<Arc<Heater>>, now: Clock) -> Fan {
        let always_enabled = match config.enable_pin {
            Some(_) => 0,
            None => Switch::Enable as u64,
        };
        let standstill = 0f64.to_bits();
        Fan {
            name: config.name.clone(),
            max_rpm: config.max_rpm,
            spin_up_s: config.spin_up_s,
            pulses_per_revolution: config.pulses_per_revolution.into(),
            cools,
            state: Seqlock::new([now.ticks(), standstill, standstill, always_enabled, 1f64.to_bits()]),
        }
    }

    /// Speed (rpm), angle (revolutions), switches and share of power.
    fn at(&self, now: Clock) -> (f64, f64, u64, f64) {
        let [since, rpm, turns, switches, share] = self.state.load();
        let share = f64::from_bits(share);
        let elapsed_s = seconds(Clock::from_ticks(since), now);
        let end_rpm = if switches == Fan::POWERED { share * self.max_rpm } else { 0.0 };
        let excess_rpm = f64::from_bits(rpm) - end_rpm;
        let decay = (-elapsed_s / self.spin_up_s).exp();
        let minutes = (end_rpm * elapsed_s + excess_rpm * self.spin_up_s * (1.0 - decay)) / 60.0;
        (end_rpm + excess_rpm * decay, f64::from_bits(turns) + minutes, switches, share)
    }

    pub fn rpm(&self, now: Clock) -> f64 {
        self.at(now).0
    }

    /// The tachometer: high for the first half of each pulse.
    pub fn tachometer(&self, now: Clock) -> bool {
        (self.at(now).1 * self.pulses_per_revolution).fract() < 0.5
    }

    /// The tachometer's edges so far, and how long ago the last one was at the present speed; `None` for a fan that
    /// stands still.
    pub fn edges(&self, now: Clock) -> (u64, Option<f64>) {
        let (rpm, turns, ..) = self.at(now);
        let edges = turns * self.pulses_per_revolution * 2.0;
        let edges_per_s = rpm / 60.0 * self.pulses_per_revolution * 2.0;
        (edges as u64, (edges_per_s > 0.0).then(|| edges.fract() / edges_per_s))
    }

    pub fn switch(&self, switch: Switch, on: bool, now: Clock) {
        let (rpm, turns, before, share) = self.at(now);
        let share = if let Switch::Power = switch { 1.0 } else { share };
        let switch = switch as u64;
        self.set(if on { before | switch } else { before & !switch }, share, (rpm, turns), now);
    }

    /// It gets this share of its power from now on.
    pub fn power(&self, share: f64, now: Clock) {
        let (rpm, turns, before, _) = self.at(now);
        let power = Switch::Power as u64;
        self.set(if share > 0.0 { before | power } else { before & !power }, share, (rpm, turns), now);
    }

    fn set(&self, switches: u64, share: f64, (rpm, turns): (f64, f64), now: Clock) {
        self.state.store([now.ticks(), rpm.to_bits(), turns.to_bits(), switches, share.to_bits()]);
        if let Some(heater) = &self.cools {
            heater.blow(switches == Fan::POWERED, now);
        }
    }
}

/// A light, or another output that is on or off.
#[derive(Debug)]
pub struct Lamp {
    pub name: String,
    /// The time of the last change, whether it is on, when it was last switched on, its share of time on, and whether a
    /// hardware PWM keeps that share.
    state: Seqlock<5>,
}

impl Lamp {
    /// Longest time between two changes for which the lamp looks dimmed. Its brightness is then the share of time that
    /// it is on. After a longer time without a change it is on or off.
    const STEADY_S: f64 = 0.15;

    pub fn new(name: &str) -> Lamp {
        Lamp { name: name.to_owned(), state: Seqlock::new([0; 5]) }
    }

    pub fn is_on(&self) -> bool {
        let [_, on, ..] = self.state.load();
        on != 0
    }

    /// The brightness that an eye sees, 0 to 1.
    pub fn brightness(&self, now: Clock) -> f64 {
        let [edge, on, _, share, dimmed] = self.state.load();
        match dimmed == 0 && seconds(Clock::from_ticks(edge), now) > Lamp::STEADY_S {
            true if on == 0 => 0.0,
            true => 1.0,
            false => f64::from_bits(share),
        }
    }

    pub fn switch(&self, on: bool, now: Clock) {
        let [edge, was_on, rise, share, dimmed] = self.state.load();
        if on == (was_on != 0) && dimmed == 0 {
            return;
        }
        let here_s = seconds(Clock::from_ticks(edge), now);
        let share = f64::from_bits(share);
        let share = match (on, here_s > Lamp::STEADY_S) {
            (true, true) => 0.0,
            (false, true) => 1.0,
            (true, false) => match seconds(Clock::from_ticks(rise), Clock::from_ticks(edge)) {
                lit_s if lit_s > Lamp::STEADY_S => 1.0,
                lit_s => lit_s / (lit_s + here_s),
            },
            (false, false) => share,
        };
        let rise = if on { now.ticks() } else { rise };
        self.state.store([now.ticks(), on.into(), rise, share.to_bits(), 0]);
    }

    /// A hardware PWM keeps it on for this share of the time from now on.
    pub fn dim(&self, share: f64, now: Clock) {
        self.state.store([now.ticks(), u64::from(share > 0.0), now.ticks(), share.to_bits(), 1]);
    }
}
