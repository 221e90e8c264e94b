// SPDX-License-Identifier: GPL-3.0-or-later
//! The inductive sensor LDC1612 on I2C, for eddy current probes (Texas Instruments SNOSCY9).
//!
//! klippy itself sets up the chip. The chip's INTB line goes low when a sample is ready. Without that line Pinion reads
//! the STATUS register every `rest_ticks`. A failing bus stops nothing: the host gets an error in the sample's place,
//! and homing ends. The hosts v0.13 and Kalico do not know these errors. For them a failing bus stops the MCU, as it
//! did in Klipper's C.

use std::sync::Arc;

use crate::board::{Bias, BusDevice, BusError, Direction, Line, Pin};
use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{
    Back, Chip, Command, Context, DialectName, Enumeration, Feature, Finished, Hosts, Job, JobSlot, Next, Object, Oid,
    Response, Timer, WireClock, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::i2c::{I2c, i2c_shutdown};
use super::named;
use super::sensor_bulk::SensorBulk;
use super::trigger_analog::Attached;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    serves: "LDC1612 eddy current probes",

    commands: &[
        CONFIG_LDC1612,
        CONFIG_LDC1612_WITH_INTB,
        LDC1612_ATTACH_TRIGGER_ANALOG,
        LDC1612_SETUP_HOME_WITHOUT_ERRORS,
        LDC1612_SETUP_HOME,
        QUERY_LDC1612_HOME_STATE,
        QUERY_LDC1612,
        QUERY_LDC1612_STATUS,
        QUERY_STATUS_LDC1612,
    ],
    enumerations: &[Enumeration::new("ldc1612_error:", |_| {
        named(&[
            ("SENSOR_REPORTS_ERROR", SENSOR_REPORTS_ERROR),
            ("I2C_STATUS_ERROR", I2C_STATUS_ERROR),
            ("I2C_DATA_ERROR", I2C_DATA_ERROR),
            ("INVALID_READ_DATA", INVALID_READ_DATA),
        ])
    })
    .of(&[Master])],
    responses: &[HomeState::FORM],
    ..Feature::EMPTY
};

/// The hosts that home by the sensor itself. For them a failing bus stops the MCU.
const HOMES_ITSELF: &[DialectName] = &[V0_13, Kalico];

response! {
    /// Whether samples are checked for homing, and when the trigger came.
    "ldc1612_home_state oid=%c homing=%c trigger_clock=%u" => Hosts::of(HOMES_ITSELF);
    pub(super) struct HomeState { oid: Oid, homing: bool, trigger_clock: Clock }
}

/// The sample has error flags of the chip.
const SENSOR_REPORTS_ERROR: u8 = 0;
const I2C_STATUS_ERROR: u8 = 1;
const I2C_DATA_ERROR: u8 = 2;
/// The sample looks like one of the errors that the host gets.
const INVALID_READ_DATA: u8 = 3;

/// "Register Maps".
#[derive(Clone, Copy)]
enum Register {
    Data0Msb = 0x00,
    Data0Lsb = 0x01,
    Status = 0x18,
}

/// UNREADCONV0 of STATUS: channel 0 has an unread sample.
const UNREADCONV0: u16 = 1 << 3;

const SAMPLE_BYTES: u32 = 4;
/// The flags of DATA0 that make a sample useless: under range, over range, watchdog. The fourth flag reports an
/// amplitude outside the best range.
const ERROR_FLAGS: u32 = 0xe000_0000;
const DATA: u32 = 0x0fff_ffff;

const TIMER: Timer = Timer::sampling(0);

/// Whether klippy would take this sample for an error that the MCU reports.
fn looks_like_an_error(words: u32) -> bool {
    words >> 16 == 0xffff
}

fn read_word(chip: &mut dyn BusDevice, register: Register) -> Result<u16, BusError> {
    let mut word = [0; 2];
    chip.read_register(&[register as u8], &mut word)?;
    Ok(u16::from_be_bytes(word))
}

