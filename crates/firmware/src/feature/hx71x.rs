// SPDX-License-Identifier: GPL-3.0-or-later
//! The ADCs HX711 and HX717 for load cells (Avia Semiconductor's data sheets), on two lines or on the data lines of an
//! SPI controller (`spi.rs`).
//!
//! 24 pulses on the chip's clock shift out a sample. One to four more pulses choose gain and channel of the next
//! sample. A clock that stays high for over 60 us switches the chip off. The chip starts again when the clock falls.
//!
//! On lines (`lines.rs`) a worker drives the clock. So this may happen on a slow or busy computer. The bits that follow
//! are then all ones, and no check of the protocol would notice. So the worker measures every pulse. If one may have been
//! too long, its sample is sent as the error "read too long". klippy then restarts the sensor.

use crate::board::{Bias, Direction, Mosi, OnWorker, Pin};
use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{
    Back, Command, Context, DeviceId, DeviceWarning, Feature, Finished, Job, JobSlot, Oid, Remote, Settable, command,
};
use crate::shutdown::{Shutdown, ShutdownReason, reason, shutdowns};
use crate::time::Ticks;

use super::ready_adc::{Ready, ReadyAdc, ReadyChip, Sample};
use lines::{Shift, WatchReading, Watcher};
use spi::Waves;

mod lines;
mod spi;

