// SPDX-License-Identifier: GPL-3.0-or-later
//! The demonstration. It identifies an MCU, configures it, homes its axes, heats its bed, and checks each result.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

mod heater;

use heater::Heater;
use pinion::terminal::ERASE_LINE;
use pinion_client::config::Config;
use pinion_client::motion::{Endstop, Homed, HomingEnd, MoveQueue, Profile, Sight, Stepper, Watch};
use pinion_client::{Client, Error};
use pinion_linux::foreign::plain;
use pinion_model::{AxisConfig, End, SimConfig};

/// How far an axis looks for its endstop, as a multiple of its travel.
const OVERTRAVEL: f64 = 1.2;
/// Speed of the second approach to the endstop, as a part of the first one's.
const SECOND_SPEED: f64 = 0.5;
/// How far an axis goes back before its second approach.
const RETRACT_MM: f64 = 5.0;
/// Acceleration as a multiple of the speed.
const ACCELERATION_PER_S: f64 = 20.0;
/// Width of a step pulse.
const PULSE_S: f64 = 2e-6;

/// Writes the progress of the demonstration and the results of its checks on stdout. On a terminal the progress is one
/// line that is written over. Elsewhere it is one line a second.
struct Progress {
    /// Whether a line can be written over.
    is_live: bool,
    next: Option<Instant>,
    /// Whether all checks passed.
    passed: bool,
}

impl Progress {
    // Errors are ignored: the demonstration continues even if nobody reads its progress.
    fn write(&self, before: &str, line: &str, after: &str) {
        let mut out = io::stdout();
        let _ = write!(out, "{before}{}{after}", plain(line)).and_then(|()| out.flush());
    }

    /// `what` is under way; `part` of it, 0 to 1, is done.
    fn update(&mut self, what: &str, part: f64, detail: &str) {
        const WIDTH: usize = 24;
        let now = Instant::now();
        if self.next.is_some_and(|next| now < next) {
            return;
        }
        if self.is_live {
            self.next = Some(now + Duration::from_millis(50));
            let full = (part.clamp(0.0, 1.0) * WIDTH as f64).round() as usize;
            let bar = "█".repeat(full) + &"░".repeat(WIDTH - full);
            self.write(&format!("\r{ERASE_LINE}"), &format!("{what:<10} {bar} {detail}"), "");
        } else {
            self.next = Some(now + Duration::from_secs(1));
            self.write("", &format!("{what}: {detail}"), "\n");
        }
    }

    /// A check is done, with the values that were seen.
    fn check(&mut self, what: &str, passed: bool, seen: &str) {
        self.next = None;
        self.passed &= passed;
        let start = if self.is_live { format!("\r{ERASE_LINE}") } else { String::new() };
        let mark = if passed { "ok    " } else { "WRONG " };
        self.write(&start, &format!("{mark}{what}: {seen}"), "\n");
    }
}

/// Carries out the demonstration with a printer's MCU. Returns whether all checks passed.
///
/// # Errors
///
/// The MCU does not answer or shuts down, or has no room for the printer's objects.
pub(crate) fn demonstrate(client: &mut Client, printer: &SimConfig) -> Result<bool, Error> {
    let mut progress = Progress { is_live: io::stdout().is_terminal(), next: None, passed: true };
    let dictionary = client.dictionary();
    let (commands, responses) = (dictionary.commands.len(), dictionary.responses.len());
    let seen = format!(
        "{} {}, {commands} commands, {responses} responses, clock of {} MHz",
        dictionary.app,
        dictionary.version,
        client.frequency_hz() / 1e6
    );
    progress.check("identified", commands > 0 && responses > 0, &seen);

    let mut config = Config::default();
    let axes: Vec<_> =
        homed(printer).map(|axis| Axis::configure(client, &mut config, axis)).collect::<Result<_, _>>()?;
    let bed = printer.heaters.iter().find(|heater| heater.name == "heater_bed");
    let mut heater = bed.and_then(|bed| Heater::configure(client, &mut config, bed)).transpose()?;
    let status = config.apply(client)?;
    let seen = format!("{} commands, check sum {:08x}, {} moves", config.lines().len(), status.crc, status.move_count);
    progress.check("configured", true, &seen);

    let mut queue = MoveQueue::new(status.move_count);
    for axis in &axes {
        axis.home(client, &mut queue, &mut progress)?;
    }
    if let Some(heater) = &mut heater {
        heat(client, heater, &mut progress)?;
    }

    for axis in &axes {
        axis.power(client, false)?;
    }
    let status = client.status()?;
    client.check()?;
    progress.check("no shutdown", !status.is_shutdown, if status.is_shutdown { "it is shut down" } else { "none" });
    Ok(progress.passed)
}

