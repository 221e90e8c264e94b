// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that records what the machine does to its pins, and lets a test play the rest.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard};

use pinion::board::{Attachment, Bias, Board, Buffer, Device, Input, Output, Pin, PwmConfig, Range, SpiConfig};
use pinion::mcu::{Completion, Job, Ticket, Workers};
use pinion::shutdown::{Reason, Shutdown};
use pinion::time::{Clock, Ticks, TimeSource, VirtualClock};

/// GPIO lines: pins 0 up to this.
pub const GPIOS: u32 = 300;
/// ADC channels: this pin and the seven after it.
pub const ANALOG: u32 = 400;
const ANALOGS: u32 = 8;
/// Hardware PWM channels: this pin and the one after it.
pub const PWM: u32 = 500;
const PWMS: u32 = 2;
/// SPI buses: 0 up to this.
const SPI_BUSES: u32 = 2;

/// A pin's level from an instant on, in ticks.
pub type Edge = (u64, u8);

/// A conversation with an SPI chip.
#[derive(Debug, PartialEq, Eq)]
pub struct Transfer {
    pub bus: u32,
    pub mode: u8,
    pub rate_hz: u32,
    pub data: Vec<u8>,
}

#[derive(Default)]
pub struct State {
    /// The pins that are claimed; what they were claimed as.
    pub claimed: HashMap<u32, &'static str>,
    pub levels: HashMap<u32, bool>,
    /// Where outputs belong if the program dies.
    pub shutdown_values: HashMap<u32, bool>,
    /// Every change of an output, in order.
    pub edges: Vec<(u32, Edge)>,
    /// Levels of inputs from instants on.
    inputs: HashMap<u32, Vec<Edge>>,
    pub biases: HashMap<u32, Bias>,
    /// Readings to come; the last one stays.
    readings: HashMap<u32, VecDeque<u16>>,
    /// Pins that can not be written or read any more, ADC channels too.
    pub broken: HashSet<u32>,
    /// Bus, mode, rate and bytes of every SPI transfer.
    transfers: Vec<(u32, u8, u32, Buffer)>,
    /// Every value of a PWM channel: pin, instant, value.
    pub pwm_values: Vec<(u32, u64, u16)>,
    /// The period of each PWM channel.
    pub pwm_cycles: HashMap<u32, u32>,
    /// How long writing a line takes.
    pub write_ticks: u32,
    /// How long a device on a worker takes to answer; without, devices answer at once.
    pub answer_ticks: Option<u32>,
}

/// What the board, its lines, its devices and the test share.
#[derive(Clone)]
pub struct Bench {
    state: Arc<Mutex<State>>,
    clock: VirtualClock,
    /// Instants that a test reads and writes count from here.
    origin: Clock,
}

impl Bench {
    pub fn new(clock: VirtualClock, origin: Clock) -> Bench {
        // Room enough: the bench does not allocate later, see tests/no_allocation.rs.
        let state = State {
            edges: Vec::with_capacity(1 << 16),
            transfers: Vec::with_capacity(256),
            pwm_values: Vec::with_capacity(256),
            ..State::default()
        };
        Bench { state: Arc::new(Mutex::new(state)), clock, origin }
    }

    fn ticks(&self) -> u64 {
        self.clock.now().since(self.origin) as u64
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    /// The edges of a pin since the last call.
    pub fn edges(&self, pin: u32) -> Vec<Edge> {
        let mut edges = Vec::new();
        self.state().edges.retain(|(of, edge)| {
            if *of == pin {
                edges.push(*edge);
            }
            *of != pin
        });
        edges
    }

    /// Every SPI transfer so far.
    pub fn transfers(&self) -> Vec<Transfer> {
        let transfer = |&(bus, mode, rate_hz, data): &(u32, u8, u32, Buffer)| {
            let data = data.as_slice().to_vec();
            Transfer { bus, mode, rate_hz, data }
        };
        self.state().transfers.iter().map(transfer).collect()
    }

    /// Forgets every edge.
    pub fn forget_edges(&self) {
        self.state().edges.clear();
    }

    pub fn level(&self, pin: u32) -> bool {
        self.state().levels[&pin]
    }

    /// Lets an input change at instants in the future.
    pub fn script_input(&self, pin: u32, levels: &[Edge]) {
        self.state().inputs.entry(pin).or_default().extend(levels);
    }

    /// Lets an ADC channel read these values and then stay at the last.
    pub fn script_adc(&self, pin: u32, values: &[u16]) {
        self.state().readings.insert(pin, values.iter().copied().collect());
    }

    fn claim(
        &self,
        pin: Pin,
        known: std::ops::Range<u32>,
        unknown: Reason,
        use_: &'static str,
    ) -> Result<u32, Shutdown> {
        let mut state = self.state();
        if !known.contains(&pin.0) {
            let detail = format!("the bench has no pin {}: choose one of {} to {}", pin.0, known.start, known.end - 1);
            return Err(Shutdown::because(unknown, detail));
        }
        if let Some(other) = state.claimed.get(&pin.0) {
            let reason = if use_ == "input" { Reason::InputLine } else { Reason::OutputLine };
            let detail = format!("pin {} is in use as {other}: choose another pin", pin.0);
            return Err(Shutdown::because(reason, detail));
        }
        state.claimed.insert(pin.0, use_);
        Ok(pin.0)
    }

    fn broken(&self, pin: u32, reason: Reason) -> Result<(), Shutdown> {
        match self.state().broken.contains(&pin) {
            true => Err(Shutdown::because(reason, format!("pin {pin} is gone: plug it in again"))),
            false => Ok(()),
        }
    }

    fn attachment(&self, bus: &str, device: impl Device + 'static) -> Attachment {
        let device = Box::new(device);
        match self.state().answer_ticks {
            Some(_) => Attachment::Worker { bus: bus.into(), device },
            None => Attachment::Inline(device),
        }
    }
}

/// The board itself; the bench is its other side.
pub struct FakeBoard(pub Bench);

impl Board for FakeBoard {
    fn describe(&self) -> String {
        "a test bench".into()
    }