pub(super) const FEATURE: Feature = Feature {
    serves: "HX711 and HX717 load cells",

    commands: &[
        CONFIG_HX71X,
        CONFIG_HX71X_BY_PULSES,
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
    /// The same, where the host calls the number `setting_pulses`.
    PULSES_RANGE = "HX71x setting_pulses out of range 1-4";
}

/// klippy recognizes errors by these values: pulses and bits do not match, or a reading took too long.
const ERROR_DESYNC: i32 = i32::MIN;
const ERROR_READ_TOO_LONG: i32 = 1 << 30;

const SAMPLE_BITS: u8 = 24;
/// The first words of each warning.
const SUBJECT: &str = "HX71x sclk";
/// All of these chips share this worker.
const WORKER: &str = "hx71x";
/// Their watchers share this one.
const WATCHER: &str = "hx71x watch";

/// Decodes a reading: the sample's bits, then the bits of the extra pulses, the last one lowest.
fn decode(raw: u32, gain_channel: u8) -> Result<i32, i32> {
    let extra = (1 << gain_channel) - 1;
    // The data line is high after the sample.
    if raw & extra != extra {
        return Err(ERROR_DESYNC);
    }
    Ok(((raw >> gain_channel) << 8) as i32 >> 8)
}

/// The bits that were shifted out.
#[derive(Clone, Copy)]
struct Shifted {
    raw: u32,
    /// Whether the chip may have switched itself off during the pulses, or did not get all of them.
    too_long: bool,
}

/// The way to the chip, on a worker.
enum Interface {
    Lines(Shift),
    Spi(Waves),
}

impl Interface {
    fn take_warning(&mut self) -> Option<DeviceWarning> {
        match self {
            Interface::Lines(shift) => shift.warning.take(),
            Interface::Spi(waves) => waves.warning.take(),
        }
    }
}

/// Reads a sample.
#[derive(Default)]
struct Read {
    warning: Option<DeviceWarning>,
}

impl Job for Read {
    type Device = Interface;
    /// `None`: no sample is ready.
    type Out = Option<Shifted>;
    type Failure = Shutdown;

    fn run(&mut self, way: &mut Interface) -> Result<Option<Shifted>, Shutdown> {
        let read = match way {
            Interface::Lines(shift) => shift.run().map(Some),
            Interface::Spi(waves) => waves.run(),
        };
        self.warning = way.take_warning();
        read
    }

    fn take_warning(&mut self) -> Option<DeviceWarning> {
        self.warning.take()
    }
}

/// The clock line while no sample is shifted out. High switches the chip off.
impl Settable for Interface {
    type Value = bool;

    fn set(&mut self, down: bool) -> Result<(), Shutdown> {
        match self {
            Interface::Lines(shift) => shift.power_down(down),
            Interface::Spi(waves) => waves.power_down(down),
        }
    }
}

// The numbers of the jobs; the reading has 0.
const POWER_DOWN: u8 = 1;
const WATCH: u8 = 2;

struct Hx71x {
    way: DeviceId<Interface>,
    gain_channel: u8,
    power_down: Remote<Interface>,
    /// Watches the pulses of a reading, on its own worker.
    watch: Option<(DeviceId<Watcher>, JobSlot<WatchReading>)>,
    /// Sent instead of samples until new measurements begin.
    last_error: Option<i32>,
}

impl Hx71x {
    fn new(
        way: DeviceId<Interface>,
        gain_channel: u8,
        watch: Option<(DeviceId<Watcher>, JobSlot<WatchReading>)>,
    ) -> Hx71x {
        Hx71x { way, gain_channel, power_down: Remote::new(POWER_DOWN, way, true), watch, last_error: None }
    }
}

impl ReadyChip for Hx71x {
    const NAME: &'static str = "HX71x";
    type Reading = Read;

    fn read(&mut self, context: &mut Context, reading: &mut JobSlot<Read>) -> Result<(), Shutdown> {
        if let Some((watcher, watch)) = &mut self.watch {
            // After a reading without its last pulses it may still watch one of them.
            if !watch.is_here() {
                return Ok(());
            }
            watch.send(context, *watcher)?;
        }
        reading.send(context, self.way)
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

    fn switch(&mut self, context: &mut Context, on: bool) -> Result<(), Shutdown> {
        self.last_error = None;
        self.power_down.set(context, !on)
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        if number == POWER_DOWN {
            return match self.power_down.back(context, finished) {
                Some(Err(failure)) => context.try_shut_down(failure),
                _ => Ok(()),
            };
        }
        match self.watch.as_mut().and_then(|(_, watch)| watch.back(finished)) {
            Some(Back { result, .. }) => result.or_else(|failure| context.try_shut_down(failure.clone())),
            None => Ok(()),
        }
    }
}

/// `out_of_range` is the reason of the shutdown for a `gain_channel` outside 1 to 4.
fn configure(
    context: &mut Context,
    oid: Oid,
    (gain_channel, out_of_range): (u8, ShutdownReason),
    dout_pin: Pin,
    sclk_pin: Pin,
) -> Result<(), Shutdown> {
    context.vacant(oid)?;
    if !(1..=4).contains(&gain_channel) {
        return Err(Shutdown::by_host(
            out_of_range,
            format_args!("{gain_channel} pulses are to choose gain and channel"),
        ));
    }
    let pulses = SAMPLE_BITS + gain_channel;
    if let Some(mosi) = context.board()?.mosi_of(dout_pin) {
        let (dout, sclk) = (context.name(dout_pin), context.name(sclk_pin));
        if mosi != sclk_pin {
            let (remedy, cause) =
                (format!("write sclk_pin: {}", context.name(mosi)), format!("{dout} has another clock than {sclk}"));
            return Err(Shutdown::because(reason::NOT_OUTPUT, cause).remedy(remedy));
        }
        let Some(Mosi { line: OnWorker { bus, device }, .. }) = context.board()?.mosi(mosi, spi::RATE_HZ)? else {
            let cause = format!("{sclk} is not the data output of an SPI device");
            return Err(Shutdown::because(reason::NOT_OUTPUT, cause).remedy("choose another SPI device"));
        };
        let way = context.device(&bus, Box::new(Interface::Spi(Waves::new(device, pulses, sclk))))?;
        let chip = Hx71x::new(way, gain_channel, None);
        return context.assign_on(dout_pin, oid, ReadyAdc::new(chip, Ready::POLL, Read::default()));
    }
    let dout = context.prompt_line(dout_pin, "dout", Direction::Input(Bias::PullUp))?;
    // High is off. The chip is off until measurements begin, and when the program dies.
    let sclk = context.prompt_line(sclk_pin, "sclk", Direction::at_rest(true))?;
    // A call of the kernel takes about as long as a watcher waits.
    let is_watched = sclk.is_fast() && context.has_parallel_workers();
    let watcher = is_watched.then(|| Watcher::new(context, sclk.clone()));
    let shift = Shift::new(context, sclk_pin, sclk, dout.clone(), pulses, watcher.as_ref());
    let way = context.device(WORKER, Box::new(Interface::Lines(shift)))?;
    let watch = match watcher {
        Some(watcher) => Some((context.device(WATCHER, Box::new(watcher))?, JobSlot::numbered(WATCH, WatchReading))),
        None => None,
    };
    let chip = Hx71x::new(way, gain_channel, watch);
    context.assign_on(dout_pin, oid, ReadyAdc::new(chip, Ready::Line(dout), Read::default()))
}

type Sensor = ReadyAdc<Hx71x>;

const CONFIG_HX71X: Command = command!(
    "config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u",
    |context, oid: Oid, gain_channel: u8, dout_pin: Pin, sclk_pin: Pin| {
        configure(context, oid, (gain_channel, GAIN_RANGE), dout_pin, sclk_pin)
    }
)
.of(&[V0_13, Master, Kalico]);

/// The form of an open change of Kalico (July 2026).
const CONFIG_HX71X_BY_PULSES: Command = command!(
    "config_hx71x oid=%c setting_pulses=%c dout_pin=%u sclk_pin=%u",
    |context, oid: Oid, setting_pulses: u8, dout_pin: Pin, sclk_pin: Pin| {
        configure(context, oid, (setting_pulses, PULSES_RANGE), dout_pin, sclk_pin)
    }
)
.of(&[]);

const HX71X_ATTACH_TRIGGER_ANALOG: Command = command!(
    "hx71x_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    Sensor,
    |sensor, context, trigger_analog_oid: Oid| { sensor.attached.attach(context, trigger_analog_oid) }
)
.of(&[Master]);

const HX71X_ATTACH_LOAD_CELL_PROBE: Command = command!(
    "hx71x_attach_load_cell_probe oid=%c load_cell_probe_oid=%c",
    Sensor,
    |sensor, context, load_cell_probe_oid: Oid| sensor.attached.attach_probe(context, load_cell_probe_oid)
)
.of(&[Kalico]);

const QUERY_HX71X: Command =
    command!("query_hx71x oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_HX71X_STATUS: Command = command!("query_hx71x_status oid=%c", Sensor, |sensor, context| sensor
    .query_status(context))
.of(&[V0_13, Master, Kalico]);

#[cfg(test)]
mod tests {
    use super::*;

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
