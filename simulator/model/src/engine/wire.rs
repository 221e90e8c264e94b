// SPDX-License-Identifier: GPL-3.0-or-later
//! The wires at the board's pins, and how the MCU drives and senses them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::motion::Axis;
use super::physics::{Fan, Heater, Lamp, Switch};
use super::rail::Rail;
use super::time::{PrinterTime, seconds};
use crate::description::pin::{PinName, on_board};
use crate::description::sensor::Sensor;
use pinion_firmware::board::{ADC_MAX, Adc, Bias, Direction, Edge, Edges, Line, PWM_MAX, Pwm};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

/// The uses of a pin that are allowed to the MCU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Drive it.
    Output,
    /// Sense it.
    Input,
    /// Drive and sense it by turns: a wire with several drivers.
    Shared,
    /// Measure it.
    Analog,
    /// Dim it, by a hardware PWM channel.
    Pwm,
    /// Send on it with an SPI controller.
    Mosi,
    /// Receive from it with an SPI controller.
    Miso,
    /// Send and receive with a serial port.
    Serial,
    /// Anything: nothing is connected.
    Free,
}

/// A part's end of a pin. "On" has the description's meaning: a high level, unless the pin is inverted.
///
/// The core calls these functions. None may block, lock or allocate.
pub(crate) trait Wire: Send + Sync {
    fn kind(&self) -> Kind;

    /// The pin's function and its owner, for example `step of axis x`.
    fn describe(&self) -> String;

    /// The MCU begins to drive the pin. The first level is not an edge.
    fn settle(&self, on: bool, at: Clock) {
        self.drive(on, at);
    }

    /// The MCU drives the pin to another level.
    fn drive(&self, on: bool, at: Clock) {
        let _ = (on, at);
    }

    /// The MCU releases a shared pin.
    fn release(&self, at: Clock) {
        let _ = at;
    }

    /// The level that the MCU senses. `driven` is the level that it drove last.
    fn sense(&self, driven: bool, at: Clock) -> bool {
        let _ = at;
        driven
    }

    /// The edges of an input so far, and how many seconds ago the last one was; `None` if the part does not count them.
    fn edges(&self, at: Clock) -> Option<(u64, Option<f64>)> {
        let _ = at;
        None
    }

    /// The hardware PWM of the pin gets another share of time, 0 to 1. `None` if the pin has no PWM.
    fn dim(&self, share: f64, at: Clock) -> Option<()> {
        let _ = (share, at);
        None
    }

    /// The counts that an ADC reads at an analog pin. `noise` is a draw from a standard normal distribution.
    fn counts(&self, at: Clock, noise: f64) -> u16 {
        let _ = (at, noise);
        0
    }
}

/// A pin that belongs to a controller: a bus's data output or input, or a serial port. The MCU does not drive it by
/// itself.
pub(crate) struct ControllerPin {
    pub(crate) kind: Kind,
    /// The name of the bus or port.
    pub(crate) of: String,
}

impl Wire for ControllerPin {
    fn kind(&self) -> Kind {
        self.kind
    }

    fn describe(&self) -> String {
        format!("of {}", self.of)
    }
}

/// A pin of the board.
#[derive(Clone)]
pub(crate) struct WiredPin {
    pub(crate) name: String,
    inverted: bool,
    pub(crate) wire: Arc<dyn Wire>,
}

impl WiredPin {
    pub(crate) fn new(pin: &PinName, wire: Arc<dyn Wire>) -> WiredPin {
        WiredPin { name: pin.name.clone(), inverted: pin.inverted, wire }
    }

    /// The same pin as its board knows it.
    pub(crate) fn on_its_board(self) -> WiredPin {
        WiredPin { name: on_board(&self.name).1.to_owned(), ..self }
    }

    /// The pin's PWM channel, if it has one.
    pub(crate) fn pwm(&self, share: f64, at: Clock) -> Option<()> {
        self.wire.dim(if self.inverted { 1.0 - share } else { share }, at)
    }

    /// The error for a pin that is not of the `wanted` kind.
    pub(crate) fn is_not(&self, wanted: &str, reason: ShutdownReason) -> Shutdown {
        let is = match self.wire.kind() {
            Kind::Output => "an output",
            Kind::Input => "an input",
            Kind::Shared => "a wire that several drive",
            Kind::Analog => "an ADC channel",
            Kind::Pwm => "a hardware PWM channel",
            Kind::Mosi => "an SPI bus's data output",
            Kind::Miso => "an SPI bus's data input",
            Kind::Serial => "a serial port",
            Kind::Free => "free",
        };
        let (name, wire) = (&self.name, self.wire.describe());
        Shutdown::because(reason, format!("pin {name} of the simulated printer is {is} ({wire}), not {wanted}"))
            .remedy("choose another pin")
    }
}

