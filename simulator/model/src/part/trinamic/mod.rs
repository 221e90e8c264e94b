// SPDX-License-Identifier: GPL-3.0-or-later
//! The common part of Trinamic's stepper drivers: registers (`registers.rs`), the microstep counter and its wave, the
//! time between steps, and StallGuard's output.
//!
//! StallGuard measures how far the load turns the rotor back from the field. Here a free motor has no load. A motor
//! that drives against the end of its axis has a load that grows with each lost step. It reaches the full torque after
//! a full step. So the measured value follows each step. In the real chips it follows each full step only.

pub(crate) mod registers;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::description::axes::End;
use crate::engine::motion::Axis;
use crate::engine::wire::{Kind, Wire};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock};

/// The internal clock.
const CLOCK_HZ: u64 = 12_000_000;
/// TSTEP at standstill. After this many clocks without a step the motor counts as standing still.
pub(crate) const STANDSTILL: u32 = 0xf_ffff;
/// Places of the wave table in a full step.
const FULL_STEP: u64 = 256;
/// The load of a stalled motor.
pub(crate) const FULL_LOAD: u32 = 1000;

/// Says in a driver's section that klippy can run without the section.
pub(crate) fn may_be_left_out(cfg: &mut Sections) {
    cfg.comment("The motor turns without this section, too. When you take it out, restart Pinion: the chip");
    cfg.comment("keeps its settings, and then takes each pulse for two steps.");
}

/// Offers the sections for homing by the driver instead of the endstop: the axis then moves until it hits its end.
pub(crate) fn offer_sensorless_homing(
    cfg: &mut Sections,
    layout: &Layout<'_>,
    driver: &str,
    axis: &str,
    (sensitivity, value): (&str, u32),
) {
    let config = layout.printer.axis(axis).filter(|_| layout.is_homed(axis));
    let Some((config, travel_mm)) = config.and_then(|config| Some((config, config.travel_mm?))) else { return };
    let stepper = layout.stepper(axis);
    cfg.comment("To home without the endstop, by the load (these keys replace those above, which may stay):");
    cfg.offer(|cfg| {
        cfg.section(&stepper);
        cfg.key("endstop_pin", format_args!("{driver}_{stepper}:virtual_endstop"));
        let (limit, end_mm) = match config.endstop_at {
            End::Min => ("position_min", -config.overtravel_mm),
            End::Max => ("position_max", travel_mm + config.overtravel_mm),
        };
        cfg.key("position_endstop", end_mm);
        cfg.key(limit, end_mm);
        cfg.key("homing_retract_dist", 0);
        cfg.section(format_args!("{driver} {stepper}"));
        cfg.key(sensitivity, value);
    });
}

/// The motor as its driver sees it.
pub(crate) struct Motor {
    pub(crate) axis: Arc<Axis>,
    /// The size of a step as a power of two of 256th full steps (MRES).
    mres: u32,
    /// Whether the counter runs backward (SHAFT).
    reversed: bool,
    /// The motor's steps and the microstep counter when one of these settings last changed.
    origin: (i64, u32),
}

impl Motor {
    pub(crate) fn new(axis: Arc<Axis>) -> Motor {
        let origin = (axis.turned_steps(), 0);
        Motor { axis, mres: 8, reversed: false, origin }
    }

    /// Sets the size and the direction of the following steps.
    pub(crate) fn set_up(&mut self, mres: u32, reversed: bool) {
        self.origin = (self.axis.turned_steps(), self.mscnt());
        self.mres = mres.min(8);
        self.reversed = reversed;
    }

    /// The place in the wave table, 1024 for four full steps. It rises while DIR is low.
    pub(crate) fn mscnt(&self) -> u32 {
        let (step, mscnt) = self.origin;
        let went = self.axis.turned_steps().wrapping_sub(step) << self.mres;
        let went = if self.reversed { went.wrapping_neg() } else { went };
        i64::from(mscnt).wrapping_add(went) as u32 & 0x3ff
    }

    /// The clocks between two 256th of a full step (TSTEP).
    pub(crate) fn tstep(&self, now: Clock) -> u32 {
        tstep(&self.axis, self.mres, now)
    }

