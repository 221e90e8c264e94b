// SPDX-License-Identifier: GPL-3.0-or-later
//! PCA9685: 16 PWM outputs on I2C, with queued values and a limit to how long the host may be silent.
//!
//! Registers and times are from NXP's data sheet, PCA9685 rev. 4.

use std::sync::Arc;

use crate::board::{BusDevice, BusError, I2cConfig, OnWorker, ShutdownValue};
use crate::mcu::{
    BusCounts, Calls, Command, Constant, Context, Device, Feature, Finished, Next, Object, Oid, Remote, Safe, Settable,
    Timer, WireClock, command,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

use super::value_queue::{Texts, ValueQueue};

pub(super) const FEATURE: Feature = Feature {
    serves: "PCA9685 outputs",

    commands: &[CONFIG_PCA9685, QUEUE_PCA9685_OUT, SET_PCA9685_OUT],
    constants: &[Constant::number("PCA9685_MAX", VALUE_MAX as u32)],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A channel above 15 or a value above 4096.
    INVALID_CHANNEL = "Invalid pca9685 channel or value";
    /// A queued value above 4096.
    INVALID_VALUE = "Invalid pca9685 value";
    /// A second period for one chip. A chip has only one.
    OTHER_CYCLE = "All PCA9685 channels must have the same cycle_ticks";
    /// More than 16 chips.
    TOO_MANY = "Too many i2c devices";
    /// The bus is missing, or the chip does not answer during its setup.
    NOT_SET_UP = "Unable to open and init PCA9685 device";
    /// The chip does not accept a value.
    NOT_UPDATED = "Unable to update PCA9685 value";
    /// The host did not refresh an output in time.
    MISSED = "Missed scheduling of next pca9685 event";
    /// An output would stay on for longer than its `max_duration`.
    MAX_DURATION = "Scheduled pca9685 event will exceed max_duration";
}

/// Full scale of a value.
const VALUE_MAX: u16 = 4096;
const CHANNELS: usize = 16;
const CHIPS_MAX: usize = 16;

/// The first registers of each kind.
#[derive(Clone, Copy)]
enum Register {
    Mode1 = 0x00,
    /// Four for each output.
    Led0 = 0x06,
    /// Four for all outputs at once.
    AllLed = 0xfa,
    PreScale = 0xfe,
}

// Bits of MODE1.
const AUTO_INCREMENT: u8 = 0x20;
const SLEEP: u8 = 0x10;
const ALL_CALL: u8 = 0x01;
/// The bit of LEDn_ON_H and LEDn_OFF_H that means always.
const FULL: u8 = 0x10;
const OSCILLATOR_HZ: u64 = 25_000_000;
/// Longest time until the oscillator runs.
const OSCILLATOR_START: Ticks = Ticks::from_us(500);
/// The host gives no rate, and the driver has its own.
const RATE_HZ: u32 = 100_000;

/// The value of PRE_SCALE for a period: 25 MHz / (4096 * rate) - 1, limited to 3 to 255.
fn prescale(cycle: Ticks) -> u8 {
    let divisor = u64::from(VALUE_MAX) * u64::from(CLOCK_FREQ);
    let rounded = (OSCILLATOR_HZ * u64::from(cycle.0) + divisor / 2) / divisor;
    // A period close to zero becomes the longest one, as in Klipper's C.
    rounded.wrapping_sub(1).clamp(3, 0xff) as u8
}

/// The message that sets the output at register `first` to a value.
fn message(first: u8, value: u16) -> [u8; 5] {
    let (on, off) = match value {
        0 => (0, u16::from(FULL) << 8),
        VALUE_MAX.. => (u16::from(FULL) << 8, 0),
        _ => (0, value),
    };
    let ([on_low, on_high], [off_low, off_high]) = (on.to_le_bytes(), off.to_le_bytes());
    [first, on_low, on_high, off_low, off_high]
}

/// A chip, on the worker of its bus.
struct Pca {
    device: Box<dyn BusDevice>,
    calls: Calls,
    clock: Arc<dyn TimeSource>,
    prescale: u8,
    is_set_up: bool,
}

impl Pca {
    /// Writes registers. Writing them twice does no harm, so a failed write is retried.
    fn write(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.calls.repeat(|| self.device.write_read(bytes, &mut []))
    }

    fn set_up(&mut self) -> Result<(), BusError> {
        if self.is_set_up {
            return Ok(());
        }
        // The prescaler takes a value only in sleep.
        self.write(&[Register::Mode1 as u8, AUTO_INCREMENT | SLEEP | ALL_CALL])?;
        self.write(&[Register::PreScale as u8, self.prescale])?;
        self.write(&[Register::Mode1 as u8, AUTO_INCREMENT | ALL_CALL])?;
        self.clock.spin_until(self.clock.now() + OSCILLATOR_START);
        self.write(&message(Register::AllLed as u8, 0))?;
        self.is_set_up = true;
        Ok(())
    }
}

/// A setting of one output of a chip.
#[derive(Clone, Copy)]
struct Setting {
    channel: u8,
    value: Value,
}

#[derive(Clone, Copy)]
enum Value {
    /// Sets up the chip. The output is then off.
    SetUp,
    Of(u16),
    /// The output's value in a stopped MCU. A chip that was never set up drives nothing.
    AtShutdown(u16),
}

impl Settable for Pca {
    type Value = Setting;

    fn set(&mut self, Setting { channel, value }: Setting) -> Result<(), Shutdown> {
        let value = match value {
            Value::AtShutdown(_) if !self.is_set_up => return Ok(()),
            Value::Of(value) | Value::AtShutdown(value) => Some(value),
            Value::SetUp => None,
        };
        self.set_up().map_err(|error| Shutdown::because(NOT_SET_UP, error.trouble))?;
        let Some(value) = value else { return Ok(()) };
        let written = self.write(&message(Register::Led0 as u8 + 4 * channel, value));
        written.map_err(|error| Shutdown::because(NOT_UPDATED, error.trouble))
    }
}

/// An output on the worker of its bus.
struct Output {
    remote: Remote<Pca>,
    shutdown_value: ShutdownValue<u16>,
    /// Whether the output was ever set.
    is_used: bool,
    /// Whether the shutdown value is still being written.
    is_pending: bool,
}

struct Address {
    bus: u8,
    address: u8,
    cycle: Ticks,
}

/// The chips and their outputs. The jobs of the outputs return to this object.
#[derive(Default)]
struct Chips {
    chips: Vec<Address>,
    /// The calls of all chips together. `None` before the first chip.
    calls: Option<Calls>,
    /// 16 for each chip.
    outputs: Vec<Output>,
}

impl Chips {
    /// Returns the index of an output. Opens the chip if this is its first output.
    fn output(&mut self, context: &mut Context, wanted: Address, channel: u8) -> Result<usize, Shutdown> {
        let Address { bus, address, cycle } = wanted;
        let known = self.chips.iter().position(|chip| chip.bus == bus && chip.address == address);
        let chip = match known {
            Some(chip) => {
                let present = self.chips[chip].cycle;
                if present != cycle {
                    let cause = format!(
                        "the chip at i2c.{bus} address {address:#04x} has a cycle of {} ticks, but the host asks for {}",
                        present.0, cycle.0
                    );
                    return Err(Shutdown::because(OTHER_CYCLE, cause).remedy("give its channels the same cycle_time"));
                }
                chip
            }
            None if self.chips.len() == CHIPS_MAX => {
                let cause = "there are 17 PCA9685 chips: 16 are possible";
                return Err(Shutdown::because(TOO_MANY, cause).remedy("remove one"));
            }
            None => {
                self.open(context, wanted)?;
                self.chips.len() - 1
            }
        };
        Ok(chip * CHANNELS + usize::from(channel))
    }

    fn open(&mut self, context: &mut Context, address: Address) -> Result<(), Shutdown> {
        let config = I2cConfig { bus: address.bus.into(), address: address.address & 0x7f, rate_hz: RATE_HZ };
        let opened = context.board()?.i2c(config);
        let OnWorker { bus, device } = opened.map_err(|error| Shutdown::because(NOT_SET_UP, error.into_trouble()))?;
        let clock = context.clock();
        let calls = self.calls.get_or_insert_with(|| Calls::new(clock.clone())).clone();
        let chip = Pca { device, calls, clock, prescale: prescale(address.cycle), is_set_up: false };
        let chip = context.device(&bus, Box::new(chip))?;
        self.chips.push(address);
        for channel in 0..CHANNELS as u8 {
            // There are 256 outputs at most.
            let number = self.outputs.len() as u8;
            let remote = Remote::new(number, chip, Setting { channel, value: Value::SetUp });
            self.outputs.push(Output {
                remote,
                shutdown_value: ShutdownValue::default(),
                is_used: false,
                is_pending: false,
            });
        }
        Ok(())
    }

    fn set(&mut self, context: &mut Context, place: usize, value: Value) -> Result<(), Shutdown> {
        let output = &mut self.outputs[place];
        output.is_used = true;
        output.remote.set(context, Setting { channel: (place % CHANNELS) as u8, value })
    }
}

impl Object for Chips {
    fn kind(&self) -> &'static str {
        "PCA9685"
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(output) = self.outputs.get_mut(usize::from(number)) else { return Ok(()) };
        match output.remote.back(context, finished) {
            Some(Ok(true)) => output.is_pending = false,
            Some(Err(failure)) => return context.device_failed(self.kind(), failure),
            _ => {}
        }
        if !self.outputs.iter().any(|output| output.is_pending) {
            context.is_safe();
        }
        Ok(())
    }

    fn counts(&self) -> Option<BusCounts> {
        self.calls.as_ref().map(Calls::counts)
    }

    /// The guardian cannot set the outputs. It holds descriptors of lines and of PWM channels, and no chips on a bus.
    fn is_guarded(&self) -> bool {
        false
    }

    fn make_safe(&mut self, context: &mut Context) -> Result<Safe, Shutdown> {
        let mut safe = Safe::Now;
        for (place, output) in self.outputs.iter_mut().enumerate().filter(|(_, output)| output.is_used) {
            output.is_pending = true;
            let value = Value::AtShutdown(output.shutdown_value.get());
            output.remote.set(context, Setting { channel: (place % CHANNELS) as u8, value })?;
            safe = Safe::Later;
        }
        Ok(safe)
    }
}

