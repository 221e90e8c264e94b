// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim PRINTER.CFG --try`: a klippy on the user's configuration does what every owner does after a change.
//!
//! Each step is one command or a few, and looks at the printer, not only at klippy: where the motors put the nozzle, how
//! hot the heater is, how fast the fan turns.

#![forbid(unsafe_code)]

mod host;
mod place;
mod report;
mod small;
mod stall;

use std::fs;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use clap::builder::PossibleValuesParser;
use pinion::cli::files;
use pinion_firmware::time::{Clock, Ticks};
use pinion_printer_config::{Limit, Place, Section, Trouble};
use pinion_sim::{AskedPath, Recorder, SimProbe, compare, write_svg};
use serde_json::Value;

use crate::camera::picture;
use crate::own::serve::{Folder, Own, section_of};
use crate::own::{Kind, kind_of};
pub(crate) use host::Running;
use host::{Host, Refused};
use place::place_of;
pub(crate) use report::Form;
use report::{Outcome, Report};

/// How long klippy has to be ready.
const READY: Duration = Duration::from_secs(90);
/// How long klippy has to learn the MCUs' clocks, and how far off an MCU's rate may be.
const CLOCKS: Duration = Duration::from_secs(10);
const CLOCKS_OFF: f64 = 1e-4;
/// How long homing, leveling or a macro may take.
const LONG: Duration = Duration::from_secs(400);
/// How long a print may take.
const PRINT: Duration = Duration::from_secs(4 * 3600);
/// How long a heater may take.
const HEAT: Duration = Duration::from_secs(240);
/// How long it may take until a fan turns or a heater cools.
const SOON: Duration = Duration::from_secs(30);
/// How near a temperature has to be.
const NEAR_K: f64 = 4.0;
/// The nozzle's axes, as klippy names them.
const AXES: [&str; 3] = ["x", "y", "z"];
/// How near the nozzle has to be to klippy's position.
const NEAR_MM: f64 = 0.15;
/// Distance above which a print is wrong.
const WITHIN_MM: f64 = 0.1;
/// How level a gantry or bed has to be.
const LEVEL_MM: f64 = 0.1;
/// Whether a leveling moves the motors of z apart, or only measures.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Moves {
    Motors,
    Nothing,
}

/// The sections that level something with a probe, in the order in which an owner uses them, and their commands.
const LEVELS: [(&str, &str, Moves); 7] = [
    ("bed_tilt", "BED_TILT_CALIBRATE", Moves::Nothing),
    ("z_tilt", "Z_TILT_ADJUST", Moves::Motors),
    ("z_tilt_ng", "Z_TILT_ADJUST", Moves::Motors),
    ("quad_gantry_level", "QUAD_GANTRY_LEVEL", Moves::Motors),
    ("delta_calibrate", "DELTA_CALIBRATE", Moves::Nothing),
    ("screws_tilt_adjust", "SCREWS_TILT_CALCULATE", Moves::Nothing),
    ("bed_mesh", "BED_MESH_CALIBRATE", Moves::Nothing),
];
/// Longest G-code file.
const GCODE_MIB: u64 = 256;
/// Names of macros that begin and end a print.
const STARTS: [&str; 4] = ["START_PRINT", "PRINT_START", "START_GCODE", "BEGIN_PRINT"];
const ENDS: [&str; 3] = ["END_PRINT", "PRINT_END", "END_GCODE"];

/// Words of a stop because a computer is too busy.
const BUSY: [&str; 6] = [
    "Timer too close",
    "Rescheduled timer in the past",
    "Missed scheduling of next",
    "Lost communication with MCU",
    "Communication timeout during homing",
    "Timeout on wait for",
];
/// How often a step is repeated because of them.
const TRIES: u32 = 4;

/// Shortest wait for a processor that klippy can stop for: while it homes with several MCUs, it has 25 ms.
const STALL: Duration = Duration::from_millis(20);

/// The options of `--try`.
#[derive(Clone, Debug)]
pub(crate) struct Attempt {
    pub(crate) klipper: PathBuf,
    pub(crate) python: PathBuf,
    /// A file to print in place of the small one.
    pub(crate) gcode: Option<PathBuf>,
    /// Only these steps, if there are any.
    pub(crate) only: Vec<String>,
    pub(crate) form: Form,
    /// klippy gets real time, too.
    pub(crate) realtime: bool,
    /// The klippy, while it runs.
    pub(crate) running: Running,
}

