// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's requests to the hardware, and the interface of boards.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use crate::shutdown::{Shutdown, reason};
use crate::time::{Ticks, TimeSource};
use crate::trouble::Trouble;

pub mod soft_i2c;
pub mod soft_spi;

/// A pin's number on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pin(pub u32);

impl Pin {
    /// The pin's name in the dictionary. `names` is the enumeration `pin`.
    pub fn name_in(self, names: &[Range]) -> String {
        names.iter().find_map(|range| range.name_of(self.0)).unwrap_or_else(|| format!("pin number {}", self.0))
    }
}

/// Full scale of an ADC reading (`ADC_MAX` of the dictionary).
pub const ADC_MAX: u16 = 4095;
/// Full scale of a PWM value (`PWM_MAX` of the dictionary).
pub const PWM_MAX: u16 = 32768;

/// A published name of the dictionary's enumerations. The `count` names from `name` on (its number counts up) have the
/// values from `first` on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Range {
    /// The first name, for example `gpiochip1/gpio0`.
    pub name: String,
    /// The value of the first name.
    pub first: u32,
    /// Number of names; 1 publishes the plain name.
    pub count: u32,
}

impl Range {
    /// The name of `value`, if it is in this range.
    pub fn name_of(&self, value: u32) -> Option<String> {
        let at = value.checked_sub(self.first).filter(|at| *at < self.count)?;
        if at == 0 {
            return Some(self.name.clone());
        }
        let root = self.name.trim_end_matches(|c: char| c.is_ascii_digit());
        let start: u64 = self.name[root.len()..].parse().unwrap_or(0);
        Some(format!("{root}{}", start + u64::from(at)))
    }
}

/// The resistor that the chip puts on an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bias {
    /// None: the wiring determines the level.
    None,
    /// To the supply.
    PullUp,
    /// To ground.
    PullDown,
}

/// The value of an output in a stopped MCU, and after the death of the program. The MCU's table of claims makes it
/// (`mcu/claims.rs`). Line, guardian and object all have this one. Other code can only make the value of an output that
/// goes off (the default), or that [stays at its level](Direction::at_rest).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShutdownValue<T>(T);

impl<T: Copy> ShutdownValue<T> {
    pub(crate) fn new(value: T) -> ShutdownValue<T> {
        ShutdownValue(value)
    }

    /// The value itself.
    pub fn get(self) -> T {
        self.0
    }
}

/// Whether a claimed GPIO line is an output or an input, and its setup.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// The line is driven.
    Output {
        /// The level when it becomes an output.
        level: bool,
        /// The level when the MCU stops or the program dies.
        shutdown_value: ShutdownValue<bool>,
    },
    /// The line is read. It is an error if the chip does not have this resistor.
    Input(Bias),
    /// An open drain, for a wire that several chips drive: it pulls low or releases the wire, and is read in both
    /// states. It begins released. It has a pull-up, except on chips known to have none. The guardian does not handle
    /// it.
    OpenDrain,
}

impl Direction {
    /// An output whose level now is also its level when the MCU stops or the program dies.
    pub const fn at_rest(level: bool) -> Direction {
        Direction::Output { level, shutdown_value: ShutdownValue(level) }
    }

    /// The shutdown value of an output.
    pub fn shutdown_value(self) -> Option<ShutdownValue<bool>> {
        if let Direction::Output { shutdown_value, .. } = self { Some(shutdown_value) } else { None }
    }
}

/// Lines whose levels one store can change together. A claimed line says if it is in one ([`Line::bank`]).
pub trait Bank: Sync {
    /// Drives the lines of the bits in `high` to high, then the lines of the bits in `low` to low.
    fn change(&self, high: u32, low: u32);

    /// Returns when the changes have reached the lines ([`Line::flush`]).
    fn flush(&self) {}
}

