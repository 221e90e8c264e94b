// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that records what the MCU does to its pins. A test plays the devices.

use std::any::Any;
use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use pinion_firmware::board::{
    self, Adc, Bank, Bias, Board, BusDevice, BusError, BusStatus, ClaimedLine, CountedLine, Direction, Edges,
    I2cConfig, Line, Mosi, OnWorker, Pin, Pwm, PwmConfig, Range, SerialPort, SpiConfig, Thermometer,
};
use pinion_firmware::mcu::{Devices, Finished, SentJob, WorkerId, Workers};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_firmware::time::{CLOCK_FREQ, Clock, NS_PER_TICK, Ticks, TimeSource, VirtualClock};
use pinion_firmware::trouble::Trouble;

use crate::memory::uncounted;

/// Number of GPIO lines. Their pins begin at 0.
pub const GPIOS: u32 = 300;
/// ADC channels: this pin and the seven after it.
pub const ANALOG: u32 = 400;
const ANALOGS: u32 = 8;
/// Hardware PWM channels: this pin and the one after it.
pub const PWM: u32 = 500;
const PWMS: u32 = 2;
/// Number of SPI buses. Their numbers begin at 0.
const SPI_BUSES: u32 = 2;
/// Number of I2C buses. Their numbers begin at 0.
const I2C_BUSES: u32 = 2;
/// The pin of the data output of SPI bus 0; the next pin is the one of bus 1.
pub const MOSI: u32 = 700;
/// The pin of the data input of SPI bus 0; the next pin is the one of bus 1.
pub const MISO: u32 = 710;
/// A serial port; the next pin is another one.
pub const SERIAL: u32 = 800;
const SERIALS: u32 = 2;
/// A number for [`State::broken`] and [`State::nacks`]: the chips of SPI bus 0; the next number is for bus 1.
pub const SPI_CHIPS: u32 = 600;
/// How long a reset waits for the workers.
const WORKERS_END: Ticks = Ticks::from_ms(2000);
/// The chip that has the lines that may sleep.
const EXPANDER: &str = "gpiochip1";

/// The time in ticks from which a pin has a level, and the level.
pub type Edge = (u64, u8);

/// Longest message on an SPI bus, in bytes.
pub const MESSAGE_MAX: usize = 512;

/// Bytes and their number, kept without an allocation.
type Message = ([u8; MESSAGE_MAX], usize);

/// A transfer with an SPI chip.
#[derive(Debug, PartialEq, Eq)]
pub struct Transfer {
    /// When it began, in ticks.
    pub at: u64,
    /// The number of the bus.
    pub bus: u32,
    /// The mode, 0 to 3.
    pub mode: u8,
    /// The clock rate.
    pub rate_hz: u32,
    /// The bytes from the MCU.
    pub data: Vec<u8>,
    /// Whether the MCU read the received bytes.
    pub read: bool,
}

/// A chip on an SPI bus. It gets the time in ticks, and replaces the bytes that it receives by the bytes that it sends.
pub type SpiChip = Box<dyn FnMut(u64, &mut [u8]) + Send>;

/// A chip at an I2C address. It gets the time in ticks and the written bytes, and fills in the bytes to read.
pub type I2cChip = Box<dyn FnMut(u64, &[u8], &mut [u8]) -> Result<(), BusStatus> + Send>;

/// The other end of a serial port. It gets the time in ticks at which the bytes are complete, and the bytes. It returns
/// everything that the port then receives.
pub type SerialEnd = Box<dyn FnMut(u64, &[u8]) -> Vec<u8> + Send>;

/// A chip behind an input. It gets the time in ticks. It also gets an output and its new level, or `None` when its
/// input is read. It returns the input's level.
pub type LineChip = Box<dyn FnMut(u64, Option<(u32, bool)>) -> bool + Send>;

