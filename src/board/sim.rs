// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer: axes that count steps and close endstops, heaters with a mass and a
//! thermistor, fans with a tachometer, lights, all of it described in TOML.
//!
//! It runs under a real host in real time, and in tests in virtual time: whatever happens
//! between two writes is solved exactly from the clock.

#![forbid(unsafe_code)]

use std::collections::HashSet;
use std::sync::Arc;

use super::{Attachment, Bias, Board, Buffer, ChipSelect, Device, Input, Output, Pin, PwmConfig, Range, SpiConfig};
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, Ticks, TimeSource};

mod config;
mod physics;
mod printer_cfg;
mod thermistor;

pub use config::{
    AxisConfig, End, FanConfig, HeaterConfig, InputConfig, Limits, OutputConfig, PinName, SimConfig, SimError,
};
pub use printer_cfg::printer_cfg;

use physics::{Axis, Fan, Heater, Lamp, Noise, Switch};

/// The SPI bus that sends back what it is sent.
const LOOPBACK_BUS: &str = "spidev0.0";
/// The worker of the bus.
const SPI_WORKER: &str = "spi0";

/// What a pin is wired to.
#[derive(Clone)]
enum Wire {
    Step(Arc<Axis>),
    Direction(Arc<Axis>),
    Enable(Arc<Axis>),
    Endstop(Arc<Axis>),
    Heater(Arc<Heater>),
    Sensor(Arc<Heater>),
    Fan(Arc<Fan>, Switch),
    Tachometer(Arc<Fan>),
    Lamp(Arc<Lamp>),
    Level(bool),
}

impl Wire {
    /// What it is, for a person, and whose.
    fn describe(&self) -> String {
        match self {
            Wire::Step(axis) => format!("output (step of axis {})", axis.name),
            Wire::Direction(axis) => format!("output (direction of axis {})", axis.name),
            Wire::Enable(axis) => format!("output (enable of axis {})", axis.name),
            Wire::Endstop(axis) => format!("input (endstop of axis {})", axis.name),
            Wire::Heater(heater) => format!("output (heater {})", heater.name),
            Wire::Sensor(heater) => format!("ADC channel (sensor of heater {})", heater.name),
            Wire::Fan(fan, Switch::Power) => format!("output (fan {})", fan.name),
            Wire::Fan(fan, Switch::Enable) => format!("output (enable of fan {})", fan.name),
            Wire::Tachometer(fan) => format!("input (tachometer of fan {})", fan.name),
            Wire::Lamp(lamp) => format!("output ({})", lamp.name),
            Wire::Level(_) => "input".to_owned(),
        }
    }
}

/// A pin of the board.
struct Line {
    name: String,
    inverted: bool,
    wire: Wire,
}

/// Everything that moves, heats, spins and shines.
struct World {
    axes: Vec<Arc<Axis>>,
    heaters: Vec<Arc<Heater>>,
    fans: Vec<Arc<Fan>>,
    lamps: Vec<Arc<Lamp>>,
}

/// A simulated printer.
pub struct SimBoard {
    clock: Arc<dyn TimeSource>,
    seed: u64,
    world: Arc<World>,
    /// By pin number.
    lines: Vec<Line>,
    claimed: HashSet<Pin>,
}

impl SimBoard {
    /// The printer of a description, at rest.
    pub fn new(config: SimConfig, clock: Arc<dyn TimeSource>) -> Result<SimBoard, SimError> {
        config.validate()?;
        let now = clock.now();
        let mut lines = Vec::new();
        let mut wire = |pin: Option<&PinName>, wire: Wire| {
            lines.extend(pin.map(|pin| Line { name: pin.name.clone(), inverted: pin.inverted, wire }));
        };
        let mut world = World { axes: Vec::new(), heaters: Vec::new(), fans: Vec::new(), lamps: Vec::new() };
        for part in &config.axes {
            let axis = Arc::new(Axis::new(part));
            wire(Some(&part.step_pin), Wire::Step(axis.clone()));
            wire(Some(&part.dir_pin), Wire::Direction(axis.clone()));
            wire(part.enable_pin.as_ref(), Wire::Enable(axis.clone()));
            wire(part.endstop_pin.as_ref(), Wire::Endstop(axis.clone()));
            world.axes.push(axis);
        }
        for part in &config.heaters {
            let heater = Arc::new(Heater::new(part, part.thermistor()?, now));
            wire(Some(&part.pin), Wire::Heater(heater.clone()));
            wire(Some(&part.sensor_pin), Wire::Sensor(heater.clone()));
            world.heaters.push(heater);
        }
        for part in &config.fans {
            let fan = Arc::new(Fan::new(part, now));
            wire(Some(&part.pin), Wire::Fan(fan.clone(), Switch::Power));
            wire(part.enable_pin.as_ref(), Wire::Fan(fan.clone(), Switch::Enable));
            wire(part.tachometer_pin.as_ref(), Wire::Tachometer(fan.clone()));
            world.fans.push(fan);
        }
        for part in config.leds.iter().chain(&config.outputs) {
            let lamp = Arc::new(Lamp::new(&part.name));
            wire(Some(&part.pin), Wire::Lamp(lamp.clone()));
            world.lamps.push(lamp);
        }
        for part in &config.inputs {
            wire(Some(&part.pin), Wire::Level(part.level));
        }
        Ok(SimBoard { clock, seed: config.seed, world: Arc::new(world), lines, claimed: HashSet::new() })
    }

