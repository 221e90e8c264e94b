// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing and probing with the samples of a sensor. Samples go through a filter. They pull a trsync when they cross the
//! host's value. Samples out of range, a filter overflow, an error of the sensor and a silent sensor also pull it. Each
//! has a reason of its own.

use crate::mcu::DialectName::Master;
use crate::mcu::{
    Command, Context, Enumeration, Feature, Hosts, Next, Object, Oid, Response, Timer, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::load_cell_probe::LoadCellProbe;
use super::named;
use super::sos_filter::SosFilter;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    serves: "load cell probes and eddy current probes",

    commands: &[
        CONFIG_TRIGGER_ANALOG,
        TRIGGER_ANALOG_SET_RAW_RANGE,
        TRIGGER_ANALOG_SET_TRIGGER,
        TRIGGER_ANALOG_HOME,
        TRIGGER_ANALOG_QUERY_STATE,
    ],
    responses: &[StateWithTrigger::FORM, State::FORM],
    enumerations: &[
        Enumeration::new("trigger_analog_type", |_| named(&TriggerType::ALL.map(|(type_, name)| (name, type_ as u8))))
            .of(&[Master]),
        Enumeration::new("trigger_analog_error:", |_| {
            named(&[
                ("RAW_RANGE", RAW_RANGE),
                ("OVERFLOW", OVERFLOW),
                ("MONITOR", MONITOR),
                ("SENSOR_SPECIFIC", SENSOR_SPECIFIC),
            ])
        })
        .of(&[Master]),
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `trigger_analog_type` outside the enumeration. (Pinion's own text. In Klipper's C nothing triggers then.)
    INVALID_TYPE = "Invalid trigger_analog_type";
}

response! {
    /// The form of 25 to 29 January 2026: when the sample came that decided, which is the peak before a tap.
    "trigger_analog_state oid=%c homing=%c trigger_clock=%u" => Hosts::of(&[]);
    pub(super) struct StateWithTrigger { oid: Oid, homing: bool, trigger_clock: Clock }
}

response! {
    /// Whether samples are checked, and when the trigger came.
    "trigger_analog_state oid=%c homing=%c homing_clock=%u" => Hosts::of(&[Master]);
    pub(super) struct State { oid: Oid, homing: bool, homing_clock: Clock }
}

const TIMER: Timer = Timer::exact(0);

/// The condition that pulls the trigger.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TriggerType {
    /// The absolute value is at least the trigger value.
    AbsGe = 0,
    /// The value is above the trigger value.
    Gt = 1,
    /// The value is below the highest one so far by more than the trigger value.
    DiffPeakGt = 2,
}