/// A claimed GPIO line. The objects and workers that share a line all hold this one value.
///
/// No call may allocate or log. No call may block, unless the board said that the line
/// [sleeps](ClaimedLine::sleeps_on). Then only a worker calls it.
pub trait Line: Send + Sync {
    /// Drives an output to a level. Releases an open drain (`true`, high) or pulls it low. Does nothing if another user
    /// has made the line an input.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    fn write(&self, level: bool) -> Result<(), Shutdown>;

    /// The line's level; `true` is high.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    fn read(&self) -> Result<bool, Shutdown>;

    /// Makes the line an output or an input for all users. As in Klipper's C, the last setup of a line replaces the
    /// earlier ones.
    ///
    /// # Errors
    ///
    /// "Unable to open out GPIO chip line" or "Unable to open in GPIO chip line". The simulated printer also has "Not
    /// an output pin" and "Not an input pin".
    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown>;

    /// The same within a message on this line (single-wire UART, open-drain I2C). It is as fast as a write,
    /// because the guardian is not informed. Claim the line as an input, so that the guardian never drives it.
    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.set_direction(direction)
    }

    /// The line's bank and its bit there, while the line is an output of a bank.
    fn bank(&self) -> Option<(&'static dyn Bank, u32)> {
        None
    }

    /// Whether the line is written and read without a call of the kernel.
    fn is_fast(&self) -> bool {
        false
    }

    /// Returns when the last write has reached the line. A clock that is read afterwards shows a time after the edge.
    fn flush(&self) {}

    /// Whether a write may reach the line after it returned, because a bus holds it back. Each edge then needs a
    /// [flush](Line::flush), which takes longer than a short pulse.
    fn is_posted(&self) -> bool {
        false
    }
}

/// A line from the board.
pub struct ClaimedLine {
    /// The line.
    pub line: Arc<dyn Line>,
    /// The name of the worker of the line's chip, if calls to that chip may block. Examples are expanders on I2C, SPI
    /// or USB. The core must not call this line.
    pub sleeps_on: Option<String>,
}

/// An edge of a line, as an interrupt saw it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// When it came, in CLOCK_MONOTONIC.
    pub at: Duration,
    /// The level that the interrupt read. It equals the previous level if the pulse was already over.
    pub level: bool,
    /// How many earlier edges were dropped because nobody read them in time.
    pub dropped: u32,
}

/// The edges of a line, with times from an interrupt. A worker makes these calls.
pub trait Edges: Send {
    /// Passes the edges since the last call to `see`, the oldest first.
    ///
    /// # Errors
    ///
    /// "GPIO line read failed".
    fn take(&mut self, see: &mut dyn FnMut(Edge)) -> Result<(), Shutdown>;

    /// Ends the interrupts. The line can still be read.
    ///
    /// # Errors
    ///
    /// "Unable to open in GPIO chip line".
    fn end(&mut self) -> Result<(), Shutdown>;
}

/// An input with counted edges, from the board.
pub struct CountedLine {
    /// The line, for reading and sharing.
    pub line: ClaimedLine,
    /// Its edges, or for the log why no interrupt counts them.
    pub edges: Result<OnWorker<dyn Edges>, Box<str>>,
}

/// An ADC channel.
pub trait Adc: Send {
    /// One reading in counts of 0 to [`ADC_MAX`]. May block.
    ///
    /// # Errors
    ///
    /// "Error on analog read".
    fn read(&mut self) -> Result<u16, Shutdown>;
}

/// A hardware PWM channel. Its calls may block.
pub trait Pwm: Send {
    /// Sets the part of each period in which the output is on: 0 to [`PWM_MAX`].
    ///
    /// # Errors
    ///
    /// "PWM write failed".
    fn set(&mut self, value: u16) -> Result<(), Shutdown>;

    /// Sets a new period, and the part of it in which the output is on: 0 to [`PWM_MAX`]. The output keeps this setting
    /// when the MCU stops or the program dies.
    ///
    /// # Errors
    ///
    /// "Unable to config pwm device", "PWM write failed", "Guardian process lost".
    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown>;
}

