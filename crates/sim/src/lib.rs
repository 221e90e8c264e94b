// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer: axes that count steps and close endstops, heaters with a mass and a
//! thermistor, fans with a tachometer, lights, all of it described in TOML.
//!
//! It runs under a real host in real time, and in tests in virtual time: whatever happens
//! between two writes is solved exactly from the clock.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

use std::sync::Arc;

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, ClaimedLine, CountedLine, Direction, Edges, I2cConfig, Mosi, OnWorker, Pin, Pwm,
    PwmConfig, Range, SpiConfig, Thermometer, not_mosi,
};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_firmware::time::{Clock, Ticks, TimeSource};

mod catalog;
mod config;
mod description;
mod engine;
mod klippy;
mod part;
mod printer_cfg;

pub use catalog::PartConfig;
pub use config::SimConfig;
pub use description::axes::{AxisConfig, BedConfig, DeltaConfig, End, Limits};
pub use description::buses::{I2cBusConfig, SpiBusConfig};
pub use description::check::SimError;
pub use description::heater::{FanConfig, HeaterConfig};
pub use description::outputs::{InputConfig, LedConfig, OutputConfig};
pub use description::pin::PinName;
pub use part::ads1220::Ads1220Config;
pub use part::adxl345::Adxl345Config;
pub use part::angle::{AngleChip, AngleConfig};
pub use part::apa102::Apa102Config;
pub use part::bltouch::{BltouchConfig, Jam};
pub use part::ds18b20::Ds18b20Config;
pub use part::hx71x::{Hx71xChip, Hx71xConfig};
pub use part::ldc1612::Ldc1612Config;
pub use part::load_cell::CellConfig;
pub use part::loopback::LoopbackConfig;
pub use part::probe::ProbeConfig;
pub use part::pwm_channel::PwmChannelConfig;
pub use part::servo::ServoConfig;
pub use part::spool::SpoolConfig;
pub use part::ssd1306::Ssd1306Config;
pub use part::thermocouple::{Converter, SensorFault, ThermocoupleConfig};
pub use part::tmc2209::Tmc2209Config;
pub use part::tmc5160::Tmc5160Config;
pub use part::ws2812::Ws2812Config;
pub use printer_cfg::printer_cfg;

use engine::i2c::{I2cBus, I2cDevice};
use engine::led::ColouredLed;
use engine::noise::Noise;
use engine::physics::{Axis, Fan, Heater, Lamp, Switch};
use engine::spi::{MosiPin, SpiBus, SpiDevice};
use engine::time::{ErrandTime, PrinterTime, STEP_LATE_LIMIT};
use engine::wire::{
    DirectionPin, EnablePin, EndstopPin, FanPin, FixedInput, HeaterPin, Kind, LampPin, SimAdc, SimEdges, SimLine,
    SimPwm, StepPin, TachometerPin, ThermistorPin, WiredPin,
};
use engine::world::World;
use part::workshop::Workshop;

/// The worker of the thermistors.
const ADC_WORKER: &str = "adc";
/// The worker that counts edges.
const EDGES_WORKER: &str = "edges";
/// The worker of the PWM channels.
const PWM_WORKER: &str = "pwm";
/// Bytes that an SPI bus sends without a pause: as many as by the kernel's default `spidev.bufsiz`.
const MESSAGE_MAX: usize = 4096;

/// A simulated printer.
pub struct SimBoard {
    time: Arc<PrinterTime>,
    seed: u64,
    world: Arc<World>,
    /// By pin number.
    pins: Vec<WiredPin>,
    /// By number.
    spi_buses: Vec<Arc<SpiBus>>,
    /// By number.
    i2c_buses: Vec<Arc<I2cBus>>,
}

