// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of a print.

use std::path::Path;
use std::time::Duration;

use pinion::page::Page;
use pinion_model::{Comparison, Pace};
use serde_json::{Value, json};

use super::limits::Limits;
use super::phase::Phase;

/// A heater during a print.
#[derive(Clone, Debug, Default)]
pub(super) struct Heated {
    pub(super) name: String,
    /// The highest target.
    pub(super) target: f64,
    /// The highest temperature.
    pub(super) most: f64,
    /// How far it was from its target at most, once it had reached it.
    pub(super) off: f64,
    /// The present target, if it was reached.
    reached: Option<f64>,
}

/// A heater that is so near to its target has reached it.
const REACHED_K: f64 = 0.5;

impl Heated {
    pub(super) fn new(name: String) -> Heated {
        Heated { name, ..Heated::default() }
    }

    /// Takes in a reading.
    pub(super) fn see(&mut self, now: f64, target: f64) {
        self.target = self.target.max(target);
        self.most = self.most.max(now);
        if self.reached != Some(target) {
            self.reached = Some(target).filter(|target| *target > 0.0 && (now - target).abs() < REACHED_K);
        }
        if self.reached.is_some() {
            self.off = self.off.max((now - target).abs());
        }
    }
}

/// Why and where a print stopped early.
#[derive(Clone, Debug)]
pub(super) struct Stopped {
    pub(super) line: usize,
    pub(super) text: String,
    pub(super) why: String,
}

/// Everything about a print.
pub(super) struct Printed {
    pub(super) file: String,
    pub(super) total_s: f64,
    pub(super) phases: Vec<(Phase, f64)>,
    /// How long each layer took, in the order of printing, and its height.
    pub(super) layers: Vec<(f64, f64)>,
    pub(super) filament_mm: f64,
    pub(super) motors: Vec<Pace>,
    /// Figures of a computer that may have to make these steps.
    pub(super) limits: Option<Limits>,
    pub(super) heaters: Vec<Heated>,
    pub(super) compared: Result<Comparison, String>,
    /// Axes that lost steps.
    pub(super) lost: Vec<(String, u64)>,
    /// klippy's words about commands that it does not know.
    pub(super) unknown: Vec<String>,
    pub(super) pauses: usize,
    pub(super) stopped: Option<Stopped>,
}

/// A time as people write it.
pub(super) fn span(seconds: f64) -> String {
    let s = seconds.round() as u64;
    match (s / 3600, s / 60 % 60, s % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, min, s) => format!("{min} min {s:02} s"),
        (h, min, _) => format!("{h} h {min:02} min"),
    }
}

impl Printed {
    /// Whether the print came to its end, with all its steps.
    pub(super) fn passed(&self) -> bool {
        self.stopped.is_none() && self.lost.is_empty()
    }

    /// The motors that have moved.
    fn moved(&self) -> Vec<&Pace> {
        self.motors.iter().filter(|pace| pace.steps_per_s > 0.0).collect()
    }

    /// The report for people.
    pub(super) fn page(&self, printer: &Path, (took, with_layers): (Duration, bool)) -> Page {
        let mut page = Page::default();
        let Printed { file, total_s, .. } = self;
        match &self.stopped {
            None => page.line(format_args!("{file} on {}: {} of printing", printer.display(), span(*total_s))),
            Some(Stopped { line, text, why }) => {
                page.line(format_args!("{file}:{line}: \"{text}\": {why}"));
                page.line(format_args!("the print on {} stopped after {}", printer.display(), span(*total_s)));
            }
        }
        for (phase, seconds) in self.phases.iter().filter(|(_, seconds)| *seconds >= 0.5) {
            page.line(format_args!("  {:<9} {}", phase.name(), span(*seconds)));
        }
        match self.pauses {
            0 => {}
            1 => page.line("  it paused once, and was resumed"),
            pauses => page.line(format_args!("  it paused {pauses} times, and was resumed each time")),
        }
        page.line(format_args!("filament   {:.2} m", self.filament_mm / 1000.0));
        page.line(format_args!("layers     {}", self.layers.len()));
        if with_layers {
            for (n, (seconds, z_mm)) in self.layers.iter().enumerate() {
                page.line(format_args!("  {:>5}  z {z_mm:>7.2} mm  {}", n + 1, span(*seconds)));
            }
        }
        for Heated { name, target, most, off, .. } in self.heaters.iter().filter(|heater| heater.target > 0.0) {
            let held =
                if *off > 0.0 { format!(", at most {off:.1} C from its target once there") } else { String::new() };
            page.line(format_args!("{name}: target {target:.0} C, highest {most:.1} C{held}"));
        }
        let moved = self.moved();
        if !moved.is_empty() {
            page.line("motor                steps/s      mm/s   mm/s2, the highest of each");
        }
        for Pace { name, steps_per_s, mm_per_s, mm_per_s2 } in &moved {
            page.line(format_args!("  {name:<17} {steps_per_s:>8.0} {mm_per_s:>9.1} {mm_per_s2:>7.0}"));
        }
        if let Some(limits) = &self.limits {
            limits.lines(&mut page, &moved);
        }
        match &self.compared {
            Ok(found) => page.line(format_args!(
                "the motors' path: {:.0} mm, at most {:.3} mm beside the file's (line {}), {:.4} mm on average",
                found.all.length_mm, found.all.greatest_mm, found.all.line, found.all.mean_mm
            )),
            Err(why) => page.line(format_args!("the motors' path was not compared with the file's: {why}")),
        }
        for line in &self.unknown {
            page.line(format_args!("klippy: {line}"));
        }
        for (axis, steps) in &self.lost {
            page.line(format_args!("{axis} lost {steps} steps at an end of its travel"));
        }
        page.line(format_args!(
            "{} of the printer took {} here. This does not show whether a host is fast enough: run pinion latency",
            span(*total_s),
            span(took.as_secs_f64())
        ));
        page
    }

