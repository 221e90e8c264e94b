// SPDX-License-Identifier: GPL-3.0-or-later
//! What the MCU asks of the hardware, and the boards that answer.

#![forbid(unsafe_code)]

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
    /// What the dictionary calls the pin; `names` are those of its enumeration `pin`.
    pub fn name_in(self, names: &[Range]) -> String {
        names.iter().find_map(|range| range.name_of(self.0)).unwrap_or_else(|| format!("pin number {}", self.0))
    }
}

/// Full scale of an ADC reading (`ADC_MAX` of the dictionary).
pub const ADC_MAX: u16 = 4095;
/// Full scale of a PWM value (`PWM_MAX` of the dictionary).
pub const PWM_MAX: u16 = 32768;

/// A published name of the dictionary's enumerations: `count` names from `name` on (its number
/// counts up) stand for the values from `first` on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Range {
    /// The first name, such as `gpiochip1/gpio0`.
    pub name: String,
    /// The value of the first name.
    pub first: u32,
    /// How many; 1 publishes the plain name.
    pub count: u32,
}

impl Range {
    /// The name that stands for `value`, if it is one of these.
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
    /// None: the level is what the wiring makes it.
    None,
    /// To the supply.
    PullUp,
    /// To ground.
    PullDown,
}

/// Whether a claimed GPIO line is an output or an input, and how it is set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// The line is driven.
    Output {
        /// The level that it is driven to as it becomes an output.
        level: bool,
        /// The level that it is driven to when the MCU stops or the program dies.
        shutdown_value: bool,
    },
    /// The line is read. A resistor that the chip does not have is an error.
    Input(Bias),
    /// It pulls low or lets go, and is read in either case: a wire that several drive. It begins let
    /// go, and has a pull-up where the chip is not known to have none. The guardian has no part in it.
    OpenDrain,
}

/// A claimed GPIO line. The objects and workers that share a line all hold this one value.
///
/// No call may allocate or log. Nor may one block, unless the board said that the line
/// [sleeps](ClaimedLine::sleeps_on): then only a worker calls it.
pub trait Line: Send + Sync {
    /// Drives an output to a level, or lets an open drain go (`true`, high) or pulls it low. A line that
    /// another user has made an input since is left as it is.
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

    /// Makes the line an output or an input for all who share it. As in the firmware, the last
    /// set-up of a line replaces the ones before.
    ///
    /// # Errors
    ///
    /// "Unable to open out GPIO chip line" or "Unable to open in GPIO chip line", and on the
    /// simulated printer "Not an output pin" or "Not an input pin".
    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown>;

    /// The same amid a conversation on this line (single-wire UART, open-drain I2C): as cheap as a
    /// write, since the guardian is not told. Claim the line as an input, so that the guardian never
    /// drives it.
    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.set_direction(direction)
    }
}

/// A line as the board hands it out.
pub struct ClaimedLine {
    /// The line.
    pub line: Arc<dyn Line>,
    /// The name of the worker of the line's chip, if calls to that chip may block, as it is an
    /// expander on I2C, SPI or USB. The core must not call such a line.
    pub sleeps_on: Option<String>,
}

/// An edge of a line, as an interrupt saw it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// When it came, in CLOCK_MONOTONIC.
    pub at: Duration,
    /// The level that the interrupt found. It equals the level before where a pulse was over by then.
    pub level: bool,
    /// Edges before this one that were dropped, as nobody took them in time.
    pub dropped: u32,
}

/// The edges of a line, which an interrupt dates. A worker makes these calls.
pub trait Edges: Send {
    /// Shows the edges since the last call, the oldest first.
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

/// An input whose edges are to be counted, as the board hands it out.
pub struct CountedLine {
    /// The line, to be read and to be shared.
    pub line: ClaimedLine,
    /// Its edges; or for the log why no interrupt counts them.
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
    /// Sets for how much of each period the output is on: 0 to [`PWM_MAX`].
    ///
    /// # Errors
    ///
    /// "PWM write failed".
    fn set(&mut self, value: u16) -> Result<(), Shutdown>;