impl SimBoard {
    /// The printer of a description, at rest.
    pub fn new(config: SimConfig, clock: Arc<dyn TimeSource>) -> Result<SimBoard, SimError> {
        config.validate()?;
        let printer = config.printer();
        let now = clock.now();
        let mut workshop = Workshop {
            printer,
            time: Arc::new(PrinterTime::new(clock)),
            world: World::default(),
            pins: Vec::new(),
            spi_buses: Vec::new(),
            i2c_buses: config.i2c_buses.iter().map(I2cBus::new).collect(),
        };
        for part in &config.axes {
            let axis = Arc::new(Axis::new(part));
            workshop.wire(Some(&part.step_pin), StepPin(axis.clone()));
            workshop.wire(Some(&part.dir_pin), DirectionPin(axis.clone()));
            workshop.wire(part.enable_pin.as_ref(), EnablePin(axis.clone()));
            workshop.wire(part.endstop_pin.as_ref(), EndstopPin(axis.clone()));
            workshop.world.axes.push(axis);
        }
        for part in &config.heaters {
            let cooling_w_per_k = printer.fan_of(&part.name).map_or(0.0, |fan| fan.cooling_w_per_k);
            let heater = Arc::new(Heater::new(part, part.thermistor()?, cooling_w_per_k, now));
            workshop.wire(part.pin.as_ref(), HeaterPin(heater.clone()));
            workshop.wire(Some(&part.sensor_pin), ThermistorPin(heater.clone()));
            workshop.world.heaters.push(heater);
        }
        for part in &config.fans {
            let cools = part.cools.as_ref().and_then(|heater| workshop.heater(heater));
            let fan = Arc::new(Fan::new(part, cools, now));
            workshop.wire(Some(&part.pin), FanPin(fan.clone(), Switch::Power));
            workshop.wire(part.enable_pin.as_ref(), FanPin(fan.clone(), Switch::Enable));
            workshop.wire(part.tachometer_pin.as_ref(), TachometerPin(fan.clone()));
            workshop.world.fans.push(fan);
        }
        let mut switched: Vec<(&PinName, Arc<Lamp>)> = Vec::new();
        let mut lamp = |workshop: &mut Workshop<'_>, name: &str, pin| {
            let lamp = Arc::new(Lamp::new(name));
            workshop.wire(Some(pin), LampPin(lamp.clone()));
            switched.push((pin, lamp.clone()));
            lamp
        };
        for part in &config.leds {
            let lamps = part.pins().map(|(_, pin)| pin.map(|pin| lamp(&mut workshop, &part.name, pin)));
            match lamps {
                [None, None, None, Some(lamp)] => workshop.world.lamps.push(lamp),
                lamps => workshop.show(Arc::new(ColouredLed { name: part.name.clone(), lamps })),
            }
        }
        for part in &config.outputs {
            let lamp = lamp(&mut workshop, &part.name, &part.pin);
            workshop.world.lamps.push(lamp);
        }
        for part in &config.inputs {
            workshop.wire(Some(&part.pin), FixedInput { name: part.name.clone(), on: part.level });
        }
        for bus in &config.spi_buses {
            let bus = SpiBus::new(bus, |name| {
                let (pin, lamp) = switched.iter().find(|(pin, _)| pin.name == name)?;
                Some((lamp.clone(), pin.inverted))
            })?;
            workshop.spi_buses.push(bus);
        }
        for part in &config.parts {
            part.part().build(&mut workshop)?;
        }
        for bus in &config.spi_buses {
            workshop.wire(Some(&bus.mosi_pin()), MosiPin { bus: bus.name.clone() });
        }
        let Workshop { time, world, pins, spi_buses, i2c_buses, .. } = workshop;
        Ok(SimBoard {
            time,
            seed: config.seed,
            world: Arc::new(world),
            pins,
            spi_buses: spi_buses.into_iter().map(Arc::new).collect(),
            i2c_buses: i2c_buses.into_iter().map(Arc::new).collect(),
        })
    }

    /// A view of the printer for demonstrations, drawings and tests.
    pub fn probe(&self) -> SimProbe {
        SimProbe { world: self.world.clone(), time: self.time.clone() }
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

/// The bus with a number, or why there is none.
fn numbered<'a, T>(
    buses: &'a [Arc<T>],
    number: u32,
    kind: &str,
    name: impl Fn(&T) -> &str,
    reason: ShutdownReason,
) -> Result<&'a Arc<T>, Shutdown> {
    usize::try_from(number)
        .ok()
        .and_then(|place| buses.get(place))
        .ok_or_else(|| is_missing(&format!("{kind} bus {number}"), buses.iter().map(|bus| name(bus)), reason))
}