const TEXTS: Texts = Texts { max_duration: MAX_DURATION, missed: MISSED };

/// An output that the host schedules.
struct Pca9685 {
    chips: Oid,
    place: usize,
    queue: ValueQueue,
}

impl Pca9685 {
    fn queue(&mut self, context: &mut Context, at: Clock, value: u16) -> Result<(), Shutdown> {
        if value > VALUE_MAX {
            return Err(Shutdown::by_host(INVALID_VALUE, format_args!("value {value} is above {VALUE_MAX}")));
        }
        self.queue.queue(context, at, value)
    }
}

impl Object for Pca9685 {
    fn kind(&self) -> &'static str {
        "PCA9685 output"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let value = self.queue.pop(context)?;
        let place = self.place;
        context.with::<Chips, _>(self.chips, |chips, context| chips.set(context, place, Value::Of(value)))?;
        self.queue.next(value, at)
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.queue.clear(context);
    }
}

/// Checks that a chip has this channel and accepts all of these values.
fn check(channel: u8, values: &[u16]) -> Result<(), Shutdown> {
    if usize::from(channel) < CHANNELS && values.iter().all(|value| *value <= VALUE_MAX) {
        return Ok(());
    }
    let what = format_args!("channel {channel} with values {values:?} is not within 15 and {VALUE_MAX}");
    Err(Shutdown::by_host(INVALID_CHANNEL, what))
}

