// SPDX-License-Identifier: GPL-3.0-or-later
//! Everything that the pins move, heat and spin.
//!
//! One thread drives a pin, mostly the core. Any thread may read. Nothing here locks, blocks or allocates: a state
//! changes only when a pin changes. The reader calculates the exact state between two changes.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};

use super::seqlock::Seqlock;
use super::time::seconds;
use super::track::Track;
use crate::description::axes::{AxisConfig, End};
use crate::description::heater::{FanConfig, HeaterConfig};
use crate::description::thermistor::Thermistor;
use pinion_firmware::time::Clock;

/// What motors move along an axis, between two ends. It counts the steps of each of its motors, forward or backward.
#[derive(Debug)]
struct Carriage {
    motors: Vec<(Arc<AtomicI64>, i64)>,
    counts_per_mm: f64,
    /// The lowest and the highest count that it reaches without hitting something.
    hard_limits: Option<(i64, i64)>,
    /// The endstop's end, and the count where it closes.
    endstop: Option<(End, i64)>,
    track: Track,
}

impl Carriage {
    fn new(config: &AxisConfig, motors: Vec<(Arc<AtomicI64>, i64)>) -> Carriage {
        let counts_per_mm = config.steps_per_mm * motors.len() as f64;
        let counts = |mm: f64| (mm * counts_per_mm).round() as i64;
        Carriage {
            motors,
            counts_per_mm,
            hard_limits: config.travel_mm.map(|travel_mm| {
                let over_mm = config.overtravel_mm;
                (counts(-over_mm), counts(travel_mm + over_mm))
            }),
            endstop: config.endstop_pin.as_ref().map(|_| match config.endstop_at {
                End::Min => (End::Min, 0),
                End::Max => (End::Max, counts(config.travel_mm.unwrap_or(0.0))),
            }),
            track: Track::new(),
        }
    }

    fn counts(&self) -> i64 {
        let count = |(motor, way): &(Arc<AtomicI64>, i64)| motor.load(Ordering::Relaxed).wrapping_mul(*way);
        self.motors.iter().map(count).fold(0, i64::wrapping_add)
    }

    fn reaches(&self, counts: i64) -> bool {
        self.hard_limits.is_none_or(|(min, max)| (min..=max).contains(&counts))
    }
}

/// A stepper motor, and the axis of its name.
#[derive(Debug)]
pub struct Axis {
    pub name: String,
    pub travel_mm: Option<f64>,
    steps_per_mm: f64,
    carriage: Arc<Carriage>,
    /// What its motor moves, and which way when it goes forward.
    moves: Vec<(Arc<Carriage>, i64)>,
    /// Whether a falling edge is also a step.
    both_edges: AtomicBool,
    /// Whether the step line is on.
    stepped: AtomicBool,
    /// Whether the direction line is low for forward.
    dir_inverted: bool,
    forward: AtomicBool,
    enabled: AtomicBool,
    /// The position of its motor.
    position: Arc<AtomicI64>,
    /// Steps that its driver received: those with a low direction line minus those with a high one.
    turned: AtomicI64,
    lost_steps: AtomicU64,
    /// The instant of the last step, the ticks between it and the step before, and the number of lost steps in a row
    /// until then.
    stride: Seqlock<3>,
}

