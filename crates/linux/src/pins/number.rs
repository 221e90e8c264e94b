// SPDX-License-Identifier: GPL-3.0-or-later
//! The numbers of pins.
//!
//! | number | what | names |
//! |---|---|---|
//! | 0..4608 | 288 lines of each of gpiochip0 to 15, as the C program | `gpiochip0/gpio17` |
//! | 4096..4104 | voltage0 to voltage7 of iio:device0, as the C program; not lines 64 to 71 of gpiochip14 | `analog3` |
//! | 65536..65664 | 16 channels of each of pwmchip0 to 7, as the C program | `pwmchip0/pwm1` |
//! | 2^24.. | every other line: 4096 numbers for each chip | `gpiochip16/gpio0` |
//! | 2^25.. | every other ADC channel: 256 numbers for each device | |
//! | 2^26.. | the data outputs (MOSI) of SPI devices, for chips without SPI: LEDs, HX711 | `spidev0.0` |
//! | 2^26 + 2^16.. | the data inputs (MISO) of the same devices | `spidev0.0/miso` |
//! | 2^27.. | serial ports, for drivers with a UART: 2^15 numbers for each driver of ports | `ttyAMA1` |

#![forbid(unsafe_code)]

use std::fmt;

use crate::spi::Node;
use pinion_firmware::board::Pin;

/// How many chips have pin numbers in the C program. Before August 2026 it had 9.
pub(super) const CHIPS: u32 = 16;
/// How many numbers each of these chips has (`MAX_GPIO_LINES`).
pub(super) const CHIP_LINES: u32 = 288;
/// The number of the first ADC channel (`ANALOG_START`).
pub(super) const ANALOG: u32 = 1 << 12;
/// How many ADC channels the C program has.
pub(super) const ANALOG_CHANNELS: u32 = 8;
/// The chip and the line that would have the numbers of the first ADC channel. In the C program they share them.
pub(super) const ANALOG_CHIP: u32 = ANALOG / CHIP_LINES;
pub(super) const ANALOG_LINE: u32 = ANALOG % CHIP_LINES;
/// The number of the first hardware PWM channel (`HARD_PWM_START`).
pub(super) const PWM: u32 = 1 << 16;
pub(super) const PWM_CHIPS: u32 = 8;
pub(super) const PWM_CHIP_CHANNELS: u32 = 16;
/// The first number of the lines without a number in the C program.
const FURTHER_LINES: u32 = 1 << 24;
const FURTHER_CHIPS: u32 = 1 << 12;
const FURTHER_CHIP_LINES: u32 = 1 << 12;
/// The first number of the ADC channels without a number in the C program.
const FURTHER_CHANNELS: u32 = 1 << 25;
const FURTHER_DEVICES: u32 = 1 << 12;
const FURTHER_DEVICE_CHANNELS: u32 = 1 << 8;
/// Data outputs of SPI devices, by the device's number on the wire.
pub(super) const MOSI: u32 = 1 << 26;
pub(super) const MOSI_NODES: u32 = 1 << 16;
/// Data inputs of the same devices.
pub(super) const MISO: u32 = MOSI + MOSI_NODES;

/// Serial ports, by the numbers of their devices (major and minor).
const SERIAL: u32 = 1 << 27;
const SERIAL_DRIVERS: u32 = 1 << 12;
const SERIAL_DRIVER_PORTS: u32 = 1 << 15;

/// The thing that a pin's number stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// A line of `/dev/gpiochip<chip>`.
    Line {
        /// The chip's number.
        chip: u32,
        /// The line's offset.
        offset: u32,
    },
    /// Channel `voltage<n>` of iio:device0.
    Analog(u32),
    /// A channel of an IIO device, by its position among the device's channels.
    Channel {
        /// The number of `iio:device<n>`.
        device: u32,
        /// Position in [`IioDevice::channels`](crate::adc::IioDevice::channels).
        position: u32,
    },
    /// A hardware PWM channel.
    Pwm {
        /// The number of `pwmchip<n>`.
        chip: u32,
        /// The channel's number in the chip.
        channel: u32,
    },
    /// The data output of an SPI device.
    Mosi(Node),
    /// The data input of an SPI device.
    Miso(Node),
    /// A serial port, by the numbers of its device.
    Serial(u32, u32),
    /// No pin has this number.
    Nothing(u32),
}

