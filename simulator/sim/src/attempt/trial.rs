// SPDX-License-Identifier: GPL-3.0-or-later
//! A klippy on the user's configuration: its commands, its restarts, and what a step asks it and the printer.

use std::fs;
use std::time::Duration;

use pinion_host::{NoStart, Refused};
use pinion_model::{Recorder, SimProbe, write_svg};
use pinion_printer_config::{Config, Place, Section, Trouble};
use serde_json::Value;

use super::place::place_of;
use super::report::Outcome;
use super::{Attempt, Host, unwritten};
use crate::camera::picture;
use crate::own::serve::{Folder, Own};

/// How long homing or a macro may take.
pub(super) const LONG: Duration = Duration::from_secs(1800);
/// How long a leveling may take, also in a macro that begins a print. A mesh of 20 by 20 points with three samples each
/// needs more than an hour.
pub(super) const LEVELING: Duration = Duration::from_secs(4 * 3600);
/// How long it may take until a fan turns.
pub(super) const SOON: Duration = Duration::from_secs(30);
/// How long klippy has to be ready.
const READY: Duration = Duration::from_secs(90);
/// Words of a stop because a computer is too busy.
const BUSY: [&str; 7] = [
    "Timer too close",
    "Stepper too far in past",
    "Rescheduled timer in the past",
    "Missed scheduling of next",
    "Lost communication with MCU",
    "Communication timeout during homing",
    "Timeout on wait for",
];

/// A printer under trial, and how far the trial came.
pub(super) struct Trial<'a> {
    pub(super) attempt: &'a Attempt,
    folder: &'a Folder,
    pub(super) own: &'a Own,
    pub(super) probe: &'a SimProbe,
    pub(super) host: Host,
    /// klippy's objects.
    pub(super) objects: Vec<String>,
    /// The path of the print.
    pub(super) path: Option<Recorder>,
    /// Why nothing more can be tried.
    pub(super) broken: Option<String>,
}

impl<'a> Trial<'a> {
    pub(super) fn new(attempt: &'a Attempt, folder: &'a Folder, own: &'a Own, probe: &'a SimProbe, host: Host) -> Self {
        Trial { attempt, folder, own, probe, host, objects: Vec::new(), path: None, broken: None }
    }

    /// Writes the camera's picture, and the path of the print, into the folder.
    pub(super) fn keep(&mut self) -> Result<(), Trouble> {
        let place = |name| self.folder.path.join(name);
        if let Some(path) = &self.path {
            let file = place("path.svg");
            let mut drawing = Vec::new();
            let drawn = write_svg(path.points(), path.filament_step_mm(), &mut drawing);
            drawn.and_then(|()| fs::write(&file, drawing)).map_err(|error| unwritten(&file, error))?;
        }
        let path = self.path.take().unwrap_or_else(|| self.probe.recorder());
        if let Some(jpeg) = picture(&self.own.sim, self.probe, path) {
            let file = place("picture.jpg");
            fs::write(&file, jpeg).map_err(|error| unwritten(&file, error))?;
        }
        Ok(())
    }

    pub(super) fn failed(&self, cause: impl Into<String>, place: Option<Place>) -> Outcome {
        let cause = cause.into();
        let place = place.or_else(|| place_of(self.config(), &cause));
        // klippy's words have several lines, and the first ones say it.
        let lines: Vec<&str> = cause.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        let cause = lines.iter().take(2).copied().collect::<Vec<&str>>().join(" ");
        Outcome::Failed { cause, place }
    }

    /// klippy's words about a refusal: those about its stop, if it stopped.
    pub(super) fn why(&mut self, words: String) -> String {
        match self.host.state() {
            Ok((state, about)) if state != "ready" => about,
            _ => words,
        }
    }

    /// Fails with klippy's words if it stopped.
    pub(super) fn still_ready(&mut self) -> Result<(), Outcome> {
        match self.host.state() {
            Ok((state, words)) if state != "ready" => Err(self.failed(words, None)),
            Err(Refused::Gone(why)) => {
                self.broken = Some("klippy ended".into());
                Err(self.failed(format!("klippy is gone: {why}"), None))
            }
            _ => Ok(()),
        }
    }