/// Whether channel 0 has an unread sample.
fn is_ready(chip: &mut dyn BusDevice) -> Result<bool, BusError> {
    Ok(read_word(chip, Register::Status)? & UNREADCONV0 != 0)
}

/// Reads a sample, if there is one.
struct Read {
    /// The error for the host if the bus fails now.
    error: u8,
}

impl Job for Read {
    type Device = Chip;
    /// Both words of channel 0.
    type Out = Option<u32>;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<Option<u32>, BusError> {
        self.error = I2C_STATUS_ERROR;
        if !is_ready(chip)? {
            return Ok(None);
        }
        self.error = I2C_DATA_ERROR;
        let high = read_word(chip, Register::Data0Msb)?;
        let low = read_word(chip, Register::Data0Lsb)?;
        Ok(Some(u32::from(high) << 16 | u32::from(low)))
    }
}

/// Asks whether there is a sample.
struct Ask;

impl Job for Ask {
    type Device = Chip;
    type Out = bool;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<bool, BusError> {
        is_ready(chip)
    }
}

/// Homing by the sensor itself.
struct Homing {
    /// The trsync that the trigger pulls. `None`: samples are not checked.
    trsync: Option<Oid>,
    /// A value above it is the trigger.
    threshold: u32,
    trigger_reason: u8,
    /// `None`: an error is a value as any other, and so is above the threshold.
    error_reason: Option<u8>,
    /// Whether every sample so far was from before `clock`.
    awaits: bool,
    /// When homing begins. After the trigger: when it came.
    clock: Clock,
}

impl Homing {
    /// Samples are not checked.
    const OFF: Homing = Homing {
        trsync: None,
        threshold: 0,
        trigger_reason: 0,
        error_reason: None,
        awaits: false,
        clock: Clock::EPOCH,
    };

    /// Processes both words of channel 0, read at `at`.
    fn update(&mut self, context: &mut Context, words: u32, at: Clock) -> Result<(), Shutdown> {
        let Some(trsync) = self.trsync else { return Ok(()) };
        let reason = if let (true, Some(reason)) = (words > DATA, self.error_reason) {
            reason
        } else if self.awaits && at < self.clock {
            return Ok(());
        } else if words > self.threshold {
            self.clock = at;
            self.trigger_reason
        } else {
            self.awaits = false;
            return Ok(());
        };
        self.trsync = None;
        context.with::<Trsync, _>(trsync, |trsync, context| trsync.trigger(context, reason))
    }
}

const KIND: &str = "LDC1612";

// The numbers of the jobs.
const READ: u8 = 0;
const ASK: u8 = 1;

struct Ldc1612 {
    i2c: Oid,
    /// Low while a sample is ready.
    intb: Option<Arc<dyn Line>>,
    read: JobSlot<Read>,
    /// Turns of the timer that came during a reading.
    missed: u16,
    ask: JobSlot<Ask>,
    rest_ticks: Ticks,
    bulk: SensorBulk,
    attached: Attached,
    homing: Homing,
    /// Whether the last job failed. Only the first failure is logged.
    failing: bool,
}

impl Ldc1612 {
    fn configure(context: &mut Context, oid: Oid, i2c: Oid, intb_pin: Option<Pin>) -> Result<(), Shutdown> {
        context.vacant(oid)?;
        context.require::<I2c>(i2c)?;
        let intb = intb_pin.map(|pin| context.prompt_line(pin, "intb", Direction::Input(Bias::PullUp))).transpose()?;
        let sensor = Ldc1612 {
            i2c,
            intb,
            read: JobSlot::numbered(READ, Read { error: I2C_STATUS_ERROR }),
            missed: 0,
            ask: JobSlot::numbered(ASK, Ask),
            rest_ticks: Ticks(0),
            bulk: SensorBulk::new(),
            attached: Attached::default(),
            homing: Homing::OFF,
            failing: false,
        };
        context.assign(oid, sensor)
    }