    fn pins(&self) -> Vec<Range> {
        vec![
            Range { name: "gpio0".into(), first: 0, count: GPIOS },
            Range { name: "analog0".into(), first: ANALOG, count: ANALOGS },
            Range { name: "pwm0".into(), first: PWM, count: PWMS },
        ]
    }

    fn spi_buses(&self) -> Vec<Range> {
        vec![Range { name: "spi0".into(), first: 0, count: SPI_BUSES }]
    }

    fn output(&mut self, pin: Pin, value: bool, shutdown_value: bool) -> Result<Box<dyn Output>, Shutdown> {
        let pin = self.0.claim(pin, 0..GPIOS, Reason::NotOutput, "output")?;
        let mut state = self.0.state();
        state.levels.insert(pin, value);
        state.shutdown_values.insert(pin, shutdown_value);
        Ok(Box::new(FakeOutput { bench: self.0.clone(), pin }))
    }

    fn input(&mut self, pin: Pin, bias: Bias) -> Result<Box<dyn Input>, Shutdown> {
        let pin = self.0.claim(pin, 0..GPIOS, Reason::NotInput, "input")?;
        self.0.state().biases.insert(pin, bias);
        Ok(Box::new(FakeInput { bench: self.0.clone(), pin }))
    }

    fn adc(&mut self, pin: Pin) -> Result<Attachment, Shutdown> {
        let pin = self.0.claim(pin, ANALOG..ANALOG + ANALOGS, Reason::AdcOpen, "ADC channel")?;
        Ok(self.0.attachment("iio", FakeAdc { bench: self.0.clone(), pin }))
    }

    fn spi(&mut self, config: SpiConfig) -> Result<Attachment, Shutdown> {
        if config.bus >= SPI_BUSES {
            let detail = format!("the bench has no SPI bus {}: choose spi0 or spi1", config.bus);
            return Err(Shutdown::because(Reason::SpiOpen, detail));
        }
        let bus = format!("spi{}", config.bus);
        Ok(self.0.attachment(&bus, FakeSpi { bench: self.0.clone(), config }))
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<Attachment, Shutdown> {
        let pin = self.0.claim(config.pin, PWM..PWM + PWMS, Reason::PwmConfig, "PWM channel")?;
        let mut pwm = FakePwm { bench: self.0.clone(), pin };
        self.0.state().pwm_cycles.insert(pin, config.cycle.0);
        pwm.run(&mut Buffer::new(&config.value.to_le_bytes()))?;
        Ok(self.0.attachment("pwm", pwm))
    }

    fn reset(&mut self) {
        self.0.state().claimed.clear();
    }
}

struct FakePwm {
    bench: Bench,
    pin: u32,
}

impl Device for FakePwm {
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, Reason::PwmWrite)?;
        let at = self.bench.ticks();
        let (value, cycle) = data.as_slice().split_at(2);
        let mut state = self.bench.state();
        state.pwm_values.push((self.pin, at, u16::from_le_bytes(value.try_into().unwrap())));
        if !cycle.is_empty() {
            state.pwm_cycles.insert(self.pin, u32::from_le_bytes(cycle.try_into().unwrap()));
        }
        Ok(())
    }
}

struct FakeOutput {
    bench: Bench,
    pin: u32,
}