    /// A view of the printer for demonstrations, drawings and tests.
    pub fn probe(&self) -> SimProbe {
        SimProbe { world: self.world.clone(), clock: self.clock.clone() }
    }

    /// Claims a pin that has to be what `pick` picks.
    fn claim<T>(
        &mut self,
        pin: Pin,
        (kind, wrong_kind, taken): (&str, Reason, Reason),
        pick: impl FnOnce(&Line) -> Option<T>,
    ) -> Result<T, Shutdown> {
        let line = usize::try_from(pin.0).ok().and_then(|i| self.lines.get(i));
        let Some(line) = line else {
            return Err(Shutdown::because(
                wrong_kind,
                format!(
                    "the simulated printer has no pin {}: name one of its {} pins (pinion sim \
                     --print-config shows them)",
                    pin.0,
                    self.lines.len(),
                ),
            ));
        };
        let Some(picked) = pick(line) else {
            return Err(Shutdown::because(
                wrong_kind,
                format!(
                    "pin {} of the simulated printer is an {}, no {kind}: choose another pin",
                    line.name,
                    line.wire.describe(),
                ),
            ));
        };
        if !self.claimed.insert(pin) {
            return Err(Shutdown::because(
                taken,
                format!(
                    "pin {} of the simulated printer is in use already as {}: choose another pin \
                     or remove one use",
                    line.name,
                    line.wire.describe(),
                ),
            ));
        }
        Ok(picked)
    }
}

impl Board for SimBoard {
    fn describe(&self) -> String {
        let count = |count: usize, one: &str, many: &str| format!("{count} {}", if count == 1 { one } else { many });
        format!(
            "simulated printer: {}, {}, {}, {}",
            count(self.world.axes.len(), "axis", "axes"),
            count(self.world.heaters.len(), "heater", "heaters"),
            count(self.world.fans.len(), "fan", "fans"),
            count(self.lines.len(), "pin", "pins"),
        )
    }

    fn pins(&self) -> Vec<Range> {
        let range = |(first, line): (u32, &Line)| Range { name: line.name.clone(), first, count: 1 };
        (0..).zip(&self.lines).map(range).collect()
    }

    fn spi_buses(&self) -> Vec<Range> {
        vec![Range { name: LOOPBACK_BUS.to_owned(), first: 0, count: 1 }]
    }

    fn output(&mut self, pin: Pin, value: bool, _shutdown_value: bool) -> Result<Box<dyn Output>, Shutdown> {
        let clock = self.clock.clone();
        let kind = ("output", Reason::NotOutput, Reason::OutputLine);
        let mut line = self.claim(pin, kind, |line| {
            let drive = match &line.wire {
                Wire::Step(axis) => Drive::Step {
                    axis: axis.clone(),
                    // The line is driven to its first level before the motor looks at it.
                    level: value != line.inverted,
                },
                Wire::Direction(axis) => Drive::Direction(axis.clone()),
                Wire::Enable(axis) => Drive::Enable(axis.clone()),
                Wire::Heater(heater) => Drive::Heater(heater.clone(), clock),
                Wire::Fan(fan, switch) => Drive::Fan(fan.clone(), *switch, clock),
                Wire::Lamp(lamp) => Drive::Lamp(lamp.clone()),
                Wire::Endstop(_) | Wire::Sensor(_) | Wire::Tachometer(_) | Wire::Level(_) => {
                    return None;
                }
            };
            Some(OutputLine { drive, inverted: line.inverted })
        })?;
        line.write(value)?;
        Ok(Box::new(line))
    }