/// A thermometer with slow readings.
pub trait Thermometer: Send {
    /// The temperature in thousandths of a degree Celsius.
    ///
    /// # Errors
    ///
    /// The text for the log. The next reading may succeed.
    fn read(&mut self) -> Result<i32, Trouble>;
}

/// A serial port. Its controller times the bits of each byte: a start bit, eight data bits, a stop bit. A worker makes
/// these calls.
pub trait SerialPort: Send {
    /// Drops the bytes that have been received, and sends others. Returns when they have been sent.
    ///
    /// # Errors
    ///
    /// The text for the log.
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble>;

    /// Reads bytes that have been received. Waits up to `limit` for the first one. Returns how many there were: 0 if
    /// none came.
    ///
    /// # Errors
    ///
    /// The text for the log.
    fn receive(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble>;

    /// The faults that the port has counted since the last call, for example "2 framing errors". `None` without faults,
    /// or if it does not count them.
    fn faults(&mut self) -> Option<String> {
        None
    }
}

/// The data lines of an SPI controller, without a chip that knows SPI. The controller's clock times the data.
pub struct Mosi {
    /// The output, and the input if something is connected to it.
    pub line: OnWorker<dyn BusDevice>,
    /// Highest number of bytes in one transfer.
    pub message_max: usize,
    /// A warning for the log, if the controller is known to pause within a transfer.
    pub pauses: Option<Trouble>,
}

/// How a bus answered, in the words of the dictionary's `i2c_bus_status`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BusStatus {
    /// The chip did not acknowledge a byte, or the driver failed for a reason not listed here. SPI has only this
    /// status.
    Nack,
    /// The bus was busy for too long, or the chip held the clock for too long.
    Timeout,
    /// No chip acknowledged the address.
    StartNack,
    /// No chip acknowledged the address after the repeated start of a read.
    StartReadNack,
}

/// Why a transfer with a chip failed.
#[derive(Clone, Debug, PartialEq)]
pub struct BusError {
    /// How the bus answered, for the wire.
    pub status: BusStatus,
    /// For the log: the device that failed, why, and the remedy.
    pub trouble: Trouble,
}

/// One addressed chip on its bus. A worker uses it, one job at a time.
///
/// A chip is on an SPI or an I2C bus. Transfers of the other kind fail.
pub trait BusDevice: Send {
    /// Sends the bytes and replaces each by the received byte (SPI). Without bytes, the chip is only
    /// [selected for a moment](ChipSelect::pulse).
    ///
    /// # Errors
    ///
    /// The error of the bus.
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        let _ = bytes;
        Err(BusError::other_kind("an SPI transfer", "an I2C device"))
    }

    /// Sends the bytes and ignores the received bytes (SPI). A controller with one data line cannot do both.
    ///
    /// # Errors
    ///
    /// The error of the bus.
    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.exchange(&mut bytes.to_vec())
    }

    /// Writes bytes and then reads bytes, with a repeated start between the two (I2C). It only
    /// writes if there is nothing to read, and only reads if there is nothing to write.
    ///
    /// # Errors
    ///
    /// The error of the bus.
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let _ = (write, read);
        Err(BusError::other_kind("an I2C transfer", "an SPI device"))
    }

    /// Reads from this register on, or without a register from the chip's present position (I2C). The MCU retries this
    /// transfer if it fails (`mcu/calls.rs`).
    ///
    /// Use it only for registers that do not change when they are selected or read. For a command or a FIFO, use
    /// [`BusDevice::write_read`], because a retry might run the command twice.
    ///
    /// # Errors
    ///
    /// The error of the last try.
    fn read_register(&mut self, register: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.write_read(register, read)
    }
}

/// For a failure of a GPIO line of the bus.
impl From<Shutdown> for BusError {
    fn from(failure: Shutdown) -> BusError {
        BusError { status: BusStatus::Nack, trouble: failure.into_trouble() }
    }
}

