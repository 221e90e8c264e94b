// SPDX-License-Identifier: GPL-3.0-or-later
//! The demonstration. It identifies an MCU, configures it, homes its axes, heats its bed, and checks each result.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

pub(crate) mod heater;

use heater::{Goal, Heater, Wiring};
use pinion::cli::terminal::ERASE_LINE;
use pinion_client::config::Config;
use pinion_client::motion::{Endstop, Homed, HomingEnd, MoveQueue, Profile, Sight, Stepper, Watch};
use pinion_client::{Client, Error};
use pinion_linux::foreign::plain;
use pinion_model::Thermistor;

/// How far an axis looks for its endstop, as a multiple of its travel.
const OVERTRAVEL: f64 = 1.2;
/// Speed of the second approach to the endstop, as a part of the first one's.
const SECOND_SPEED: f64 = 0.5;

/// A pin by its name, and whether it is inverted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NamedPin {
    /// A name of the dictionary's enumeration `pin`.
    pub name: String,
    /// Whether a low level means on.
    pub invert: bool,
}

/// An axis.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisPlan {
    /// Its name for people.
    pub name: String,
    /// The step pin.
    pub step: NamedPin,
    /// The direction pin.
    pub dir: NamedPin,
    /// The pin that powers the motor, if there is one.
    pub enable: Option<NamedPin>,
    /// The endstop's pin.
    pub endstop: NamedPin,
    /// The endstop's resistor: 1 pulls up, -1 down, 0 is none.
    pub endstop_pull: i8,
    /// Steps per millimeter.
    pub steps_per_mm: f64,
    /// Whether the driver steps on both edges.
    pub both_edges: bool,
    /// Width of a step pulse in microseconds.
    pub pulse_us: f64,
    /// How far the axis can go, in millimeters.
    pub travel_mm: f64,
    /// How far the axis is from the endstop at first, in millimeters, if that is known.
    pub start_mm: Option<f64>,
    /// Whether the endstop is at the highest position.
    pub home_positive: bool,
    /// Speed towards the endstop, in mm/s.
    pub speed_mm_s: f64,
    /// Acceleration in mm/s².
    pub acceleration_mm_s2: f64,
    /// How far the axis goes back before its second approach, in millimeters.
    pub retract_mm: f64,
}

/// A heater.
#[derive(Clone, Debug, PartialEq)]
pub struct HeaterPlan {
    /// Its name for people.
    pub name: String,
    /// The output's pin.
    pub heater: NamedPin,
    /// The sensor's pin.
    pub sensor: String,
    /// The sensor.
    pub thermistor: Thermistor,
    /// Degrees Celsius below which the MCU shuts down.
    pub min_c: f64,
    /// Degrees Celsius above which the MCU shuts down.
    pub max_c: f64,
    /// The goal to reach.
    pub goal: Goal,
}

/// The plan of a demonstration.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// The axes, homed in this order.
    pub axes: Vec<AxisPlan>,
    /// The heater, if there is one.
    pub heater: Option<HeaterPlan>,
}

/// A check, and its result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Check {
    /// The subject of the check.
    pub what: String,
    /// Whether it passed.
    pub passed: bool,
    /// The values that were seen.
    pub seen: String,
}

/// The result of the demonstration.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// The program at the other end.
    pub app: String,
    /// Its version.
    pub version: String,
    /// All checks.
    pub checks: Vec<Check>,
}

impl Report {
    /// Whether all checks passed.
    pub fn passed(&self) -> bool {
        self.checks.iter().all(|check| check.passed)
    }

    fn check(&mut self, progress: &mut dyn Observer, what: String, passed: bool, seen: String) {
        let check = Check { what, passed, seen };
        progress.checked(&check);
        self.checks.push(check);
    }
}

/// Gets the progress of the demonstration.
pub trait Observer {
    /// `what` is under way; `part` of it, 0 to 1, is done.
    fn update(&mut self, what: &str, part: f64, detail: &str);
    /// A check is done.
    fn checked(&mut self, check: &Check);
}

/// Writes the progress of the demonstration. On a terminal it is one line that is written over. Elsewhere it is one
/// line a second.
#[derive(Debug)]
pub struct ProgressLines<W: Write> {
    out: W,
    live: bool,
    next: Option<Instant>,
}