#[derive(Default)]
/// The settings and records of the board, for a test.
pub struct State {
    /// By the input that the chip drives.
    line_chips: HashMap<u32, LineChip>,
    /// By bus.
    spi_chips: HashMap<u32, SpiChip>,
    /// By pin.
    serial_ends: HashMap<u32, SerialEnd>,
    /// By bus and address.
    i2c_chips: HashMap<(u32, u8), I2cChip>,
    /// The last direction of each claimed pin.
    pub directions: HashMap<u32, Direction>,
    /// The changes of direction within messages, in order.
    pub turns: Vec<(u32, Direction)>,
    /// Inputs with edges that an interrupt counts.
    pub counted: HashSet<u32>,
    /// Pins of chips that may sleep.
    pub sleeping: HashSet<u32>,
    /// Lines that are written and read without a call of the kernel.
    pub fast: HashSet<u32>,
    /// Whether a job is running. Only then may lines that sleep be called.
    on_worker: bool,
    /// ADC and PWM channels in use.
    pub claimed: HashSet<u32>,
    /// The level of each output.
    pub levels: HashMap<u32, bool>,
    /// Every change of an output, in order.
    pub edges: Vec<(u32, Edge)>,
    /// Levels of inputs, with the times from which they hold.
    inputs: HashMap<u32, Vec<Edge>>,
    /// Next readings. The last one stays.
    readings: HashMap<u32, VecDeque<u16>>,
    /// Readings of each DS18B20 in thousandths of a degree. The last one stays. `None` is a failure.
    thermometers: HashMap<Vec<u8>, VecDeque<Option<i32>>>,
    /// Pins that can no longer be written or read, also ADC channels.
    pub broken: HashSet<u32>,
    /// How many of a pin's next calls fail.
    pub nacks: HashMap<u32, u32>,
    /// How long a failing call takes.
    pub fail_ticks: u32,
    /// Lines that are claimed.
    pub held: HashSet<u32>,
    /// Every SPI transfer, with its time.
    transfers: Vec<(u64, u32, u8, u32, Message, bool)>,
    /// Every value of a PWM channel: pin, time, value.
    pub pwm_values: Vec<(u32, u64, u16)>,
    /// The period of each PWM channel.
    pub pwm_cycles: HashMap<u32, u32>,
    /// Whether pins 0 to 31 are in a bank ([`Bank`]). Set it before they are claimed.
    pub has_bank: bool,
    bank: Option<&'static FakeBank>,
    /// Every store to the bank: the pins that went high, and those that went low.
    pub stores: Vec<(u32, u32)>,
    /// How long a write to a line takes.
    pub write_ticks: u32,
    /// The bus between the processor and all lines, if there is one that holds writes back.
    pub link: Option<SleepyLink>,
    /// How long a device on a worker takes to answer; 0 by default.
    pub answer_ticks: u32,
    /// Whether the workers' queues are full and refuse jobs.
    pub refuses: bool,
    /// How long each byte takes on a bus. If it is not 0, a job runs as soon as it is submitted. Its chip gets the
    /// times at which its transfers will begin.
    pub byte_ticks: u32,
    /// The time that the running job has reached, if [`State::byte_ticks`] is not 0.
    bus_now: Option<Clock>,
}

/// A bus that sleeps when it is idle, as PCIe does. A write returns at once. The bus holds it back until it is awake.
#[derive(Clone, Copy, Debug, Default)]
pub struct SleepyLink {
    /// How long the bus takes to wake up.
    pub wake_ticks: u64,
    /// How long it stays awake without work.
    pub idle_ticks: u64,
    awake_at: u64,
    last: Option<u64>,
}

impl SleepyLink {
    /// A bus that sleeps.
    pub fn new(wake_ticks: u64, idle_ticks: u64) -> SleepyLink {
        SleepyLink { wake_ticks, idle_ticks, awake_at: 0, last: None }
    }

    /// When something that is sent now arrives.
    fn arrival(&mut self, now: u64) -> u64 {
        if self.last.is_none_or(|last| now > last + self.idle_ticks) {
            self.awake_at = now + self.wake_ticks;
        }
        let arrival = now.max(self.awake_at);
        self.last = Some(arrival);
        arrival
    }
}

/// Shared by the board, its lines, its devices and the test.
#[derive(Clone)]
pub struct Bench {
    state: Arc<Mutex<State>>,
    gate: Arc<Gate>,
    clock: VirtualClock,
    /// How many ticks ago the worker ran the present job. The core may have stood still since then.
    ago: Arc<AtomicU32>,
    /// A test's times count from here.
    origin: Clock,
}

/// Lets the SPI chips hang, in tests in real time.
#[derive(Default)]
struct Gate {
    /// Whether it is closed, and whether a transfer waits at it.
    state: Mutex<(bool, bool)>,
    changed: Condvar,
}

impl Gate {
    fn pass(&self) {
        let mut state = self.state.lock().unwrap();
        state.1 = true;
        state = self.changed.wait_while(state, |(closed, _)| *closed).unwrap();
        state.1 = false;
    }
}

impl Bench {
    /// Lets the SPI chips hang, or ends that.
    pub fn hang(&self, hang: bool) {
        self.gate.state.lock().unwrap().0 = hang;
        self.gate.changed.notify_all();
    }

    /// Whether a transfer hangs.
    pub fn hangs(&self) -> bool {
        self.gate.state.lock().unwrap().1
    }