impl BusError {
    /// A failure with this status of the bus. A text alone is its cause.
    pub fn new(status: BusStatus, trouble: impl Into<Trouble>) -> BusError {
        BusError { status, trouble: trouble.into() }
    }

    /// The same failure, with this device as its subject.
    pub fn of(self, device: impl fmt::Display) -> BusError {
        BusError { trouble: self.trouble.of(device), ..self }
    }

    fn other_kind(wanted: &str, is: &str) -> BusError {
        let cause = format!("the host asked for {wanted} on {is}: a fault of the host's configuration");
        BusError::new(BusStatus::Nack, Trouble::new(cause).remedy("correct the bus"))
    }
}

/// A device whose calls may block, and the name of the worker that makes them.
pub struct OnWorker<T: ?Sized> {
    /// The name of the worker, for example `spi0` or `iio:device1`. Devices on one bus have the same name. So one
    /// worker makes all their calls, one after the other.
    pub bus: String,
    /// The device.
    pub device: Box<T>,
}

/// A hardware PWM output's parameters. Both values are 0 (off) to [`PWM_MAX`] (on all the time).
#[derive(Clone, Copy, Debug)]
pub struct PwmConfig {
    /// The channel.
    pub pin: Pin,
    /// The period.
    pub cycle: Ticks,
    /// The first value.
    pub value: u16,
    /// The value when the program dies.
    pub shutdown_value: ShutdownValue<u16>,
}

/// An SPI device's parameters.
pub struct SpiConfig {
    /// The bus's number on the wire.
    pub bus: u32,
    /// 0 to 3: clock polarity in bit 1, clock phase in bit 0.
    pub mode: u8,
    /// The bus's clock rate for this chip.
    pub rate_hz: u32,
    /// The GPIO line that selects the chip; `None` if the bus's controller selects it, or nothing does.
    pub chip_select: Option<ChipSelect>,
}

/// An I2C device's parameters.
#[derive(Clone, Copy, Debug)]
pub struct I2cConfig {
    /// The bus's number on the wire.
    pub bus: u32,
    /// The chip's address, 7 bits.
    pub address: u8,
    /// The host's clock rate. On Linux the driver uses its own.
    pub rate_hz: u32,
}

/// A line that selects a chip.
#[derive(Clone)]
pub struct ChipSelect {
    /// The line, an output.
    pub line: Arc<dyn Line>,
    /// Whether a high level selects the chip, instead of a low one.
    pub active_high: bool,
    /// The clock that times a pulse.
    pub clock: Arc<dyn TimeSource>,
}

/// Shortest pulse on a chip select. The TLE5012B latches at the end of a pulse of 1 us (Infineon, TLE5012B E1000 user
/// manual, "SSC timing": t_CSupdate).
const SELECT_MIN: Ticks = Ticks::from_us(1);

impl ChipSelect {
    /// Selects or deselects the chip.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    pub fn select(&self, selected: bool) -> Result<(), Shutdown> {
        self.line.write(selected == self.active_high)
    }

    /// Selects the chip for at least 1 us. The clock has no edge in that time.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    pub fn pulse(&self) -> Result<(), Shutdown> {
        let selected = self.select(true);
        self.clock.spin_until(self.clock.now() + SELECT_MIN);
        let deselected = self.select(false);
        selected.and(deselected)
    }
}

/// A computer with pins. Opening and claiming may block and allocate. So the MCU does it only until `finalize_config`.
pub trait Board: Send {
    /// One line for the log that describes the board and its devices.
    fn describe(&self) -> String;

    /// The names of the dictionary's enumeration `pin`.
    fn pins(&self) -> Vec<Range>;

    /// The names of the dictionary's enumeration `spi_bus`.
    fn spi_buses(&self) -> Vec<Range>;