impl ProgressLines<io::Stdout> {
    /// Writes to standard output.
    pub fn stdout() -> ProgressLines<io::Stdout> {
        let out = io::stdout();
        let live = out.is_terminal();
        ProgressLines::new(out, live)
    }
}

impl<W: Write> ProgressLines<W> {
    /// Writes to `out`. `live`: a line there can be written over.
    pub fn new(out: W, live: bool) -> ProgressLines<W> {
        ProgressLines { out, live, next: None }
    }

    // Errors are ignored: the demonstration continues even if nobody reads its progress.
    fn write(&mut self, before: &str, line: &str, after: &str) {
        let _ = write!(self.out, "{before}{}{after}", plain(line)).and_then(|()| self.out.flush());
    }
}

impl<W: Write> Observer for ProgressLines<W> {
    fn update(&mut self, what: &str, part: f64, detail: &str) {
        const WIDTH: usize = 24;
        let now = Instant::now();
        if self.next.is_some_and(|next| now < next) {
            return;
        }
        if self.live {
            self.next = Some(now + Duration::from_millis(50));
            let full = (part.clamp(0.0, 1.0) * WIDTH as f64).round() as usize;
            let bar = "█".repeat(full) + &"░".repeat(WIDTH - full);
            self.write(&format!("\r{ERASE_LINE}"), &format!("{what:<10} {bar} {detail}"), "");
        } else {
            self.next = Some(now + Duration::from_secs(1));
            self.write("", &format!("{what}: {detail}"), "\n");
        }
    }

    fn checked(&mut self, check: &Check) {
        self.next = None;
        let start = if self.live { format!("\r{ERASE_LINE}") } else { String::new() };
        let mark = if check.passed { "ok    " } else { "WRONG " };
        self.write(&start, &format!("{mark}{}: {}", check.what, check.seen), "\n");
    }
}

/// An axis whose stepper, endstop and motor switch are configured.
struct Axis<'a> {
    plan: &'a AxisPlan,
    stepper: Stepper,
    endstop: Endstop,
    enable: Option<(u8, bool)>,
}

/// Carries out the plan. Checks that failed are in the report.
///
/// # Errors
///
/// The MCU does not answer or shuts down, or the plan cannot be carried out.
pub fn demonstrate(client: &mut Client, plan: &Plan, progress: &mut dyn Observer) -> Result<Report, Error> {
    let dictionary = client.dictionary();
    let mut report = Report { app: dictionary.app.clone(), version: dictionary.version.clone(), ..Report::default() };
    let (commands, responses) = (dictionary.commands.len(), dictionary.responses.len());
    let seen = format!(
        "{} {}, {commands} commands, {responses} responses, clock of {} MHz",
        report.app,
        report.version,
        client.frequency_hz() / 1e6
    );
    let known = commands > 0 && responses > 0;
    report.check(progress, "identified".to_owned(), known, seen);

    let mut config = Config::default();
    let axes: Vec<_> =
        plan.axes.iter().map(|axis| Axis::configure(client, &mut config, axis)).collect::<Result<_, _>>()?;
    let mut heater = match &plan.heater {
        Some(plan) => Some((plan, configure_heater(client, &mut config, plan)?)),
        None => None,
    };
    let status = config.apply(client)?;
    let seen = format!("{} commands, check sum {:08x}, {} moves", config.lines().len(), status.crc, status.move_count);
    report.check(progress, "configured".to_owned(), true, seen);

    let mut queue = MoveQueue::new(status.move_count);
    for axis in &axes {
        axis.home(client, &mut queue, &mut report, progress)?;
    }
    if let Some((plan, heater)) = &mut heater {
        heat(client, plan, heater, &mut report, progress)?;
    }

    for axis in &axes {
        axis.power(client, false)?;
    }
    let status = client.status()?;
    client.check()?;
    let seen = if status.is_shutdown { "it is shut down" } else { "none" };
    report.check(progress, "no shutdown".to_owned(), !status.is_shutdown, seen.to_owned());
    Ok(report)
}

