// SPDX-License-Identifier: GPL-3.0-or-later
//! Kalico's probing with load cells. A sensor's sample is converted to grams and filtered. If the force is as large as
//! the host has set, it pulls a trsync. A sample outside the safe range, grams that overflow, and a silent sensor also
//! pull it. Each has a reason of its own. (Klipper's `trigger_analog` developed from this.)

use crate::mcu::DialectName::Kalico;
use crate::mcu::{Command, Context, Feature, Hosts, Next, Object, Oid, Response, Timer, WireClock, command, response};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::sos_filter::SosFilter;
use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    serves: "load cell probes",

    commands: &[CONFIG_LOAD_CELL_PROBE, LOAD_CELL_PROBE_SET_RANGE, LOAD_CELL_PROBE_HOME, LOAD_CELL_PROBE_QUERY_STATE],
    responses: &[State::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// The highest safe value is below the lowest one.
    RANGE_REVERSED = "Safety range reversed";
    /// A trigger beyond 65535 g.
    TRIGGER_TOO_LARGE = "trigger_grams too large";
    /// `grams_per_count` is not a fraction.
    GRAMS_PER_COUNT = "grams_per_count is invalid";
}

response! {
    /// Whether the trigger came, and when.
    "load_cell_probe_state oid=%c is_homing_trigger=%c trigger_ticks=%u" => Hosts::of(&[Kalico]);
    pub(super) struct State { oid: Oid, is_homing_trigger: bool, trigger_ticks: u32 }
}

/// Fractional bits of grams, and of grams for each count.
const GRAMS_FRAC_BITS: u32 = 15;
const GRAMS_PER_COUNT_FRAC_BITS: u32 = 29;
const TRIGGER_GRAMS_MAX: u32 = u16::MAX as u32;

// Error codes. The host finds them added to its `error_reason` in the trsync's reason.
const SAFETY_RANGE: u8 = 0;
const OVERFLOW: u8 = 1;
const WATCHDOG: u8 = 2;

const TIMER: Timer = Timer::exact(0);

/// The host's settings for the sensor.
#[derive(Default)]
struct Limits {
    /// A sample at or beyond these is an error.
    counts_min: i32,
    counts_max: i32,
    tare_counts: i32,
    /// Has [`GRAMS_FRAC_BITS`] fractional bits.
    trigger_grams: i32,
    /// Has [`GRAMS_PER_COUNT_FRAC_BITS`] fractional bits.
    grams_per_count: i32,
}

impl Limits {
    /// The weight of a sample. `None`: it does not fit.
    fn grams(&self, counts: i32) -> Option<i32> {
        let delta = counts.wrapping_sub(self.tare_counts);
        let product = i64::from(delta) * i64::from(self.grams_per_count);
        i32::try_from(product >> (GRAMS_PER_COUNT_FRAC_BITS - GRAMS_FRAC_BITS)).ok()
    }
}

/// The state of homing.
struct Homing {
    trsync: Oid,
    trigger_reason: u8,
    error_reason: u8,
    /// Whether every sample so far was from before `begin`.
    awaits: bool,
    begin: Clock,
    rest_ticks: Ticks,
    /// Highest number of watchdog turns without a sample. One more is an error.
    watchdog_max: u8,
    watchdog_count: u8,
}

pub(super) struct LoadCellProbe {
    filter: Oid,
    limits: Limits,
    /// `None`: samples are not checked.
    homing: Option<Homing>,
    /// When the trigger came.
    triggered: Option<Clock>,
}

impl LoadCellProbe {
    /// Processes a sample of the sensor, read at `at`.
    pub(super) fn update(&mut self, context: &mut Context, sample: i32, at: Clock) -> Result<(), Shutdown> {
        let Some(homing) = &mut self.homing else { return Ok(()) };
        homing.watchdog_count = 0;
        if homing.awaits && at < homing.begin {
            return Ok(());
        }
        homing.awaits = false;
        // The safe range does not include its ends.
        if sample <= self.limits.counts_min || sample >= self.limits.counts_max {
            return homing.fail(context, SAFETY_RANGE);
        }
        let Some(grams) = self.limits.grams(sample) else { return homing.fail(context, OVERFLOW) };
        let filtered = context.with::<SosFilter, _>(self.filter, |filter, _| filter.apply_scaled(grams))?;
        // The first trigger counts. Samples are still checked until the host ends that.
        if filtered.wrapping_abs() < self.limits.trigger_grams || self.triggered.is_some() {
            return Ok(());
        }
        self.triggered = Some(at);
        homing.pull(context, homing.trigger_reason)
    }
}

impl Homing {
    fn fail(&self, context: &mut Context, error: u8) -> Result<(), Shutdown> {
        self.pull(context, self.error_reason.wrapping_add(error))
    }