impl TriggerType {
    /// All of them with their names in the dictionary, in the order of their numbers.
    const ALL: [(TriggerType, &'static str); 3] =
        [(TriggerType::AbsGe, "abs_ge"), (TriggerType::Gt, "gt"), (TriggerType::DiffPeakGt, "diff_peak_gt")];

    /// The type with this number.
    ///
    /// # Errors
    ///
    /// "Invalid trigger_analog_type".
    fn of(number: u8) -> Result<TriggerType, Shutdown> {
        TriggerType::ALL.get(usize::from(number)).map(|(type_, _)| *type_).ok_or_else(|| {
            Shutdown::by_host(INVALID_TYPE, format_args!("trigger_analog_type {number} is not in the dictionary"))
        })
    }
}

// Error codes. The host finds them added to its `error_reason` in the trsync's reason.
const RAW_RANGE: u8 = 0;
const OVERFLOW: u8 = 1;
const MONITOR: u8 = 2;
/// The first of the sensor's own error codes.
const SENSOR_SPECIFIC: u8 = 3;

pub(super) struct TriggerAnalog {
    filter: Oid,
    raw_min: i32,
    raw_max: i32,
    trigger_type: TriggerType,
    trigger_value: i32,
    /// The highest filtered value since `trigger_analog_home`.
    peak: i32,
    /// Whether samples are checked.
    homing: bool,
    /// Whether every sample so far was from before `homing_clock`.
    awaits: bool,
    /// When homing begins. After the trigger: when it came.
    homing_clock: Clock,
    /// When the last sample came that may be the trigger. For [`TriggerType::DiffPeakGt`]: when the peak came.
    trigger_clock: Clock,
    trsync: Option<Oid>,
    trigger_reason: u8,
    error_reason: u8,
    monitor_ticks: Ticks,
    monitor_max: u8,
    /// Turns of the monitor since the last sample.
    monitor_count: u8,
}

impl TriggerAnalog {
    /// Processes a sample of the sensor, read at `at`.
    fn update(&mut self, context: &mut Context, sample: i32, at: Clock) -> Result<(), Shutdown> {
        if !self.homing || self.awaits && at < self.homing_clock {
            return Ok(());
        }
        self.awaits = false;
        self.monitor_count = 0;
        if !(self.raw_min..=self.raw_max).contains(&sample) {
            return self.fail(context, RAW_RANGE);
        }
        let Ok(value) = context.with::<SosFilter, _>(self.filter, |filter, _| Ok(filter.apply(sample)))? else {
            return self.fail(context, OVERFLOW);
        };
        if !self.crosses(value, at) {
            return Ok(());
        }
        self.homing = false;
        self.homing_clock = at;
        self.pull(context, self.trigger_reason)
    }

    /// Whether a filtered value pulls the trigger. Klipper's C compares a negative trigger value as unsigned, except
    /// for [`TriggerType::Gt`].
    fn crosses(&mut self, value: i32, at: Clock) -> bool {
        if self.trigger_type != TriggerType::DiffPeakGt || value > self.peak {
            self.trigger_clock = at;
        }
        match self.trigger_type {
            TriggerType::AbsGe => value.unsigned_abs() >= self.trigger_value as u32,
            TriggerType::Gt => value > self.trigger_value,
            TriggerType::DiffPeakGt if value > self.peak => {
                self.peak = value;
                false
            }
            TriggerType::DiffPeakGt => self.peak.abs_diff(value) > self.trigger_value as u32,
        }
    }

    /// Ends homing with an error.
    fn fail(&mut self, context: &mut Context, error: u8) -> Result<(), Shutdown> {
        if !std::mem::take(&mut self.homing) {
            return Ok(());
        }
        self.pull(context, self.error_reason.wrapping_add(error))
    }

    fn pull(&self, context: &mut Context, reason: u8) -> Result<(), Shutdown> {
        let Some(trsync) = self.trsync else { return Ok(()) };
        context.with::<Trsync, _>(trsync, |trsync, context| trsync.trigger(context, reason))
    }
}

impl Object for TriggerAnalog {
    fn kind(&self) -> &'static str {
        "analog trigger"
    }

    /// Checks whether the sensor is silent, and pulls the trigger if it is. Later samples are still checked, as in
    /// Klipper's C: a trsync is pulled only once.
    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if !self.homing {
            return Ok(Next::Done);
        }
        if self.monitor_count > self.monitor_max {
            self.pull(context, self.error_reason.wrapping_add(MONITOR))?;
            return Ok(Next::Done);
        }
        self.monitor_count = self.monitor_count.wrapping_add(1);
        Ok(Next::At(at + self.monitor_ticks))
    }
}

/// Where a sensor's samples go for homing, if the host attached something.
#[derive(Clone, Copy, Default)]
pub(super) enum Attached {
    #[default]
    Nothing,
    /// An analog trigger.
    Trigger(Oid),
    /// A load cell probe of Kalico.
    Probe(Oid),
}

impl Attached {
    /// Attaches an analog trigger.
    pub(super) fn attach(&mut self, context: &mut Context, trigger_analog: Oid) -> Result<(), Shutdown> {
        context.require::<TriggerAnalog>(trigger_analog)?;
        *self = Attached::Trigger(trigger_analog);
        Ok(())
    }

    /// Attaches a load cell probe.
    pub(super) fn attach_probe(&mut self, context: &mut Context, probe: Oid) -> Result<(), Shutdown> {
        context.require::<LoadCellProbe>(probe)?;
        *self = Attached::Probe(probe);
        Ok(())
    }