    /// The report for programs.
    pub(super) fn json(&self, printer: &Path, (took, folder): (Duration, &Path)) -> Value {
        let tenth = |value: f64| (value * 10.0).round() / 10.0;
        let phases = self.phases.iter().map(|(phase, seconds)| (phase.name().to_owned(), json!(tenth(*seconds))));
        json!({
            "printer": printer.display().to_string(),
            "file": self.file,
            "passed": self.passed(),
            "seconds": tenth(self.total_s),
            "phases": phases.collect::<serde_json::Map<String, Value>>(),
            "pauses": self.pauses,
            "layers": self.layers.iter().map(|(seconds, z_mm)| json!({
                "seconds": tenth(*seconds),
                "z_mm": (z_mm * 1000.0).round() / 1000.0,
            })).collect::<Vec<Value>>(),
            "filament_mm": tenth(self.filament_mm),
            "motors": self.motors.iter().map(|pace| json!({
                "name": pace.name,
                "steps_per_s": pace.steps_per_s.round(),
                "mm_per_s": tenth(pace.mm_per_s),
                "mm_per_s2": pace.mm_per_s2.round(),
            })).collect::<Vec<Value>>(),
            "limits": self.limits.as_ref().map(|limits| limits.json(&self.moved())),
            "heaters": self.heaters.iter().map(|heater| json!({
                "name": heater.name,
                "target_celsius": tenth(heater.target),
                "highest_celsius": tenth(heater.most),
                "off_kelvin": tenth(heater.off),
            })).collect::<Vec<Value>>(),
            "path": self.compared.as_ref().ok().map(|found| json!({
                "length_mm": found.all.length_mm.round(),
                "greatest_mm": found.all.greatest_mm,
                "line": found.all.line,
                "mean_mm": found.all.mean_mm,
            })),
            "lost_steps": self.lost.iter().map(|(axis, steps)| (axis.clone(), json!(steps)))
                .collect::<serde_json::Map<String, Value>>(),
            "unknown_commands": self.unknown,
            "stopped": self.stopped.as_ref().map(|stopped| json!({
                "line": stopped.line,
                "text": stopped.text,
                "why": stopped.why,
            })),
            "folder": folder.display().to_string(),
            "real_seconds": tenth(took.as_secs_f64()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_heater_is_off_its_target_only_once_it_was_there() {
        let mut heater = Heated::new("extruder".into());
        for (now, target) in
            [(20.0, 0.0), (25.0, 200.0), (199.8, 200.0), (203.0, 200.0), (199.0, 200.0), (199.0, 220.0)]
        {
            heater.see(now, target);
        }
        assert_eq!((heater.target, heater.most, heater.off), (220.0, 203.0, 3.0));
        heater.see(219.9, 220.0);
        heater.see(210.0, 220.0);
        heater.see(210.0, 0.0);
        assert_eq!(heater.off, 10.0);
    }

    #[test]
    fn times_are_as_people_write_them() {
        for (seconds, text) in [(0.4, "0 s"), (59.6, "1 min 00 s"), (61.0, "1 min 01 s"), (36_061.0, "10 h 01 min")] {
            assert_eq!(span(seconds), text);
        }
    }
}
