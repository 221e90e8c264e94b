// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer: axes that count steps and close endstops, heaters with a mass and a
//! thermistor, fans with a tachometer, lights, all of it described in TOML.
//!
//! It runs under a real host in real time, and in tests in virtual time: whatever happens
//! between two writes is solved exactly from the clock.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::{
    Adc, Board, BusDevice, ClaimedLine, Direction, I2cConfig, Line, OnWorker, Pin, Pwm, PwmConfig, Range, SpiConfig,
};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use crate::time::{Clock, Ticks, TimeSource};

mod config;
mod loopback;
mod physics;
mod printer_cfg;
mod spi;
mod thermistor;
mod tmc5160;

pub use config::{
    AxisConfig, ChipConfig, End, FanConfig, HeaterConfig, InputConfig, Limits, OutputConfig, PinName, SimConfig,
    SimError, SpiBusConfig,
};
pub use printer_cfg::printer_cfg;

use loopback::Loopback;
use physics::{Axis, Fan, Heater, Lamp, Noise, Switch};
use spi::{SelectLine, SpiBus, SpiChip, SpiDevice};
use tmc5160::Tmc5160;

/// The worker of the thermistors.
const ADC_WORKER: &str = "adc";

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
    Select(Arc<SelectLine>),
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
            Wire::Select(line) => format!("output (chip select of {})", line.chip),
            Wire::Level(_) => "input".to_owned(),
        }
    }
}

/// A pin of the board.
#[derive(Clone)]
struct WiredPin {
    name: String,
    inverted: bool,
    wire: Wire,
}

impl WiredPin {
    /// Says that it is no `kind` of pin.
    fn is_no(&self, kind: &str, reason: ShutdownReason) -> Shutdown {
        let detail = format!(
            "pin {} of the simulated printer is an {}, no {kind}: choose another pin",
            self.name,
            self.wire.describe()
        );
        Shutdown::because(reason, detail)
    }
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
    pins: Vec<WiredPin>,
    /// By number.
    spi_buses: Vec<Arc<SpiBus>>,
}

impl SimBoard {
    /// The printer of a description, at rest.
    pub fn new(config: SimConfig, clock: Arc<dyn TimeSource>) -> Result<SimBoard, SimError> {
        config.validate()?;
        let now = clock.now();
        let mut pins = Vec::new();
        let mut wire = |pin: Option<&PinName>, wire: Wire| {
            pins.extend(pin.map(|pin| WiredPin { name: pin.name.clone(), inverted: pin.inverted, wire }));
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
        for part in config.switched() {
            let lamp = Arc::new(Lamp::new(&part.name));
            wire(Some(&part.pin), Wire::Lamp(lamp.clone()));
            world.lamps.push(lamp);
        }
        for part in &config.inputs {
            wire(Some(&part.pin), Wire::Level(part.level));
        }
        let lamp = |name: &str| {
            let (part, lamp) = config.switched().zip(&world.lamps).find(|(part, _)| part.pin.name == name)?;
            Some((lamp.clone(), part.pin.inverted))
        };
        let buses: Result<Vec<_>, _> = config.spi_buses.iter().map(|bus| SpiBus::new(bus, lamp)).collect();
        let mut buses = buses?;
        for part in &config.chips {
            let chip: Box<dyn SpiChip> = match part {
                ChipConfig::Loopback { .. } => Box::new(Loopback),
                ChipConfig::Tmc5160 { axis, .. } => {
                    let Some(axis) = world.axes.iter().find(|other| other.name == *axis) else { continue };
                    Box::new(Tmc5160::new(axis.clone(), clock.clone()))
                }
            };
            let select = part.select_pin().map(|_| Arc::new(SelectLine::new(&part.name())));
            if let Some(line) = &select {
                wire(part.select_pin(), Wire::Select(line.clone()));
            }
            if let Some(bus) = buses.iter_mut().find(|bus| bus.name == part.bus()) {
                bus.solder(part.name(), select, chip);
            }
        }
        let spi_buses = buses.into_iter().map(Arc::new).collect();
        Ok(SimBoard { clock, seed: config.seed, world: Arc::new(world), pins, spi_buses })
    }

    /// A view of the printer for demonstrations, drawings and tests.
    pub fn probe(&self) -> SimProbe {
        SimProbe { world: self.world.clone(), clock: self.clock.clone() }
    }

    fn pin(&self, pin: Pin, no_pin: ShutdownReason) -> Result<&WiredPin, Shutdown> {
        usize::try_from(pin.0).ok().and_then(|place| self.pins.get(place)).ok_or_else(|| {
            let detail = format!(
                "the simulated printer has no pin {}: name one of its {} pins (pinion sim --print-config shows them)",
                pin.0,
                self.pins.len(),
            );
            Shutdown::because(no_pin, detail)
        })
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
            count(self.pins.len(), "pin", "pins"),
        )
    }

    fn pins(&self) -> Vec<Range> {
        let range = |(first, pin): (u32, &WiredPin)| Range { name: pin.name.clone(), first, count: 1 };
        (0..).zip(&self.pins).map(range).collect()
    }

