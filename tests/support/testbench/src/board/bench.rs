// SPDX-License-Identifier: GPL-3.0-or-later
//! The bench: what the MCU did to each pin, and the devices that a test plays.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};

use pinion_firmware::board::{Bank, BusStatus, Direction, Pin};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason};
use pinion_firmware::time::{Clock, Ticks, TimeSource, VirtualClock};

/// Number of GPIO lines. Their pins begin at 0.
pub const GPIOS: u32 = 300;
/// ADC channels: this pin and the seven after it.
pub const ANALOG: u32 = 400;
pub(super) const ANALOGS: u32 = 8;
/// Hardware PWM channels: this pin and the one after it.
pub const PWM: u32 = 500;
pub(super) const PWMS: u32 = 2;
/// Number of SPI buses. Their numbers begin at 0.
pub(super) const SPI_BUSES: u32 = 2;
/// Number of I2C buses. Their numbers begin at 0.
pub(super) const I2C_BUSES: u32 = 2;
/// The pin of the data output of SPI bus 0; the next pin is the one of bus 1.
pub const MOSI: u32 = 700;
/// The pin of the data input of SPI bus 0; the next pin is the one of bus 1.
pub const MISO: u32 = 710;
/// A serial port; the next pin is another one.
pub const SERIAL: u32 = 800;
pub(super) const SERIALS: u32 = 2;
/// A number for [`State::broken`] and [`State::nacks`]: the chips of SPI bus 0; the next number is for bus 1.
pub const SPI_CHIPS: u32 = 600;
/// The time in ticks from which a pin has a level, and the level.
pub type Edge = (u64, u8);

/// Longest message on an SPI bus, in bytes.
pub const MESSAGE_MAX: usize = 512;

/// Bytes and their number, kept without an allocation.
pub(super) type Message = ([u8; MESSAGE_MAX], usize);

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
    pub(super) line_chips: HashMap<u32, LineChip>,
    /// By bus.
    pub(super) spi_chips: HashMap<u32, SpiChip>,
    /// By pin.
    pub(super) serial_ends: HashMap<u32, SerialEnd>,
    /// By bus and address.
    pub(super) i2c_chips: HashMap<(u32, u8), I2cChip>,
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
    pub(super) on_worker: bool,
    /// ADC and PWM channels in use.
    pub claimed: HashSet<u32>,
    /// The level of each output.
    pub levels: HashMap<u32, bool>,
    /// Every change of an output, in order.
    pub edges: Vec<(u32, Edge)>,
    /// Levels of inputs, with the times from which they hold.
    pub(super) inputs: HashMap<u32, Vec<Edge>>,
    /// Next readings. The last one stays.
    pub(super) readings: HashMap<u32, VecDeque<u16>>,
    /// Readings of each DS18B20 in thousandths of a degree. The last one stays. `None` is a failure.
    pub(super) thermometers: HashMap<Vec<u8>, VecDeque<Option<i32>>>,
    /// Pins that can no longer be written or read, also ADC channels.
    pub broken: HashSet<u32>,
    /// How many of a pin's next calls fail.
    pub nacks: HashMap<u32, u32>,
    /// How long a failing call takes.
    pub fail_ticks: u32,
    /// Lines that are claimed.
    pub held: HashSet<u32>,
    /// Every SPI transfer, with its time.
    pub(super) transfers: Vec<(u64, u32, u8, u32, Message, bool)>,
    /// Every value of a PWM channel: pin, time, value.
    pub pwm_values: Vec<(u32, u64, u16)>,
    /// The value of each PWM channel if the program dies.
    pub pwm_shutdown_values: HashMap<u32, u16>,
    /// The period of each PWM channel.
    pub pwm_cycles: HashMap<u32, u32>,
    /// Whether pins 0 to 31 are in a bank ([`Bank`]). Set it before they are claimed.
    pub has_bank: bool,
    pub(super) bank: Option<&'static dyn Bank>,
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
    pub(super) bus_now: Option<Clock>,
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
    pub(super) fn arrival(&mut self, now: u64) -> u64 {
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
    pub(super) state: Arc<Mutex<State>>,
    pub(super) gate: Arc<Gate>,
    pub(super) clock: VirtualClock,
    /// How many ticks ago the worker ran the present job. The core may have stood still since then.
    pub(super) ago: Arc<AtomicU32>,
    /// A test's times count from here.
    pub(super) origin: Clock,
}

/// Lets the SPI chips hang, in tests in real time.
#[derive(Default)]
pub(super) struct Gate {
    /// Whether it is closed, and whether a transfer waits at it.
    state: Mutex<(bool, bool)>,
    changed: Condvar,
}

impl Gate {
    pub(super) fn pass(&self) {
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
    pub(super) fn arrival(&self) -> u64 {
        let now = self.ticks();
        self.state().link.as_mut().map_or(now, |link| link.arrival(now))
    }

    /// Waits until all writes have arrived.
    pub(super) fn flush(&self) {
        let wait = self.arrival() - self.ticks();
        self.clock.set(self.clock.now() + Ticks(wait as u32));
    }

    pub(super) fn ticks(&self) -> u64 {
        let now = self.clock.now() - Ticks(self.ago.load(Ordering::Relaxed));
        now.since(self.origin) as u64
    }

    /// Advances the clock by the time that a device needs.
    pub fn pass(&self, ticks: Ticks) {
        self.clock.set(self.clock.now() + ticks);
    }

    /// When a transfer of `bytes` bytes begins.
    pub(super) fn bus_ticks(&self, bytes: usize) -> u64 {
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
        let direction = self.state().directions[&pin];
        direction.shutdown_value().unwrap_or_else(|| panic!("pin {pin} is {direction:?}")).get()
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
    pub(super) fn claim(
        &self,
        pin: Pin,
        known: std::ops::Range<u32>,
        unknown: ShutdownReason,
    ) -> Result<u32, Shutdown> {
        if !known.contains(&pin.0) {
            let remedy = format!("choose one of {} to {}", known.start, known.end - 1);
            return Err(Shutdown::because(unknown, format!("the bench has no pin {}", pin.0)).remedy(remedy));
        }
        self.state().claimed.insert(pin.0);
        Ok(pin.0)
    }

    /// Checks that the core does not call a line that may sleep.
    pub(super) fn may_call(&self, pin: u32) {
        let state = self.state();
        assert!(state.on_worker || !state.sleeping.contains(&pin), "the core itself calls pin {pin}");
    }

    pub(super) fn broken(&self, pin: u32, reason: ShutdownReason) -> Result<(), Shutdown> {
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