impl Output for FakeOutput {
    fn write(&mut self, value: bool) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, Reason::LineWrite)?;
        let mut state = self.bench.state();
        if state.levels.insert(self.pin, value) != Some(value) {
            state.edges.push((self.pin, (self.bench.ticks(), value.into())));
        }
        self.bench.clock.set(self.bench.clock.now() + Ticks(state.write_ticks));
        Ok(())
    }
}

struct FakeInput {
    bench: Bench,
    pin: u32,
}

impl Input for FakeInput {
    fn read(&mut self) -> Result<bool, Shutdown> {
        self.bench.broken(self.pin, Reason::LineRead)?;
        let now = self.bench.ticks();
        let state = self.bench.state();
        let levels = state.inputs.get(&self.pin).map_or(&[][..], Vec::as_slice);
        Ok(levels.iter().rev().find(|(from, _)| *from <= now).is_some_and(|(_, level)| *level != 0))
    }
}

struct FakeAdc {
    bench: Bench,
    pin: u32,
}

impl Device for FakeAdc {
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, Reason::AdcRead)?;
        let mut state = self.bench.state();
        let value = match state.readings.get_mut(&self.pin) {
            Some(readings) if readings.len() > 1 => readings.pop_front().unwrap(),
            Some(readings) => readings.front().copied().unwrap_or(0),
            None => 0,
        };
        *data = Buffer::new(&value.to_le_bytes());
        Ok(())
    }
}

/// A chip that sends back the complement of what it gets.
struct FakeSpi {
    bench: Bench,
    config: SpiConfig,
}

impl Device for FakeSpi {
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
        if let Some(chip_select) = &mut self.config.chip_select {
            chip_select.select(true)?;
        }
        let SpiConfig { bus, mode, rate_hz, .. } = self.config;
        self.bench.state().transfers.push((bus, mode, rate_hz, *data));
        data.as_mut_slice().iter_mut().for_each(|byte| *byte = !*byte);
        if let Some(chip_select) = &mut self.config.chip_select {
            chip_select.select(false)?;
        }
        Ok(())
    }
}

/// Workers in virtual time: one job of a bus after the other, each takes its time.
#[derive(Clone)]
pub struct FakeWorkers {
    bench: Bench,
    shop: Arc<Mutex<Shop>>,
}

struct Shop {
    /// Each device and the number of its bus.
    devices: Vec<(usize, Box<dyn Device>)>,
    /// Each bus, and when it is free again.
    buses: Vec<(String, Clock)>,
    /// In the order of their ends.
    ends: VecDeque<(Clock, usize, Ticket, Buffer)>,
}

impl Shop {
    /// Room for more jobs than a test asks for: the bench does not allocate later.
    fn new() -> Shop {
        Shop { devices: Vec::new(), buses: Vec::new(), ends: VecDeque::with_capacity(256) }
    }
}

impl FakeWorkers {
    pub fn new(bench: Bench) -> FakeWorkers {
        FakeWorkers { bench, shop: Arc::new(Mutex::new(Shop::new())) }
    }

    /// When the next answer comes.
    pub fn next_end(&self) -> Option<Clock> {
        self.shop.lock().unwrap().ends.front().map(|(end, ..)| *end)
    }
}

impl Workers for FakeWorkers {
    fn attach(&mut self, bus: &str, device: Box<dyn Device>) -> Result<usize, Shutdown> {
        let mut shop = self.shop.lock().unwrap();
        let number = shop.buses.iter().position(|(name, _)| name == bus).unwrap_or_else(|| {
            shop.buses.push((bus.into(), Clock::EPOCH));
            shop.buses.len() - 1
        });
        shop.devices.push((number, device));
        Ok(shop.devices.len() - 1)
    }

    fn submit(&mut self, job: Job) -> Result<(), Shutdown> {
        let takes = Ticks(self.bench.state().answer_ticks.unwrap_or(0));
        let mut shop = self.shop.lock().unwrap();
        let shop = &mut *shop;
        let begin = self.bench.clock.now();
        let free = &mut shop.buses[shop.devices[job.device].0].1;
        let end = begin.max(*free) + takes;
        *free = end;
        let place = shop.ends.partition_point(|(other, ..)| *other <= end);
        shop.ends.insert(place, (end, job.device, job.ticket, job.data));
        Ok(())
    }

    fn has_room(&self) -> bool {
        true
    }

    fn completion(&mut self) -> Option<Completion> {
        if !self.has_completion() {
            return None;
        }
        let mut shop = self.shop.lock().unwrap();
        let (_, device, ticket, mut data) = shop.ends.pop_front()?;
        let result = shop.devices[device].1.run(&mut data).map(|()| data);
        Some(Completion { ticket, result })
    }

    fn has_completion(&self) -> bool {
        self.next_end().is_some_and(|end| end <= self.bench.clock.now())
    }

    fn reset(&mut self) {
        *self.shop.lock().unwrap() = Shop::new();
    }
}