/// Tries a printer. Returns whether nothing failed. `ended` is set when the program is asked to end.
pub(crate) fn run(
    attempt: &Attempt,
    (own, printer): (&Own, &Path),
    folder: &Folder,
    probe: &SimProbe,
    ended: &AtomicBool,
) -> bool {
    let mut report = Report::new(attempt.form);
    let since = Instant::now();
    report.progress("klippy starts");
    let host = match Host::start(attempt, folder) {
        Ok(host) => host,
        Err(trouble) => {
            report.add("ready", Outcome::Failed { cause: trouble.to_string(), place: None }, since);
            report.end(printer, Some(&folder.path));
            return false;
        }
    };
    let mut trial = Trial { attempt, folder, own, probe, host, objects: Vec::new(), path: None, broken: None };
    for step in STEPS {
        if ended.load(Ordering::SeqCst) {
            break;
        }
        if !attempt.only.is_empty() && step.name != "ready" && !attempt.only.iter().any(|only| only == step.name) {
            continue;
        }
        let since = if step.name == "ready" { since } else { Instant::now() };
        report.progress(step.name);
        let outcome = match &trial.broken {
            Some(why) => Outcome::Skipped(format!("not tried: {why}")),
            None => trial.tried(step),
        };
        if outcome.is_failure() {
            trial.recover(step.name);
        }
        report.add(step.name, outcome, since);
    }
    if let Err(trouble) = trial.keep() {
        log::warn!("{trouble}");
    }
    drop(trial);
    report.end(printer, Some(&folder.path));
    report.passed() && !ended.load(Ordering::SeqCst)
}

/// Reports a mistake that is found before klippy starts.
pub(crate) fn refused(printer: &Path, mistake: Trouble, form: Form) -> ExitCode {
    let mut report = Report::new(form);
    let (cause, place) = without_place(mistake);
    report.add("read", Outcome::Failed { cause, place }, Instant::now());
    report.end(printer, None);
    ExitCode::FAILURE
}

/// The text of a mistake, and its place, which is `file:line` in front of its subject.
fn without_place(mistake: Trouble) -> (String, Option<Place>) {
    let subject = mistake.subject.clone().unwrap_or_default();
    let (first, rest) = subject.split_once(": ").unwrap_or((&subject, ""));
    let place = first.rsplit_once(':').and_then(|(file, line)| Some((file, line.parse().ok()?)));
    let Some((file, line)) = place else { return (mistake.to_string(), None) };
    let subject = Some(rest).filter(|rest| !rest.is_empty()).map(Box::from);
    (Trouble { subject, ..mistake }.to_string(), Some(Place { file: Path::new(file).into(), line }))
}

/// Something that is tried.
struct Step {
    name: &'static str,
    run: fn(&mut Trial<'_>) -> Outcome,
}

const STEPS: &[Step] = &[
    Step { name: "ready", run: |trial| trial.ready() },
    Step { name: "homed", run: |trial| trial.homed() },
    Step { name: "carriage", run: |trial| trial.second_carriage() },
    Step { name: "heated", run: |trial| trial.heated() },
    Step { name: "fans", run: |trial| trial.fans() },
    Step { name: "lights", run: |trial| trial.lights() },
    Step { name: "servo", run: |trial| trial.servo() },
    Step { name: "leveled", run: |trial| trial.leveled() },
    Step { name: "probe", run: |trial| trial.probed() },
    Step { name: "shaper", run: |trial| trial.shaped() },
    Step { name: "macros", run: |trial| trial.macros() },
    Step { name: "printed", run: |trial| trial.printed() },
    Step { name: "cooled", run: |trial| trial.cooled() },
];

/// The names of the steps, for the command line.
pub(crate) fn steps() -> PossibleValuesParser {
    PossibleValuesParser::new(STEPS.iter().map(|step| step.name))
}

/// Whether a step comes before anything is homed.
fn is_first(step: &str) -> bool {
    ["ready", "homed"].contains(&step)
}

struct Trial<'a> {
    attempt: &'a Attempt,
    folder: &'a Folder,
    own: &'a Own,
    probe: &'a SimProbe,
    host: Host,
    objects: Vec<String>,
    /// The path of the print.
    path: Option<Recorder>,
    /// Why nothing more can be tried.
    broken: Option<String>,
}

