// SPDX-License-Identifier: GPL-3.0-or-later
//! The ADCs HX711 and HX717 for load cells (Avia Semiconductor's data sheets), on two lines or on the data lines of an
//! SPI controller (`spi.rs`).
//!
//! 24 pulses on the chip's clock shift out a sample. One to four more pulses choose gain and channel of the next
//! sample. A clock that stays high for over 60 us switches the chip off. The chip starts again when the clock falls.
//!
//! On lines a worker drives the clock, and two system calls make a pulse. So this may happen on a slow or busy computer. The bits
//! that follow are then all ones, and no check of the protocol would notice. So the worker measures every pulse. If one
//! may have been too long, its sample is sent as the error "read too long". klippy then restarts the sensor.

#![forbid(unsafe_code)]

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use log::warn;

use crate::board::{Bias, Direction, Line, Mosi, OnWorker, Pin};
use crate::mcu::{
    Command, Done, Errand, Feature, Generation::Kalico, Generation::Master, Generation::V0_13, Mcu, Oid, Remote,
    Settable, Slot, Turn, WorkerId, command, since,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Ticks, TimeSource};

use super::ready_adc::{Ready, ReadyAdc, ReadyChip, Sample};
use spi::{Shared, Waves};

mod spi;

pub(super) const FEATURE: Feature = Feature {
    commands: &[
        CONFIG_HX71X,
        HX71X_ATTACH_TRIGGER_ANALOG,
        HX71X_ATTACH_LOAD_CELL_PROBE,
        QUERY_HX71X,
        QUERY_HX71X_STATUS,
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// The number of pulses for gain and channel is not one to four.
    GAIN_RANGE = "HX71x gain/channel out of range 1-4";
}

/// klippy recognizes errors by these values: pulses and bits do not match, or a reading took too long.
const ERROR_DESYNC: i32 = i32::MIN;
const ERROR_READ_TOO_LONG: i32 = 1 << 30;

const SAMPLE_BITS: u8 = 24;
/// Shortest time that the clock is high, and low (T3 and T4 of the data sheet).
const PULSE: Duration = Duration::from_nanos(200);
/// Longest time that the clock may be high before the chip switches itself off.
const POWER_DOWN: Ticks = Ticks::from_us(60);
/// All of these chips share this worker.
const WORKER: &str = "hx71x";

/// Decodes a reading: the sample's bits, then the bits of the extra pulses, the last one lowest.
fn decode(raw: u32, gain_channel: u8) -> Result<i32, i32> {
    let extra = (1 << gain_channel) - 1;
    // The data line is high after the sample.
    if raw & extra != extra {
        return Err(ERROR_DESYNC);
    }
    Ok(((raw >> gain_channel) << 8) as i32 >> 8)
}

/// Shifts out a sample.
struct Shift {
    sclk: Arc<dyn Line>,
    dout: Arc<dyn Line>,
    /// Pulses of the sample, and for gain and channel.
    pulses: u8,
    time: Arc<dyn TimeSource>,
    /// The clock line's name in the log.
    name: String,
    /// Whether the log already has a line about a clock that was high for too long.
    told: bool,
}

/// The bits that were shifted out.
#[derive(Clone, Copy)]
struct Shifted {
    raw: u32,
    /// Whether the chip may have switched itself off during the pulses.
    too_long: bool,
}

impl Shift {
    fn run(&mut self) -> Result<Shifted, Shutdown> {
        let mut raw = 0;
        let mut longest = 0;
        for _ in 0..self.pulses {
            let rises = self.time.now();
            self.sclk.write(true)?;
            wait();
            self.sclk.write(false)?;
            longest = self.time.now().since(rises).max(longest);
            raw = raw << 1 | u32::from(self.dout.read()?);
            wait();
        }
        let too_long = longest > i64::from(POWER_DOWN.0);
        if too_long && !self.told {
            self.told = true;
            warn!("{}", too_slow(&self.name, longest));
        }
        Ok(Shifted { raw, too_long })
    }
}

/// For the log: the clock was high for too long, up to this many ticks.
fn too_slow(name: &str, ticks: i64) -> String {
    let us = ticks / i64::from(Ticks::from_us(1).0);
    format!(
        "HX71x sclk ({name}): the clock was high for up to {us} us, and from 60 us on the chip switches itself off: this computer is too slow or too busy for it: run Pinion with -r, or connect it to an SPI controller (docs/guide/pins.md); said once"
    )
}

fn wait() {
    let start = Instant::now();
    while start.elapsed() < PULSE {
        std::hint::spin_loop();
    }
}

/// Reads a sample on a worker.
enum Reading {
    Lines(Shift),
    Spi(Waves),
}

impl Errand for Reading {
    /// `None`: no sample is ready.
    type Answer = Option<Shifted>;
    type Failure = Shutdown;

    fn run(&mut self) -> Result<Option<Shifted>, Shutdown> {
        match self {
            Reading::Lines(shift) => shift.run().map(Some),
            Reading::Spi(waves) => waves.run(),
        }
    }
}

/// The clock line while no sample is shifted out. High switches the chip off.
enum PowerDown {
    Line(Arc<dyn Line>),
    Spi(Shared),
}

impl Settable for PowerDown {
    type Value = bool;

    fn set(&mut self, down: bool) -> Result<(), Shutdown> {
        match self {
            PowerDown::Line(line) => line.write(down),
            PowerDown::Spi(device) => spi::power_down(device, down),
        }
    }
}

struct Hx71x {
    worker: WorkerId,
    gain_channel: u8,
    power_down: Remote<PowerDown>,
    /// Sent instead of samples until new measurements begin.
    last_error: Option<i32>,
}

impl ReadyChip for Hx71x {
    const NAME: &'static str = "HX71x";
    type Reading = Reading;

    fn read(&mut self, turn: &mut Turn, reading: &mut Slot<Reading>) -> Result<(), Shutdown> {
        reading.send(turn, self.worker)
    }

    fn stop(failure: &Shutdown) -> Shutdown {
        failure.clone()
    }

    fn sample(&mut self, answer: Option<Shifted>, late: bool) -> Sample {
        let Some(Shifted { raw, too_long }) = answer else { return Sample::NotReady };
        match decode(raw, self.gain_channel) {
            Err(error) => self.last_error = Some(error),
            Ok(_) if late || too_long => self.last_error = Some(ERROR_READ_TOO_LONG),
            Ok(value) if self.last_error.is_none() => return Sample::Value(value),
            Ok(_) => {}
        }
        Sample::Error { code: None, value: self.last_error.unwrap_or(ERROR_DESYNC) }
    }

    fn switch(&mut self, turn: &mut Turn, on: bool) -> Result<(), Shutdown> {
        self.last_error = None;
        self.power_down.set(turn, !on)
    }

    fn switched(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        match self.power_down.back(turn, done) {
            Some(Err(failure)) => turn.try_shut_down(failure),
            _ => Ok(()),
        }
    }
}

fn configure(mcu: &mut Mcu, oid: Oid, gain_channel: u8, dout_pin: Pin, sclk_pin: Pin) -> Result<(), Shutdown> {
    mcu.vacant(oid)?;
    if !(1..=4).contains(&gain_channel) {
        return Err(Shutdown::by_host(
            GAIN_RANGE,
            format_args!("{gain_channel} pulses are to choose gain and channel"),
        ));
    }
    let pulses = SAMPLE_BITS + gain_channel;
    if let Some(mosi) = mcu.board()?.mosi_of(dout_pin) {
        let (dout, sclk) = (mcu.name(dout_pin), mcu.name(sclk_pin));
        if mosi != sclk_pin {
            let (remedy, cause) =
                (format!("write sclk_pin: {}", mcu.name(mosi)), format!("{dout} has another clock than {sclk}"));
            return Err(Shutdown::because(reason::NOT_OUTPUT, cause).remedy(remedy));
        }
        let Some(Mosi { line: OnWorker { bus, device }, .. }) = mcu.board()?.mosi(mosi, spi::RATE_HZ)? else {
            let cause = format!("{sclk} is no data output of an SPI device");
            return Err(Shutdown::because(reason::NOT_OUTPUT, cause).remedy("choose another SPI device"));
        };
        let worker = mcu.worker(&bus)?;
        let device: Shared = Arc::new(Mutex::new(device));
        let power_down = Remote::new(worker, PowerDown::Spi(device.clone()), true);
        let chip = Hx71x { worker, gain_channel, power_down, last_error: None };
        let waves = Slot::new(Reading::Spi(Waves::new(device, pulses, sclk)));
        return mcu.assign_on(dout_pin, oid, ReadyAdc::new(chip, Ready::LOOK, waves));
    }
    let dout = mcu.prompt_line(dout_pin, "dout", Direction::Input(Bias::PullUp))?;
    // High is off. The chip is off until measurements begin, and when the program dies.
    let sclk = mcu.prompt_line(sclk_pin, "sclk", Direction::Output { level: true, shutdown_value: true })?;
    let worker = mcu.worker(WORKER)?;
    let shift = Shift {
        sclk: sclk.clone(),
        dout: dout.clone(),
        pulses,
        time: mcu.clock(),
        name: mcu.name(sclk_pin),
        told: false,
    };
    let power_down = Remote::new(worker, PowerDown::Line(sclk), true);
    let chip = Hx71x { worker, gain_channel, power_down, last_error: None };
    mcu.assign_on(dout_pin, oid, ReadyAdc::new(chip, Ready::Line(dout), Slot::new(Reading::Lines(shift))))
}

type Sensor = ReadyAdc<Hx71x>;

const CONFIG_HX71X: Command = command!(
    "config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u",
    |mcu, oid: Oid, gain_channel: u8, dout_pin: Pin, sclk_pin: Pin| {
        configure(mcu, oid, gain_channel, dout_pin, sclk_pin)
    }
)
.of(since(V0_13));

const HX71X_ATTACH_TRIGGER_ANALOG: Command = command!(
    "hx71x_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    Sensor,
    |sensor, turn, trigger_analog_oid: Oid| { sensor.attached.attach(turn, trigger_analog_oid) }
)
.of(since(Master));

const HX71X_ATTACH_LOAD_CELL_PROBE: Command = command!(
    "hx71x_attach_load_cell_probe oid=%c load_cell_probe_oid=%c",
    Sensor,
    |sensor, turn, load_cell_probe_oid: Oid| sensor.attached.attach_probe(turn, load_cell_probe_oid)
)
.of(since(Kalico));

const QUERY_HX71X: Command = command!("query_hx71x oid=%c rest_ticks=%u", Sensor, |sensor, turn, rest_ticks: Ticks| {
    sensor.query(turn, rest_ticks)
})
.of(since(V0_13));

const QUERY_HX71X_STATUS: Command =
    command!("query_hx71x_status oid=%c", Sensor, |sensor, turn| sensor.query_status(turn)).of(since(V0_13));

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_log_says_which_clock_line_was_too_slow_and_for_how_long() {
        let line = too_slow("gpio11", i64::from(Ticks::from_us(75).0));
        assert!(line.contains("(gpio11)") && line.contains("up to 75 us") && line.contains("-r"), "{line}");
    }

    #[test]
    fn samples_are_those_of_the_data_sheet() {
        // "Serial Interface": 800000h is the lowest value, 7FFFFFh the highest.
        for (sample, value) in [(0x80_0000, -8_388_608), (0xff_ffff, -1), (0, 0), (1, 1), (0x7f_ffff, 8_388_607)] {
            for gain_channel in 1..=4 {
                let ones = (1 << gain_channel) - 1;
                assert_eq!(decode((sample << gain_channel) | ones, gain_channel), Ok(value));
                assert_eq!(decode((sample << gain_channel) | (ones - 1), gain_channel), Err(ERROR_DESYNC));
                assert_eq!(decode(sample << gain_channel, gain_channel), Err(ERROR_DESYNC));
            }
        }
    }
}