    /// Runs G-code. The error is the outcome.
    pub(super) fn gcode(&mut self, script: &str, limit: Duration) -> Result<(), Outcome> {
        let ran = self.host.gcode(script, limit);
        // The first lines of a cause are shown.
        let script = script.replace('\n', ", ");
        match ran {
            // M400 ends without an error if klippy stops during it.
            Ok(()) => self.still_ready(),
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

    /// Adds to a failure that this computer may have caused it.
    pub(super) fn judged(&self, outcome: Outcome) -> Outcome {
        match outcome {
            Outcome::Failed { cause, place }
                if self.attempt.real_time && BUSY.iter().any(|words| cause.contains(words)) =>
            {
                let cause = format!("{cause} (this computer may be too busy: leave --real-time out)");
                Outcome::Failed { cause, place }
            }
            outcome => outcome,
        }
    }

    /// Starts another klippy. One that stopped while it homed does not take a FIRMWARE_RESTART.
    fn restart(&mut self) -> Result<(), NoStart> {
        self.host.start_anew(self.attempt.launch(self.folder))
    }

    /// After a failure: goes on if klippy is ready, or is so after a restart.
    pub(super) fn recover(&mut self, step: &str) {
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
    pub(super) fn until_ready(&mut self) -> Result<(), String> {
        self.host.until_ready(READY)
    }

    /// Lets time pass. A klippy that takes no more turns does not answer the next question.
    pub(super) fn sleep(&mut self, span: Duration) {
        let _ = self.host.sleep(span);
    }

    /// The same for another klippy. Some wait for the user if they find an MCU shut down.
    fn until_ready_again(&mut self) -> Result<(), String> {
        match self.until_ready() {
            Err(words) if words.contains("is shutdown") => {
                self.host.restart("FIRMWARE_RESTART");
                self.until_ready()
            }
            ready => ready,
        }
    }

    pub(super) fn config(&self) -> &'a Config {
        &self.own.config
    }

    /// A macro of the user's. klippy takes its name in any case.
    pub(super) fn macro_named(&self, name: &str) -> Option<&'a Section> {
        let has_name = |section: &&Section| section.own_name().is_some_and(|own| own.eq_ignore_ascii_case(name));
        self.config().of_kind("gcode_macro").find(has_name)
    }

    /// The place of a section that klippy has.
    pub(super) fn place(&self, section: &str) -> Option<Place> {
        let section = self.config().section(section).filter(|section| !self.is_left_out(section))?;
        Some(section.place.clone())
    }

    /// Whether klippy's copy is without a section.
    pub(super) fn is_left_out(&self, section: &Section) -> bool {
        self.folder.left_out.contains(&section.name)
    }

    /// Whether klippy has this object.
    pub(super) fn has(&self, object: &str) -> bool {
        self.objects.iter().any(|name| name == object)
    }

    /// klippy's objects of a kind, by their own names.
    pub(super) fn named(&self, kind: &str) -> Vec<String> {
        let names = self.objects.iter().filter_map(|name| name.strip_prefix(kind)?.strip_prefix(' '));
        names.map(str::to_owned).collect()
    }

    /// The lost steps of each axis.
    pub(super) fn lost(&self) -> Vec<(String, u64)> {
        self.probe.axes().map(|axis| (axis.name.to_owned(), axis.lost_steps)).collect()
    }

    /// Fails if an axis lost steps since then. An axis that homes by its driver's StallGuard has to, and the motors that
    /// share its belts, too.
    pub(super) fn lost_none_since(&self, before: &[(String, u64)]) -> Result<(), Outcome> {
        let lost = self
            .lost()
            .into_iter()
            .zip(before)
            .find(|((name, now), (_, then))| now > then && !homes_by_stall(self.config(), name));
        lost.map_or(Ok(()), |((name, now), (_, then))| {
            let cause = format!("axis {name} lost {} steps at an end of its travel", now - then);
            Err(self.failed(cause, self.place(&format!("stepper_{name}"))))
        })
    }

    pub(super) fn kinematics(&self) -> Option<&'a str> {
        self.config().section("printer")?.text("kinematics")
    }

    /// klippy's status of its toolhead.
    pub(super) fn toolhead(&mut self) -> Result<Value, Outcome> {
        match self.host.query(&["toolhead"]) {
            Ok(mut status) => Ok(status["toolhead"].take()),
            Err(_) => Err(self.failed("klippy does not answer", None)),
        }
    }
}

/// Whether a step comes before anything is homed.
fn is_first(step: &str) -> bool {
    ["ready", "homed"].contains(&step)
}

/// Whether an axis homes by its driver's StallGuard, or shares its belts with one that does. It loses steps then.
pub(super) fn homes_by_stall(config: &Config, axis: &str) -> bool {
    let stalls = |section: &Section| section.text("endstop_pin").is_some_and(|pin| pin.trim_start().starts_with("tmc"));
    let kinematics = config.section("printer").and_then(|section| section.text("kinematics")).unwrap_or_default();
    let is_on_belts = kinematics.contains("core") && (kinematics.ends_with("xz") || !axis.starts_with('z'));
    let sections = [format!("stepper_{axis}"), axis.to_owned()];
    (is_on_belts && config.sections().iter().any(stalls))
        || sections.iter().filter_map(|name| config.section(name)).any(stalls)
}

/// The ends of the axes' travel, as klippy says them.
pub(super) fn travel(toolhead: &Value) -> ([f64; 3], [f64; 3]) {
    (coordinates(&toolhead["axis_minimum"]), coordinates(&toolhead["axis_maximum"]))
}

/// The first three numbers of a list.
pub(super) fn coordinates(list: &Value) -> [f64; 3] {
    [0, 1, 2].map(|n| list[n].as_f64().unwrap_or_default())
}
