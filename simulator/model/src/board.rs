// SPDX-License-Identifier: GPL-3.0-or-later
//! A simulated printer, assembled and driven as a board.

use std::collections::BTreeMap;
use std::sync::Arc;

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, ClaimedLine, CountedLine, Direction, Edges, I2cConfig, Mosi, OnWorker, Pin, Pwm,
    PwmConfig, Range, SerialPort, SpiConfig, Thermometer,
};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_firmware::time::{Ticks, TimeSource, Timing};

use super::config::SimConfig;
use super::description::axes::AxisConfig;
use super::description::boards::{Boards, ConstantValue, McuConfig};
use super::description::check::Trouble;
use super::description::pin::{PinName, on_board};
use super::engine::assemble::{Motion, assemble};
use super::engine::i2c::{I2cBus, I2cDevice};
use super::engine::led::ColouredLed;
use super::engine::noise::Noise;
use super::engine::physics::{Fan, Heater, Lamp};
use super::engine::serial::{SerialDevice, SerialWire};
use super::engine::spi::{MISO, SpiBus, SpiDevice};
use super::engine::time::{Drift, LATE_LIMIT, PrinterTime};
use super::engine::wire::{
    ControllerPin, FreePin, Kind, SimAdc, SimEdges, SimLine, SimPwm, TachometerPin, WiredPin, direction_pin,
    enable_pin, endstop_pin, fan_enable_pin, fan_pin, fixed_analog, fixed_input, heater_pin, lamp_pin, step_pin,
    thermistor_pin,
};
use super::engine::world::World;
use super::part::workshop::Workshop;
use super::view::SimProbe;

/// The worker for the thermistors.
const ADC_WORKER: &str = "adc";
/// The worker for the edges.
const EDGES_WORKER: &str = "edges";
/// The worker for the PWM channels.
const PWM_WORKER: &str = "pwm";
/// Highest number of bytes that an SPI bus sends without a pause, as with the kernel's default `spidev.bufsiz`.
const MESSAGE_MAX: usize = 4096;

/// A simulated printer with its boards.
pub struct SimWorld {
    /// The boards, in the description's order.
    pub boards: Vec<SimBoard>,
    /// A view of the printer for demonstrations, drawings and tests.
    pub probe: SimProbe,
}

/// A board of a simulated printer.
pub struct SimBoard {
    name: String,
    constants: Vec<(String, serde_json::Value)>,
    clock: Arc<dyn TimeSource>,
    /// The time of its pins, and of the MCU that drives them.
    time: Arc<PrinterTime>,
    seed: u64,
    world: Arc<World>,
    probe: SimProbe,
    /// By pin number.
    pins: Vec<WiredPin>,
    /// By number.
    spi_buses: Vec<Arc<SpiBus>>,
    /// By number.
    i2c_buses: Vec<Arc<I2cBus>>,
    /// Buses on lines, each with the names of its lines.
    soft_spi: Vec<([String; 3], Arc<SpiBus>)>,
    soft_i2c: Vec<([String; 2], Arc<I2cBus>)>,
    serial_wires: Vec<Arc<SerialWire>>,
}

