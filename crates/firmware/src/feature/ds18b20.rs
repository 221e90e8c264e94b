// SPDX-License-Identifier: GPL-3.0-or-later
//! DS18B20 thermometers, read through the kernel's 1-Wire driver.
//!
//! A reading takes 750 ms on a worker. Sensors that are powered by the data wire take turns, because the kernel keeps
//! the bus while one of them measures: three take 2.25 s. So a `config_reset` does not wait for a reading. A reading is
//! reported as soon as it arrives. Klipper's C reports it when the next one is due.

use crate::board::Thermometer;
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{
    Back, Command, Context, Device, DeviceId, Feature, Finished, Hosts, Job, JobSlot, Next, Object, Oid, Report,
    Response, Timer, Tolerance, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{CLOCK_FREQ, Clock, Ticks};
use crate::trouble::Trouble;

pub(super) const FEATURE: Feature = Feature {
    serves: "DS18B20 sensors",

    commands: &[CONFIG_DS18B20_OF_V0_10, CONFIG_DS18B20, CONFIG_DS18B20_OF_KALICO, QUERY_DS18B20],
    responses: &[ReadingOfV010::FORM, Reading::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A serial number that would lead out of the folder of the sensors.
    INVALID_SERIAL = "Invalid DS18B20 serial id, must not contain '/'";
    /// More than `max_error_count` readings in a row failed.
    READ_FAILED = "Error reading DS18B20 sensor";
    /// A reading takes longer than five seconds.
    TOO_SLOW = "DS18B20 sensor didn't respond in time";
    /// A temperature outside its range.
    OUT_OF_RANGE = "DS18B20 out of range";
}

response! {
    /// A temperature in thousandths of a degree.
    "ds18b20_result oid=%c next_clock=%u value=%i" => Hosts::of(&[]).with(CONFIG_DS18B20_OF_V0_10.format);
    pub(super) struct ReadingOfV010 { oid: Oid, next_clock: Clock, value: i32 }
}

response! {
    /// A temperature in thousandths of a degree, measured `rest_ticks` before `next_clock`. After a failure: the last
    /// temperature, and how many readings have failed since.
    "ds18b20_result oid=%c next_clock=%u value=%i fault=%u"
    pub(super) struct Reading { oid: Oid, next_clock: Clock, value: i32, fault: u32 }
}

/// Longest time of a reading (`W1_READ_TIMEOUT_SEC` of Klipper's C).
const READ_LIMIT: i64 = 5 * CLOCK_FREQ as i64;

const TIMER: Timer = Timer::sampling(0);

/// One reading.
struct Read;

impl Job for Read {
    type Device = dyn Thermometer;
    type Out = i32;
    type Failure = Trouble;

    fn run(&mut self, thermometer: &mut Self::Device) -> Result<i32, Trouble> {
        thermometer.read()
    }
}

struct Ds18b20 {
    thermometer: DeviceId<dyn Thermometer>,
    read: JobSlot<Read>,
    /// When the reading under way was requested.
    asked: Clock,
    /// When the next reading is due.
    next_clock: Clock,
    rest_ticks: Ticks,
    min_value: i32,
    max_value: i32,
    max_error_count: u8,
    /// Whether every temperature is accepted.
    ignores_limits: bool,
    /// How many readings failed since the last success.
    error_count: u8,
    value: i32,
    /// Whether a reading has succeeded.
    has_value: bool,
    tolerance: Option<Tolerance>,
    /// When the first failure came since the last success.
    failing_since: Option<Clock>,
}

const KIND: &str = "DS18B20";

impl Ds18b20 {
    fn check_range(&self, context: &Context) -> Result<(), Shutdown> {
        if self.ignores_limits || (self.min_value..=self.max_value).contains(&self.value) {
            return Ok(());
        }
        let celsius = |value: i32| f64::from(value) / 1000.;
        context.try_shut_down(Shutdown::because(
            OUT_OF_RANGE,
            format!(
                "it read {} C where {} C to {} C is allowed: the watched part is past its limits, or the sensor is broken (a sensor that has just got its supply back reads 85 C)",
                celsius(self.value),
                celsius(self.min_value),
                celsius(self.max_value)
            ),
        ))
    }
}

impl Object for Ds18b20 {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn report(&self) -> Report {
        Report { repeats: self.tolerance.as_ref().is_some_and(Tolerance::is_used), ..Report::default() }
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let next = at + self.rest_ticks;
        if self.read.is_here() {
            self.asked = at;
            self.next_clock = next;
            self.read.send(context, self.thermometer)?;
        } else if at.since(self.asked) > READ_LIMIT {
            context.try_shut_down(Shutdown::because(
                TOO_SLOW,
                Trouble::new("the reading has taken more than 5 s")
                    .remedy("look at the kernel's log (dmesg), or connect fewer sensors to one wire"),
            ))?;
        }
        Ok(Next::At(next))
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, is_wanted: true, .. }) = self.read.back(finished) else { return Ok(()) };
        match result {
            Ok(value) => {
                self.value = value;
                self.error_count = 0;
                self.has_value = true;
                self.failing_since = None;
                if let Some(tolerance) = &mut self.tolerance {
                    tolerance.works(context, KIND, READ_FAILED);
                }
            }
            Err(trouble)
                if self.has_value
                    && self.tolerance.as_mut().is_some_and(|tolerance| {
                        let since = *self.failing_since.get_or_insert(context.now());
                        tolerance.bears(context, KIND, since, |_| Shutdown::because(READ_FAILED, trouble.clone()))
                    }) => {}
            Err(trouble) => {
                self.error_count = self.error_count.saturating_add(1);
                if self.error_count > self.max_error_count {
                    let times = self.error_count;
                    let cause = format!("{} ({times} readings in a row failed)", trouble.cause).into();
                    return context.try_shut_down(Shutdown::because(READ_FAILED, Trouble { cause, ..trouble.clone() }));
                }
            }
        }
        let fault = self.error_count;
        let (oid, next_clock, value) = (context.oid(), self.next_clock, self.value);
        context.send(Reading { oid, next_clock, value, fault: fault.into() });
        // The dictionary has one of both.
        context.send(ReadingOfV010 { oid, next_clock, value });
        if fault == 0 { self.check_range(context) } else { Ok(()) }
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.read.drop_pending();
    }
}