/// The axes that their own motor can home.
fn homed(printer: &SimConfig) -> impl Iterator<Item = &AxisConfig> {
    let is_homed = |axis: &&AxisConfig| axis.travel_mm.is_some() && axis.endstop_pin.is_some();
    printer.axes.iter().filter(|axis| !printer.is_on_belts(&axis.name)).filter(is_homed)
}

/// An axis whose stepper, endstop and motor switch are configured.
struct Axis<'a> {
    axis: &'a AxisConfig,
    travel_mm: f64,
    /// How far the axis is from its endstop at first.
    start_mm: f64,
    stepper: Stepper,
    endstop: Endstop,
    enable: Option<(u8, bool)>,
}

impl<'a> Axis<'a> {
    fn configure(client: &Client, config: &mut Config, axis: &'a AxisConfig) -> Result<Axis<'a>, Error> {
        let (step, dir) = (&axis.step_pin, &axis.dir_pin);
        let invert_step = if axis.step_both_edges { -1 } else { i8::from(step.inverted) };
        let pulse = client.ticks(PULSE_S);
        let stepper = Stepper::configure(config, &step.name, invert_step, &dir.name, dir.inverted, pulse)?;
        let (pin, invert) = axis.endstop_pin.as_ref().map_or(("", false), |pin| (&pin.name, pin.inverted));
        let endstop = Endstop::configure(config, pin, 0, invert)?;
        let enable = match &axis.enable_pin {
            Some(pin) => {
                let (oid, off) = (config.oid()?, u8::from(pin.inverted));
                config.add(format!(
                    "config_digital_out oid={oid} pin={} value={off} default_value={off} max_duration=0",
                    pin.name
                ));
                Some((oid, pin.inverted))
            }
            None => None,
        };
        let max_mm = axis.travel_mm.unwrap_or(axis.min_mm);
        let start_mm = match axis.endstop_at {
            End::Min => axis.start_mm - axis.min_mm,
            End::Max => max_mm - axis.start_mm,
        };
        Ok(Axis { axis, travel_mm: max_mm - axis.min_mm, start_mm, stepper, endstop, enable })
    }

    fn power(&self, client: &mut Client, on: bool) -> Result<(), Error> {
        let Some((oid, invert)) = self.enable else {
            return Ok(());
        };
        client.send("update_digital_out", &[("oid", oid.into()), ("value", (on != invert).into())])
    }

    /// Approaches the endstop, goes back, approaches it again more slowly, and reports on it.
    fn home(&self, client: &mut Client, queue: &mut MoveQueue, progress: &mut Progress) -> Result<(), Error> {
        self.power(client, true)?;
        let from = self.stepper.position(client)?;
        let frequency_hz = client.frequency_hz();
        let what = format!("home {}", self.axis.name);
        let mut trace = AxisProgress { what: &what, axis: self, from, frequency_hz, last: None, progress };
        let speed = self.axis.homing_mm_per_s;
        let first = self.approach(client, queue, self.travel_mm * OVERTRAVEL, speed, &mut trace)?;
        let back = self.profile(client, RETRACT_MM, speed)?;
        let watch = Watch { endstop: self.endstop, seen: &mut |sight| trace.saw(sight) };
        let outwards = self.axis.endstop_at == End::Min;
        queue.run(client, self.stepper, outwards, &back, Some(watch))?;
        let released = !self.endstop.triggered(client)?;
        let far = RETRACT_MM * 2.0;
        let second = self.approach(client, queue, far, speed * SECOND_SPEED, &mut trace)?;

        let (passed, seen) = self.judge(from, first, released, second);
        progress.check(&format!("{} homed", self.axis.name), passed, &seen);
        Ok(())
    }

    /// Whether both approaches ended at the endstop and at the same place, and the values that were seen. The first one
    /// began at position `from`. `released`: the endstop opened in between.
    fn judge(&self, from: i64, first: Homed, released: bool, second: Homed) -> (bool, String) {
        let went = (first.position - from).abs();
        let slack = i64::from(first.slack_steps);
        let apart = (second.position - first.position).abs();
        let expected = (self.start_mm * self.axis.steps_per_mm).round() as i64;
        let mut passed = first.reason == HomingEnd::Endstop && second.reason == HomingEnd::Endstop && released;
        passed &= apart <= slack && (went - expected).abs() <= slack;
        let mut seen = format!(
            "endstop after {went} steps ({expected} expected), the second time {apart} steps off, at most {slack} allowed"
        );
        for (homed, time) in [(first, "first"), (second, "second")] {
            if homed.reason != HomingEnd::Endstop {
                seen += &format!("; the {time} time it ended by {:?}", homed.reason);
            }
        }
        if !released {
            seen += "; the endstop stayed triggered when the axis went back";
        }
        (passed, seen)
    }

    fn approach(
        &self,
        client: &mut Client,
        queue: &mut MoveQueue,
        far_mm: f64,
        speed_mm_s: f64,
        trace: &mut AxisProgress<'_>,
    ) -> Result<Homed, Error> {
        let profile = self.profile(client, far_mm, speed_mm_s)?;
        let is_up = self.axis.endstop_at == End::Max;
        queue.home(client, self.stepper, self.endstop, is_up, &profile, &mut |sight| trace.saw(sight))
    }

    fn profile(&self, client: &Client, mm: f64, speed_mm_s: f64) -> Result<Profile, Error> {
        let AxisConfig { steps_per_mm, homing_mm_per_s, .. } = self.axis;
        Profile::trapezoid(
            (mm * steps_per_mm).round() as u32,
            speed_mm_s * steps_per_mm,
            ACCELERATION_PER_S * homing_mm_per_s * steps_per_mm,
            client.frequency_hz(),
        )
    }
}

/// Shows an axis while it moves.
struct AxisProgress<'a> {
    what: &'a str,
    axis: &'a Axis<'a>,
    from: i64,
    frequency_hz: f64,
    last: Option<Sight>,
    progress: &'a mut Progress,
}