    /// A bench on this clock, whose ticks count from `origin`.
    pub fn new(clock: VirtualClock, origin: Clock) -> Bench {
        // Reserve enough memory: the bench must not allocate later (tests/no_allocation.rs).
        let state = State {
            edges: Vec::with_capacity(1 << 16),
            transfers: Vec::with_capacity(256),
            pwm_values: Vec::with_capacity(256),
            turns: Vec::with_capacity(256),
            stores: Vec::with_capacity(1 << 16),
            ..State::default()
        };
        Bench { state: Arc::new(Mutex::new(state)), gate: Arc::default(), clock, ago: Arc::default(), origin }
    }

    /// The clock.
    pub fn clock(&self) -> VirtualClock {
        self.clock.clone()
    }

    /// When a write arrives that is sent now.
    fn arrival(&self) -> u64 {
        let now = self.ticks();
        self.state().link.as_mut().map_or(now, |link| link.arrival(now))
    }

    /// Waits until all writes have arrived.
    fn flush(&self) {
        let wait = self.arrival() - self.ticks();
        self.clock.set(self.clock.now() + Ticks(wait as u32));
    }

    fn ticks(&self) -> u64 {
        let now = self.clock.now() - Ticks(self.ago.load(Ordering::Relaxed));
        now.since(self.origin) as u64
    }

    /// Advances the clock by the time that a device needs.
    pub fn pass(&self, ticks: Ticks) {
        self.clock.set(self.clock.now() + ticks);
    }

    /// When a transfer of `bytes` bytes begins.
    fn bus_ticks(&self, bytes: usize) -> u64 {
        let mut state = self.state();
        let takes = Ticks(state.byte_ticks * bytes as u32);
        let Some(now) = &mut state.bus_now else { return self.ticks() };
        let at = *now;
        *now = at + takes;
        at.since(self.origin) as u64
    }

    /// The settings and records, for a test.
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
        let transfer = |&(at, bus, mode, rate_hz, (bytes, len), read): &(u64, u32, u8, u32, Message, bool)| {
            let data = bytes[..len].to_vec();
            Transfer { at, bus, mode, rate_hz, data, read }
        };
        self.state().transfers.iter().map(transfer).collect()
    }

    /// Forgets every edge.
    pub fn forget_edges(&self) {
        self.state().edges.clear();
    }

    /// Forgets everything that it has recorded.
    pub(crate) fn forget(&self) {
        let mut state = self.state();
        state.edges.clear();
        state.transfers.clear();
        state.pwm_values.clear();
        state.turns.clear();
    }

    /// The level of an output.
    pub fn level(&self, pin: u32) -> bool {
        self.state().levels[&pin]
    }

    /// The level of an output if the program dies.
    pub fn shutdown_value(&self, pin: u32) -> bool {
        match self.state().directions[&pin] {
            Direction::Output { shutdown_value, .. } => shutdown_value,
            input => panic!("pin {pin} is {input:?}"),
        }
    }

    /// Puts a chip on SPI bus 0 or 1.
    pub fn plug_spi(&self, bus: u32, chip: impl FnMut(u64, &mut [u8]) + Send + 'static) {
        self.state().spi_chips.insert(bus, Box::new(chip));
    }

    /// Connects a serial port.
    pub fn plug_serial(&self, pin: u32, end: impl FnMut(u64, &[u8]) -> Vec<u8> + Send + 'static) {
        self.state().serial_ends.insert(pin, Box::new(end));
    }

    /// Puts a chip at an address of I2C bus 0 or 1.
    pub fn plug_i2c(
        &self,
        bus: u32,
        address: u8,
        chip: impl FnMut(u64, &[u8], &mut [u8]) -> Result<(), BusStatus> + Send + 'static,
    ) {
        self.state().i2c_chips.insert((bus, address), Box::new(chip));
    }

    /// Takes a chip off an I2C bus.
    pub fn unplug_i2c(&self, bus: u32, address: u8) {
        self.state().i2c_chips.remove(&(bus, address));
    }

    /// Puts a chip behind an input.
    pub fn plug_line(&self, pin: u32, chip: impl FnMut(u64, Option<(u32, bool)>) -> bool + Send + 'static) {
        self.state().line_chips.insert(pin, Box::new(chip));
    }

    /// Lets an input change at these future times.
    pub fn script_input(&self, pin: u32, levels: &[Edge]) {
        self.state().inputs.entry(pin).or_default().extend(levels);
    }

    /// Sets the next readings of an ADC channel. The last one stays.
    pub fn script_adc(&self, pin: u32, values: &[u16]) {
        self.state().readings.insert(pin, values.iter().copied().collect());
    }

    /// Adds a DS18B20 with these next readings. The last one stays. `None` is a failure.
    pub fn script_ds18b20(&self, serial: &str, values: &[Option<i32>]) {
        self.state().thermometers.insert(serial.into(), values.iter().copied().collect());
    }

    /// Claims an ADC or PWM channel.
    fn claim(&self, pin: Pin, known: std::ops::Range<u32>, unknown: ShutdownReason) -> Result<u32, Shutdown> {
        if !known.contains(&pin.0) {
            let remedy = format!("choose one of {} to {}", known.start, known.end - 1);
            return Err(Shutdown::because(unknown, format!("the bench has no pin {}", pin.0)).remedy(remedy));
        }
        self.state().claimed.insert(pin.0);
        Ok(pin.0)
    }

    /// Checks that the core does not call a line that may sleep.
    fn may_call(&self, pin: u32) {
        let state = self.state();
        assert!(state.on_worker || !state.sleeping.contains(&pin), "the core itself calls pin {pin}");
    }

    fn broken(&self, pin: u32, reason: ShutdownReason) -> Result<(), Shutdown> {
        let mut state = self.state();
        let nack = state.nacks.get_mut(&pin).filter(|left| **left > 0);
        let fails = nack.map(|left| *left -= 1).is_some() || state.broken.contains(&pin);
        let takes = Ticks(state.fail_ticks);
        drop(state);
        if !fails {
            return Ok(());
        }
        self.pass(takes);
        Err(Shutdown::because(reason, format!("pin {pin} is gone")).remedy("plug it in again"))
    }
}