impl Trial<'_> {
    /// Writes the camera's picture, and the path of the print, into the folder.
    fn keep(&mut self) -> Result<(), Trouble> {
        let place = |name| self.folder.path.join(name);
        let failed = |path: PathBuf, error: io::Error| {
            Trouble::new(format!("it cannot be written: {error}")).of(path.display()).remedy("free space")
        };
        if let Some(path) = &self.path {
            let file = place("path.svg");
            let mut drawing = Vec::new();
            let drawn = write_svg(path.points(), path.filament_step_mm(), &mut drawing);
            drawn.and_then(|()| fs::write(&file, drawing)).map_err(|error| failed(file, error))?;
        }
        let path = self.path.take().unwrap_or_else(|| self.probe.recorder());
        if let Some(jpeg) = picture(&self.own.sim, self.probe, path) {
            let file = place("picture.jpg");
            fs::write(&file, jpeg).map_err(|error| failed(file, error))?;
        }
        Ok(())
    }

    fn failed(&self, cause: impl Into<String>, place: Option<Place>) -> Outcome {
        let cause = cause.into();
        let place = place.or_else(|| place_of(&self.own.config, &cause));
        // klippy's words have several lines, of which the first ones say it.
        let lines: Vec<&str> = cause.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        let cause = lines.iter().take(2).copied().collect::<Vec<&str>>().join(" ");
        Outcome::Failed { cause, place }
    }

    /// klippy's words about a refusal: those about its stop, if it stopped.
    fn why(&mut self, words: String) -> String {
        match self.host.state() {
            Ok((state, about)) if state != "ready" => about,
            _ => words,
        }
    }

    /// Runs G-code. The error is the outcome.
    fn gcode(&mut self, script: &str, limit: Duration) -> Result<(), Outcome> {
        match self.host.gcode(script, limit) {
            Ok(()) => Ok(()),
            Err(Refused::Error(words)) => {
                let words = self.why(words);
                Err(self.failed(format!("{script}: {words}"), None))
            }
            Err(Refused::Late) => {
                self.host.stop();
                Err(self.failed(format!("{script}: it takes longer than {} s", limit.as_secs()), None))
            }
            Err(Refused::Gone(why)) => {
                self.broken = Some("klippy ended".into());
                Err(self.failed(format!("{script}: klippy is gone: {why}"), None))
            }
        }
    }

    /// Runs a step. It is repeated if klippy stopped because it or an MCU was late. If this computer made them late each
    /// time, the step says nothing about the printer. Any other failure of a late klippy is tried once more: a probe that
    /// answers late homes at another height.
    fn tried(&mut self, step: &Step) -> Outcome {
        let mut repeated = 0;
        loop {
            self.host.stalls.take();
            let outcome = (step.run)(self);
            let stall = self.host.stalls.take();
            let Outcome::Failed { cause, .. } = &outcome else { return outcome };
            if self.broken.is_some() {
                return outcome;
            }
            let is_busy = BUSY.iter().any(|words| cause.contains(words));
            let is_late = stall >= STALL;
            let repeats = if is_busy { TRIES } else { u32::from(is_late) };
            if repeated >= repeats || !self.begins_again(step.name) {
                let is_slow = is_busy && is_late;
                return if is_slow { Outcome::Slow { cause: cause.clone(), stall } } else { outcome };
            }
            repeated += 1;
        }
    }

    /// Starts another klippy. One that stopped while it homed does not take a FIRMWARE_RESTART.
    fn restart(&mut self) -> Result<(), Trouble> {
        self.host.end();
        self.host = Host::start(self.attempt, self.folder)?;
        Ok(())
    }

    /// After a failure: goes on if klippy is ready, or is so after a restart.
    fn recover(&mut self, step: &str) {
        if self.broken.is_some() {
            return;
        }
        let state = self.host.state().map(|(state, _)| state).unwrap_or_default();
        if state == "ready" {
            if step == "homed" {
                self.broken = Some("it is not homed".into());
            }
            return;
        }
        if is_first(step) || !self.begins_again(step) {
            self.broken = Some("klippy is not ready".into());
        }
    }

    /// Starts another klippy, and homes unless a step does that itself. Returns whether this worked.
    fn begins_again(&mut self, step: &str) -> bool {
        self.restart().is_ok()
            && self.until_ready_again().is_ok()
            && (is_first(step) || self.host.gcode("G28", LONG).is_ok())
    }

    /// Waits until klippy is ready. The error is its words.
    fn until_ready(&mut self) -> Result<(), String> {
        let until = Instant::now() + READY;
        loop {
            match self.host.state() {
                Ok((state, _)) if state == "ready" => {
                    self.until_clocks_agree();
                    return Ok(());
                }
                Ok((state, words)) if state == "error" || state == "shutdown" => return Err(words),
                Ok((_, words)) if Instant::now() > until => return Err(format!("klippy is not ready: {words}")),
                Ok(_) => thread::sleep(Duration::from_millis(100)),
                // A klippy that finds its MCU shut down restarts both.
                Err(Refused::Gone(_)) if Instant::now() < until && self.host.reconnect() => {}
                Err(refused) => return Err(format!("klippy does not answer: {refused:?}")),
            }
        }
    }

    /// Waits until klippy knows the MCUs' clocks. Right after its start on a busy computer it can be milliseconds wrong, and
    /// then it is late when it homes.
    fn until_clocks_agree(&mut self) {
        let names: Vec<String> = self.own.mcus.iter().map(|mcu| section_of(mcu)).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let until = Instant::now() + CLOCKS;
        while Instant::now() < until {
            let status = self.host.query(&names).unwrap_or_default();
            let off = |mcu: &Value| {
                let [now, nominal] =
                    [&mcu["last_stats"]["freq"], &mcu["mcu_constants"]["CLOCK_FREQ"]].map(Value::as_f64);
                now.zip(nominal).is_none_or(|(now, nominal)| (now / nominal - 1.0).abs() > CLOCKS_OFF)
            };
            if !names.iter().any(|name| off(&status[*name])) {
                return;
            }
            thread::sleep(Duration::from_millis(200));
        }
    }

    /// The same for another klippy. Some wait for the user if they find an MCU shut down.
    fn until_ready_again(&mut self) -> Result<(), String> {
        match self.until_ready() {
            Err(words) if words.contains("is shutdown") => {
                self.host.firmware_restart();
                self.until_ready()
            }
            ready => ready,
        }
    }

    fn ready(&mut self) -> Outcome {
        if let Err(words) = self.until_ready() {
            let missing = self.own.config.sections().iter().find(|section| kind_of(section.kind()) != Kind::Known);
            return match (self.failed(words, None), missing) {
                (Outcome::Failed { cause, place }, Some(section)) => {
                    Outcome::Failed { cause: format!("{cause} ([{}] is not simulated)", section.name), place }
                }
                (failed, _) => failed,
            };
        }
        match self.host.objects() {
            Ok(objects) => self.objects = objects,
            Err(refused) => return self.failed(format!("klippy names no objects: {refused:?}"), None),
        }
        let count = self.own.mcus.len();
        Outcome::Passed(format!("klippy is ready, with {count} MCU{}", if count == 1 { "" } else { "s" }))
    }

    fn has(&self, object: &str) -> bool {
        self.objects.iter().any(|name| name == object)
    }

    /// klippy's objects of a kind, by their own names.
    fn named(&self, kind: &str) -> Vec<String> {
        let names = self.objects.iter().filter_map(|name| name.strip_prefix(kind)?.strip_prefix(' '));
        names.map(str::to_owned).collect()
    }

    fn lost(&self) -> Vec<(String, u64)> {
        self.probe.axes().map(|axis| (axis.name.to_owned(), axis.lost_steps)).collect()
    }

    /// The axes that lost steps since then. An axis that homes by its driver's StallGuard has to, and the motors that
    /// share its belts, too.
    fn new_lost(&self, before: &[(String, u64)]) -> Option<Outcome> {
        let config = &self.own.config;
        let homes_by_stall =
            |section: &Section| section.text("endstop_pin").is_some_and(|pin| pin.trim_start().starts_with("tmc"));
        let kinematics = self.kinematics().unwrap_or_default();
        let on_belts =
            |name: &str| kinematics.contains("core") && (kinematics.ends_with("xz") || !name.starts_with('z'));
        let any = config.sections().iter().any(homes_by_stall);
        let stalls = |name: &str| {
            let sections = [format!("stepper_{name}"), name.to_owned()];
            (any && on_belts(name)) || sections.iter().filter_map(|name| config.section(name)).any(homes_by_stall)
        };
        let lost = self.lost().into_iter().zip(before).find(|((name, now), (_, then))| now > then && !stalls(name));
        lost.map(|((name, now), (_, then))| {
            let place = self.own.config.section(&format!("stepper_{name}")).map(|section| section.place.clone());
            let count = now - then;
            self.failed(format!("axis {name} lost {count} steps at an end of its travel"), place)
        })
    }

    fn homed(&mut self) -> Outcome {
        if self.kinematics() == Some("none") {
            return Outcome::Skipped("kinematics: none".into());
        }
        let before = self.lost();
        let start = self.probe.nozzle_mm();
        if let Err(outcome) = self.gcode("G28", LONG) {
            return outcome;
        }
        if let Err(outcome) = self.gcode("M400", LONG) {
            return outcome;
        }
        if let Some(outcome) = self.new_lost(&before) {
            return outcome;
        }
        let Ok(status) = self.host.query(&["toolhead"]) else { return self.failed("klippy does not answer", None) };
        let toolhead = &status["toolhead"];
        let homed = toolhead["homed_axes"].as_str().unwrap_or_default();
        if !AXES.iter().all(|axis| homed.contains(axis)) {
            return self.failed(format!("G28 homed only \"{homed}\""), None);
        }
        let position = coordinates(&toolhead["position"]);
        let nozzle = self.probe.nozzle_mm();
        // A probe that homes z finds the bed within its own distance of a step, and a mesh may be in force.
        let off = position.iter().zip(nozzle).map(|(klippys, real)| (klippys - real).abs());
        let off: Vec<f64> = off.collect();
        let [x, y, z] = nozzle;
        // A belt as z axis has no end: [homing_override] says where it is, and does not move it.
        let over = self.own.config.section("homing_override");
        let is_said = |axis: usize| {
            start[axis] == nozzle[axis]
                && over.is_some_and(|over| over.text(&format!("set_position_{}", AXES[axis])).is_some())
        };
        let far = off.iter().enumerate().find(|(axis, off)| **off > NEAR_MM && !is_said(*axis));
        if let Some((axis, off)) = far.filter(|_| self.is_plain()) {
            let axis = AXES[axis];
            let place =
                self.own.config.section(&format!("stepper_{axis}")).map(|s| s.place_of("position_endstop").clone());
            return self.failed(format!("after G28 the nozzle is {off:.3} mm from klippy's {axis} position"), place);
        }
        Outcome::Passed(format!("G28: the nozzle is at {x:.2} {y:.2} {z:.2}"))
    }

    /// Moves the second carriage of a printer with two, and looks where its motor is.
    fn second_carriage(&mut self) -> Outcome {
        let Some(section) = self.own.config.section("dual_carriage") else {
            return Outcome::Skipped("there is no [dual_carriage]".into());
        };
        let before = self.lost();
        for command in ["G28", "SET_DUAL_CARRIAGE CARRIAGE=1"] {
            if let Err(outcome) = self.gcode(command, LONG) {
                return outcome.at(&section.place);
            }
        }
        let Ok(status) = self.host.query(&["toolhead"]) else { return self.failed("klippy does not answer", None) };
        let axis = usize::from(section.text("axis") == Some("y"));
        let [low, high] = ["axis_minimum", "axis_maximum"].map(|key| coordinates(&status["toolhead"][key])[axis]);
        let (middle, letter) = ((low + high) / 2.0, ["X", "Y"][axis]);
        let moves = format!("G90\nG1 {letter}{middle:.2} F6000\nM400");
        if let Err(outcome) = self.gcode(&moves, LONG) {
            return outcome.at(&section.place);
        }
        let off = self.probe.axis("dual_carriage").map(|axis| (axis.position_mm - middle).abs());
        if let Some(off) = off.filter(|off| *off > NEAR_MM) {
            let cause = format!("the second carriage is {off:.3} mm from klippy's {letter} position");
            return self.failed(cause, Some(section.place_of("position_endstop").clone()));
        }
        if let Err(outcome) = self.gcode("SET_DUAL_CARRIAGE CARRIAGE=0", LONG) {
            return outcome.at(&section.place);
        }
        self.new_lost(&before).unwrap_or_else(|| Outcome::Passed(format!("the second carriage is at {middle:.2}")))
    }

    fn kinematics(&self) -> Option<&str> {
        self.own.config.section("printer")?.text("kinematics")
    }

    /// Whether klippy's position is the nozzle's: nothing is between them, and the bed does not change it.
    fn is_plain(&self) -> bool {
        let sections = ["bed_tilt", "skew_correction", "axis_twist_compensation", "z_tilt", "quad_gantry_level"];
        let simple = ["cartesian", "corexy", "corexz", "delta", "hybrid_corexy", "hybrid_corexz"];
        !sections.iter().any(|name| self.own.config.section(name).is_some())
            && self.kinematics().is_some_and(|kinematics| simple.contains(&kinematics))
    }

    /// The heaters with klippy's name and a usual temperature of theirs.
    fn targets(&mut self) -> Vec<(String, f64)> {
        let status = self.host.query(&["heaters"]).unwrap_or_default();
        let names = status["heaters"]["available_heaters"].as_array().cloned().unwrap_or_default();
        let names = names.iter().filter_map(Value::as_str).map(str::to_owned);
        let target = |name: String| {
            let section = self.own.config.section(&name)?;
            let number = |key| section.number(key, Limit::Any).ok().flatten();
            let max = number("max_temp")?;
            let usual = if section.kind().starts_with("extruder") {
                number("min_extrude_temp").unwrap_or(170.0).max(200.0)
            } else if section.kind() == "heater_bed" {
                60.0
            } else {
                50.0
            };
            Some((name, usual.min(max - 10.0)))
        };
        names.filter_map(target).collect()
    }

    fn heated(&mut self) -> Outcome {
        let targets = self.targets();
        if targets.is_empty() {
            return Outcome::Skipped("there is no heater".into());
        }
        for (name, target) in &targets {
            let own = name.rsplit(' ').next().unwrap_or(name);
            if let Err(outcome) = self.gcode(&format!("SET_HEATER_TEMPERATURE HEATER={own} TARGET={target}"), LONG) {
                return outcome;
            }
        }
        let until = Instant::now() + HEAT;
        let objects: Vec<&str> = targets.iter().map(|(name, _)| name.as_str()).collect();
        loop {
            let status = match self.host.query(&objects) {
                Ok(status) => status,
                Err(refused) => return self.failed(format!("klippy does not answer: {refused:?}"), None),
            };
            let celsius = |name: &str| status[name]["temperature"].as_f64().unwrap_or_default();
            let cold = targets.iter().find(|(name, target)| (celsius(name) - target).abs() > NEAR_K);
            let Some((name, target)) = cold else { break };
            if let Ok((state, words)) = self.host.state()
                && state != "ready"
            {
                return self.failed(words, None);
            }
            if Instant::now() > until {
                let place = self.own.config.section(name).map(|section| section.place.clone());
                return self.failed(format!("{name} is at {:.0} of {target} C", celsius(name)), place);
            }
            thread::sleep(Duration::from_millis(500));
        }
        // klippy's reading has to be the heater's temperature.
        let status = self.host.query(&objects).unwrap_or_default();
        for (name, _) in &targets {
            let own = name.rsplit(' ').next().unwrap_or(name);
            let read = status[name]["temperature"].as_f64().unwrap_or_default();
            if let Some(heater) =
                self.probe.heater(own).filter(|heater| (heater.sensor_celsius - read).abs() > 3.0 * NEAR_K)
            {
                let section = self.own.config.section(name);
                let place = section.map(|section| section.place_of("sensor_type").clone());
                return self.failed(format!("klippy reads {read:.0} C at {:.0} C", heater.sensor_celsius), place);
            }
        }
        let seen: Vec<String> = targets.iter().map(|(name, target)| format!("{name} {target:.0} C")).collect();
        Outcome::Passed(seen.join(", "))
    }

    fn cooled(&mut self) -> Outcome {
        let targets = self.targets();
        if targets.is_empty() {
            return Outcome::Skipped("there is no heater".into());
        }
        let objects: Vec<&str> = targets.iter().map(|(name, _)| name.as_str()).collect();
        let read = |host: &mut Host| {
            let status = host.query(&objects).unwrap_or_default();
            let celsius = |name: &&str| status[*name]["temperature"].as_f64().unwrap_or_default();
            objects.iter().map(celsius).collect::<Vec<f64>>()
        };
        let hot = read(&mut self.host);
        if let Err(outcome) = self.gcode("TURN_OFF_HEATERS", LONG) {
            return outcome;
        }
        let until = Instant::now() + SOON;
        loop {
            let now = read(&mut self.host);
            let still = hot.iter().zip(&now).position(|(hot, now)| *hot > 45.0 && hot - now < 2.0);
            match still {
                None => return Outcome::Passed("all heaters are off, and cool".into()),
                Some(n) if Instant::now() > until => {
                    return self.failed(format!("{} is off and does not cool", objects[n]), None);
                }
                Some(_) => thread::sleep(Duration::from_millis(500)),
            }
        }
    }

    fn fans(&mut self) -> Outcome {
        let mut fans: Vec<(String, String, String)> = Vec::new();
        if self.has("fan") {
            fans.push(("fan".into(), "M106 S255".into(), "M106 S0".into()));
        }
        for name in self.named("fan_generic") {
            let set = |speed| format!("SET_FAN_SPEED FAN={name} SPEED={speed}");
            fans.push((name.clone(), set(1), set(0)));
        }
        if fans.is_empty() {
            return Outcome::Skipped("there is no fan that a command switches".into());
        }
        for (name, on, off) in &fans {
            if let Err(outcome) = self.gcode(on, LONG) {
                return outcome;
            }
            let until = Instant::now() + SOON;
            while self.probe.fan(name).is_some_and(|fan| fan.rpm < 500.0) {
                if Instant::now() > until {
                    let section = self.own.config.section(name);
                    let section = section.or_else(|| self.own.config.section(&format!("fan_generic {name}")));
                    return self.failed(format!("{on}: the fan stands still"), section.map(|s| s.place.clone()));
                }
                thread::sleep(Duration::from_millis(50));
            }
            if let Err(outcome) = self.gcode(off, LONG) {
                return outcome;
            }
        }
        let names: Vec<&str> = fans.iter().map(|(name, ..)| name.as_str()).collect();
        Outcome::Passed(names.join(", "))
    }

    fn lights(&mut self) -> Outcome {
        let kinds = ["led", "neopixel", "dotstar", "pca9533", "pca9632"];
        let names: Vec<String> = kinds.iter().flat_map(|kind| self.named(kind)).collect();
        if names.is_empty() {
            return Outcome::Skipped("there is no light".into());
        }
        for name in &names {
            for color in ["RED=1 GREEN=0.5 BLUE=0", "RED=0 GREEN=0 BLUE=0"] {
                if let Err(outcome) = self.gcode(&format!("SET_LED LED={name} {color}"), LONG) {
                    return outcome;
                }
            }
        }
        Outcome::Passed(names.join(", "))
    }

    fn servo(&mut self) -> Outcome {
        let names = self.named("servo");
        if names.is_empty() {
            return Outcome::Skipped("there is no servo".into());
        }
        for name in &names {
            for angle in [90, 0] {
                if let Err(outcome) = self.gcode(&format!("SET_SERVO SERVO={name} ANGLE={angle}"), LONG) {
                    return outcome;
                }
            }
        }
        Outcome::Passed(names.join(", "))
    }

    fn leveled(&mut self) -> Outcome {
        let config = &self.own.config;
        let found: Vec<_> = LEVELS
            .iter()
            .filter_map(|(name, command, moves)| Some((config.section(name)?, *command, *moves)))
            .collect();
        if found.is_empty() {
            return Outcome::Skipped("nothing of [z_tilt], [quad_gantry_level], [bed_mesh] is there".into());
        }
        if !self.has("probe") {
            return Outcome::Skipped("there is no probe".into());
        }
        let before = self.lost();
        for (section, command, moves) in &found {
            for script in ["G28", command, "M400"] {
                if let Err(outcome) = self.gcode(script, LONG) {
                    return outcome.at(&section.place);
                }
            }
            if let Some((apart, name)) = self.apart().filter(|(apart, _)| *apart > LEVEL_MM && *moves == Moves::Motors)
            {
                let cause = format!("after {command} the motor {name} holds its side {apart:.3} mm too high or low");
                return self.failed(cause, Some(section.place.clone()));
            }
        }
        let commands: Vec<&str> = found.iter().map(|(_, command, _)| *command).collect();
        self.new_lost(&before).unwrap_or_else(|| Outcome::Passed(commands.join(", ")))
    }

    /// The largest distance of a z motor from the first one, and its name. The simulated bed is flat.
    fn apart(&self) -> Option<(f64, String)> {
        let first = self.probe.axis("z")?.position_mm;
        let others = (1..).map_while(|n| self.probe.axis(&format!("z{n}")));
        let apart = others.map(|axis| ((axis.position_mm - first).abs(), axis.name.to_owned()));
        apart.max_by(|(a, _), (b, _)| a.total_cmp(b))
    }

    fn probed(&mut self) -> Outcome {
        if !self.has("probe") {
            return Outcome::Skipped("there is no probe".into());
        }
        let before = self.lost();
        // G28 may end where the probe has triggered, or where it is beside the bed.
        let Ok(status) = self.host.query(&["toolhead"]) else { return self.failed("klippy does not answer", None) };
        let [low, high] = ["axis_minimum", "axis_maximum"].map(|key| coordinates(&status["toolhead"][key]));
        let [x, y] = [0, 1].map(|n| (low[n] + high[n]) / 2.0);
        let middle = format!("G90\nG1 Z10 F600\nG1 X{x:.2} Y{y:.2} F6000");
        for command in ["G28", &middle, "PROBE_CALIBRATE", "ABORT"] {
            if let Err(outcome) = self.gcode(command, LONG) {
                return outcome;
            }
        }
        self.new_lost(&before).unwrap_or_else(|| Outcome::Passed("PROBE_CALIBRATE".into()))
    }

    fn shaped(&mut self) -> Outcome {
        let Some(section) = self.own.config.section("resonance_tester") else {
            return Outcome::Skipped("there is no [resonance_tester]".into());
        };
        let chips = ["accel_chip", "accel_chip_x", "accel_chip_y"].into_iter().filter_map(|key| section.text(key));
        let mut kinds = chips.filter_map(|chip| chip.split_whitespace().next());
        if let Some(kind) = kinds.find(|kind| kind_of(kind) != Kind::Known) {
            return Outcome::Skipped(format!("[{kind}] is not simulated"));
        }
        // The whole range would take four minutes.
        let calibrate = "SHAPER_CALIBRATE FREQ_START=25 FREQ_END=85 HZ_PER_SEC=2";
        match self.gcode("G28", LONG).and_then(|()| self.gcode(calibrate, LONG)) {
            Ok(()) => Outcome::Passed("SHAPER_CALIBRATE".into()),
            Err(outcome) => outcome.at(&section.place),
        }
    }

    fn macro_of(&self, names: &[&str]) -> Option<String> {
        let macros = self.own.config.of_kind("gcode_macro").filter_map(|section| section.own_name());
        macros.map(str::to_uppercase).find(|name| names.contains(&name.as_str()))
    }

    fn macros(&mut self) -> Outcome {
        let found: Vec<String> = [self.macro_of(&STARTS), self.macro_of(&ENDS)].into_iter().flatten().collect();
        if found.is_empty() {
            return Outcome::Skipped("there is no START_PRINT and no END_PRINT".into());
        }
        let before = self.lost();
        for name in &found {
            // The usual names of the temperatures.
            let with = "BED_TEMP=60 EXTRUDER_TEMP=200 BED=60 EXTRUDER=200 HOTEND=200 TOOL_TEMP=200";
            if let Err(outcome) = self.gcode(&format!("{name} {with}"), LONG) {
                return outcome;
            }
        }
        self.new_lost(&before).unwrap_or_else(|| Outcome::Passed(found.join(", ")))
    }

    fn printed(&mut self) -> Outcome {
        if !self.has("extruder") {
            return Outcome::Skipped("there is no extruder".into());
        }
        let Ok(status) = self.host.query(&["toolhead"]) else { return self.failed("klippy does not answer", None) };
        let [low, high] = ["axis_minimum", "axis_maximum"].map(|key| coordinates(&status["toolhead"][key]));
        let (name, text) = match &self.attempt.gcode {
            Some(path) => match files::read(path, GCODE_MIB) {
                Ok(bytes) => (path.display().to_string(), String::from_utf8_lossy(&bytes).into_owned()),
                Err(error) => return self.failed(format!("{}: {error}", path.display()), None),
            },
            None => ("a small square".to_owned(), small::square(low, high)),
        };
        let asked = match AskedPath::read(BufReader::new(text.as_bytes()), &name) {
            Ok(asked) => asked,
            Err(trouble) => return self.failed(trouble.to_string(), None),
        };
        let mut first = vec!["CLEAR_PAUSE".to_owned()];
        first.retain(|_| self.has("pause_resume"));
        if self.own.config.section("input_shaper").is_some() {
            // A shaper rounds corners, as it should.
            first.push("SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0".into());
        }
        let heats = self.attempt.gcode.is_none();
        if heats {
            first.push("G28".into());
            let hot = self.targets().into_iter().find(|(name, _)| name == "extruder");
            first.extend(hot.map(|(_, target)| format!("SET_HEATER_TEMPERATURE HEATER=extruder TARGET={target}")));
        }
        for command in &first {
            if let Err(outcome) = self.gcode(command, LONG) {
                return outcome;
            }
        }
        if heats && let Err(outcome) = self.until_hot("extruder") {
            return outcome;
        }
        let before = self.lost();
        let (stop, stopped) = mpsc::channel::<()>();
        let mut recorder = self.probe.recorder();
        let watched = self.probe.clone();
        let recorded = thread::spawn(move || {
            while stopped.recv_timeout(Duration::from_millis(50)) == Err(RecvTimeoutError::Timeout) {
                recorder.read(watched.now());
            }
            let late = u64::from(Ticks::from_ms(450).0);
            recorder.read(Clock::from_ticks(watched.now().ticks() + late));
            recorder
        });
        let lines: Vec<&str> = text.lines().collect();
        let mut sent = Ok(());
        for block in lines.chunks(200) {
            sent = self.gcode_block(&block.join("\n"));
            if sent.is_err() {
                break;
            }
        }
        let sent = sent.and_then(|()| self.gcode("M400", PRINT));
        thread::sleep(Duration::from_millis(600));
        drop(stop);
        let Ok(recorder) = recorded.join() else { return self.failed("the path was not recorded", None) };
        let failed = sent.err().or_else(|| self.new_lost(&before));
        if let Some(outcome) = failed {
            self.path = Some(recorder);
            return outcome;
        }
        let compared = compare(recorder.points(), &asked);
        self.path = Some(recorder);
        match compared {
            Err(trouble) => self.failed(trouble.to_string(), None),
            Ok(found) if found.all.greatest_mm > WITHIN_MM => {
                let (mm, line) = (found.all.greatest_mm, found.all.line);
                self.failed(format!("{name}, line {line}: the nozzle was {mm:.3} mm off"), None)
            }
            Ok(found) if found.ends_at_line.is_some() => {
                let line = found.ends_at_line.unwrap_or_default();
                self.failed(format!("{name}: the path ends at line {line}"), None)
            }
            Ok(found) => {
                let (mm, length) = (found.all.greatest_mm, found.all.length_mm);
                Outcome::Passed(format!("{name}: {length:.0} mm, at most {mm:.3} mm off"))
            }
        }
    }

    /// Sends a block of a file.
    fn gcode_block(&mut self, block: &str) -> Result<(), Outcome> {
        match self.host.gcode(block, PRINT) {
            Ok(()) => Ok(()),
            Err(Refused::Error(words)) => {
                let words = self.why(words);
                Err(self.failed(words, None))
            }
            Err(refused) => Err(self.failed(format!("the print stopped: {refused:?}"), None)),
        }
    }

    fn until_hot(&mut self, heater: &str) -> Result<(), Outcome> {
        let until = Instant::now() + HEAT;
        loop {
            let status = self.host.query(&[heater]).unwrap_or_default();
            let [now, target] = ["temperature", "target"].map(|key| status[heater][key].as_f64().unwrap_or_default());
            if (now - target).abs() < NEAR_K {
                return Ok(());
            }
            if Instant::now() > until {
                return Err(self.failed(format!("{heater} is at {now:.0} of {target} C"), None));
            }
            thread::sleep(Duration::from_millis(300));
        }
    }
}

/// The first three numbers of a list.
fn coordinates(list: &Value) -> [f64; 3] {
    [0, 1, 2].map(|n| list[n].as_f64().unwrap_or_default())
}

/// The klippy that is named, or the one of KLIPPER_DIR.
///
/// # Errors
///
/// There is none.
pub(crate) fn klipper(named: Option<PathBuf>) -> Result<PathBuf, Trouble> {
    named.ok_or_else(|| {
        Trouble::new("--try needs a klippy").remedy("name a checkout of Klipper or Kalico: --klipper ~/klipper")
    })
}

/// The Python that is named, that of KLIPPER_PYTHON, the one of Klipper's usual environment, or the system's.
pub(crate) fn python(named: Option<&Path>, klipper: &Path) -> PathBuf {
    let usual = || std::env::var_os("KLIPPER_PYTHON").map(PathBuf::from);
    let beside = || {
        let path = klipper.parent()?.join("klippy-env/bin/python");
        path.is_file().then_some(path)
    };
    named.map(Path::to_owned).or_else(usual).or_else(beside).unwrap_or_else(|| "python3".into())
}
