// SPDX-License-Identifier: GPL-3.0-or-later
//! The inductive sensor LDC1612 on I2C, for eddy current probes (Texas Instruments SNOSCY9).
//!
//! klippy sets the chip up by itself. Its INTB line goes low when a sample is ready; without that line
//! the STATUS register is asked every `rest_ticks`. A bus that fails stops nothing: the host gets an
//! error in the sample's place, and homing ends. (For hosts that do not know such errors, v0.13 and Kalico, it
//! stops the machine, as it did in the firmware.)

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Bias, BusDevice, BusError, Direction, Line, Pin};
use crate::mcu::{
    Command, Conversation, Done, Enumeration, Feature, Generation::Kalico, Generation::Master, Generation::V0_13,
    Generations, Mcu, Next, Object, Oid, Response, Talk, Ticket, TimerId, WireClock, command, only, response, since,
};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::i2c::{I2c, i2c_shutdown};
use super::named;
use super::sensor_bulk::SensorBulk;
use super::trigger_analog::Attached;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    name: "ldc1612",
    commands: &[
        CONFIG_LDC1612,
        CONFIG_LDC1612_WITH_INTB,
        LDC1612_ATTACH_TRIGGER_ANALOG,
        LDC1612_SETUP_HOME,
        QUERY_LDC1612_HOME_STATE,
        QUERY_LDC1612,
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
    .of(since(Master))],
    responses: &[HomeState::FORM],
    ..Feature::EMPTY
};

/// The hosts that home by the sensor itself, and have the machine stop where its bus fails.
const HOMES_ITSELF: Generations = only(V0_13).and(Kalico);

response! {
    /// Whether samples are looked at for homing, and when the trigger came.
    "ldc1612_home_state oid=%c homing=%c trigger_clock=%u" => HOMES_ITSELF;
    pub(super) struct HomeState { oid: Oid, homing: bool, trigger_clock: Clock }
}

/// Error flags of the chip stand in the sample.
const SENSOR_REPORTS_ERROR: u8 = 0;
const I2C_STATUS_ERROR: u8 = 1;
const I2C_DATA_ERROR: u8 = 2;
/// A sample that looks like one of the errors that the host is sent.
const INVALID_READ_DATA: u8 = 3;

// Registers ("Register Maps").
const DATA0_MSB: u8 = 0x00;
const DATA0_LSB: u8 = 0x01;
const STATUS: u8 = 0x18;
/// UNREADCONV0 of STATUS: channel 0 has a sample that was not read.
const UNREADCONV0: u16 = 1 << 3;

const SAMPLE_BYTES: u32 = 4;
/// The flags of DATA0 that make a sample useless: under range, over range, watchdog. The fourth is an
/// amplitude that is out of the best range.
const ERROR_FLAGS: u32 = 0xe000_0000;
const DATA: u32 = 0x0fff_ffff;

/// What a reading came to.
#[derive(Clone, Copy)]
enum Found {
    Nothing,
    /// Both words of channel 0.
    Sample(u32),
    Error(u8),
}

/// Whether klippy would take such a sample for an error of the machine's.
fn looks_like_an_error(words: u32) -> bool {
    words >> 16 == 0xffff
}

fn read_word(chip: &mut dyn BusDevice, register: u8) -> Result<u16, BusError> {
    let mut word = [0; 2];
    chip.read_register(&[register], &mut word)?;
    Ok(u16::from_be_bytes(word))
}

/// Reads a sample, if there is one.
struct Look {
    found: Found,
}

impl Talk for Look {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.found = Found::Error(I2C_STATUS_ERROR);
        if read_word(chip, STATUS)? & UNREADCONV0 == 0 {
            self.found = Found::Nothing;
            return Ok(());
        }
        self.found = Found::Error(I2C_DATA_ERROR);
        let high = read_word(chip, DATA0_MSB)?;
        let low = read_word(chip, DATA0_LSB)?;
        self.found = Found::Sample(u32::from(high) << 16 | u32::from(low));
        Ok(())
    }
}

/// Asks whether there is a sample.
struct Ask {
    ready: bool,
}

impl Talk for Ask {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.ready = read_word(chip, STATUS)? & UNREADCONV0 != 0;
        Ok(())
    }
}

// The errands.
const LOOK: u8 = 0;
const ASK: u8 = 1;

/// Homing by the sensor itself.
struct Homing {
    /// Pulled when the trigger comes; none while samples are not looked at.
    trsync: Option<Oid>,
    /// A value above it is the trigger.
    threshold: u32,
    trigger_reason: u8,
    error_reason: u8,
    /// Whether every sample so far was of an instant before `clock`.
    awaits: bool,
    /// When homing begins; when it was triggered, from then on.
    clock: Clock,
}

impl Homing {
    /// Samples are not looked at.
    const OFF: Homing =
        Homing { trsync: None, threshold: 0, trigger_reason: 0, error_reason: 0, awaits: false, clock: Clock::EPOCH };