/// The board. The bench is the test's side of it.
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
            Range { name: "spidev0".into(), first: MOSI, count: SPI_BUSES },
            Range { name: "miso0".into(), first: MISO, count: SPI_BUSES },
            Range { name: "ttyS0".into(), first: SERIAL, count: SERIALS },
        ]
    }

    fn spi_buses(&self) -> Vec<Range> {
        vec![Range { name: "spi0".into(), first: 0, count: SPI_BUSES }]
    }

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let Pin(number) = pin;
        if number >= GPIOS {
            let unknown = match direction {
                Direction::Output { .. } | Direction::OpenDrain => reason::NOT_OUTPUT,
                Direction::Input(_) => reason::NOT_INPUT,
            };
            let remedy = format!("choose one of 0 to {}", GPIOS - 1);
            return Err(Shutdown::because(unknown, format!("the bench has no pin {number}")).remedy(remedy));
        }
        if !self.0.state().held.insert(number) {
            return Err(Shutdown::because(reason::INPUT_LINE, format!("pin {number} is in use")).remedy("free it"));
        }
        let is_first = self.0.state().has_bank && self.0.state().bank.is_none();
        if is_first {
            let bank = Box::leak(Box::new(FakeBank(self.0.clone())));
            self.0.state().bank = Some(bank);
        }
        let line = FakeLine { bench: self.0.clone(), pin: number };
        line.set_direction(direction)?;
        let sleeps_on = self.0.state().sleeping.contains(&number).then(|| EXPANDER.to_owned());
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on })
    }

    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        let line = self.line(pin, Direction::Input(bias))?;
        let edges = match self.0.state().counted.contains(&pin.0) {
            true => {
                let edges = FakeEdges { bench: self.0.clone(), pin: pin.0, taken: 0 };
                Ok(OnWorker { bus: "edges".into(), device: Box::new(edges) as Box<dyn Edges> })
            }
            false => Err("this pin has no interrupt".into()),
        };
        Ok(CountedLine { line, edges })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let pin = self.0.claim(pin, ANALOG..ANALOG + ANALOGS, reason::ADC_OPEN)?;
        Ok(OnWorker { bus: "iio".into(), device: Box::new(FakeAdc { bench: self.0.clone(), pin }) })
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        if config.bus >= SPI_BUSES {
            let cause = format!("the bench has no SPI bus {}", config.bus);
            return Err(Shutdown::because(reason::SPI_OPEN, cause).remedy("choose spi0 or spi1"));
        }
        let bus = format!("spi{}", config.bus);
        Ok(OnWorker { bus, device: Box::new(FakeSpi { bench: self.0.clone(), config }) })
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let Some(bus) = pin.0.checked_sub(MOSI).filter(|bus| *bus < SPI_BUSES) else { return Ok(None) };
        let line = self.spi(SpiConfig { bus, mode: 0, rate_hz, chip_select: None })?;
        Ok(Some(Mosi { line, message_max: MESSAGE_MAX, pauses: None }))
    }

    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        let bus = miso.0.checked_sub(MISO).filter(|bus| *bus < SPI_BUSES)?;
        Some(Pin(MOSI + bus))
    }

    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        if !(SERIAL..SERIAL + SERIALS).contains(&pin.0) {
            return Ok(None);
        }
        self.0.broken(pin.0, reason::SERIAL_OPEN)?;
        let port = FakeSerial { bench: self.0.clone(), pin: pin.0, rate_hz, received: Vec::new() };
        Ok(Some(OnWorker { bus: format!("ttyS{}", pin.0 - SERIAL), device: Box::new(port) }))
    }

    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        if !self.0.state().thermometers.contains_key(serial) {
            let cause = format!("the bench has no {}", String::from_utf8_lossy(serial));
            return Err(Shutdown::because(reason::DS18B20_OPEN, cause).remedy("plug it in"));
        }
        let device = FakeThermometer { bench: self.0.clone(), serial: serial.into() };
        Ok(OnWorker { bus: "w1".into(), device: Box::new(device) })
    }

    fn i2c_buses(&self) -> Vec<Range> {
        vec![Range { name: "i2c.0".into(), first: 0, count: I2C_BUSES }]
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        if config.bus >= I2C_BUSES {
            let cause = format!("the bench has no I2C bus {}", config.bus);
            return Err(Shutdown::because(reason::I2C_OPEN, cause).remedy("choose i2c.0 or i2c.1"));
        }
        let bus = format!("i2c{}", config.bus);
        Ok(OnWorker { bus, device: Box::new(FakeI2c { bench: self.0.clone(), config }) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let pin = self.0.claim(config.pin, PWM..PWM + PWMS, reason::PWM_CONFIG)?;
        let mut pwm = FakePwm { bench: self.0.clone(), pin };
        pwm.set_cycle(config.cycle, config.value)?;
        Ok(OnWorker { bus: "pwm".into(), device: Box::new(pwm) })
    }

    fn reset(&mut self) {
        let mut state = self.0.state();
        state.claimed.clear();
        state.directions.clear();
    }
}

struct FakeSerial {
    bench: Bench,
    pin: u32,
    rate_hz: u32,
    received: Vec<u8>,
}

impl SerialPort for FakeSerial {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.bench.broken(self.pin, reason::SERIAL_OPEN).map_err(|stop| *stop.trouble)?;
        self.bench.pass(Ticks(CLOCK_FREQ / self.rate_hz * 10 * bytes.len() as u32));
        // The state is not locked while the other end answers, because it may read the bench.
        let end = self.bench.state().serial_ends.remove(&self.pin);
        self.received.clear();
        if let Some(mut end) = end {
            self.received = end(self.bench.ticks(), bytes);
            self.bench.state().serial_ends.insert(self.pin, end);
        }
        Ok(())
    }

    fn receive(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble> {
        let count = bytes.len().min(self.received.len());
        if count == 0 {
            self.bench.pass(Ticks((limit.as_nanos() as u64 / NS_PER_TICK) as u32));
        }
        self.bench.pass(Ticks(CLOCK_FREQ / self.rate_hz * 10 * count as u32));
        bytes[..count].copy_from_slice(&self.received[..count]);
        self.received.drain(..count);
        Ok(count)
    }
}

struct FakeThermometer {
    bench: Bench,
    serial: Vec<u8>,
}

impl Thermometer for FakeThermometer {
    fn read(&mut self) -> Result<i32, Trouble> {
        let mut state = self.bench.state();
        let values = state.thermometers.get_mut(&self.serial).unwrap();
        let value = if values.len() > 1 { values.pop_front().unwrap() } else { values[0] };
        value.ok_or_else(|| Trouble::new("the sensor on the bench has a wrong CRC").remedy("check the wires"))
    }
}

struct FakePwm {
    bench: Bench,
    pin: u32,
}

impl Pwm for FakePwm {
    fn set(&mut self, value: u16) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, reason::PWM_WRITE)?;
        let at = self.bench.ticks();
        uncounted(|| self.bench.state().pwm_values.push((self.pin, at, value)));
        Ok(())
    }

    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.bench.state().pwm_cycles.insert(self.pin, cycle.0);
        self.set(value)
    }
}

