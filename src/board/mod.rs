// SPDX-License-Identifier: GPL-3.0-or-later
//! What the machine asks of the hardware, and the boards that answer.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::shutdown::Shutdown;
use crate::time::Ticks;

pub mod linux;
pub mod sim;

/// A pin's number on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pin(pub u32);

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

/// An input's resistor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bias {
    /// As the line is wired.
    None,
    /// To the supply.
    PullUp,
    /// To ground.
    PullDown,
}

/// What a GPIO line is claimed as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// It drives.
    Output {
        /// The level from the first moment on.
        level: bool,
        /// Where the line belongs when the machine stops or the program dies.
        shutdown_level: bool,
    },
    /// It is read; a resistor that can not be had is an error.
    Input(Bias),
}

/// A claimed GPIO line. Whoever shares it, core or worker, has a handle of the same line.
///
/// Calls must not allocate or log. They must not block either, unless the board said that the
/// line [sleeps](ClaimedLine::sleeps_on): then only a worker calls them.
pub trait Line: Send + Sync {
    /// Drives an output. On a line that was made an input since, it does nothing.
    fn write(&self, level: bool) -> Result<(), Shutdown>;

    /// The line's level.
    fn read(&self) -> Result<bool, Shutdown>;

    /// Makes it an output or an input, for all who share it: the last use decides, as in the
    /// firmware, where a line that is set up again loses its earlier set-up.
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
    /// The name of its chip's worker, if calls to this chip may take their time (an expander
    /// behind I2C, SPI or USB): the core itself must not call it.
    pub sleeps_on: Option<String>,
}

/// An ADC channel.
pub trait Adc: Send {
    /// One reading in counts of 0 to [`ADC_MAX`].
    fn read(&mut self) -> Result<u16, Shutdown>;
}

/// A hardware PWM channel.
pub trait Pwm: Send {
    /// Sets the share of the period that the output is on: 0 to [`PWM_MAX`].
    fn set(&mut self, value: u16) -> Result<(), Shutdown>;

    /// Sets period and share anew.
    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown>;
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

/// A conversation that failed: what the bus said, and for the log which device, why, and what
/// to do.
#[derive(Debug, PartialEq)]
pub struct BusError {
    /// How the bus answered.
    pub status: BusStatus,
    /// Subject, cause and remedy.
    pub detail: Box<str>,
}

/// One addressed chip on its bus. A worker uses it, one conversation at a time.
///
/// A chip is on an SPI or an I2C bus, and has the conversations of the other kind fail.
pub trait BusDevice: Send {
    /// Sends the bytes and replaces each by the one that came back meanwhile (SPI).
    ///
    /// # Errors
    ///
    /// What the bus said.
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        let _ = bytes;
        Err(BusError::other_kind("an SPI transfer", "an I2C device"))
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
}

impl BusError {
    fn other_kind(wanted: &str, is: &str) -> BusError {
        let detail = format!("{wanted} was asked of {is}: a fault of the host's configuration; correct the bus");
        BusError { status: BusStatus::Nack, detail: detail.into() }
    }
}

/// Something whose calls may take their time, and the worker that makes them.
pub struct OnWorker<T: ?Sized> {
    /// Whatever shares a bus has its name in common, such as `spi0` or `iio:device1`: one
    /// worker runs the conversations of a bus, one after the other.
    pub bus: String,
    /// The thing itself.
    pub device: Box<T>,
}

/// A hardware PWM output's parameters; values are of a full scale of [`PWM_MAX`].
#[derive(Clone, Copy, Debug)]
pub struct PwmConfig {
    /// The channel.
    pub pin: Pin,
    /// The period.
    pub cycle: Ticks,
    /// The first value.
    pub value: u16,
    /// Where the output belongs if the program dies.
    pub shutdown_value: u16,
}

/// An SPI device's parameters.
pub struct SpiConfig {
    /// The bus's number on the wire.
    pub bus: u32,
    /// 0 to 3: clock polarity in bit 1, clock phase in bit 0.
    pub mode: u8,
    /// Clock rate.
    pub rate_hz: u32,
    /// A line of our own that selects the chip.
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
pub struct ChipSelect {
    /// The line, at its idle level.
    pub line: Arc<dyn Line>,
    /// Whether the chip is selected by a high level.
    pub active_high: bool,
}

impl ChipSelect {
    /// Drives the line to its selected or idle level.
    pub fn select(&self, selected: bool) -> Result<(), Shutdown> {
        self.line.write(selected == self.active_high)
    }
}

/// A computer with pins. Errors carry the firmware's shutdown reason, and the cause, the thing
/// and the remedy for the log.
pub trait Board: Send {
    /// One line for the log: what it is and how many pins it has.
    fn describe(&self) -> String;

    /// The names of the dictionary's enumeration `pin`.
    fn pins(&self) -> Vec<Range>;

    /// The names of the dictionary's enumeration `spi_bus`.
    fn spi_buses(&self) -> Vec<Range>;

    /// The one number that stands for the line of a pin, where several may.
    fn canonical(&self, pin: Pin) -> Pin {
        pin
    }

    /// Claims a line that is not claimed yet.
    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown>;

    /// Opens an ADC channel.
    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown>;

    /// Opens an SPI device.
    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown>;

    /// The names of the dictionary's enumeration `i2c_bus`.
    fn i2c_buses(&self) -> Vec<Range>;

    /// Opens an I2C device.
    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown>;

    /// Opens a hardware PWM channel.
    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown>;

    /// How late a step may be before the machine stops: a motor that is stepped late loses its
    /// place. 1 ms, as in the firmware.
    fn step_late_limit(&self) -> Ticks {
        Ticks::from_us(1000)
    }

    /// Forgets every claim. The machine has dropped what it was given.
    fn reset(&mut self);
}