    /// Logs a failure of the bus if the job before did not fail, or stops the MCU.
    fn note(failing: &mut bool, context: &mut Context, failure: Option<&BusError>) -> Result<(), Shutdown> {
        let failed_before = std::mem::replace(failing, failure.is_some());
        let Some(error) = failure else { return Ok(()) };
        let stops = context.speaks::<HomeState>();
        if failed_before && !stops {
            return Ok(());
        }
        let trouble = i2c_shutdown(context, error.clone());
        if stops {
            return context.device_failed(KIND, trouble);
        }
        context.warn(KIND, trouble);
        Ok(())
    }

    /// Makes the worker read the sensor, if it may have a sample.
    fn read(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        if self.intb.as_ref().map_or(Ok(false), |intb| intb.read())? {
            return Ok(());
        }
        self.read.send_to(context, self.i2c)
    }

    /// Makes up for the turns that came while the sensor was read. Klipper's timer waits for the bus. So the first
    /// of these turns runs now, and each further one counts as possibly lost samples.
    fn make_up(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        let missed = std::mem::take(&mut self.missed);
        if missed == 0 {
            return Ok(());
        }
        self.read(context)?;
        if self.read.is_pending() {
            self.bulk.count_overflows(missed - 1);
        }
        Ok(())
    }

    /// Processes a sample: both words of channel 0, or an error.
    fn add(&mut self, context: &mut Context, words: Result<u32, u8>, read_at: Clock) -> Result<(), Shutdown> {
        let sample = match words {
            Ok(words) if looks_like_an_error(words) && !context.speaks::<HomeState>() => Err(INVALID_READ_DATA),
            words => words,
        };
        let sample = match sample {
            Err(error) => {
                self.attached.note_error(context, error)?;
                [0xff, 0xff, 0, error]
            }
            Ok(words) => {
                match words & ERROR_FLAGS {
                    0 => self.attached.update(context, (words & DATA) as i32, read_at)?,
                    _ => self.attached.note_error(context, SENSOR_REPORTS_ERROR)?,
                }
                self.homing.update(context, words, read_at)?;
                words.to_be_bytes()
            }
        };
        self.bulk.add(context, &sample);
        Ok(())
    }

    fn setup_home(
        &mut self,
        context: &mut Context,
        clock: WireClock,
        threshold: u32,
        trsync_oid: Oid,
        (trigger_reason, error_reason): (u8, Option<u8>),
    ) -> Result<(), Shutdown> {
        let clock = context.instant(clock);
        if threshold == 0 {
            self.homing.trsync = None;
            return Ok(());
        }
        context.require::<Trsync>(trsync_oid)?;
        let trsync = Some(trsync_oid);
        self.homing = Homing { trsync, threshold, trigger_reason, error_reason, awaits: true, clock };
        Ok(())
    }

    fn query_status(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        let Some(intb) = &self.intb else {
            return self.ask.send_to(context, self.i2c);
        };
        let now = context.now();
        // A sample that is being read counts as one in the chip.
        let ready = self.read.is_pending() || !intb.read()?;
        self.bulk.send_status(context, (now, now), if ready { SAMPLE_BYTES } else { 0 });
        Ok(())
    }
}

impl Object for Ldc1612 {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if self.read.is_here() {
            self.read(context)?;
        } else {
            self.missed = self.missed.saturating_add(1);
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        if number == READ {
            let Some(Back { result, is_wanted, ended, .. }) = self.read.back(finished) else { return Ok(()) };
            let read = result.ok();
            Self::note(&mut self.failing, context, result.err())?;
            let words = match read {
                Some(words) => words.map(Ok),
                None => self.read.here().map(|read| Err(read.error)),
            };
            if let (true, Some(words)) = (is_wanted, words) {
                self.add(context, words, ended)?;
            }
            return self.make_up(context);
        }
        // If there is no answer, klippy asks again.
        let Some(Back { result, began, ended, .. }) = self.ask.back(finished) else { return Ok(()) };
        if let Ok(ready) = result {
            self.bulk.send_status(context, (began, ended), if ready { SAMPLE_BYTES } else { 0 });
        }
        Self::note(&mut self.failing, context, result.err())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.read.drop_pending();
        self.missed = 0;
    }
}