struct FakeLine {
    bench: Bench,
    pin: u32,
}

impl Drop for FakeLine {
    fn drop(&mut self) {
        // This also runs when a test panics.
        self.bench.state.lock().unwrap_or_else(PoisonError::into_inner).held.remove(&self.pin);
    }
}

impl FakeLine {
    fn drive(bench: &Bench, pin: u32, level: bool) {
        let at = bench.arrival();
        let mut state = bench.state();
        if state.levels.insert(pin, level) != Some(level) {
            uncounted(|| state.edges.push((pin, (at, level.into()))));
            for chip in state.line_chips.values_mut() {
                chip(at, Some((pin, level)));
            }
        }
    }
}

impl Line for FakeLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_WRITE)?;
        if matches!(self.bench.state().directions.get(&self.pin), Some(Direction::Input(_))) {
            return Ok(());
        }
        FakeLine::drive(&self.bench, self.pin, level);
        self.bench.clock.set(self.bench.clock.now() + Ticks(self.bench.state().write_ticks));
        Ok(())
    }

    fn bank(&self) -> Option<(&'static dyn Bank, u32)> {
        let state = self.bench.state();
        let is_output = matches!(state.directions.get(&self.pin), Some(Direction::Output { .. }));
        state.bank.filter(|_| is_output && self.pin < u32::BITS).map(|bank| (bank as &dyn Bank, 1 << self.pin))
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_READ)?;
        let now = self.bench.ticks();
        let mut state = self.bench.state();
        if let Some(chip) = state.line_chips.get_mut(&self.pin) {
            return Ok(chip(now, None));
        }
        let levels = state.inputs.get(&self.pin).map_or(&[][..], Vec::as_slice);
        Ok(levels.iter().rev().find(|(from, _)| *from <= now).is_some_and(|(_, level)| *level != 0))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let mut state = self.bench.state();
        let before = state.directions.insert(self.pin, direction);
        if let Direction::Output { level, .. } = direction {
            let was = state.levels.insert(self.pin, level);
            let at = self.bench.ticks();
            if before.is_some() && was != Some(level) {
                uncounted(|| state.edges.push((self.pin, (at, level.into()))));
            }
            for chip in state.line_chips.values_mut() {
                chip(at, Some((self.pin, level)));
            }
        }
        Ok(())
    }

    fn is_fast(&self) -> bool {
        self.bench.state().fast.contains(&self.pin)
    }

    fn flush(&self) {
        self.bench.flush();
    }

    fn is_posted(&self) -> bool {
        self.bench.state().link.is_some()
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_WRITE)?;
        uncounted(|| self.bench.state().turns.push((self.pin, direction)));
        self.set_direction(direction)
    }
}