/// Says that there is no such thing, but these.
fn is_missing<'a>(what: &str, names: impl Iterator<Item = &'a str>, reason: ShutdownReason) -> Shutdown {
    let names: Vec<&str> = names.collect();
    let has = if names.is_empty() { "it has none".to_owned() } else { format!("use {}", names.join(" or ")) };
    Shutdown::because(reason, format!("the simulated printer has no {what}: {has}"))
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

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let no_pin = match direction {
            Direction::Output { .. } | Direction::OpenDrain => reason::NOT_OUTPUT,
            Direction::Input(_) => reason::NOT_INPUT,
        };
        let line = SimLine::new(self.pin(pin, no_pin)?.clone(), self.time.clone());
        pinion_firmware::board::Line::set_direction(&line, direction)?;
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on: None })
    }

    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        let line = self.line(pin, Direction::Input(bias))?;
        let wired = self.pin(pin, reason::NOT_INPUT)?;
        let edges = match SimEdges::new(wired.wire.clone(), self.time.clone()) {
            Some(edges) => Ok(OnWorker { bus: EDGES_WORKER.to_owned(), device: Box::new(edges) as Box<dyn Edges> }),
            None => Err(format!("nobody counts the edges of {}", wired.wire.describe()).into()),
        };
        Ok(CountedLine { line, edges })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let wired = self.pin(pin, reason::ADC_OPEN)?;
        if wired.wire.kind() != Kind::Analog {
            return Err(wired.is_no("ADC channel", reason::ADC_OPEN));
        }
        let noise = Noise::of(&wired.name, self.seed);
        let adc = SimAdc { wire: wired.wire.clone(), time: self.time.clone(), noise };
        Ok(OnWorker { bus: ADC_WORKER.to_owned(), device: Box::new(adc) })
    }

    fn runs(&mut self, due: Option<Clock>) {
        self.time.set_due(due);
    }

    fn errand_clock(&self, machine: Arc<dyn TimeSource>) -> Arc<dyn TimeSource> {
        Arc::new(ErrandTime(machine))
    }

    fn step_late_limit(&self) -> Ticks {
        STEP_LATE_LIMIT
    }

    fn i2c_buses(&self) -> Vec<Range> {
        let range = |(first, bus): (u32, &Arc<I2cBus>)| Range { name: bus.name.clone(), first, count: 1 };
        (0..).zip(&self.i2c_buses).map(range).collect()
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let bus = numbered(&self.i2c_buses, config.bus, "I2C", |bus| &bus.name, reason::I2C_OPEN)?;
        let device = I2cDevice { bus: bus.clone(), address: config.address };
        Ok(OnWorker { bus: format!("i2c{}", config.bus), device: Box::new(device) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let wired = self.pin(config.pin, reason::PWM_CONFIG)?;
        if wired.wire.kind() != Kind::Pwm {
            return Err(wired.is_no("hardware PWM channel", reason::PWM_CONFIG));
        }
        let mut pwm = SimPwm(wired.wire.clone());
        pwm.set(config.value)?;
        Ok(OnWorker { bus: PWM_WORKER.to_owned(), device: Box::new(pwm) })
    }

    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        let found = self.world.thermometers.iter().find(|(name, _)| name.as_bytes() == serial);
        let (name, open) = found.ok_or_else(|| {
            let names = self.world.thermometers.iter().map(|(name, _)| name.as_str());
            let what = format!("DS18B20 {}", String::from_utf8_lossy(serial));
            is_missing(&what, names, reason::DS18B20_OPEN)
        })?;
        Ok(OnWorker { bus: name.clone(), device: open() })
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let bus = numbered(&self.spi_buses, config.bus, "SPI", |bus| &bus.name, reason::SPI_OPEN)?;
        let device =
            SpiDevice { bus: bus.clone(), mode: config.mode, rate_hz: config.rate_hz, chip_select: config.chip_select };
        Ok(OnWorker { bus: format!("spi{}", config.bus), device: Box::new(device) })
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Mosi, Shutdown> {
        let wired = self.pin(pin, reason::NOT_OUTPUT)?;
        let bus = self.spi_buses().into_iter().find(|bus| wired.wire.kind() == Kind::Mosi && bus.name == wired.name);
        let bus = bus.ok_or_else(|| not_mosi(&wired.name))?.first;
        let line = self.spi(SpiConfig { bus, mode: 0, rate_hz, chip_select: None })?;
        Ok(Mosi { line, message_max: MESSAGE_MAX })
    }

    /// Nothing is claimed for good: the parts are there whoever drives them.
    fn reset(&mut self) {}
}

/// A view of a simulated printer, from any thread, while it runs.
#[derive(Clone)]
pub struct SimProbe {
    world: Arc<World>,
    time: Arc<PrinterTime>,
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
    /// How bright an eye takes it for, 0 to 1: half if it is switched on and off quickly.
    pub brightness: f64,
}

impl SimProbe {
    /// The instant of the printer's clock.
    pub fn now(&self) -> Clock {
        self.time.now()
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
        let now = self.now();
        let lamps = self.world.lamps.iter();
        lamps.map(move |lamp| OutputView { name: &lamp.name, on: lamp.is_on(), brightness: lamp.brightness(now) })
    }

    /// What a person would see of the other parts at this instant: the part's name, and a line or a
    /// picture of several lines.
    pub fn sights(&self) -> impl Iterator<Item = (&str, String)> {
        let now = self.now();
        self.world.sights.iter().map(move |sight| (sight.name(), sight.look(now)))
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