impl<'a> Axis<'a> {
    fn configure(client: &Client, config: &mut Config, plan: &'a AxisPlan) -> Result<Axis<'a>, Error> {
        let positive = [
            ("steps/mm", plan.steps_per_mm),
            ("travel", plan.travel_mm),
            ("speed", plan.speed_mm_s),
            ("acceleration", plan.acceleration_mm_s2),
            ("retract", plan.retract_mm),
        ];
        if let Some((what, value)) = positive.iter().find(|(_, v)| *v <= 0.0 || v.is_nan()) {
            return Err(Error::Plan {
                subject: format!("axis {}", plan.name),
                why: format!("its {what} is {value}: give it one above zero"),
            });
        }
        let invert_step = if plan.both_edges { -1 } else { i8::from(plan.step.invert) };
        let stepper = Stepper::configure(
            config,
            &plan.step.name,
            invert_step,
            &plan.dir.name,
            plan.dir.invert,
            client.ticks(plan.pulse_us * 1e-6),
        )?;
        let endstop = Endstop::configure(config, &plan.endstop.name, plan.endstop_pull, plan.endstop.invert)?;
        let enable = match &plan.enable {
            Some(pin) => {
                let oid = config.oid()?;
                let off = u8::from(pin.invert);
                config.add(format!(
                    "config_digital_out oid={oid} pin={} value={off} default_value={off} \
                     max_duration=0",
                    pin.name
                ));
                Some((oid, pin.invert))
            }
            None => None,
        };
        Ok(Axis { plan, stepper, endstop, enable })
    }

    fn power(&self, client: &mut Client, on: bool) -> Result<(), Error> {
        let Some((oid, invert)) = self.enable else {
            return Ok(());
        };
        client.send("update_digital_out", &[("oid", oid.into()), ("value", (on != invert).into())])
    }

    /// Approaches the endstop, goes back, approaches it again more slowly, and reports on it.
    fn home(
        &self,
        client: &mut Client,
        queue: &mut MoveQueue,
        report: &mut Report,
        progress: &mut dyn Observer,
    ) -> Result<(), Error> {
        let plan = self.plan;
        let what = format!("home {}", plan.name);
        self.power(client, true)?;
        let from = self.stepper.position(client)?;
        let mut trace = AxisProgress {
            what: &what,
            steps_per_mm: plan.steps_per_mm,
            full_mm: plan.start_mm.unwrap_or(plan.travel_mm),
            from,
            frequency_hz: client.frequency_hz(),
            last: None,
            progress,
        };
        let speed = plan.speed_mm_s;
        let first = self.approach(client, queue, plan.travel_mm * OVERTRAVEL, speed, &mut trace)?;
        let back = self.profile(client, plan.retract_mm, speed)?;
        let watch = Watch { endstop: self.endstop, seen: &mut |sight| trace.saw(sight) };
        let outwards = !plan.home_positive;
        queue.run(client, self.stepper, outwards, &back, Some(watch))?;
        let released = !self.endstop.triggered(client)?;
        let far = plan.retract_mm * 2.0;
        let second = self.approach(client, queue, far, speed * SECOND_SPEED, &mut trace)?;

        let (passed, seen) = self.judge(from, first, released, second);
        report.check(progress, format!("{} homed", plan.name), passed, seen);
        Ok(())
    }

    /// Whether both approaches ended at the endstop and at the same place, and the values that were seen. The first one
    /// began at position `from`. `released`: the endstop opened in between.
    fn judge(&self, from: i64, first: Homed, released: bool, second: Homed) -> (bool, String) {
        let went = (first.position - from).abs();
        let slack = i64::from(first.slack_steps);
        let apart = (second.position - first.position).abs();
        let mut passed = first.reason == HomingEnd::Endstop && second.reason == HomingEnd::Endstop && released;
        passed &= apart <= slack;
        let mut seen = format!("endstop after {went} steps");
        if let Some(start_mm) = self.plan.start_mm {
            let expected = (start_mm * self.plan.steps_per_mm).round() as i64;
            passed &= (went - expected).abs() <= slack;
            seen += &format!(" ({expected} expected)");
        }
        seen += &format!(", the second time {apart} steps off, at most {slack} allowed");
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
        queue.home(client, self.stepper, self.endstop, self.plan.home_positive, &profile, &mut |sight| trace.saw(sight))
    }

    fn profile(&self, client: &Client, mm: f64, speed_mm_s: f64) -> Result<Profile, Error> {
        let plan = self.plan;
        Profile::trapezoid(
            (mm * plan.steps_per_mm).round() as u32,
            speed_mm_s * plan.steps_per_mm,
            plan.acceleration_mm_s2 * plan.steps_per_mm,
            client.frequency_hz(),
        )
    }
}

/// Shows the observer an axis while it moves.
struct AxisProgress<'a> {
    what: &'a str,
    steps_per_mm: f64,
    full_mm: f64,
    from: i64,
    frequency_hz: f64,
    last: Option<Sight>,
    progress: &'a mut dyn Observer,
}