/// The lines of pins 0 to 31.
struct FakeBank(Bench);

impl Bank for FakeBank {
    fn change(&self, high: u32, low: u32) {
        uncounted(|| self.0.state().stores.push((high, low)));
        for (lines, level) in [(high, true), (low, false)] {
            (0..u32::BITS).filter(|pin| lines >> pin & 1 != 0).for_each(|pin| FakeLine::drive(&self.0, pin, level));
        }
        self.0.clock.set(self.0.clock.now() + Ticks(self.0.state().write_ticks));
    }

    fn flush(&self) {
        self.0.flush();
    }
}

/// The changes of a scripted input.
struct FakeEdges {
    bench: Bench,
    pin: u32,
    /// How many changes were read.
    taken: usize,
}

impl Edges for FakeEdges {
    fn take(&mut self, see: &mut dyn FnMut(board::Edge)) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, reason::LINE_READ)?;
        let now = self.bench.ticks();
        let state = self.bench.state();
        assert!(state.counted.contains(&self.pin), "the interrupts were ended");
        let levels = state.inputs.get(&self.pin).map_or(&[][..], Vec::as_slice);
        let monotonic = |at: u64| Duration::from_nanos((self.bench.origin.ticks() + at) * NS_PER_TICK);
        for (at, level) in levels[self.taken..].iter().take_while(|(at, _)| *at <= now) {
            self.taken += 1;
            see(board::Edge { at: monotonic(*at), level: *level != 0, dropped: 0 });
        }
        Ok(())
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        self.bench.state().counted.remove(&self.pin);
        Ok(())
    }
}

struct FakeAdc {
    bench: Bench,
    pin: u32,
}

impl Adc for FakeAdc {
    fn read(&mut self) -> Result<u16, Shutdown> {
        self.bench.broken(self.pin, reason::ADC_READ)?;
        let mut state = self.bench.state();
        Ok(match state.readings.get_mut(&self.pin) {
            Some(readings) if readings.len() > 1 => readings.pop_front().unwrap(),
            Some(readings) => readings.front().copied().unwrap_or(0),
            None => 0,
        })
    }
}

/// The device at an I2C address: a chip from a test, or nothing.
struct FakeI2c {
    bench: Bench,
    config: I2cConfig,
}