/// A claimed line of the board.
pub(crate) struct SimLine {
    pin: WiredPin,
    /// Whether it was last driven on.
    on: AtomicBool,
    time: Arc<PrinterTime>,
}

impl SimLine {
    pub(crate) fn new(pin: WiredPin, time: Arc<PrinterTime>) -> SimLine {
        SimLine { pin, on: AtomicBool::new(false), time }
    }

    fn begin(&self, level: bool) {
        let on = level != self.pin.inverted;
        self.on.store(on, Ordering::Relaxed);
        self.pin.wire.settle(on, self.time.of_the_caller());
    }
}

impl Line for SimLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        let on = level != self.pin.inverted;
        if self.on.swap(on, Ordering::Relaxed) != on {
            self.pin.wire.drive(on, self.time.of_the_caller());
        }
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        let driven = self.on.load(Ordering::Relaxed);
        Ok(self.pin.wire.sense(driven, self.time.of_the_caller()) != self.pin.inverted)
    }

    /// The parts drive their lines harder than any bias pulls.
    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let kind = self.pin.wire.kind();
        match direction {
            Direction::Output { level, .. } if matches!(kind, Kind::Output | Kind::Shared | Kind::Free) => {
                self.begin(level);
            }
            Direction::OpenDrain if matches!(kind, Kind::Output | Kind::Shared | Kind::Free) => self.begin(true),
            // Only the resistor decides the level of a free pin.
            Direction::Input(bias) if kind == Kind::Free => self.begin(bias == Bias::PullUp),
            Direction::Output { .. } | Direction::OpenDrain => {
                return Err(self.pin.is_not("an output", reason::NOT_OUTPUT));
            }
            Direction::Input(_) if kind == Kind::Shared => self.pin.wire.release(self.time.of_the_caller()),
            Direction::Input(_) if kind == Kind::Input => {}
            Direction::Input(_) => return Err(self.pin.is_not("an input", reason::NOT_INPUT)),
        }
        Ok(())
    }
}

/// An ADC at an analog pin.
pub(crate) struct SimAdc {
    pub(crate) wire: Arc<dyn Wire>,
    pub(crate) clock: Arc<dyn TimeSource>,
    pub(crate) noise: super::noise::Noise,
}

impl Adc for SimAdc {
    fn read(&mut self) -> Result<u16, Shutdown> {
        Ok(self.wire.counts(self.clock.now(), self.noise.draw()))
    }
}

/// A hardware PWM channel.
pub(crate) struct SimPwm {
    pub(crate) pin: WiredPin,
    pub(crate) clock: Arc<dyn TimeSource>,
}

impl Pwm for SimPwm {
    fn set(&mut self, value: u16) -> Result<(), Shutdown> {
        let share = (f64::from(value) / f64::from(PWM_MAX)).min(1.0);
        self.pin.pwm(share, self.clock.now()).ok_or_else(|| self.pin.is_not("a PWM channel", reason::PWM_CONFIG))
    }

    fn set_cycle(&mut self, _cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.set(value)
    }
}

/// The edges of an input, with the times that a kernel's interrupts would give them.
pub(crate) struct SimEdges {
    wire: Arc<dyn Wire>,
    clock: Arc<dyn TimeSource>,
    /// The number of edges when they were last taken; the next field is the level after the last of them.
    taken: u64,
    level: bool,
    /// The time of the last edge. Before the first edge it is the time when the line was claimed.
    last: Clock,
}

/// Highest number of edges kept, the same as in the kernel.
const EDGES_KEPT: u64 = 1024;

impl SimEdges {
    /// `None` if the part does not count edges. `level` is the level of the line.
    pub(crate) fn new(wire: Arc<dyn Wire>, clock: Arc<dyn TimeSource>, level: bool) -> Option<SimEdges> {
        let last = clock.now();
        let (taken, _) = wire.edges(last)?;
        Some(SimEdges { wire, clock, taken, level, last })
    }
}

fn ticks(seconds: f64) -> u64 {
    (seconds * f64::from(CLOCK_FREQ)) as u64
}