    /// Takes in both words of channel 0, read at the instant `at`.
    fn update(&mut self, mcu: &mut Mcu, words: u32, at: Clock) -> Result<(), Shutdown> {
        let Some(trsync) = self.trsync else { return Ok(()) };
        let reason = if words > DATA {
            self.error_reason
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
        mcu.with::<Trsync, _>(trsync, |object, mcu| object.trigger(mcu, trsync, reason))
    }
}

struct Ldc1612 {
    i2c: Oid,
    /// Low while a sample is ready.
    intb: Option<Arc<dyn Line>>,
    /// Here while no reading is under way.
    look: Option<Box<Conversation<Look>>>,
    /// Turns of the timer that came meanwhile.
    missed: u16,
    /// Whether the reading under way is of an earlier query, and counts no more.
    stale: bool,
    /// Here while no status is asked for.
    ask: Option<Box<Conversation<Ask>>>,
    rest_ticks: Ticks,
    bulk: SensorBulk,
    attached: Attached,
    homing: Homing,
    /// Whether the last conversation failed: the log is told of the first one.
    failing: bool,
}

impl Ldc1612 {
    fn configure(mcu: &mut Mcu, oid: Oid, i2c: Oid, intb_pin: Option<Pin>) -> Result<(), Shutdown> {
        mcu.vacant(oid)?;
        mcu.with::<I2c, _>(i2c, |_, _| Ok(()))?;
        let intb = intb_pin.map(|pin| mcu.prompt_line(pin, "intb", Direction::Input(Bias::PullUp))).transpose()?;
        let sensor = Ldc1612 {
            i2c,
            intb,
            look: Some(Conversation::new(Look { found: Found::Nothing })),
            missed: 0,
            stale: false,
            ask: Some(Conversation::new(Ask { ready: false })),
            rest_ticks: Ticks(0),
            bulk: SensorBulk::new(),
            attached: Attached::default(),
            homing: Homing::OFF,
            failing: false,
        };
        mcu.assign(oid, sensor)
    }

    /// Whether a sample that counts is being read.
    fn is_pending(&self) -> bool {
        self.look.is_none() && !self.stale
    }

    /// Says in the log that the bus fails, if it did not before; or stops the machine.
    fn note(&mut self, mcu: &mut Mcu, oid: Oid, result: Result<(), BusError>) -> Result<(), Shutdown> {
        let failed_before = std::mem::replace(&mut self.failing, result.is_err());
        let Err(error) = result else { return Ok(()) };
        let trouble = i2c_shutdown(mcu, error);
        if mcu.serves(HOMES_ITSELF) {
            return mcu.device_failed(oid, self.kind(), trouble);
        }
        if !failed_before {
            mcu.warn(oid, self.kind(), trouble);
        }
        Ok(())
    }

    /// Has the sensor read, if it may have a sample.
    fn turn(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        if self.intb.as_ref().map_or(Ok(false), |intb| intb.read())? {
            return Ok(());
        }
        let Some(look) = self.look.take() else { return Ok(()) };
        mcu.converse(self.i2c, Ticket { oid, tag: LOOK }, look)
    }

    /// Makes up for the turns that came while the sensor was read, as in the firmware, whose timer waits for
    /// the bus: the first one is taken now, each further one says that samples may be lost.
    fn make_up(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        let missed = std::mem::take(&mut self.missed);
        if missed == 0 {
            return Ok(());
        }
        self.turn(mcu, oid)?;
        if self.is_pending() {
            self.bulk.count_overflows(missed - 1);
        }
        Ok(())
    }

    fn looked(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let read_at = done.ended;
        let Some(mut look) = done.errand::<Conversation<Look>>() else { return Ok(()) };
        let result = std::mem::replace(&mut look.result, Ok(()));
        let found = look.talk.found;
        self.look = Some(look);
        self.note(mcu, oid, result)?;
        if std::mem::take(&mut self.stale) {
            return Ok(());
        }
        let found = match found {
            Found::Sample(words) if looks_like_an_error(words) && !mcu.serves(HOMES_ITSELF) => {
                Found::Error(INVALID_READ_DATA)
            }
            found => found,
        };
        let sample = match found {
            Found::Nothing => return Ok(()),
            Found::Error(error) => {
                self.attached.note_error(mcu, error)?;
                [0xff, 0xff, 0, error]
            }
            Found::Sample(words) => {
                match words & ERROR_FLAGS {
                    0 => self.attached.update(mcu, (words & DATA) as i32, read_at)?,
                    _ => self.attached.note_error(mcu, SENSOR_REPORTS_ERROR)?,
                }
                self.homing.update(mcu, words, read_at)?;
                words.to_be_bytes()
            }
        };
        self.bulk.add(mcu, oid, &sample);
        Ok(())
    }