impl BusDevice for FakeI2c {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let I2cConfig { bus, address, .. } = self.config;
        // An address byte precedes the written bytes, and another precedes the bytes to read.
        let addresses = usize::from(!write.is_empty()) + usize::from(!read.is_empty());
        let at = self.bench.bus_ticks(write.len() + read.len() + addresses);
        // The state is not locked while the chip answers, because the chip may read the bench.
        let chip = self.bench.state().i2c_chips.remove(&(bus, address));
        let Some(mut chip) = chip else {
            let trouble = Trouble::new(format!("nothing answers at 0x{address:02x}")).remedy("check the wiring");
            return Err(BusError::new(BusStatus::StartNack, trouble));
        };
        let answer = chip(at, write, read);
        self.bench.state().i2c_chips.insert((bus, address), chip);
        answer.map_err(|status| {
            BusError::new(status, Trouble::new("the chip on the bench says no").remedy("ask it again"))
        })
    }
}

/// A chip from a test, or one that returns the complement of each byte.
struct FakeSpi {
    bench: Bench,
    config: SpiConfig,
}

impl FakeSpi {
    fn converse(&mut self, bytes: &mut [u8], read: bool) -> Result<(), BusError> {
        let SpiConfig { bus, mode, rate_hz, .. } = self.config;
        self.bench.gate.pass();
        self.bench.broken(SPI_CHIPS + bus, reason::LINE_READ)?;
        match &self.config.chip_select {
            Some(line) if bytes.is_empty() => line.pulse()?,
            Some(line) => line.select(true)?,
            None => {}
        }
        let mut message = ([0; MESSAGE_MAX], bytes.len());
        message.0[..bytes.len()].copy_from_slice(bytes);
        let at = self.bench.bus_ticks(bytes.len());
        uncounted(|| self.bench.state().transfers.push((at, bus, mode, rate_hz, message, read)));
        let chip = self.bench.state().spi_chips.remove(&bus);
        match chip {
            Some(mut chip) => {
                chip(at, bytes);
                self.bench.state().spi_chips.insert(bus, chip);
            }
            None => bytes.iter_mut().for_each(|byte| *byte = !*byte),
        }
        match &self.config.chip_select {
            Some(line) if !bytes.is_empty() => line.select(false).map_err(BusError::from),
            _ => Ok(()),
        }
    }
}

impl BusDevice for FakeSpi {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.converse(bytes, true)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        let mut copy = [0; MESSAGE_MAX];
        let copy = &mut copy[..bytes.len()];
        copy.copy_from_slice(bytes);
        self.converse(copy, false)
    }
}

/// Workers in virtual time. The jobs of one bus run one after the other, and each takes its time.
#[derive(Clone)]
pub struct FakeWorkers {
    bench: Bench,
    shop: Arc<Mutex<Shop>>,
}

struct Shop {
    buses: Vec<Bus>,
    /// In the order of their end times.
    under_way: VecDeque<UnderWay>,
    /// Jobs that hung when the workers were reset, with the devices of their workers.
    left_behind: Vec<(UnderWay, Option<Devices>)>,
}

/// A job on its way.
struct UnderWay {
    worker: usize,
    begin: Clock,
    end: Clock,
    work: Work,
}

/// A bus and its worker.
struct Bus {
    name: String,
    /// When it is free again.
    free: Clock,
    /// `None` while a job runs.
    devices: Option<Devices>,
    device_count: usize,
}

enum Work {
    ToDo(SentJob),
    Done(Finished),
}

impl Shop {
    /// Reserves memory for more jobs than a test sends, because the bench must not allocate later.
    fn new() -> Shop {
        Shop { buses: Vec::new(), under_way: VecDeque::with_capacity(256), left_behind: Vec::new() }
    }

    fn insert(&mut self, new: UnderWay) {
        let place = self.under_way.partition_point(|other| other.end <= new.end);
        uncounted(|| self.under_way.insert(place, new));
    }

    /// Delays the jobs after one that ran for a time of its own on this worker.
    fn delay(&mut self, worker: usize, ended: Clock, by: Ticks) {
        let free = &mut self.buses[worker].free;
        *free = (*free).max(ended);
        for other in self.under_way.iter_mut().filter(|other| other.worker == worker) {
            other.begin = other.begin + by;
            other.end = other.end + by;
            *free = (*free).max(other.end);
        }
        uncounted(|| self.under_way.make_contiguous().sort_by_key(|other| other.end));
    }
}

impl FakeWorkers {
    /// The workers of this bench.
    pub fn new(bench: Bench) -> FakeWorkers {
        FakeWorkers { bench, shop: Arc::new(Mutex::new(Shop::new())) }
    }

    /// How many jobs are on their way.
    pub fn under_way(&self) -> usize {
        self.shop.lock().unwrap().under_way.len()
    }