impl Edges for SimEdges {
    /// A part knows the number of edges and the time of the last one. The others are spread evenly before it.
    fn take(&mut self, see: &mut dyn FnMut(Edge)) -> Result<(), Shutdown> {
        let now = self.clock.now();
        let (edges, ago_s) = self.wire.edges(now).unwrap_or((self.taken, None));
        let new = edges.saturating_sub(self.taken);
        if new == 0 {
            return Ok(());
        }
        let since_s = seconds(self.last, now);
        // The last edge came after the edges that were taken before.
        let ago_s = ago_s.unwrap_or(0.0).min(since_s);
        let each_s = (since_s - ago_s) / new as f64;
        let dropped = new.saturating_sub(EDGES_KEPT);
        for number in dropped + 1..=new {
            let at = now.earlier(ticks(ago_s + (new - number) as f64 * each_s));
            let dropped = if number == dropped + 1 { u32::try_from(dropped).unwrap_or(u32::MAX) } else { 0 };
            see(Edge { at: self.clock.duration_of(at), level: self.level ^ (number % 2 == 1), dropped });
        }
        self.taken = edges;
        self.level ^= new % 2 == 1;
        self.last = now.earlier(ticks(ago_s));
        Ok(())
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        Ok(())
    }
}

/// A wire that the MCU drives.
struct Output<F, D> {
    describe: String,
    /// Whether the first level counts as an edge.
    takes_first: bool,
    drive: F,
    dim: D,
}

impl<F, D> Wire for Output<F, D>
where
    F: Fn(bool, Clock) + Send + Sync,
    D: Fn(f64, Clock) -> Option<()> + Send + Sync,
{
    fn kind(&self) -> Kind {
        Kind::Output
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }

    fn settle(&self, on: bool, at: Clock) {
        if self.takes_first {
            self.drive(on, at);
        }
    }

    fn drive(&self, on: bool, at: Clock) {
        (self.drive)(on, at);
    }

    fn dim(&self, share: f64, at: Clock) -> Option<()> {
        (self.dim)(share, at)
    }
}

/// An output that gets each level.
pub(crate) fn output(describe: String, drive: impl Fn(bool, Clock) + Send + Sync) -> impl Wire {
    Output { describe, takes_first: true, drive, dim: |_, _| None }
}

/// An output that gets the edges only.
pub(crate) fn edges(describe: String, drive: impl Fn(bool, Clock) + Send + Sync) -> impl Wire {
    Output { describe, takes_first: false, drive, dim: |_, _| None }
}

/// An output that a hardware PWM may drive, too.
fn dimmable(
    describe: String,
    drive: impl Fn(bool, Clock) + Send + Sync,
    dim: impl Fn(f64, Clock) + Send + Sync,
) -> impl Wire {
    let dim = move |share, at| {
        dim(share, at);
        Some(())
    };
    Output { describe, takes_first: true, drive, dim }
}

/// A wire that the MCU senses.
struct Input<F> {
    describe: String,
    level: F,
}

impl<F: Fn(Clock) -> bool + Send + Sync> Wire for Input<F> {
    fn kind(&self) -> Kind {
        Kind::Input
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }

    fn sense(&self, _driven: bool, at: Clock) -> bool {
        (self.level)(at)
    }
}

/// An input with this level.
pub(crate) fn input(describe: String, level: impl Fn(Clock) -> bool + Send + Sync) -> impl Wire {
    Input { describe, level }
}

/// A wire that an ADC measures.
struct Analog<F> {
    describe: String,
    counts: F,
}

impl<F: Fn(Clock, f64) -> u16 + Send + Sync> Wire for Analog<F> {
    fn kind(&self) -> Kind {
        Kind::Analog
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }

    fn counts(&self, at: Clock, noise: f64) -> u16 {
        (self.counts)(at, noise)
    }
}

/// The step input of an axis's driver. The motor ignores the first level of the line.
pub(crate) fn step_pin(axis: Arc<Axis>) -> impl Wire {
    edges(format!("step of axis {}", axis.name), move |on, at| axis.edge(on, at))
}

/// The direction input of an axis's driver.
pub(crate) fn direction_pin(axis: Arc<Axis>) -> impl Wire {
    output(format!("direction of axis {}", axis.name), move |on, _| axis.set_forward(on))
}

/// The enable inputs of the drivers at one line.
pub(crate) fn enable_pin(axes: Vec<Arc<Axis>>) -> impl Wire {
    let names: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
    output(format!("enable of axis {}", names.join(", ")), move |on, _| {
        axes.iter().for_each(|axis| axis.set_enabled(on));
    })
}