    /// The chip says whether it has a sample. Without an answer klippy asks again.
    fn asked(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let asked = (done.began, done.ended);
        let Some(mut ask) = done.errand::<Conversation<Ask>>() else { return Ok(()) };
        let result = std::mem::replace(&mut ask.result, Ok(()));
        if result.is_ok() {
            self.bulk.send_status(mcu, oid, asked, if ask.talk.ready { SAMPLE_BYTES } else { 0 });
        }
        self.ask = Some(ask);
        self.note(mcu, oid, result)
    }

    fn query_status(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        let Some(intb) = &self.intb else {
            // Commands wait for each other, so it is here, unless the machine was stopped meanwhile.
            let Some(ask) = self.ask.take() else { return Ok(()) };
            return mcu.converse(self.i2c, Ticket { oid, tag: ASK }, ask);
        };
        let now = mcu.now();
        // One that is being read counts as one in the chip.
        let ready = self.is_pending() || !intb.read()?;
        self.bulk.send_status(mcu, oid, (now, now), if ready { SAMPLE_BYTES } else { 0 });
        Ok(())
    }
}

impl Object for Ldc1612 {
    fn kind(&self) -> &'static str {
        "LDC1612"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        match self.look {
            Some(_) => self.turn(mcu, oid)?,
            None => self.missed = self.missed.saturating_add(1),
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        match done.tag {
            LOOK => {
                self.looked(mcu, oid, done)?;
                self.make_up(mcu, oid)
            }
            _ => self.asked(mcu, oid, done),
        }
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.stale = self.look.is_none();
        self.missed = 0;
    }
}

const CONFIG_LDC1612: Command = command!("config_ldc1612 oid=%c i2c_oid=%c", |mcu, oid: Oid, i2c_oid: Oid| {
    Ldc1612::configure(mcu, oid, i2c_oid, None)
})
.of(since(V0_13));

const CONFIG_LDC1612_WITH_INTB: Command =
    command!("config_ldc1612_with_intb oid=%c i2c_oid=%c intb_pin=%c", |mcu, oid: Oid, i2c_oid: Oid, intb_pin: Pin| {
        Ldc1612::configure(mcu, oid, i2c_oid, Some(intb_pin))
    })
    .of(since(V0_13));

const LDC1612_ATTACH_TRIGGER_ANALOG: Command =
    command!("ldc1612_attach_trigger_analog oid=%c trigger_analog_oid=%c", |mcu, oid: Oid, trigger_analog_oid: Oid| {
        mcu.with::<Ldc1612, _>(oid, |sensor, mcu| sensor.attached.attach(mcu, trigger_analog_oid))
    })
    .of(since(Master));

const LDC1612_SETUP_HOME: Command = command!(
    "ldc1612_setup_home oid=%c clock=%u threshold=%u trsync_oid=%c trigger_reason=%c error_reason=%c",
    |mcu, oid: Oid, clock: WireClock, threshold: u32, trsync_oid: Oid, trigger_reason: u8, error_reason: u8| {
        let clock = mcu.instant(clock);
        mcu.with::<Ldc1612, _>(oid, |sensor, mcu| {
            if threshold == 0 {
                sensor.homing.trsync = None;
                return Ok(());
            }
            mcu.with::<Trsync, _>(trsync_oid, |_, _| Ok(()))?;
            let trsync = Some(trsync_oid);
            sensor.homing = Homing { trsync, threshold, trigger_reason, error_reason, awaits: true, clock };
            Ok(())
        })
    }
)
.of(HOMES_ITSELF);

const QUERY_LDC1612_HOME_STATE: Command = command!("query_ldc1612_home_state oid=%c", |mcu, oid: Oid| {
    mcu.with::<Ldc1612, _>(oid, |sensor, mcu| {
        let homing = &sensor.homing;
        mcu.send(HomeState { oid, homing: homing.trsync.is_some(), trigger_clock: homing.clock });
        Ok(())
    })
})
.of(HOMES_ITSELF);

const QUERY_LDC1612: Command = command!("query_ldc1612 oid=%c rest_ticks=%u", |mcu, oid: Oid, rest_ticks: Ticks| {
    mcu.with::<Ldc1612, _>(oid, |sensor, mcu| {
        let timer = TimerId::sampling(oid, 0);
        mcu.cancel(timer);
        sensor.stale = sensor.look.is_none();
        sensor.missed = 0;
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        sensor.rest_ticks = rest_ticks;
        sensor.bulk.reset();
        let at = mcu.now() + rest_ticks;
        mcu.schedule(timer, at)
    })
})
.of(since(V0_13));

const QUERY_STATUS_LDC1612: Command = command!("query_status_ldc1612 oid=%c", |mcu, oid: Oid| {
    mcu.with::<Ldc1612, _>(oid, |sensor, mcu| sensor.query_status(mcu, oid))
})
.of(since(V0_13));

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