    /// Constants of the dictionary that differ from Pinion's own, or come in addition. A simulated board says with `MCU`
    /// which chip it stands for.
    fn constants(&self) -> Vec<(String, serde_json::Value)> {
        Vec::new()
    }

    /// A device on a software bus of these lines (MISO, MOSI, SCLK), if the board has another way to it than its lines.
    /// The number of the bus has no meaning.
    fn spi_on_lines(&mut self, pins: [Pin; 3], config: &SpiConfig) -> Option<OnWorker<dyn BusDevice>> {
        let _ = (pins, config);
        None
    }

    /// The same for an I2C device on two lines (SCL, SDA).
    fn i2c_on_lines(&mut self, pins: [Pin; 2], config: I2cConfig) -> Option<OnWorker<dyn BusDevice>> {
        let _ = (pins, config);
        None
    }

    /// Another view of the same hardware, for a thread that [looks again](Board::look_again). This board then also has
    /// the devices that the view finds. `None` if no device comes or goes.
    fn view(&self) -> Option<Box<dyn Board>> {
        None
    }

    /// Looks for devices that have come or gone, which may block. True if there are any.
    fn look_again(&mut self) -> bool {
        false
    }

    /// The one number for all pins that lead to the same line.
    fn canonical(&self, pin: Pin) -> Pin {
        pin
    }

    /// Claims a line that is not claimed yet.
    ///
    /// # Errors
    ///
    /// "Not an output pin", "Not an input pin", "GPIO chip device not found", "Unable to open GPIO
    /// chip device", "Unable to open out GPIO chip line", "Unable to open in GPIO chip line",
    /// "Guardian process lost".
    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown>;

    /// Claims an input that is not claimed yet, with counted edges if possible.
    ///
    /// # Errors
    ///
    /// The errors of [`Board::line`].
    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        let line = self.line(pin, Direction::Input(bias))?;
        Ok(CountedLine { line, edges: Err("this board has no edge events".into()) })
    }

    /// Opens an ADC channel.
    ///
    /// # Errors
    ///
    /// "Unable to open adc device".
    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown>;

    /// Opens an SPI device.
    ///
    /// # Errors
    ///
    /// "Unable to open spi device", "Unable to set SPI speed", "Unable to set SPI mode".
    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown>;

    /// The names of the dictionary's enumeration `i2c_bus`.
    fn i2c_buses(&self) -> Vec<Range>;

    /// Opens an I2C device.
    ///
    /// # Errors
    ///
    /// "Unable to open i2c device".
    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown>;

    /// Opens a hardware PWM channel.
    ///
    /// # Errors
    ///
    /// "Unable to config pwm device", "PWM write failed", "Guardian process lost".
    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown>;

    /// Opens the SPI data output with the name `pin`, in mode 0. `None`: this pin is no SPI data output.
    ///
    /// # Errors
    ///
    /// The errors of [`Board::spi`].
    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let _ = (pin, rate_hz);
        Ok(None)
    }

    /// The data output of the SPI device whose data input has the name `pin`. `None`: this pin is no SPI data input.
    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        let _ = miso;
        None
    }

    /// Opens the serial port with the name `pin`. `None`: this pin is no serial port.
    ///
    /// # Errors
    ///
    /// "Unable to open serial port".
    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        let _ = (pin, rate_hz);
        Ok(None)
    }

    /// Opens the DS18B20 thermometer that the kernel names `serial`, for example `28-0123456789ab`.
    ///
    /// # Errors
    ///
    /// "Invalid DS18B20 serial id, could not open for reading".
    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        let serial = String::from_utf8_lossy(serial);
        let trouble = Trouble::new("this board has no one-wire bus").remedy("take another sensor");
        Err(Shutdown::because(reason::DS18B20_OPEN, trouble.of(format_args!("{serial:?}"))))
    }

    /// Forgets all claims. The MCU has dropped the lines and devices before this.
    fn reset(&mut self);
}