    /// Sets a new period, and for how much of it the output is on: 0 to [`PWM_MAX`]. The output
    /// stays as it is set here when the MCU stops or the program dies.
    ///
    /// # Errors
    ///
    /// "Unable to config pwm device", "PWM write failed", "Guardian process lost".
    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown>;
}

/// A thermometer whose reading takes its time.
pub trait Thermometer: Send {
    /// The temperature in thousandths of a degree Celsius.
    ///
    /// # Errors
    ///
    /// What the log says; the next reading may be good.
    fn read(&mut self) -> Result<i32, Trouble>;
}

/// The data output of an SPI controller, used for itself: the controller's clock times what is sent.
pub struct Mosi {
    /// The output; nobody answers there.
    pub line: OnWorker<dyn BusDevice>,
    /// Bytes that are sent at once.
    pub message_max: usize,
}

/// How a bus answered, in the words of the dictionary's `i2c_bus_status`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BusStatus {
    /// The chip did not acknowledge a byte, or the driver failed in another way than these; SPI has
    /// no other status.
    Nack,
    /// The bus was not free, or the chip held the clock, for too long.
    Timeout,
    /// No chip acknowledged the address.
    StartNack,
    /// No chip acknowledged the address when it was addressed again to be read from.
    StartReadNack,
}

/// Why a conversation with a chip failed.
#[derive(Clone, Debug, PartialEq)]
pub struct BusError {
    /// How the bus answered, for the wire.
    pub status: BusStatus,
    /// Which device failed, why, and what to do about it, for the log.
    pub trouble: Trouble,
}

/// One addressed chip on its bus. A worker uses it, one conversation at a time.
///
/// A chip is on an SPI or an I2C bus, and has the conversations of the other kind fail.
pub trait BusDevice: Send {
    /// Sends the bytes and replaces each by the one that came back meanwhile (SPI). With no bytes the chip
    /// is only [selected for a moment](ChipSelect::pulse).
    ///
    /// # Errors
    ///
    /// What the bus said.
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        let _ = bytes;
        Err(BusError::other_kind("an SPI transfer", "an I2C device"))
    }

    /// Sends the bytes, and leaves what comes back meanwhile alone (SPI): a controller with one data line
    /// cannot do both.
    ///
    /// # Errors
    ///
    /// What the bus said.
    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.exchange(&mut bytes.to_vec())
    }

    /// Writes bytes and reads bytes, with a repeated start between the two (I2C). Nothing to read is
    /// a plain write, nothing to write a plain read.
    ///
    /// # Errors
    ///
    /// What the bus said.
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let _ = (write, read);
        Err(BusError::other_kind("an I2C transfer", "an SPI device"))
    }

    /// Reads from a register on, or with none from wherever the chip stands (I2C). The MCU makes such
    /// a transfer again if it fails (`mcu/calls.rs`).
    ///
    /// For registers that reading or naming does not change. A command, or a FIFO, is
    /// [`BusDevice::write_read`]'s: asked for twice it might be carried out twice.
    ///
    /// # Errors
    ///
    /// What the bus said at last.
    fn read_register(&mut self, register: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.write_read(register, read)
    }
}

/// A line of the bus failed.
impl From<Shutdown> for BusError {
    fn from(failure: Shutdown) -> BusError {
        BusError { status: BusStatus::Nack, trouble: *failure.trouble }
    }
}

impl BusError {
    /// A failure that the bus answered with this status; a text alone is its cause.
    pub fn new(status: BusStatus, trouble: impl Into<Trouble>) -> BusError {
        BusError { status, trouble: trouble.into() }
    }

    /// The same failure, of this device.
    pub fn of(self, device: impl fmt::Display) -> BusError {
        BusError { trouble: self.trouble.of(device), ..self }
    }

    fn other_kind(wanted: &str, is: &str) -> BusError {
        let cause = format!("{wanted} was asked of {is}: a fault of the host's configuration");
        BusError::new(BusStatus::Nack, Trouble::new(cause).remedy("correct the bus"))
    }
}

/// A device whose calls may block, and the name of the worker that is to make them.
pub struct OnWorker<T: ?Sized> {
    /// The name of the worker, such as `spi0` or `iio:device1`. Devices on one bus carry the same
    /// name, so that one worker makes all their calls, one after the other.
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
    /// The value from the beginning.
    pub value: u16,
    /// The value that the output is set to if the program dies.
    pub shutdown_value: u16,
}