    /// The parts drive their lines harder than any bias pulls.
    fn input(&mut self, pin: Pin, _bias: Bias) -> Result<Box<dyn Input>, Shutdown> {
        let clock = self.clock.clone();
        let kind = ("input", Reason::NotInput, Reason::InputLine);
        let line = self.claim(pin, kind, |line| {
            let sense = match &line.wire {
                Wire::Endstop(axis) => Sense::Endstop(axis.clone()),
                Wire::Tachometer(fan) => Sense::Tachometer(fan.clone(), clock),
                Wire::Level(level) => Sense::Level(*level),
                _ => return None,
            };
            Some(InputLine { sense, inverted: line.inverted })
        })?;
        Ok(Box::new(line))
    }

    fn adc(&mut self, pin: Pin) -> Result<Attachment, Shutdown> {
        let clock = self.clock.clone();
        let seed = self.seed ^ u64::from(pin.0) << 32;
        let kind = ("ADC channel", Reason::AdcOpen, Reason::AdcOpen);
        let sensor = self.claim(pin, kind, |line| match &line.wire {
            Wire::Sensor(heater) => Some(Sensor { heater: heater.clone(), clock, noise: Noise::new(seed) }),
            _ => None,
        })?;
        Ok(Attachment::Inline(Box::new(sensor)))
    }

    /// A simulated motor follows at any pace: a computer without real time, as most that try
    /// the printer, is late by milliseconds now and then.
    fn step_late_limit(&self) -> Ticks {
        Ticks::from_us(100_000)
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<Attachment, Shutdown> {
        let detail =
            format!("the simulated printer has no hardware PWM (pin number {}): leave out hardware_pwm", config.pin.0);
        Err(Shutdown::because(Reason::PwmConfig, detail))
    }

    fn spi(&mut self, config: SpiConfig) -> Result<Attachment, Shutdown> {
        if config.bus != 0 {
            return Err(Shutdown::because(
                Reason::SpiOpen,
                format!("the simulated printer has no SPI bus {}: use {LOOPBACK_BUS}", config.bus),
            ));
        }
        if config.mode > 3 {
            return Err(Shutdown::because(
                Reason::InvalidSpi,
                format!("SPI mode {} on {LOOPBACK_BUS}: use 0 to 3", config.mode),
            ));
        }
        Ok(Attachment::Worker {
            bus: SPI_WORKER.to_owned(),
            device: Box::new(Loopback { chip_select: config.chip_select }),
        })
    }

    fn reset(&mut self) {
        self.claimed.clear();
    }
}

/// What an output line drives.
enum Drive {
    Step { axis: Arc<Axis>, level: bool },
    Direction(Arc<Axis>),
    Enable(Arc<Axis>),
    Heater(Arc<Heater>, Arc<dyn TimeSource>),
    Fan(Arc<Fan>, Switch, Arc<dyn TimeSource>),
    Lamp(Arc<Lamp>),
}

struct OutputLine {
    drive: Drive,
    inverted: bool,
}

impl Output for OutputLine {
    fn write(&mut self, value: bool) -> Result<(), Shutdown> {
        let on = value != self.inverted;
        match &mut self.drive {
            Drive::Step { axis, level } => {
                if on != *level && (on || axis.both_edges) {
                    axis.step();
                }
                *level = on;
            }
            Drive::Direction(axis) => axis.set_forward(on),
            Drive::Enable(axis) => axis.set_enabled(on),
            Drive::Heater(heater, clock) => heater.switch(on, clock.now()),
            Drive::Fan(fan, switch, clock) => fan.switch(*switch, on, clock.now()),
            Drive::Lamp(lamp) => lamp.switch(on),
        }
        Ok(())
    }
}

/// What an input line senses.
enum Sense {
    Endstop(Arc<Axis>),
    Tachometer(Arc<Fan>, Arc<dyn TimeSource>),
    Level(bool),
}

struct InputLine {
    sense: Sense,
    inverted: bool,
}

impl Input for InputLine {
    fn read(&mut self) -> Result<bool, Shutdown> {
        let on = match &self.sense {
            Sense::Endstop(axis) => axis.endstop().unwrap_or(false),
            Sense::Tachometer(fan, clock) => fan.tachometer(clock.now()),
            Sense::Level(level) => *level,
        };
        Ok(on != self.inverted)
    }
}

/// A thermistor at its ADC channel.
struct Sensor {
    heater: Arc<Heater>,
    clock: Arc<dyn TimeSource>,
    noise: Noise,
}

impl Device for Sensor {
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
        let celsius = self.heater.at(self.clock.now()).sensor_celsius;
        let noise_counts = self.noise.draw() * self.heater.noise_counts;
        let counts = self.heater.thermistor.counts(celsius, noise_counts);
        *data = Buffer::new(&counts.to_le_bytes());
        Ok(())
    }
}