    fn spi_buses(&self) -> Vec<Range> {
        let range = |(first, bus): (u32, &Arc<SpiBus>)| Range { name: bus.name.clone(), first, count: 1 };
        (0..).zip(&self.spi_buses).map(range).collect()
    }

    /// The parts drive their lines harder than any bias pulls.
    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let no_pin = match direction {
            Direction::Output { .. } | Direction::OpenDrain => reason::NOT_OUTPUT,
            Direction::Input(_) => reason::NOT_INPUT,
        };
        let pin = self.pin(pin, no_pin)?.clone();
        // The line stands at its first level before the motor looks at it.
        let first = matches!(direction, Direction::Output { level, .. } if level != pin.inverted);
        let line = SimLine { pin, on: AtomicBool::new(first), clock: self.clock.clone() };
        line.set_direction(direction)?;
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on: None })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let wired = self.pin(pin, reason::ADC_OPEN)?;
        let Wire::Sensor(heater) = &wired.wire else { return Err(wired.is_no("ADC channel", reason::ADC_OPEN)) };
        let noise = Noise::new(self.seed ^ u64::from(pin.0) << 32);
        let sensor = Sensor { heater: heater.clone(), clock: self.clock.clone(), noise };
        Ok(OnWorker { bus: ADC_WORKER.to_owned(), device: Box::new(sensor) })
    }

    /// A simulated motor follows at any pace: a computer without real time, as most that try
    /// the printer, is late by milliseconds now and then.
    fn step_late_limit(&self) -> Ticks {
        Ticks::from_us(100_000)
    }

    fn i2c_buses(&self) -> Vec<Range> {
        Vec::new()
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let detail = format!("the simulated printer has no I2C bus {}: leave out what is on it", config.bus);
        Err(Shutdown::because(reason::I2C_OPEN, detail))
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let detail =
            format!("the simulated printer has no hardware PWM (pin number {}): leave out hardware_pwm", config.pin.0);
        Err(Shutdown::because(reason::PWM_CONFIG, detail))
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let bus = usize::try_from(config.bus).ok().and_then(|place| self.spi_buses.get(place)).ok_or_else(|| {
            let names: Vec<&str> = self.spi_buses.iter().map(|bus| bus.name.as_str()).collect();
            let has = if names.is_empty() { "it has none".to_owned() } else { format!("use {}", names.join(" or ")) };
            Shutdown::because(reason::SPI_OPEN, format!("the simulated printer has no SPI bus {}: {has}", config.bus))
        })?;
        let device = SpiDevice { bus: bus.clone(), mode: config.mode, chip_select: config.chip_select };
        Ok(OnWorker { bus: format!("spi{}", config.bus), device: Box::new(device) })
    }

    /// Nothing is claimed for good: the parts are there whoever drives them.
    fn reset(&mut self) {}
}

/// A line of the board: what a pin is wired to, driven or sensed.
struct SimLine {
    pin: WiredPin,
    /// Whether it was driven on last.
    on: AtomicBool,
    clock: Arc<dyn TimeSource>,
}

impl Line for SimLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        let on = level != self.pin.inverted;
        let was_on = self.on.swap(on, Ordering::Relaxed);
        match &self.pin.wire {
            Wire::Step(axis) if on != was_on => axis.edge(on),
            Wire::Direction(axis) => axis.set_forward(on),
            Wire::Enable(axis) => axis.set_enabled(on),
            Wire::Heater(heater) => heater.switch(on, self.clock.now()),
            Wire::Fan(fan, switch) => fan.switch(*switch, on, self.clock.now()),
            Wire::Lamp(lamp) => lamp.switch(on),
            Wire::Select(line) => line.drive(on),
            Wire::Step(_) | Wire::Endstop(_) | Wire::Sensor(_) | Wire::Tachometer(_) | Wire::Level(_) => {}
        }
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        let on = match &self.pin.wire {
            Wire::Endstop(axis) => axis.endstop().unwrap_or(false),
            Wire::Tachometer(fan) => fan.tachometer(self.clock.now()),
            Wire::Level(level) => *level,
            _ => self.on.load(Ordering::Relaxed),
        };
        Ok(on != self.pin.inverted)
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let senses = matches!(self.pin.wire, Wire::Endstop(_) | Wire::Tachometer(_) | Wire::Level(_));
        let drives = !senses && !matches!(self.pin.wire, Wire::Sensor(_));
        match direction {
            Direction::Output { level, .. } if drives => self.write(level),
            Direction::OpenDrain if drives => self.write(true),
            Direction::Output { .. } | Direction::OpenDrain => Err(self.pin.is_no("output", reason::NOT_OUTPUT)),
            Direction::Input(_) if senses => Ok(()),
            Direction::Input(_) => Err(self.pin.is_no("input", reason::NOT_INPUT)),
        }
    }
}

/// A thermistor at its ADC channel.
struct Sensor {
    heater: Arc<Heater>,
    clock: Arc<dyn TimeSource>,
    noise: Noise,
}

impl Adc for Sensor {
    fn read(&mut self) -> Result<u16, Shutdown> {
        let celsius = self.heater.at(self.clock.now()).sensor_celsius;
        let noise_counts = self.noise.draw() * self.heater.noise_counts;
        Ok(self.heater.thermistor.counts(celsius, noise_counts))
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