/// A rail's endstop.
pub(crate) fn endstop_pin(rail: Arc<Rail>) -> impl Wire {
    input(format!("endstop of axis {}", rail.name), move |_| rail.endstop().unwrap_or(false))
}

/// A heater's switch.
pub(crate) fn heater_pin(heater: Arc<Heater>) -> impl Wire {
    let dimmed = heater.clone();
    dimmable(
        format!("heater {}", heater.name),
        move |on, at| heater.switch(on, at),
        move |share, at| dimmed.power(share, at),
    )
}

/// A heater's thermistor.
pub(crate) fn thermistor_pin(heater: Arc<Heater>) -> impl Wire {
    let describe = format!("sensor of heater {}", heater.name);
    let counts = move |at, noise: f64| {
        let counts = |sensor: &Sensor| sensor.counts(heater.at(at).sensor_celsius, noise * heater.noise_counts);
        heater.sensor.as_ref().map_or(0, counts)
    };
    Analog { describe, counts }
}

/// A fan's power switch.
pub(crate) fn fan_pin(fan: Arc<Fan>) -> impl Wire {
    let dimmed = fan.clone();
    dimmable(
        format!("fan {}", fan.name),
        move |on, at| fan.switch(Switch::Power, on, at),
        move |share, at| dimmed.power(share, at),
    )
}

/// A fan's enable switch.
pub(crate) fn fan_enable_pin(fan: Arc<Fan>) -> impl Wire {
    let dimmed = fan.clone();
    dimmable(
        format!("enable of fan {}", fan.name),
        move |on, at| fan.switch(Switch::Enable, on, at),
        move |share, at| dimmed.switch(Switch::Enable, share > 0.0, at),
    )
}

/// The switch of a light or of another output.
pub(crate) fn lamp_pin(lamp: Arc<Lamp>) -> impl Wire {
    let dimmed = lamp.clone();
    dimmable(lamp.name.clone(), move |on, at| lamp.switch(on, at), move |share, at| dimmed.dim(share, at))
}

/// An input that stays at one level.
pub(crate) fn fixed_input(name: String, on: bool) -> impl Wire {
    input(name, move |_| on)
}

/// An analog pin at a fixed level.
pub(crate) fn fixed_analog(describe: String, fraction: f64) -> impl Wire {
    let max = f64::from(ADC_MAX);
    // The clamp keeps the value in the range of a u16, so the cast loses nothing.
    Analog { describe, counts: move |_, _| (fraction * max).round().clamp(0.0, max) as u16 }
}

/// A line whose level selects parts.
pub(crate) struct LevelLine {
    description: String,
    high: AtomicBool,
}

impl LevelLine {
    /// The select line of a chip, at its idle level.
    pub(crate) fn chip_select(chip: &str) -> LevelLine {
        LevelLine { description: format!("chip select of {chip}"), high: AtomicBool::new(true) }
    }

    /// A line that connects UARTs to their wire.
    pub(crate) fn uart_select() -> LevelLine {
        LevelLine { description: "select line of UARTs".into(), high: AtomicBool::new(false) }
    }

    pub(crate) fn is_high(&self) -> bool {
        self.high.load(Ordering::Relaxed)
    }
}

impl Wire for LevelLine {
    fn kind(&self) -> Kind {
        Kind::Output
    }

    fn describe(&self) -> String {
        self.description.clone()
    }

    fn drive(&self, on: bool, _at: Clock) {
        self.high.store(on, Ordering::Relaxed);
    }
}

/// A fan's tachometer.
pub(crate) struct TachometerPin(pub(crate) Arc<Fan>);

impl Wire for TachometerPin {
    fn kind(&self) -> Kind {
        Kind::Input
    }

    fn describe(&self) -> String {
        format!("tachometer of fan {}", self.0.name)
    }

    fn sense(&self, _driven: bool, at: Clock) -> bool {
        self.0.tachometer(at)
    }

    fn edges(&self, at: Clock) -> Option<(u64, Option<f64>)> {
        Some(self.0.edges(at))
    }
}

/// A pin with nothing connected.
pub(crate) struct FreePin;

impl Wire for FreePin {
    fn kind(&self) -> Kind {
        Kind::Free
    }

    fn describe(&self) -> String {
        "nothing is connected".into()
    }

    fn dim(&self, _share: f64, _at: Clock) -> Option<()> {
        Some(())
    }

    fn counts(&self, _at: Clock, _noise: f64) -> u16 {
        ADC_MAX / 2
    }
}