impl Target {
    /// The meaning of `pin`.
    pub(crate) fn of(pin: Pin) -> Target {
        let within = |base: u32, count: u32| pin.0.checked_sub(base).filter(|at| *at < count);
        if let Some(at) = within(ANALOG, ANALOG_CHANNELS) {
            Target::Analog(at)
        } else if let Some(at) = within(0, CHIPS * CHIP_LINES) {
            Target::Line { chip: at / CHIP_LINES, offset: at % CHIP_LINES }
        } else if let Some(at) = within(PWM, PWM_CHIPS * PWM_CHIP_CHANNELS) {
            Target::Pwm { chip: at / PWM_CHIP_CHANNELS, channel: at % PWM_CHIP_CHANNELS }
        } else if let Some(at) = within(FURTHER_LINES, FURTHER_CHIPS * FURTHER_CHIP_LINES) {
            Target::Line { chip: at / FURTHER_CHIP_LINES, offset: at % FURTHER_CHIP_LINES }
        } else if let Some(at) = within(FURTHER_CHANNELS, FURTHER_DEVICES * FURTHER_DEVICE_CHANNELS) {
            Target::Channel { device: at / FURTHER_DEVICE_CHANNELS, position: at % FURTHER_DEVICE_CHANNELS }
        } else if let Some(at) = within(MOSI, MOSI_NODES) {
            Target::Mosi(Node::of(at))
        } else if let Some(at) = within(MISO, MOSI_NODES) {
            Target::Miso(Node::of(at))
        } else if let Some(at) = within(SERIAL, SERIAL_DRIVERS * SERIAL_DRIVER_PORTS) {
            Target::Serial(at / SERIAL_DRIVER_PORTS, at % SERIAL_DRIVER_PORTS)
        } else {
            Target::Nothing(pin.0)
        }
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Target::Line { chip, offset } => write!(f, "gpiochip{chip} line {offset}"),
            Target::Analog(n) => write!(f, "analog{n} (an ADC channel)"),
            Target::Channel { device, position } => {
                write!(f, "ADC channel {position} of iio:device{device}")
            }
            Target::Pwm { chip, channel } => write!(f, "pwmchip{chip}/pwm{channel} (hardware PWM)"),
            Target::Mosi(node) => write!(f, "{node} (an SPI device's data output)"),
            Target::Miso(node) => write!(f, "{node}/miso (an SPI device's data input)"),
            Target::Serial(major, minor) => write!(f, "/dev/char/{major}:{minor} (a serial port)"),
            Target::Nothing(pin) => write!(f, "pin number {pin} (no pin has it)"),
        }
    }
}

/// The number of a line, if it has one.
pub fn line_number(chip: u32, offset: u32) -> Option<u32> {
    let is_analog = chip == ANALOG_CHIP && (ANALOG_LINE..ANALOG_LINE + ANALOG_CHANNELS).contains(&offset);
    if chip < CHIPS && offset < CHIP_LINES && !is_analog {
        Some(chip * CHIP_LINES + offset)
    } else if chip < FURTHER_CHIPS && offset < FURTHER_CHIP_LINES {
        Some(FURTHER_LINES + chip * FURTHER_CHIP_LINES + offset)
    } else {
        None
    }
}

/// The number of an ADC channel, if it has one. `id` is the driver's name, for example `voltage3`.
pub fn channel_number(device: u32, position: usize, id: &str) -> Option<u32> {
    let plain =
        id.strip_prefix("voltage").and_then(|n| n.parse::<u32>().ok()).filter(|n| device == 0 && *n < ANALOG_CHANNELS);
    let position = u32::try_from(position).ok()?;
    match plain {
        Some(n) => Some(ANALOG + n),
        None if device < FURTHER_DEVICES && position < FURTHER_DEVICE_CHANNELS => {
            Some(FURTHER_CHANNELS + device * FURTHER_DEVICE_CHANNELS + position)
        }
        None => None,
    }
}