    /// The motor's load, up to [`FULL_LOAD`].
    pub(crate) fn load(&self, now: Clock) -> u32 {
        load(&self.axis, self.mres, now)
    }

    pub(crate) fn mres(&self) -> u32 {
        self.mres
    }

    /// The actual currents of the two phases (MSCURACT): sine and cosine of the place in the wave table.
    pub(crate) fn currents(&self, wave: &Wave) -> u32 {
        let current = |microstep| wave.at(microstep) as u32 & 0x1ff;
        current(self.mscnt() + 256) << 16 | current(self.mscnt())
    }
}

fn tstep(axis: &Axis, mres: u32, now: Clock) -> u32 {
    let clocks = axis.stride(now).ticks.saturating_mul(CLOCK_HZ) / u64::from(CLOCK_FREQ);
    if clocks > u64::from(STANDSTILL) {
        return STANDSTILL;
    }
    u32::try_from(clocks >> mres).unwrap_or(STANDSTILL)
}

fn load(axis: &Axis, mres: u32, now: Clock) -> u32 {
    let back = axis.stride(now).lost_in_a_row.saturating_mul(1 << mres).min(FULL_STEP);
    back as u32 * FULL_LOAD / FULL_STEP as u32
}

/// A sine as increments between the places of its first quarter. It has four segments with their own widths ("Sine-Wave
/// Look-up Table").
pub(crate) struct Wave {
    /// MSLUT: a bit for each increment.
    pub(crate) increments: [u32; 8],
    /// MSLUTSEL: the segments' widths and bounds.
    pub(crate) segments: u32,
    /// MSLUTSTART: the sine's value at 0 and at 90 degrees.
    pub(crate) start: u32,
}

impl Wave {
    /// The wave at power-up. Drivers without wave registers always use it.
    pub(crate) const DEFAULT: Wave = Wave {
        increments: [
            0xaaaa_b554,
            0x4a95_54aa,
            0x2449_2929,
            0x1010_4222,
            0xfbff_ffff,
            0xb5bb_777d,
            0x4929_5556,
            0x0040_4222,
        ],
        segments: 0xffff_8056,
        start: 0x00f7_0000,
    };

    /// The value, -255 to 255, at a place in the wave.
    pub(crate) fn at(&self, microstep: u32) -> i32 {
        let (quarter, place) = (microstep >> 8 & 3, microstep & 0xff);
        let place = if quarter & 1 == 0 { place } else { 256 - place };
        let bounds = [8, 16, 24].map(|shift| self.segments >> shift & 0xff);
        let increment = |at: u32| {
            let segment = bounds.iter().filter(|bound| at >= **bound).count() as u32;
            let width = self.segments >> (2 * segment) & 3;
            let bit = self.increments[(at / 32) as usize] >> (at % 32) & 1;
            (width + bit) as i32 - 1
        };
        let value = match place {
            256 => (self.start >> 16 & 0xff) as i32,
            _ => (self.start & 0xff) as i32 + (0..place).map(increment).sum::<i32>(),
        };
        if quarter < 2 { value } else { -value }
    }
}

/// When a driver reports that its motor is stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StallRule {
    /// `None` if it never reports a stall.
    pub(crate) least_load: Option<u32>,
    /// The range of TSTEP in which the driver checks.
    pub(crate) fastest: u32,
    pub(crate) slowest: u32,
    pub(crate) mres: u32,
    /// Whether the pin is driven high for a stall. Otherwise it is an open drain, and low for a stall.
    pub(crate) push_pull: bool,
}

/// A driver's output for a stall (DIAG). The core reads it, so the rule is one word.
pub(crate) struct StallOutput {
    name: String,
    axis: Arc<Axis>,
    rule: AtomicU64,
}

/// Means "no least load". No motor has this load.
const NO_LOAD: u32 = 0x3ff;

impl StallOutput {
    pub(crate) fn new(name: String, axis: Arc<Axis>, rule: StallRule) -> StallOutput {
        let output = StallOutput { name, axis, rule: AtomicU64::new(0) };
        output.set(rule);
        output
    }