const CONFIG_PCA9685: Command = command!(
    "config_pca9685 oid=%c bus=%c addr=%c channel=%c cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    |context,
     oid: Oid,
     bus: u8,
     addr: u8,
     channel: u8,
     cycle_ticks: Ticks,
     value: u16,
     default_value: u16,
     max_duration: Ticks| {
        context.vacant(oid)?;
        check(channel, &[value, default_value])?;
        let device = Device::I2c(bus.into(), addr);
        if context.tolerance(&device).is_some() {
            let cause = format_args!("failures of {device} are tolerated, but outputs are not read");
            return Err(Shutdown::because(NOT_SET_UP, cause.to_string()).remedy("remove it from tolerate"));
        }
        let (own, shutdown_value) = (context.own::<Chips>(), context.unguarded(default_value));
        let place = context.with::<Chips, _>(own, |chips, context| {
            let place = chips.output(context, Address { bus, address: addr, cycle: cycle_ticks }, channel)?;
            chips.outputs[place].shutdown_value = shutdown_value;
            let setting = if value == 0 { Value::SetUp } else { Value::Of(value) };
            chips.set(context, place, setting)?;
            Ok(place)
        })?;
        context.assign(oid, Pca9685 { chips: own, place, queue: ValueQueue::new(shutdown_value, max_duration, &TEXTS) })
    }
);

const QUEUE_PCA9685_OUT: Command = command!(
    "queue_pca9685_out oid=%c clock=%u value=%hu",
    Pca9685,
    |output, context, clock: WireClock, value: u16| {
        let at = context.instant(clock);
        output.queue(context, at, value)
    }
);

const SET_PCA9685_OUT: Command = command!(
    "set_pca9685_out bus=%c addr=%c channel=%c cycle_ticks=%u value=%hu",
    |context, bus: u8, addr: u8, channel: u8, cycle_ticks: Ticks, value: u16| {
        check(channel, &[value])?;
        let own = context.own::<Chips>();
        context.with::<Chips, _>(own, |chips, context| {
            let place = chips.output(context, Address { bus, address: addr, cycle: cycle_ticks }, channel)?;
            chips.set(context, place, Value::Of(value))
        })
    }
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_prescaler_of_a_period() {
        // The data sheet's example: 200 Hz is 30 (7.3.5).
        for (hz, expected) in [(200, 30), (50, 121), (1526, 3), (24, 253), (20, 255), (10_000, 3), (25_000_000, 255)] {
            assert_eq!(prescale(Ticks(CLOCK_FREQ / hz)), expected, "{hz} Hz");
        }
        assert_eq!(prescale(Ticks(u32::MAX)), 255);
    }

    #[test]
    fn the_registers_of_a_value() {
        for (value, expected) in [
            (0, [6, 0, 0, 0, 0x10]),
            (1, [6, 0, 0, 1, 0]),
            (0x0abc, [6, 0, 0, 0xbc, 0x0a]),
            (4095, [6, 0, 0, 0xff, 0x0f]),
            (4096, [6, 0, 0x10, 0, 0]),
        ] {
            assert_eq!(message(Register::Led0 as u8, value), expected);
        }
    }
}