    /// Passes on a sample that was read at `at`.
    pub(super) fn update(self, context: &mut Context, sample: i32, at: Clock) -> Result<(), Shutdown> {
        match self {
            Attached::Nothing => Ok(()),
            Attached::Trigger(oid) => {
                context.with::<TriggerAnalog, _>(oid, |trigger, context| trigger.update(context, sample, at))
            }
            Attached::Probe(oid) => {
                context.with::<LoadCellProbe, _>(oid, |probe, context| probe.update(context, sample, at))
            }
        }
    }

    /// Passes on an error of the sensor, by the sensor's own number. (A load cell probe gets no errors: it notices that
    /// samples are missing.)
    pub(super) fn note_error(self, context: &mut Context, error: u8) -> Result<(), Shutdown> {
        let Attached::Trigger(oid) = self else { return Ok(()) };
        context.with::<TriggerAnalog, _>(oid, |trigger, context| {
            trigger.fail(context, error.wrapping_add(SENSOR_SPECIFIC))
        })
    }
}

const CONFIG_TRIGGER_ANALOG: Command =
    command!("config_trigger_analog oid=%c sos_filter_oid=%c", |context, oid: Oid, sos_filter_oid: Oid| {
        context.require::<SosFilter>(sos_filter_oid)?;
        let trigger = TriggerAnalog {
            filter: sos_filter_oid,
            raw_min: 0,
            raw_max: 0,
            trigger_type: TriggerType::AbsGe,
            trigger_value: 0,
            peak: 0,
            homing: false,
            awaits: false,
            homing_clock: Clock::EPOCH,
            trigger_clock: Clock::EPOCH,
            trsync: None,
            trigger_reason: 0,
            error_reason: 0,
            monitor_ticks: Ticks(0),
            monitor_max: 0,
            monitor_count: 0,
        };
        context.assign(oid, trigger)
    })
    .of(&[Master]);

const TRIGGER_ANALOG_SET_RAW_RANGE: Command = command!(
    "trigger_analog_set_raw_range oid=%c raw_min=%i raw_max=%i",
    TriggerAnalog,
    |trigger, _, raw_min: i32, raw_max: i32| {
        trigger.raw_min = raw_min;
        trigger.raw_max = raw_max;
        Ok(())
    }
)
.of(&[Master]);

const TRIGGER_ANALOG_SET_TRIGGER: Command = command!(
    "trigger_analog_set_trigger oid=%c trigger_analog_type=%c trigger_value=%i",
    TriggerAnalog,
    |trigger, _, trigger_analog_type: u8, trigger_value: i32| {
        trigger.trigger_type = TriggerType::of(trigger_analog_type)?;
        trigger.trigger_value = trigger_value;
        Ok(())
    }
)
.of(&[Master]);

const TRIGGER_ANALOG_HOME: Command = command!(
    "trigger_analog_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u monitor_ticks=%u monitor_max=%u",
    TriggerAnalog,
    |trigger,
     context,
     trsync_oid: Oid,
     trigger_reason: u8,
     error_reason: u8,
     clock: WireClock,
     monitor_ticks: Ticks,
     monitor_max: u32| {
        let at = context.instant(clock);
        if monitor_ticks == Ticks(0) {
            context.cancel(TIMER);
            (trigger.homing, trigger.trsync) = (false, None);
            return Ok(());
        }
        context.require::<Trsync>(trsync_oid)?;
        context.cancel(TIMER);
        trigger.monitor_ticks = monitor_ticks;
        trigger.trsync = Some(trsync_oid);
        trigger.trigger_reason = trigger_reason;
        trigger.error_reason = error_reason;
        trigger.homing_clock = at;
        // Klipper's C keeps its low byte.
        trigger.monitor_max = monitor_max as u8;
        trigger.monitor_count = 0;
        trigger.homing = true;
        trigger.awaits = true;
        trigger.peak = i32::MIN;
        context.schedule(TIMER, at)
    }
)
.of(&[Master]);

const TRIGGER_ANALOG_QUERY_STATE: Command =
    command!("trigger_analog_query_state oid=%c", TriggerAnalog, |trigger, context| {
        let (oid, homing) = (context.oid(), trigger.homing);
        context.send(State { oid, homing, homing_clock: trigger.homing_clock });
        // The dictionary has one of both.
        context.send(StateWithTrigger { oid, homing, trigger_clock: trigger.trigger_clock });
        Ok(())
    })
    .of(&[Master]);