    /// When the next job ends.
    pub fn next_end(&self) -> Option<Clock> {
        self.shop.lock().unwrap().under_way.front().map(|next| next.end)
    }
}

impl Workers for FakeWorkers {
    fn start(&mut self, bus: &str) -> Result<WorkerId, Shutdown> {
        let mut shop = self.shop.lock().unwrap();
        let known = shop.buses.iter().position(|known| known.name == bus);
        Ok(WorkerId(known.unwrap_or_else(|| {
            let devices = Some(Devices::default());
            shop.buses.push(Bus { name: bus.into(), free: Clock::EPOCH, devices, device_count: 0 });
            shop.buses.len() - 1
        })))
    }

    fn give(&mut self, WorkerId(worker): WorkerId, device: Box<dyn Any + Send>) -> Result<usize, Shutdown> {
        let bus = &mut self.shop.lock().unwrap().buses[worker];
        bus.devices.as_mut().expect("no job runs").add(device);
        bus.device_count += 1;
        Ok(bus.device_count - 1)
    }

    fn submit(&mut self, WorkerId(worker): WorkerId, mut job: SentJob) -> Result<(), (SentJob, Shutdown)> {
        if self.bench.state().refuses {
            return Err((job, Shutdown::because(reason::WORKER_OVERFLOW, "the bench refuses it")));
        }
        let takes = Ticks(self.bench.state().answer_ticks);
        let at_once = self.bench.state().byte_ticks != 0;
        let mut shop = self.shop.lock().unwrap();
        let bus = &mut shop.buses[worker];
        let begin = self.bench.clock.now().max(bus.free);
        let mut end = begin + takes;
        let work = if at_once {
            self.bench.state().bus_now = Some(end);
            job.run(bus.devices.as_mut().expect("no job runs"));
            end = self.bench.state().bus_now.take().unwrap_or(end);
            Work::Done(Finished { job, began: begin, ended: end })
        } else {
            Work::ToDo(job)
        };
        bus.free = end;
        shop.insert(UnderWay { worker, begin, end, work });
        Ok(())
    }

    /// A job calls its device at its own end, unless bytes take time. A job that keeps time itself goes on from
    /// there in a time of its own. It is finished when that time has come.
    fn completion(&mut self) -> Option<Finished> {
        while self.has_completion() {
            let UnderWay { worker, begin: began, end, work } = self.shop.lock().unwrap().under_way.pop_front()?;
            let mut job = match work {
                Work::ToDo(job) => job,
                Work::Done(finished) => return Some(finished),
            };
            let ago = Ticks(self.bench.clock.now().since(end) as u32);
            self.bench.state().on_worker = true;
            self.bench.ago.store(ago.0, Ordering::Relaxed);
            // A worker may take memory, for example for the words of what failed.
            let taken = || self.shop.lock().unwrap().buses[worker].devices.take();
            let mut devices = taken().expect("no other job runs");
            let ended = uncounted(|| self.bench.clock.run_job(&mut || job.run(&mut devices))) - ago;
            self.shop.lock().unwrap().buses[worker].devices = Some(devices);
            self.bench.ago.store(0, Ordering::Relaxed);
            self.bench.state().on_worker = false;
            if ended == end {
                return Some(Finished { job, began, ended });
            }
            let mut shop = self.shop.lock().unwrap();
            shop.delay(worker, ended, Ticks(ended.since(end) as u32));
            let work = Work::Done(Finished { job, began, ended });
            shop.insert(UnderWay { worker, begin: began, end: ended, work });
        }
        None
    }

    fn has_completion(&self) -> bool {
        let now = self.bench.clock.now();
        let mut shop = self.shop.lock().unwrap();
        // A worker that hung returns and ends.
        let back: Vec<_> = uncounted(|| shop.left_behind.extract_if(.., |(hung, _)| hung.end <= now).collect());
        drop(shop);
        uncounted(|| drop(back));
        self.next_end().is_some_and(|end| end <= now)
    }

    /// The program waits two seconds. Longer work is left behind.
    fn reset(&mut self) {
        let waits_until = self.bench.clock.now() + WORKERS_END;
        let mut shop = self.shop.lock().unwrap();
        let Shop { under_way, mut left_behind, mut buses } = std::mem::replace(&mut *shop, Shop::new());
        let hung = under_way.into_iter().filter(|work| work.begin <= waits_until && work.end > waits_until);
        left_behind.extend(hung.map(|work| {
            let devices = buses[work.worker].devices.take();
            (work, devices)
        }));
        shop.left_behind = left_behind;
    }
}