/// The number of a hardware PWM channel, if it has one.
pub fn pwm_number(chip: u32, channel: u32) -> Option<u32> {
    (chip < PWM_CHIPS && channel < PWM_CHIP_CHANNELS).then_some(PWM + chip * PWM_CHIP_CHANNELS + channel)
}

/// The data output of the SPI device with this data input.
pub(crate) fn mosi_of(miso: Pin) -> Option<Pin> {
    let node = miso.0.checked_sub(MISO).filter(|node| *node < MOSI_NODES)?;
    Some(Pin(MOSI + node))
}

/// The number of a serial port, if it has one.
pub(crate) fn serial_number((major, minor): (u32, u32)) -> Option<u32> {
    let fits = major < SERIAL_DRIVERS && minor < SERIAL_DRIVER_PORTS;
    fits.then_some(SERIAL + major * SERIAL_DRIVER_PORTS + minor)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_a_range_has_no_room_for_has_another_number_or_none() {
        assert_eq!(
            [line_number(15, 288), line_number(16, 0)],
            [Some((1 << 24) + 15 * 4096 + 288), Some((1 << 24) + 16 * 4096)]
        );
        assert_eq!(
            [line_number(4095, 4095), line_number(4096, 0), line_number(0, 4096)],
            [Some((2 << 24) - 1), None, None]
        );
        assert_eq!(
            [channel_number(0, 0, "voltage7"), channel_number(0, 3, "voltage8")],
            [Some(4103), Some((1 << 25) + 3)]
        );
        assert_eq!(channel_number(1, 2, "voltage0"), Some((1 << 25) + 256 + 2));
        assert_eq!(channel_number(4095, 255, "temp"), Some((1 << 25) + (1 << 20) - 1));
        assert_eq!([channel_number(4096, 0, "temp"), channel_number(1, 256, "temp")], [None, None]);
        assert_eq!([pwm_number(0, 0), pwm_number(2, 3), pwm_number(7, 15)], [65536, 65536 + 35, 65536 + 127].map(Some));
        assert_eq!([pwm_number(8, 0), pwm_number(0, 16)], [None, None]);
    }

    #[test]
    fn hardware_pwm_keeps_its_numbers() {
        assert_eq!(Target::of(Pin(65536)), Target::Pwm { chip: 0, channel: 0 });
        assert_eq!(Target::of(Pin(65663)), Target::Pwm { chip: 7, channel: 15 });
        for nothing in [65664, 66000, 4608, 65535] {
            assert_eq!(Target::of(Pin(nothing)), Target::Nothing(nothing));
        }
    }

    proptest! {
        #[test]
        fn a_line_comes_back_from_its_number(chip in 0u32..5000, offset in 0u32..5000) {
            match line_number(chip, offset) {
                Some(pin) => prop_assert_eq!(Target::of(Pin(pin)), Target::Line { chip, offset }),
                None => prop_assert!(chip >= FURTHER_CHIPS || offset >= FURTHER_CHIP_LINES),
            }
        }

        #[test]
        fn any_number_has_an_answer(pin: u32) {
            match Target::of(Pin(pin)) {
                Target::Line { chip, offset } => {
                    let number = line_number(chip, offset);
                    prop_assert!(number == Some(pin) || number.is_some_and(|n| n < FURTHER_LINES));
                }
                Target::Pwm { chip, channel } => prop_assert_eq!(PWM + chip * PWM_CHIP_CHANNELS + channel, pin),
                Target::Nothing(same) => prop_assert_eq!(same, pin),
                Target::Analog(n) => prop_assert_eq!(n + ANALOG, pin),
                Target::Channel { .. } => prop_assert!((FURTHER_CHANNELS..MOSI).contains(&pin)),
                Target::Mosi(node) => prop_assert_eq!(node.number().map(|number| MOSI + number), Some(pin)),
                Target::Miso(node) => {
                    prop_assert_eq!(node.number().map(|number| MISO + number), Some(pin));
                    prop_assert_eq!(mosi_of(Pin(pin)).map(Target::of), Some(Target::Mosi(node)));
                }
                Target::Serial(major, minor) => prop_assert_eq!(serial_number((major, minor)), Some(pin)),
            }
        }
    }
}