    pub(crate) fn set(&self, rule: StallRule) {
        let StallRule { least_load, fastest, slowest, mres, push_pull } = rule;
        let load = least_load.unwrap_or(NO_LOAD).min(NO_LOAD);
        let [fastest, slowest] = [fastest, slowest].map(|tstep| u64::from(tstep.min(STANDSTILL)));
        let low = u64::from(load) | u64::from(mres) << 10 | u64::from(push_pull) << 14;
        self.rule.store(low | fastest << 20 | slowest << 40, Ordering::Relaxed);
    }

    fn rule(&self) -> StallRule {
        let word = self.rule.load(Ordering::Relaxed);
        let bits = |from: u32, count: u32| (word >> from) as u32 & ((1 << count) - 1);
        StallRule {
            least_load: Some(bits(0, 10)).filter(|load| *load != NO_LOAD),
            fastest: bits(20, 20),
            slowest: bits(40, 20),
            mres: bits(10, 4),
            push_pull: bits(14, 1) != 0,
        }
    }

    /// Whether the driver sees the motor as stalled.
    pub(crate) fn is_stalled(&self, now: Clock) -> bool {
        let StallRule { least_load, fastest, slowest, mres, .. } = self.rule();
        let tstep = tstep(&self.axis, mres, now);
        let looks = tstep != STANDSTILL && (fastest..=slowest).contains(&tstep) && self.axis.is_enabled();
        looks && least_load.is_some_and(|least| load(&self.axis, mres, now) >= least)
    }
}

impl Wire for StallOutput {
    fn kind(&self) -> Kind {
        Kind::Input
    }

    fn describe(&self) -> String {
        format!("diag of {}", self.name)
    }

    fn sense(&self, _driven: bool, at: Clock) -> bool {
        self.is_stalled(at) == self.rule().push_pull
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;

    #[test]
    fn the_wave_of_power_up_is_a_sine() {
        for microstep in 0..1024 {
            let angle = f64::from(microstep) * std::f64::consts::TAU / 1024.0;
            let value = f64::from(Wave::DEFAULT.at(microstep));
            assert!((value - 247.5 * angle.sin()).abs() < 1.5, "{microstep}: {value}");
        }
    }

    #[test]
    fn a_stall_is_reported_while_the_motor_drives_against_its_end_within_the_velocities() {
        let mut config = DefaultPrinter::read();
        config.axes[0].start_mm = 0.0;
        config.axes[0].overtravel_mm = 0.0;
        let axis = Arc::new(Axis::new(&config.axes[0]));
        axis.set_enabled(true);
        // 16 microsteps, each 250 us: 3000 clocks, of 16 parts each.
        let rule = StallRule { least_load: Some(500), fastest: 0, slowest: 187, mres: 4, push_pull: true };
        let output = StallOutput::new("x".into(), axis.clone(), rule);
        assert_eq!(output.rule(), rule);
        let mut now = Clock::EPOCH;
        let mut step = |forward: bool| {
            now = now + pinion_firmware::time::Ticks::from_us(250);
            axis.set_forward(forward);
            axis.edge(true, now);
            axis.edge(false, now);
            now
        };
        for _ in 0..20 {
            assert!(!output.is_stalled(step(true)));
        }
        for _ in 0..20 {
            assert!(!output.is_stalled(step(false)), "at its end");
        }
        for lost in 1..=20 {
            assert_eq!(output.is_stalled(step(false)), lost >= 8, "after {lost} lost steps of 16 in a full one");
        }
        let now = step(false);
        assert!(output.sense(false, now));
        assert!(!output.sense(false, now + pinion_firmware::time::Ticks::from_us(251)), "too slow");
        for other in [
            StallRule { fastest: 188, slowest: STANDSTILL, ..rule },
            StallRule { slowest: 186, ..rule },
            StallRule { least_load: None, ..rule },
        ] {
            output.set(other);
            assert!(!output.sense(false, now), "{other:?}");
        }
        output.set(StallRule { push_pull: false, ..rule });
        assert!(!output.sense(false, now), "an open drain pulls down");
        axis.set_enabled(false);
        assert!(output.sense(false, now));
    }
}