impl SimWorld {
    /// The printer of a description, in its initial state.
    ///
    /// # Errors
    ///
    /// The first wrong value of the description.
    pub fn new(config: SimConfig, clock: Arc<dyn TimeSource>) -> Result<SimWorld, Trouble> {
        config.validate()?;
        let printer = config.printer();
        let now = clock.now();
        let mut workshop = Workshop {
            levels: Vec::new(),
            printer,
            clock: clock.clone(),
            world: World::default(),
            pins: Vec::new(),
            spi_buses: Vec::new(),
            i2c_buses: config.i2c_buses.iter().map(I2cBus::new).collect(),
            serial_wires: Vec::new(),
            uarts: Vec::new(),
        };
        Motion { axes: workshop.world.axes, carriages: workshop.world.carriages } = assemble(&printer)?;
        for (part, axis) in config.axes.iter().zip(workshop.world.axes.clone()) {
            workshop.wire(Some(&part.step_pin), step_pin(axis.clone()));
            workshop.wire(Some(&part.dir_pin), direction_pin(axis.clone()));
            workshop.wire(part.endstop_pin.as_ref(), endstop_pin(axis.rail().clone()));
        }
        let boards = Boards(&config.mcus);
        let line = |pin: &PinName| (boards.of(&pin.name), local(&pin.name));
        for (place, part) in config.axes.iter().enumerate() {
            let Some(pin) = &part.enable_pin else { continue };
            let shares = |other: &AxisConfig| other.enable_pin.as_ref().is_some_and(|other| line(other) == line(pin));
            if config.axes[..place].iter().any(shares) {
                continue;
            }
            let motors = config.axes.iter().zip(&workshop.world.axes).filter(|(other, _)| shares(other));
            let motors = motors.map(|(_, axis)| axis.clone()).collect();
            workshop.wire(Some(pin), enable_pin(motors));
        }
        for (part, rail) in config.carriages.iter().zip(workshop.world.carriages.clone()) {
            workshop.wire(part.endstop_pin.as_ref(), endstop_pin(rail));
        }
        let extruders = printer.hot_ends().filter_map(|hot_end| workshop.axis(&hot_end.name));
        workshop.world.extruders = extruders.collect();
        for part in &config.heaters {
            let cooling_w_per_k = printer.fan_of(&part.name).map_or(0.0, |fan| fan.cooling_w_per_k);
            let heater = Arc::new(Heater::new(part, part.sensor()?, cooling_w_per_k, now));
            workshop.wire(part.pin.as_ref(), heater_pin(heater.clone()));
            workshop.wire(part.sensor_pin.as_ref(), thermistor_pin(heater.clone()));
            workshop.world.heaters.push(heater);
        }
        for part in &config.fans {
            let cools = part.cools.as_ref().and_then(|heater| workshop.heater(heater));
            let fan = Arc::new(Fan::new(part, cools, now));
            workshop.wire(Some(&part.pin), fan_pin(fan.clone()));
            workshop.wire(part.enable_pin.as_ref(), fan_enable_pin(fan.clone()));
            workshop.wire(part.tachometer_pin.as_ref(), TachometerPin(fan.clone()));
            workshop.world.fans.push(fan);
        }
        let mut switched: Vec<(&PinName, Arc<Lamp>)> = Vec::new();
        let mut lamp = |workshop: &mut Workshop<'_>, name: &str, pin| {
            let lamp = Arc::new(Lamp::new(name));
            workshop.wire(Some(pin), lamp_pin(lamp.clone()));
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
            workshop.wire(Some(&part.pin), fixed_input(part.name.clone(), part.level));
        }
        for part in &config.analogs {
            workshop.wire(Some(&part.pin), fixed_analog(part.name.clone(), part.fraction));
        }
        for bus in &config.spi_buses {
            let bus = SpiBus::new(bus, |name| {
                let (pin, lamp) = switched.iter().find(|(pin, _)| pin.name == name)?;
                Some((lamp.clone(), pin.inverted))
            });
            workshop.spi_buses.push(bus);
        }
        for part in &config.parts {
            part.part().build(&mut workshop)?;
        }
        // Buses may share lines.
        let mut lines: BTreeMap<&str, (&PinName, &str)> = BTreeMap::new();
        for bus in &config.spi_buses {
            match bus.lines() {
                None => {
                    let pin = ControllerPin { kind: Kind::Mosi, of: bus.name.clone() };
                    workshop.wire(Some(&bus.output_pin()), pin);
                }
                Some(of_bus) => lines.extend(of_bus.map(|pin| (pin.name.as_str(), (pin, bus.name.as_str())))),
            }
        }
        for bus in &config.i2c_buses {
            let of_bus = bus.lines().into_iter().flatten();
            lines.extend(of_bus.map(|pin| (pin.name.as_str(), (pin, bus.name.as_str()))));
        }
        for (pin, bus) in lines.into_values() {
            workshop.wire(Some(pin), ControllerPin { kind: Kind::Free, of: bus.to_owned() });
        }
        for pin in config.mcus.iter().map(McuConfig::free_pins) {
            pin?.iter().for_each(|pin| workshop.wire(Some(pin), FreePin));
        }
        let bed = Arc::new(workshop.bed());
        let Workshop { world, pins, spi_buses, i2c_buses, serial_wires, .. } = workshop;
        let spi_buses: Vec<_> = spi_buses.into_iter().map(Arc::new).collect();
        let settles = if config.mcus.len() > 1 { LATE_LIMIT } else { Ticks(0) };
        let world = Arc::new(world);
        let probe = SimProbe { world, bed, spi_buses, clock, settles };
        let parts = Parts {
            pins,
            i2c_buses: i2c_buses.into_iter().map(Arc::new).collect(),
            serial_wires: serial_wires.into_iter().map(Arc::new).collect(),
        };
        let count = config.mcus.len().max(1);
        let boards = (0..count).map(|number| SimBoard::of(number, &config, &parts, &probe)).collect();
        Ok(SimWorld { boards, probe })
    }
}

/// The parts that are connected to the boards.
struct Parts {
    pins: Vec<WiredPin>,
    i2c_buses: Vec<Arc<I2cBus>>,
    serial_wires: Vec<Arc<SerialWire>>,
}