/// The position of a motor at its start. The limits of the description keep it below 2^63.
fn motor_at(start_mm: f64, config: &AxisConfig) -> Arc<AtomicI64> {
    Arc::new(AtomicI64::new((start_mm * config.steps_per_mm).round() as i64))
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stride {
    /// Ticks between two steps.
    pub ticks: u64,
    /// Steps in a row that the motor could not make.
    pub lost_in_a_row: u64,
}

impl Axis {
    /// An axis with a motor of its own.
    pub fn new(config: &AxisConfig) -> Axis {
        let motor = motor_at(config.start_mm, config);
        let carriage = Arc::new(Carriage::new(config, vec![(motor.clone(), 1)]));
        Axis::driven(config, motor, carriage.clone(), vec![(carriage, 1)])
    }

    /// The axes x and y of a CoreXY printer. Their motors drive two belts. The motor `x` moves the head by half of its
    /// step along both axes. The motor `y` moves it along x too, but backward along y.
    pub fn belts([x, y]: [&AxisConfig; 2]) -> [Axis; 2] {
        let motors = [motor_at(x.start_mm + y.start_mm, x), motor_at(x.start_mm - y.start_mm, x)];
        let [a, b] = &motors;
        let along_x = Arc::new(Carriage::new(x, vec![(a.clone(), 1), (b.clone(), 1)]));
        let along_y = Arc::new(Carriage::new(y, vec![(a.clone(), 1), (b.clone(), -1)]));
        let [a, b] = motors;
        let moves = |way| vec![(along_x.clone(), 1), (along_y.clone(), way)];
        [Axis::driven(x, a, along_x.clone(), moves(1)), Axis::driven(y, b, along_y.clone(), moves(-1))]
    }

    fn driven(
        config: &AxisConfig,
        position: Arc<AtomicI64>,
        carriage: Arc<Carriage>,
        moves: Vec<(Arc<Carriage>, i64)>,
    ) -> Axis {
        Axis {
            name: config.name.clone(),
            travel_mm: config.travel_mm,
            steps_per_mm: config.steps_per_mm,
            carriage,
            moves,
            both_edges: AtomicBool::new(config.step_both_edges),
            stepped: AtomicBool::new(false),
            dir_inverted: config.dir_pin.inverted,
            forward: AtomicBool::new(false),
            enabled: AtomicBool::new(config.enable_pin.is_none()),
            position,
            turned: AtomicI64::new(0),
            lost_steps: AtomicU64::new(0),
            stride: Seqlock::new([0, u64::MAX, 0]),
        }
    }

    pub fn set_both_edges(&self, both_edges: bool) {
        self.both_edges.store(both_edges, Ordering::Relaxed);
    }

    pub fn set_forward(&self, forward: bool) {
        self.forward.store(forward, Ordering::Relaxed);
    }

    pub fn set_enabled(&self, enabled: bool) {
        self.enabled.store(enabled, Ordering::Relaxed);
    }

    pub fn is_enabled(&self) -> bool {
        self.enabled.load(Ordering::Relaxed)
    }

    /// Whether the level of the direction line is high.
    pub fn is_dir_high(&self) -> bool {
        self.forward.load(Ordering::Relaxed) != self.dir_inverted
    }

    pub fn is_stepped(&self) -> bool {
        self.stepped.load(Ordering::Relaxed)
    }

    /// An edge of the step line.
    pub fn edge(&self, on: bool, at: Clock) {
        self.stepped.store(on, Ordering::Relaxed);
        if on || self.both_edges.load(Ordering::Relaxed) {
            let [last, _, lost_in_a_row] = self.stride.load();
            let ticks = if last == 0 { u64::MAX } else { at.since(Clock::from_ticks(last)).max(0) as u64 };
            let lost_in_a_row = if self.step(at) { 0 } else { lost_in_a_row + 1 };
            self.stride.store([at.ticks(), ticks, lost_in_a_row]);
        }
    }

    /// One step. False if the motor could not make it, because its axis had hit something.
    fn step(&self, at: Clock) -> bool {
        let turn = if self.is_dir_high() { -1 } else { 1 };
        self.turned.store(self.turned_steps().wrapping_add(turn), Ordering::Relaxed);
        if !self.is_enabled() {
            return true;
        }
        let way = if self.forward.load(Ordering::Relaxed) { 1 } else { -1 };
        let reaches = |(carriage, its): &(Arc<Carriage>, i64)| carriage.reaches(carriage.counts() + way * its);
        if !self.moves.iter().all(reaches) {
            let lost = self.lost_steps.load(Ordering::Relaxed);
            self.lost_steps.store(lost.wrapping_add(1), Ordering::Relaxed);
            return false;
        }
        self.position.store(self.position_steps().wrapping_add(way), Ordering::Relaxed);
        for (carriage, _) in &self.moves {
            carriage.track.push(at, carriage.counts());
        }
        true
    }

    /// The stride at this instant. The time to the next step is unknown, but at least the time since the last step.
    pub fn stride(&self, now: Clock) -> Stride {
        let [last, ticks, lost_in_a_row] = self.stride.load();
        let since = now.since(Clock::from_ticks(last)).max(0) as u64;
        Stride { ticks: ticks.max(since), lost_in_a_row }
    }

    /// Its last changes with their instants. Its unit is [`Axis::place_mm`]'s.
    pub fn track(&self) -> &Track {
        &self.carriage.track
    }

    /// The place of an entry of its track, in mm.
    pub fn place_mm(&self, counts: i64) -> f64 {
        counts as f64 / self.carriage.counts_per_mm
    }

    /// The position of its motor.
    pub fn position_steps(&self) -> i64 {
        self.position.load(Ordering::Relaxed)
    }

    pub fn turned_steps(&self) -> i64 {
        self.turned.load(Ordering::Relaxed)
    }

    /// The way of the motor in this number of steps, in mm.
    pub fn mm(&self, steps: i64) -> f64 {
        steps as f64 / self.steps_per_mm
    }

    /// The way of one step.
    pub fn step_mm(&self) -> f64 {
        1.0 / self.steps_per_mm
    }

    pub fn position_mm(&self) -> f64 {
        self.place_mm(self.carriage.counts())
    }

    pub fn lost_steps(&self) -> u64 {
        self.lost_steps.load(Ordering::Relaxed)
    }

    /// Whether the endstop is closed; `None` without an endstop.
    pub fn endstop(&self) -> Option<bool> {
        let position = self.carriage.counts();
        self.carriage.endstop.map(|(end, at)| match end {
            End::Min => position <= at,
            End::Max => position >= at,
        })
    }
}

/// A heater, the mass that it heats, and the sensor in it.
///
/// The mass follows `C dT/dt = P - L (T - Ta)` with the power `P` on or off. So from one change to the next
/// `T(t) = T∞ + (T0 - T∞) exp(-t L/C)` with `T∞ = Ta + P/L`. The sensor follows the mass: `τ dS/dt = T - S`, a second
/// exponential. A fan that blows at the heater adds to `L` while the fan has power.
#[derive(Debug)]
pub struct Heater {
    pub name: String,
    pub thermistor: Thermistor,
    pub noise_counts: f64,
    ambient_celsius: f64,
    watts: f64,
    heat_capacity_j_per_k: f64,
    /// Loss to the surroundings without the fan; the next field is the fan's addition.
    loss_w_per_k: f64,
    cooling_w_per_k: f64,
    sensor_lag_s: f64,
    /// The time of the last change, the temperatures of the mass and the sensor then, whether power is on, and whether
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
}

impl Heater {
    /// `cooling_w_per_k` is the loss that a fan adds.
    pub fn new(config: &HeaterConfig, thermistor: Thermistor, cooling_w_per_k: f64, now: Clock) -> Heater {
        let start = config.start_celsius().to_bits();
        let always_on = config.pin.is_none();
        Heater {
            name: config.name.clone(),
            thermistor,
            noise_counts: config.noise_counts,
            ambient_celsius: config.ambient_celsius,
            watts: config.heater_watts,
            heat_capacity_j_per_k: config.heat_capacity_j_per_k,
            loss_w_per_k: config.loss_w_per_k,
            cooling_w_per_k,
            sensor_lag_s: config.sensor_lag_s,
            state: Seqlock::new([now.ticks(), start, start, always_on.into(), 0]),
        }
    }

    /// The heater's state, and whether a fan blows at it.
    fn state_at(&self, now: Clock) -> (Heat, bool) {
        let [since, celsius, sensor_celsius, on, blown] = self.state.load();
        let (on, blown) = (on != 0, blown != 0);
        let elapsed_s = seconds(Clock::from_ticks(since), now);
        let loss_w_per_k = self.loss_w_per_k + if blown { self.cooling_w_per_k } else { 0.0 };
        let time_constant_s = self.heat_capacity_j_per_k / loss_w_per_k;
        let end = self.ambient_celsius + if on { self.watts / loss_w_per_k } else { 0.0 };
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
        (Heat { celsius, sensor_celsius, on }, blown)
    }

    pub fn at(&self, now: Clock) -> Heat {
        self.state_at(now).0
    }

    pub fn switch(&self, on: bool, now: Clock) {
        let (heat, blown) = self.state_at(now);
        self.store(Heat { on, ..heat }, blown, now);
    }

    /// Its fan has power from now on, or no longer has it.
    fn blow(&self, blown: bool, now: Clock) {
        self.store(self.at(now), blown, now);
    }

    fn store(&self, heat: Heat, blown: bool, now: Clock) {
        let Heat { celsius, sensor_celsius, on } = heat;
        self.state.store([now.ticks(), celsius.to_bits(), sensor_celsius.to_bits(), on.into(), blown.into()]);
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
    /// The time of the last change, the speed (rpm) and the angle (revolutions) then, and the [`Switch`]es.
    state: Seqlock<4>,
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
            state: Seqlock::new([now.ticks(), standstill, standstill, always_enabled]),
        }
    }

    /// Speed (rpm), angle (revolutions) and switches.
    fn at(&self, now: Clock) -> (f64, f64, u64) {
        let [since, rpm, turns, switches] = self.state.load();
        let elapsed_s = seconds(Clock::from_ticks(since), now);
        let end_rpm = if switches == Fan::POWERED { self.max_rpm } else { 0.0 };
        let excess_rpm = f64::from_bits(rpm) - end_rpm;
        let decay = (-elapsed_s / self.spin_up_s).exp();
        let minutes = (end_rpm * elapsed_s + excess_rpm * self.spin_up_s * (1.0 - decay)) / 60.0;
        (end_rpm + excess_rpm * decay, f64::from_bits(turns) + minutes, switches)
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
        let (rpm, turns, _) = self.at(now);
        let edges = turns * self.pulses_per_revolution * 2.0;
        let edges_per_s = rpm / 60.0 * self.pulses_per_revolution * 2.0;
        (edges as u64, (edges_per_s > 0.0).then(|| edges.fract() / edges_per_s))
    }

    pub fn switch(&self, switch: Switch, on: bool, now: Clock) {
        let (rpm, turns, before) = self.at(now);
        let switch = switch as u64;
        let switches = if on { before | switch } else { before & !switch };
        self.state.store([now.ticks(), rpm.to_bits(), turns.to_bits(), switches]);
        if let Some(heater) = &self.cools {
            heater.blow(switches == Fan::POWERED, now);
        }
    }
}