    fn pull(&self, context: &mut Context, reason: u8) -> Result<(), Shutdown> {
        context.with::<Trsync, _>(self.trsync, |trsync, context| trsync.trigger(context, reason))
    }
}

impl Object for LoadCellProbe {
    fn kind(&self) -> &'static str {
        "load cell probe"
    }

    /// Checks whether the sensor is silent.
    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let Some(homing) = self.homing.as_mut().filter(|_| self.triggered.is_none()) else { return Ok(Next::Done) };
        if homing.watchdog_count > homing.watchdog_max {
            homing.fail(context, WATCHDOG)?;
        }
        homing.watchdog_count = homing.watchdog_count.wrapping_add(1);
        Ok(Next::At(at + homing.rest_ticks))
    }
}

const CONFIG_LOAD_CELL_PROBE: Command =
    command!("config_load_cell_probe oid=%c sos_filter_oid=%c", |context, oid: Oid, sos_filter_oid: Oid| {
        context.require::<SosFilter>(sos_filter_oid)?;
        let limits = Limits::default();
        context.assign(oid, LoadCellProbe { filter: sos_filter_oid, limits, homing: None, triggered: None })
    })
    .of(&[Kalico]);

const LOAD_CELL_PROBE_SET_RANGE: Command = command!(
    "load_cell_probe_set_range oid=%c safety_counts_min=%i safety_counts_max=%i tare_counts=%i trigger_grams=%u grams_per_count=%i",
    LoadCellProbe,
    |probe,
     _,
     safety_counts_min: i32,
     safety_counts_max: i32,
     tare_counts: i32,
     trigger_grams: u32,
     grams_per_count: i32| {
        let refuse = |reason, what: String| Err(Shutdown::by_host(reason, what));
        if safety_counts_max < safety_counts_min {
            return refuse(RANGE_REVERSED, format!("counts of {safety_counts_min} to {safety_counts_max} are to be safe"));
        }
        if trigger_grams > TRIGGER_GRAMS_MAX {
            return refuse(TRIGGER_TOO_LARGE, format!("{trigger_grams} g are above {TRIGGER_GRAMS_MAX}"));
        }
        if !(0..1 << GRAMS_PER_COUNT_FRAC_BITS).contains(&grams_per_count) {
            return refuse(GRAMS_PER_COUNT, format!("{grams_per_count} is not a fraction of 2^29"));
        }
        probe.limits = Limits {
            counts_min: safety_counts_min,
            counts_max: safety_counts_max,
            tare_counts,
            trigger_grams: (trigger_grams << GRAMS_FRAC_BITS) as i32,
            grams_per_count,
        };
        Ok(())
    }
)
.of(&[Kalico]);

const LOAD_CELL_PROBE_HOME: Command = command!(
    "load_cell_probe_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u rest_ticks=%u timeout=%u",
    LoadCellProbe,
    |probe,
     context,
     trsync_oid: Oid,
     trigger_reason: u8,
     error_reason: u8,
     clock: WireClock,
     rest_ticks: Ticks,
     timeout: u32| {
        let begin = context.instant(clock);
        context.cancel(TIMER);
        (probe.homing, probe.triggered) = (None, None);
        // The host ends probing this way.
        if error_reason == 0 {
            return Ok(());
        }
        context.require::<Trsync>(trsync_oid)?;
        probe.homing = Some(Homing {
            trsync: trsync_oid,
            trigger_reason,
            error_reason,
            awaits: true,
            begin,
            rest_ticks,
            // Klipper's C keeps its low byte.
            watchdog_max: timeout as u8,
            watchdog_count: 0,
        });
        context.schedule(TIMER, begin)
    }
)
.of(&[Kalico]);

const LOAD_CELL_PROBE_QUERY_STATE: Command =
    command!("load_cell_probe_query_state oid=%c", LoadCellProbe, |probe, context| {
        let trigger_ticks = probe.triggered.map_or(0, Clock::wire);
        context.send(State { oid: context.oid(), is_homing_trigger: probe.triggered.is_some(), trigger_ticks });
        Ok(())
    })
    .of(&[Kalico]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_become_grams_with_15_fractional_bits() {
        let limits = Limits { tare_counts: 1000, grams_per_count: 1 << 28, ..Limits::default() };
        assert_eq!(limits.grams(1000), Some(0));
        assert_eq!(limits.grams(1001), Some(1 << 14), "half a gram");
        assert_eq!(limits.grams(-1000), Some(-1000 << 15));
        assert_eq!(limits.grams(1000 + 131_071), Some(131_071 << 14));
        assert_eq!(limits.grams(1000 + 131_072), None);
        assert_eq!(limits.grams(1000 - 131_072), Some(i32::MIN));
        // A shift rounds down.
        let small = Limits { grams_per_count: 1, ..Limits::default() };
        assert_eq!((small.grams(1), small.grams(-1), small.grams(1 << 14)), (Some(0), Some(-1), Some(1)));
    }
}