impl AxisProgress<'_> {
    fn saw(&mut self, sight: Sight) {
        let mm = (sight.position - self.from) as f64 / self.axis.axis.steps_per_mm;
        let rate = self.last.map_or(0.0, |last| rate(last, sight, self.frequency_hz));
        let endstop = if sight.triggered { "closed" } else { "open" };
        self.progress.update(
            self.what,
            mm.abs() / self.axis.start_mm,
            &format!("{mm:+8.2} mm  {:6.0} steps/s  endstop {endstop}", rate.abs()),
        );
        self.last = Some(sight);
    }
}

fn rate(earlier: Sight, later: Sight, frequency_hz: f64) -> f64 {
    let ticks = later.clock.since(earlier.clock);
    if ticks <= 0 {
        return 0.0;
    }
    (later.position - earlier.position) as f64 / ticks as f64 * frequency_hz
}

fn heat(client: &mut Client, heater: &mut Heater<'_>, progress: &mut Progress) -> Result<(), Error> {
    let (what, done) = (format!("heat {}", heater.name()), format!("{} at target", heater.name()));
    let target_c = heater.target_c();
    let mut first_c = None;
    let result = heater.heat(client, &mut |celsius, power| {
        let first_c = *first_c.get_or_insert(celsius);
        progress.update(
            &what,
            (celsius - first_c) / (target_c - first_c).max(1.0),
            &format!("{celsius:6.1} °C of {target_c:.0} °C  power {:3.0} %", power * 100.0),
        );
    });
    match result {
        Ok(celsius) => {
            let (tolerance, hold) = (heater::TOLERANCE_C, heater::HOLD_S);
            let seen = format!("{celsius:.1} °C of {target_c:.0} ± {tolerance:.1} °C for {hold:.0} s");
            progress.check(&done, true, &seen);
        }
        Err(Error::Plan { why, .. }) => progress.check(&done, false, &why),
        Err(error) => return Err(error),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_with_an_endstop_is_homed() {
        let printer = SimConfig::default_printer();
        assert_eq!(homed(&printer).map(|axis| axis.name.as_str()).collect::<Vec<_>>(), ["x", "y", "z"]);
    }
}