fn configure(
    context: &mut Context,
    oid: Oid,
    serial: &[u8],
    max_error_count: u8,
    ignores_limits: bool,
) -> Result<(), Shutdown> {
    context.vacant(oid)?;
    if serial.contains(&b'/') {
        let serial = String::from_utf8_lossy(serial);
        let remedy = "serial_no is a name in /sys/bus/w1/devices, such as 28-0123456789ab";
        return Err(Shutdown::because(INVALID_SERIAL, format!("{serial:?} is not a sensor")).remedy(remedy));
    }
    let thermometer = context.board()?.ds18b20(serial)?;
    let sensor = Ds18b20 {
        thermometer: context.reader(thermometer)?,
        read: JobSlot::new(Read),
        asked: Clock::EPOCH,
        next_clock: Clock::EPOCH,
        rest_ticks: Ticks(0),
        min_value: 0,
        max_value: 0,
        max_error_count,
        ignores_limits,
        error_count: 0,
        value: 0,
        has_value: false,
        tolerance: context.tolerance(&Device::OneWire(String::from_utf8_lossy(serial).into_owned())),
        failing_since: None,
    };
    context.assign(oid, sensor)
}

const CONFIG_DS18B20_OF_V0_10: Command =
    command!("config_ds18b20 oid=%c serial=%*s", |context, oid: Oid, serial: &[u8]| {
        configure(context, oid, serial, 0, false)
    })
    .of(&[]);

const CONFIG_DS18B20: Command = command!(
    "config_ds18b20 oid=%c serial=%*s max_error_count=%c",
    |context, oid: Oid, serial: &[u8], max_error_count: u8| configure(context, oid, serial, max_error_count, false)
)
.of(&[V0_11, V0_12, V0_13, Master]);

/// Hosts with this form also ignore the limits of other sensors.
pub(super) const CONFIG_DS18B20_OF_KALICO: Command = command!(
    "config_ds18b20 oid=%c serial=%*s max_error_count=%c ignore_limits=%c",
    |context, oid: Oid, serial: &[u8], max_error_count: u8, ignore_limits: bool| {
        configure(context, oid, serial, max_error_count, ignore_limits)
    }
)
.of(&[Kalico]);

const QUERY_DS18B20: Command = command!(
    "query_ds18b20 oid=%c clock=%u rest_ticks=%u min_value=%i max_value=%i",
    Ds18b20,
    |sensor, context, clock: WireClock, rest_ticks: Ticks, min_value: i32, max_value: i32| {
        let at = context.instant(clock);
        context.cancel(TIMER);
        sensor.read.drop_pending();
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        sensor.rest_ticks = rest_ticks;
        sensor.min_value = min_value;
        sensor.max_value = max_value;
        context.schedule(TIMER, at)
    }
);
