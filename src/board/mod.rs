// SPDX-License-Identifier: GPL-3.0-or-later
//! What the machine asks of the hardware, and the boards that answer.

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::RawFd;

use crate::shutdown::Shutdown;
use crate::time::Ticks;

pub mod linux;
pub mod sim;

/// A pin's number on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pin(pub u32);

/// Bytes of a message block's parameters fit in here with room to spare.
pub const BUFFER_BYTES: usize = 64;

/// Up to [`BUFFER_BYTES`] bytes on their way to a device or back.
#[derive(Clone, Copy, Debug)]
pub struct Buffer {
    len: u8,
    bytes: [u8; BUFFER_BYTES],
}

impl Buffer {
    /// No bytes.
    pub const EMPTY: Buffer = Buffer { len: 0, bytes: [0; BUFFER_BYTES] };

    /// A copy of `bytes`; what is past [`BUFFER_BYTES`] is left out.
    pub fn new(bytes: &[u8]) -> Buffer {
        let mut buffer = Buffer::EMPTY;
        let len = bytes.len().min(BUFFER_BYTES);
        buffer.bytes[..len].copy_from_slice(&bytes[..len]);
        buffer.len = len as u8;
        buffer
    }

    /// The bytes.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }

    /// The bytes, to be changed in place.
    pub fn as_mut_slice(&mut self) -> &mut [u8] {
        &mut self.bytes[..usize::from(self.len)]
    }
}

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

/// An output line. The core writes it: a write must not block, allocate or log.
pub trait Output: Send {
    /// Drives the line.
    fn write(&mut self, value: bool) -> Result<(), Shutdown>;
}

/// An input line. The core reads it: a read must not block, allocate or log.
pub trait Input: Send {
    /// The line's level.
    fn read(&mut self) -> Result<bool, Shutdown>;
}

/// Something behind a bus or a file, which may take its time.
pub trait Device: Send {
    /// Runs one conversation: takes the request's bytes out of `data` and leaves the reply's
    /// there. An ADC takes none and leaves its reading, scaled to `ADC_MAX`, in two bytes,
    /// low byte first; an SPI device replaces each byte by the one that came back.
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown>;
}

/// Where a device's conversations run.
pub enum Attachment {
    /// In the core, as they take no time.
    Inline(Box<dyn Device>),
    /// On the worker of the named bus, one at a time, in order.
    Worker {
        /// Such as `spi0` or `iio`.
        bus: String,
        /// The device.
        device: Box<dyn Device>,
    },
}

/// A hardware PWM output's parameters; values are of a full scale of 32768.
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

/// A line that selects a chip.
pub struct ChipSelect {
    /// The line, at its idle level.
    pub line: Box<dyn Output>,
    /// Whether the chip is selected by a high level.
    pub active_high: bool,
}

impl ChipSelect {
    /// Drives the line to its selected or idle level.
    pub fn select(&mut self, selected: bool) -> Result<(), Shutdown> {
        self.line.write(selected == self.active_high)
    }
}

/// Keeps copies of the outputs, to drive them to their shutdown values if the program dies.
///
/// An output is known by its name, which is also what the log calls it, such as `gpiochip0 line 5`
/// or `pwmchip0/pwm1`. One that is given again replaces what was known of it.
pub trait Guard: Send {
    /// Copies an output line's descriptor (a GPIO line handle of the character device).
    /// `sleeping` is the line's chip if its driver may sleep, as it talks to the chip over a bus:
    /// the lines of such a chip are driven apart from all others, which do not wait for it.
    fn output(&mut self, name: &str, line: RawFd, shutdown_value: bool, sleeping: Option<&str>) -> io::Result<()>;

    /// Copies the descriptors of the files that drive one output (a PWM's duty cycle and its
    /// switch), and what is to be written at the beginning of each, in this order.
    fn files(&mut self, name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()>;

    /// Gives back every copy, so that the lines can be claimed anew. When this returns, they
    /// are free.
    fn release(&mut self) -> io::Result<()>;
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

    /// Claims a line and drives it to `value`. `shutdown_value` is where the line belongs
    /// if the program dies.
    fn output(&mut self, pin: Pin, value: bool, shutdown_value: bool) -> Result<Box<dyn Output>, Shutdown>;

    /// Claims a line as an input; a bias that can not be had is an error.
    fn input(&mut self, pin: Pin, bias: Bias) -> Result<Box<dyn Input>, Shutdown>;

    /// Claims an ADC channel.
    fn adc(&mut self, pin: Pin) -> Result<Attachment, Shutdown>;

    /// Opens an SPI device.
    fn spi(&mut self, config: SpiConfig) -> Result<Attachment, Shutdown>;

    /// Claims a hardware PWM channel that is not in use. The device takes a value in two bytes,
    /// low byte first, of a full scale of 32768; four more are a new period in ticks.
    fn pwm(&mut self, config: PwmConfig) -> Result<Attachment, Shutdown>;

    /// How late a step may be before the machine stops: a motor that is stepped late loses its
    /// place. 1 ms, as in the firmware.
    fn step_late_limit(&self) -> Ticks {
        Ticks::from_us(1000)
    }

    /// Forgets every claim. The machine has dropped what it was given.
    fn reset(&mut self);
}