impl SimBoard {
    /// The only board of a description, in the printer's initial state.
    ///
    /// # Errors
    ///
    /// The first wrong value of the description, or there are several boards.
    pub fn new(config: SimConfig, clock: Arc<dyn TimeSource>) -> Result<SimBoard, Trouble> {
        let mut boards = SimWorld::new(config, clock)?.boards;
        match (boards.pop(), boards.is_empty()) {
            (Some(board), true) => Ok(board),
            _ => Err(Trouble::new("the simulated printer has several boards").remedy("serve it with `pinion sim`")),
        }
    }

    /// The board with this number.
    fn of(number: usize, config: &SimConfig, parts: &Parts, probe: &SimProbe) -> SimBoard {
        let boards = Boards(&config.mcus);
        let is_here = |name: &str| boards.of(name) == Some(number);
        let local = |pin: &PinName| on_board(&pin.name).1.to_owned();
        let mcu = config.mcus.get(number);
        let clock = probe.clock.clone();
        let drift = Drift::of(mcu.map_or(0.0, |mcu| mcu.drift_ppm));
        let mut board = SimBoard {
            name: mcu.map_or_else(|| "mcu".to_owned(), |mcu| mcu.name.clone()),
            constants: mcu.map_or_else(Vec::new, constants),
            time: Arc::new(PrinterTime::new(clock.clone(), drift)),
            clock,
            seed: config.seed,
            world: probe.world.clone(),
            probe: probe.clone(),
            pins: parts.pins.iter().filter(|pin| is_here(&pin.name)).cloned().map(WiredPin::on_its_board).collect(),
            spi_buses: Vec::new(),
            i2c_buses: Vec::new(),
            soft_spi: Vec::new(),
            soft_i2c: Vec::new(),
            serial_wires: parts.serial_wires.iter().filter(|wire| is_here(&wire.name)).cloned().collect(),
        };
        for (described, bus) in config.spi_buses.iter().zip(&probe.spi_buses) {
            match described.lines() {
                Some(lines) if is_here(&lines[2].name) => board.soft_spi.push((lines.map(local), bus.clone())),
                None if is_here(&bus.name) => board.spi_buses.push(bus.clone()),
                _ => {}
            }
        }
        for (described, bus) in config.i2c_buses.iter().zip(&parts.i2c_buses) {
            match described.lines() {
                Some(lines) if is_here(&lines[0].name) => board.soft_i2c.push((lines.map(local), bus.clone())),
                None if is_here(&bus.name) => board.i2c_buses.push(bus.clone()),
                _ => {}
            }
        }
        board
    }

    /// Its name in printer.cfg, for example `toolhead`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// A view of the printer for demonstrations, drawings and tests.
    pub fn probe(&self) -> SimProbe {
        self.probe.clone()
    }

    /// The time of the MCU that drives the printer.
    pub fn timing(&self) -> Timing {
        let due = self.time.due();
        Timing { clock: self.time.clone(), due, late_limit: LATE_LIMIT, step_late_limit: LATE_LIMIT }
    }

    fn pin_name(&self, pin: Pin) -> String {
        self.pin(pin, reason::NOT_OUTPUT).map_or_else(|_| String::new(), |wired| wired.name.clone())
    }

    fn pin(&self, pin: Pin, no_pin: ShutdownReason) -> Result<&WiredPin, Shutdown> {
        usize::try_from(pin.0).ok().and_then(|place| self.pins.get(place)).ok_or_else(|| {
            let count = self.pins.len();
            Shutdown::because(no_pin, format!("the simulated printer has no pin {}", pin.0))
                .remedy(format!("name one of its {count} pins (pinion sim --print-config shows them)"))
        })
    }
}

/// The constants of a board's dictionary.
fn constants(mcu: &McuConfig) -> Vec<(String, serde_json::Value)> {
    let value = |value: &ConstantValue| match value {
        ConstantValue::Number(number) => (*number).into(),
        ConstantValue::Text(text) => text.as_str().into(),
    };
    let chip = ("MCU".to_owned(), mcu.chip.as_str().into());
    std::iter::once(chip).chain(mcu.constants.iter().map(|(name, constant)| (name.clone(), value(constant)))).collect()
}

/// The name of a pin or a bus on its board.
fn local(name: &str) -> String {
    on_board(name).1.to_owned()
}

/// The bus with this number, or an error.
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