/// An SPI device with its output wired to its input: every byte comes back.
struct Loopback {
    chip_select: Option<ChipSelect>,
}

impl Device for Loopback {
    fn run(&mut self, _data: &mut Buffer) -> Result<(), Shutdown> {
        if let Some(chip_select) = &mut self.chip_select {
            chip_select.select(true)?;
            chip_select.select(false)?;
        }
        Ok(())
    }
}

/// A view of a simulated printer, from any thread, while it runs.
#[derive(Clone)]
pub struct SimProbe {
    world: Arc<World>,
    clock: Arc<dyn TimeSource>,
}

/// An axis as it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisView<'a> {
    /// Such as `x`.
    pub name: &'a str,
    /// Where it stands.
    pub position_mm: f64,
    /// It goes from 0 to here, if it ends.
    pub travel_mm: Option<f64>,
    /// Whether its motor is held.
    pub enabled: bool,
    /// Whether its endstop is closed; none if it has none.
    pub endstop: Option<bool>,
    /// Steps that it could not go since the start.
    pub lost_steps: u64,
}

/// A heater as it is.
#[derive(Clone, Debug, PartialEq)]
pub struct HeaterView<'a> {
    /// Such as `heater_bed`.
    pub name: &'a str,
    /// Temperature of the heated mass.
    pub celsius: f64,
    /// Temperature of its sensor, which lags behind.
    pub sensor_celsius: f64,
    /// Whether power is on.
    pub on: bool,
}

/// A fan as it turns.
#[derive(Clone, Debug, PartialEq)]
pub struct FanView<'a> {
    /// Such as `fan`.
    pub name: &'a str,
    /// Revolutions in a minute.
    pub rpm: f64,
}

/// A light, or another output that is on or off.
#[derive(Clone, Debug, PartialEq)]
pub struct OutputView<'a> {
    /// Such as `light`.
    pub name: &'a str,
    /// Whether it is on.
    pub on: bool,
}

impl SimProbe {
    /// The instant of the printer's clock.
    pub fn now(&self) -> Clock {
        self.clock.now()
    }

    /// The axes, in the description's order.
    pub fn axes(&self) -> impl Iterator<Item = AxisView<'_>> {
        self.world.axes.iter().map(|axis| AxisView {
            name: &axis.name,
            position_mm: axis.position_mm(),
            travel_mm: axis.travel_mm,
            enabled: axis.is_enabled(),
            endstop: axis.endstop(),
            lost_steps: axis.lost_steps(),
        })
    }

    /// The heaters at this instant.
    pub fn heaters(&self) -> impl Iterator<Item = HeaterView<'_>> {
        let now = self.now();
        self.world.heaters.iter().map(move |heater| {
            let heat = heater.at(now);
            HeaterView { name: &heater.name, celsius: heat.celsius, sensor_celsius: heat.sensor_celsius, on: heat.on }
        })
    }

    /// The fans at this instant.
    pub fn fans(&self) -> impl Iterator<Item = FanView<'_>> {
        let now = self.now();
        self.world.fans.iter().map(move |fan| FanView { name: &fan.name, rpm: fan.rpm(now) })
    }

    /// The lights, then the other outputs.
    pub fn outputs(&self) -> impl Iterator<Item = OutputView<'_>> {
        self.world.lamps.iter().map(|lamp| OutputView { name: &lamp.name, on: lamp.is_on() })
    }

    /// An axis by name.
    pub fn axis(&self, name: &str) -> Option<AxisView<'_>> {
        self.axes().find(|axis| axis.name == name)
    }

    /// A heater by name.
    pub fn heater(&self, name: &str) -> Option<HeaterView<'_>> {
        self.heaters().find(|heater| heater.name == name)
    }

    /// A fan by name.
    pub fn fan(&self, name: &str) -> Option<FanView<'_>> {
        self.fans().find(|fan| fan.name == name)
    }

    /// A light or another output by name.
    pub fn output(&self, name: &str) -> Option<OutputView<'_>> {
        self.outputs().find(|output| output.name == name)
    }
}

#[cfg(test)]
mod tests;