impl AxisProgress<'_> {
    fn saw(&mut self, sight: Sight) {
        let mm = (sight.position - self.from) as f64 / self.steps_per_mm;
        let rate = self.last.map_or(0.0, |last| rate(last, sight, self.frequency_hz));
        let endstop = if sight.triggered { "closed" } else { "open" };
        self.progress.update(
            self.what,
            mm.abs() / self.full_mm,
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

fn configure_heater(client: &Client, config: &mut Config, plan: &HeaterPlan) -> Result<Heater, Error> {
    let thermistor = plan.thermistor;
    Heater::configure(
        client,
        config,
        Wiring {
            heater_pin: plan.heater.name.clone(),
            invert: plan.heater.invert,
            sensor_pin: plan.sensor.clone(),
            min_c: plan.min_c,
            max_c: plan.max_c,
        },
        Box::new(move |fraction| thermistor.celsius(fraction)),
    )
}

fn heat(
    client: &mut Client,
    plan: &HeaterPlan,
    heater: &mut Heater,
    report: &mut Report,
    progress: &mut dyn Observer,
) -> Result<(), Error> {
    let what = format!("heat {}", plan.name);
    let goal = plan.goal;
    let mut first_c = None;
    let result = heater.heat(client, goal, &mut |reading| {
        let first_c = *first_c.get_or_insert(reading.celsius);
        let (celsius, target_c) = (reading.celsius, goal.target_c);
        progress.update(
            &what,
            (celsius - first_c) / (target_c - first_c).max(1.0),
            &format!("{celsius:6.1} °C of {target_c:.0} °C  power {:3.0} %", reading.power * 100.0),
        );
    });
    let (passed, seen) = match result {
        Ok(reading) => (
            true,
            format!(
                "{:.1} °C of {:.0} ± {:.1} °C for {:.0} s",
                reading.celsius, goal.target_c, goal.tolerance_c, goal.hold_s
            ),
        ),
        Err(Error::Plan { why, .. }) => (false, why),
        Err(error) => return Err(error),
    };
    report.check(progress, format!("{} at target", plan.name), passed, seen);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_protocol::clock::Clock;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;

    fn shown(live: bool) -> String {
        let mut out = Vec::new();
        let mut lines = ProgressLines::new(&mut out, live);
        lines.update("home x", 0.5, "5 mm");
        lines.update("home x", 2.0, "not shown: too soon");
        lines.checked(&Check { what: "x homed".to_owned(), passed: false, seen: "800 steps".to_owned() });
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn progress_is_lines_elsewhere_and_a_bar_on_a_terminal() {
        assert_eq!(shown(false), "home x: 5 mm\nWRONG x homed: 800 steps\n");
        let bar = format!("\r\x1b[0Khome x     {}{} 5 mm", "█".repeat(12), "░".repeat(12));
        assert_eq!(shown(true), bar + "\r\x1b[0KWRONG x homed: 800 steps\n");
    }

    proptest! {
        #[test]
        fn whatever_an_mcu_names_stays_in_its_line(name in any_name()) {
            let shown = |live| {
                let mut out = Vec::new();
                let mut lines = ProgressLines::new(&mut out, live);
                lines.update(&name, 0.5, &name);
                lines.checked(&Check { what: name.clone(), passed: true, seen: name.clone() });
                String::from_utf8(out).unwrap()
            };
            assert_plain(&shown(false), 2);
            assert_plain(&shown(true).replace(&format!("\r{ERASE_LINE}"), ""), 1);
        }
    }

    #[test]
    fn the_rate_is_that_since_the_sight_before() {
        let sight = |ticks, position| Sight { clock: Clock::from_ticks(ticks), position, triggered: false };
        assert_eq!(rate(sight(0, 0), sight(500, -40), 1000.0), -80.0);
        assert_eq!(rate(sight(500, -40), sight(500, -40), 1000.0), 0.0);
    }
}