/// An SPI device's parameters.
pub struct SpiConfig {
    /// The bus's number on the wire.
    pub bus: u32,
    /// 0 to 3: clock polarity in bit 1, clock phase in bit 0.
    pub mode: u8,
    /// The bus's clock rate while it speaks to this chip.
    pub rate_hz: u32,
    /// The GPIO line that selects the chip; none if the bus's controller selects it, or nothing.
    pub chip_select: Option<ChipSelect>,
}

/// An I2C device's parameters.
#[derive(Clone, Copy, Debug)]
pub struct I2cConfig {
    /// The bus's number on the wire.
    pub bus: u32,
    /// The chip's address, 7 bits.
    pub address: u8,
    /// Clock rate that the host asks for; on Linux the driver has its own.
    pub rate_hz: u32,
}

/// A line that selects a chip.
#[derive(Clone)]
pub struct ChipSelect {
    /// The line, an output.
    pub line: Arc<dyn Line>,
    /// Whether a high level selects the chip, rather than a low one.
    pub active_high: bool,
    /// What a pulse is timed by.
    pub clock: Arc<dyn TimeSource>,
}

/// Shortest pulse on a line that selects a chip. The TLE5012B latches at the end of one of 1 us (Infineon,
/// TLE5012B E1000 user manual, "SSC timing": t_CSupdate).
const SELECT_MIN: Ticks = Ticks::from_us(1);

impl ChipSelect {
    /// Drives the line so that the chip is selected, or not.
    ///
    /// # Errors
    ///
    /// "GPIO line write failed".
    pub fn select(&self, selected: bool) -> Result<(), Shutdown> {
        self.line.write(selected == self.active_high)
    }

    /// Selects the chip for 1 us at least, with no clock meanwhile.
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

/// A computer with pins. Opening and claiming may block and allocate, so the MCU does so only
/// until `finalize_config`.
pub trait Board: Send {
    /// One line for the log: what the board is and what it has.
    fn describe(&self) -> String;

    /// The names of the dictionary's enumeration `pin`.
    fn pins(&self) -> Vec<Range>;

    /// The names of the dictionary's enumeration `spi_bus`.
    fn spi_buses(&self) -> Vec<Range>;

    /// Another view of the same hardware, for a thread that [looks again](Board::look_again): what it
    /// then finds, this board has, too. None if nothing comes and goes.
    fn view(&self) -> Option<Box<dyn Board>> {
        None
    }

    /// Looks for what has come and gone, which may block. True if something has.
    fn look_again(&mut self) -> bool {
        false
    }

    /// One and the same number for all the pins that lead to one line.
    fn canonical(&self, pin: Pin) -> Pin {
        pin
    }

    /// Claims a line that nobody has claimed yet.
    ///
    /// # Errors
    ///
    /// "Not an output pin", "Not an input pin", "GPIO chip device not found", "Unable to open GPIO
    /// chip device", "Unable to open out GPIO chip line", "Unable to open in GPIO chip line",
    /// "Guardian process lost".
    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown>;

    /// Claims an input that nobody has claimed yet, and has its edges counted where that can be.
    ///
    /// # Errors
    ///
    /// Those of [`Board::line`].
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

    /// Opens the SPI data output that `pin` names, in mode 0.
    ///
    /// # Errors
    ///
    /// "Not an output pin" for any other pin, and those of [`Board::spi`].
    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Mosi, Shutdown> {
        let _ = rate_hz;
        Err(not_mosi(&pin.name_in(&self.pins())))
    }

    /// Opens the DS18B20 thermometer that the kernel calls `serial`, such as `28-0123456789ab`.
    ///
    /// # Errors
    ///
    /// "Invalid DS18B20 serial id, could not open for reading".
    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        let serial = String::from_utf8_lossy(serial);
        let trouble = Trouble::new("this board has no one-wire bus").remedy("take another sensor");
        Err(Shutdown::because(reason::DS18B20_OPEN, trouble.of(format_args!("{serial:?}"))))
    }

    /// Forgets all claims. The MCU has dropped the lines and devices before.
    fn reset(&mut self);
}

/// The error of [`Board::mosi`] for a pin that is no SPI data output.
pub fn not_mosi(name: &str) -> Shutdown {
    let cause = format!("{name} can not drive LEDs: their pulses are too short for a program on Linux");
    Shutdown::because(reason::NOT_OUTPUT, cause).remedy(
        "connect them to the data output (MOSI) of an SPI controller and name its device, such as \"pin: spidev0.0\" (pinion pins lists them)",
    )
}