/// A light, or another output that is on or off.
#[derive(Debug)]
pub struct Lamp {
    pub name: String,
    /// The time of the last change, whether it is on, when it was last switched on, and its share of time on.
    state: Seqlock<4>,
}

impl Lamp {
    /// Longest time between two changes for which the lamp looks dimmed. Its brightness is then the share of time that
    /// it is on. After a longer time without a change it is on or off.
    const STEADY_S: f64 = 0.15;

    pub fn new(name: &str) -> Lamp {
        Lamp { name: name.to_owned(), state: Seqlock::new([0; 4]) }
    }

    pub fn is_on(&self) -> bool {
        let [_, on, ..] = self.state.load();
        on != 0
    }

    /// The brightness that an eye sees, 0 to 1.
    pub fn brightness(&self, now: Clock) -> f64 {
        let [edge, on, _, share] = self.state.load();
        match seconds(Clock::from_ticks(edge), now) > Lamp::STEADY_S {
            true if on == 0 => 0.0,
            true => 1.0,
            false => f64::from_bits(share),
        }
    }

    pub fn switch(&self, on: bool, now: Clock) {
        let [edge, was_on, rise, share] = self.state.load();
        if on == (was_on != 0) {
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
        self.state.store([now.ticks(), on.into(), rise, share.to_bits()]);
    }
}