const CONFIG_LDC1612: Command = command!("config_ldc1612 oid=%c i2c_oid=%c", |context, oid: Oid, i2c_oid: Oid| {
    Ldc1612::configure(context, oid, i2c_oid, None)
})
.of(&[V0_13, Master, Kalico]);

const CONFIG_LDC1612_WITH_INTB: Command = command!(
    "config_ldc1612_with_intb oid=%c i2c_oid=%c intb_pin=%c",
    |context, oid: Oid, i2c_oid: Oid, intb_pin: Pin| { Ldc1612::configure(context, oid, i2c_oid, Some(intb_pin)) }
)
.of(&[V0_13, Master, Kalico]);

const LDC1612_ATTACH_TRIGGER_ANALOG: Command = command!(
    "ldc1612_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    Ldc1612,
    |sensor, context, trigger_analog_oid: Oid| sensor.attached.attach(context, trigger_analog_oid)
)
.of(&[Master]);

const LDC1612_SETUP_HOME: Command = command!(
    "ldc1612_setup_home oid=%c clock=%u threshold=%u trsync_oid=%c trigger_reason=%c error_reason=%c",
    Ldc1612,
    |sensor, context, clock: WireClock, threshold: u32, trsync_oid: Oid, trigger_reason: u8, error_reason: u8| {
        sensor.setup_home(context, clock, threshold, trsync_oid, (trigger_reason, Some(error_reason)))
    }
)
.of(HOMES_ITSELF);

/// The form of April and May 2024.
const LDC1612_SETUP_HOME_WITHOUT_ERRORS: Command = command!(
    "ldc1612_setup_home oid=%c clock=%u threshold=%u trsync_oid=%c trigger_reason=%c",
    Ldc1612,
    |sensor, context, clock: WireClock, threshold: u32, trsync_oid: Oid, trigger_reason: u8| {
        sensor.setup_home(context, clock, threshold, trsync_oid, (trigger_reason, None))
    }
)
.of(&[]);

const QUERY_LDC1612_HOME_STATE: Command = command!("query_ldc1612_home_state oid=%c", Ldc1612, |sensor, context| {
    let homing = &sensor.homing;
    context.send(HomeState { oid: context.oid(), homing: homing.trsync.is_some(), trigger_clock: homing.clock });
    Ok(())
})
.of(HOMES_ITSELF);

const QUERY_LDC1612: Command =
    command!("query_ldc1612 oid=%c rest_ticks=%u", Ldc1612, |sensor, context, rest_ticks: Ticks| {
        context.cancel(TIMER);
        sensor.read.drop_pending();
        sensor.missed = 0;
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        sensor.rest_ticks = rest_ticks;
        sensor.bulk.reset();
        let at = context.now() + rest_ticks;
        context.schedule(TIMER, at)
    })
    .of(&[V0_13, Master, Kalico]);

/// The name until June 2024.
const QUERY_LDC1612_STATUS: Command =
    command!("query_ldc1612_status oid=%c", Ldc1612, |sensor, context| sensor.query_status(context)).of(&[]);

const QUERY_STATUS_LDC1612: Command = command!("query_status_ldc1612 oid=%c", Ldc1612, |sensor, context| sensor
    .query_status(context))
.of(&[V0_13, Master, Kalico]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_highest_values_are_taken_for_errors() {
        for (words, error) in
            [(0x0000_0000, false), (0x0fff_ffff, false), (0xfffe_ffff, false), (0xffff_0000, true), (0xffff_ffff, true)]
        {
            assert_eq!(looks_like_an_error(words), error, "{words:#x}");
        }
    }
}