/// The error for a missing bus or thermometer, with the names that exist.
fn is_missing<'a>(what: &str, names: impl Iterator<Item = &'a str>, reason: ShutdownReason) -> Shutdown {
    let names: Vec<&str> = names.collect();
    let has = if names.is_empty() { "it has none".to_owned() } else { format!("use {}", names.join(" or ")) };
    Shutdown::because(reason, format!("the simulated printer has no {what}")).remedy(has)
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

    fn constants(&self) -> Vec<(String, serde_json::Value)> {
        self.constants.clone()
    }

    fn spi_on_lines(&mut self, pins: [Pin; 3], config: &SpiConfig) -> Option<OnWorker<dyn BusDevice>> {
        let names = pins.map(|pin| self.pin_name(pin));
        let (_, bus) = self.soft_spi.iter().find(|(lines, _)| *lines == names)?;
        let device = SpiDevice {
            bus: bus.clone(),
            mode: config.mode,
            rate_hz: config.rate_hz,
            chip_select: config.chip_select.clone(),
        };
        Some(OnWorker { bus: bus.name.clone(), device: Box::new(device) })
    }

    fn i2c_on_lines(&mut self, pins: [Pin; 2], config: I2cConfig) -> Option<OnWorker<dyn BusDevice>> {
        let names = pins.map(|pin| self.pin_name(pin));
        let (_, bus) = self.soft_i2c.iter().find(|(lines, _)| *lines == names)?;
        let device = I2cDevice { bus: bus.clone(), address: config.address };
        Some(OnWorker { bus: bus.name.clone(), device: Box::new(device) })
    }

    fn spi_buses(&self) -> Vec<Range> {
        let range = |(first, bus): (u32, &Arc<SpiBus>)| Range { name: local(&bus.name), first, count: 1 };
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
        let edges = match SimEdges::new(wired.wire.clone(), self.clock.clone(), line.line.read()?) {
            Some(edges) => Ok(OnWorker { bus: EDGES_WORKER.to_owned(), device: Box::new(edges) as Box<dyn Edges> }),
            None => Err(format!("nobody counts the edges of {}", wired.wire.describe()).into()),
        };
        Ok(CountedLine { line, edges })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let wired = self.pin(pin, reason::ADC_OPEN)?;
        if !matches!(wired.wire.kind(), Kind::Analog | Kind::Free) {
            return Err(wired.is_not("an ADC channel", reason::ADC_OPEN));
        }
        let noise = Noise::of(&wired.name, self.seed);
        let adc = SimAdc { wire: wired.wire.clone(), clock: self.clock.clone(), noise };
        Ok(OnWorker { bus: ADC_WORKER.to_owned(), device: Box::new(adc) })
    }

    fn i2c_buses(&self) -> Vec<Range> {
        let range = |(first, bus): (u32, &Arc<I2cBus>)| Range { name: local(&bus.name), first, count: 1 };
        (0..).zip(&self.i2c_buses).map(range).collect()
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let bus = numbered(&self.i2c_buses, config.bus, "I2C", |bus| &bus.name, reason::I2C_OPEN)?;
        let device = I2cDevice { bus: bus.clone(), address: config.address };
        Ok(OnWorker { bus: format!("i2c{}", config.bus), device: Box::new(device) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let wired = self.pin(config.pin, reason::PWM_CONFIG)?;
        let mut pwm = SimPwm { pin: wired.clone(), clock: self.clock.clone() };
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

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let wired = self.pin(pin, reason::NOT_OUTPUT)?;
        let bus = self.spi_buses().into_iter().find(|bus| wired.wire.kind() == Kind::Mosi && bus.name == wired.name);
        let Some(Range { first: bus, .. }) = bus else { return Ok(None) };
        let line = self.spi(SpiConfig { bus, mode: 0, rate_hz, chip_select: None })?;
        Ok(Some(Mosi { line, message_max: MESSAGE_MAX, pauses: None }))
    }

    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        let wired = self.pin(miso, reason::NOT_INPUT).ok().filter(|wired| wired.wire.kind() == Kind::Miso)?;
        let name = wired.name.strip_suffix(MISO)?;
        (0..).zip(&self.pins).find(|(_, pin)| pin.name == name).map(|(number, _)| Pin(number))
    }

    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        // Another error names a pin that is not there.
        let Ok(wired) = self.pin(pin, reason::SERIAL_OPEN) else { return Ok(None) };
        let is_it = |wire: &&Arc<SerialWire>| wired.wire.kind() == Kind::Serial && local(&wire.name) == wired.name;
        let Some(wire) = self.serial_wires.iter().find(is_it) else { return Ok(None) };
        let (wire, clock) = (wire.clone(), self.clock.clone());
        let bus = wire.name.clone();
        Ok(Some(OnWorker { bus, device: Box::new(SerialDevice { wire, clock, rate_hz, received: Vec::new() }) }))
    }

    /// No claim is permanent: the parts exist independent of the MCU.
    fn reset(&mut self) {}
}

#[cfg(test)]
mod tests;
