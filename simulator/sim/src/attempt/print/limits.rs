// SPDX-License-Identifier: GPL-3.0-or-later
//! Whether a computer can make the steps of a print, by the figures of `pinion latency --json`.

use std::path::PathBuf;

use pinion::latency::{EdgeCost, Figures, Latency};
use pinion::page::Page;
use pinion_model::Pace;
use serde_json::{Value, json};

/// The figures of a computer that is to make the steps.
#[derive(Clone, Debug)]
pub(super) struct Limits {
    computer: String,
    latency: Option<Latency>,
    edge: Option<EdgeCost>,
}

impl Limits {
    /// Reads the files, if there are any. Each may have a part of the figures.
    ///
    /// # Errors
    ///
    /// A file cannot be read, or they are of several computers.
    pub(super) fn read(files: &[PathBuf]) -> Result<Option<Limits>, String> {
        let mut limits: Option<Limits> = None;
        for file in files {
            let Figures { computer, latency, edge, .. } = Figures::read(file)?;
            limits = match limits {
                Some(other) if other.computer != computer => {
                    return Err(format!(
                        "{}: its computer is {computer}, but the other file's is {}: measure both on one computer",
                        file.display(),
                        other.computer
                    ));
                }
                Some(other) => Some(Limits { latency: latency.or(other.latency), edge: edge.or(other.edge), ..other }),
                None => Some(Limits { computer, latency, edge }),
            };
        }
        Ok(limits)
    }

    /// The lateness that one step of 1000 exceeds, in microseconds.
    fn late_us(&self) -> Option<f64> {
        let Latency { idle, under_load, .. } = self.latency.as_ref()?;
        Some(idle.edges.p999.max(under_load.edges.p999))
    }

    /// Why the computer cannot make this motor's steps in time.
    fn refusal(&self, motor: &Pace) -> Option<String> {
        let (latency, late_us) = (self.latency.as_ref()?, self.late_us()?);
        let interval_us = 1e6 / motor.steps_per_s;
        match () {
            () if !latency.fit_for_steppers => Some("the computer is not fit for steppers".into()),
            // A step that is later than the next one is due makes the motor jump by two steps.
            () if late_us > interval_us => Some(format!(
                "a step is due every {interval_us:.0} us, but 1 of 1000 is more than {late_us:.0} us late"
            )),
            () => None,
        }
    }

    /// The share of a processor that the edges of these motors take at most: two edges a step. For some drivers klippy
    /// makes one.
    fn share(&self, motors: &[&Pace]) -> Option<f64> {
        let EdgeCost { kernel_ns, registers_ns, .. } = self.edge.as_ref()?;
        let steps_per_s: f64 = motors.iter().map(|pace| pace.steps_per_s).sum();
        Some(2.0 * steps_per_s * registers_ns.or(*kernel_ns)? / 1e9)
    }

    pub(super) fn lines(&self, page: &mut Page, motors: &[&Pace]) {
        page.line(format_args!("these steps, made by {}:", self.computer));
        if let Some(latency) = &self.latency {
            page.line(format_args!("  {}", latency.why));
            let refusals = motors.iter().filter_map(|motor| Some((&motor.name, self.refusal(motor)?)));
            let refusals: Vec<_> = refusals.collect();
            match refusals.as_slice() {
                [] => page.line("  it is in time for all motors"),
                [(_, why), ..] if !latency.fit_for_steppers => page.line(format_args!("  {why}")),
                refusals => {
                    refusals.iter().for_each(|(name, why)| page.line(format_args!("  {name}: not in time: {why}")))
                }
            }
        }
        if let Some(share) = self.share(motors) {
            page.line(format_args!("  their edges alone take at most {:.1} % of a processor", share * 100.0));
        }
    }

    pub(super) fn json(&self, motors: &[&Pace]) -> Value {
        let refusals = motors.iter().map(|motor| (motor.name.clone(), json!(self.refusal(motor))));
        json!({
            "computer": self.computer,
            "late_us": self.late_us(),
            "refusals": self.latency.as_ref().map(|_| refusals.collect::<serde_json::Map<String, Value>>()),
            "edges_share": self.share(motors),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// A motor with so many steps in a second.
    fn motor(steps_per_s: f64) -> Pace {
        Pace { name: "x".into(), steps_per_s, mm_per_s: 100.0, mm_per_s2: 1000.0 }
    }

    /// A document of `pinion latency`.
    fn file(folder: &tempfile::TempDir, name: &str, part: Value) -> PathBuf {
        let mut document = json!({ "form": 1, "version": "0.1.0", "computer": "a board, Linux 6.1" });
        document.as_object_mut().unwrap().extend(part.as_object().unwrap().clone());
        let path = folder.path().join(name);
        fs::write(&path, document.to_string()).unwrap();
        path
    }

    fn latency(is_fit: bool, p999: f64) -> Value {
        let late = |p999: f64| json!({ "events": 3750, "p50": 1.0, "p99": 2.0, "p999": p999, "max": 400.0 });
        let half = |p999| json!({ "wakeups": late(90.0), "edges": late(p999), "margin_us": 60.0 });
        json!({ "latency": { "fit_for_steppers": is_fit, "fit_for_slow_outputs": true, "why": "a figure",
                             "idle": half(4.0), "under_load": half(p999) } })
    }

    fn said(limits: &Limits, motors: &[&Pace]) -> String {
        let mut page = Page::default();
        limits.lines(&mut page, motors);
        page.to_string()
    }

    #[test]
    fn a_step_that_is_later_than_the_next_one_is_not_in_time() {
        let folder = tempfile::tempdir().unwrap();
        let (slow, fast) = (motor(9_900.0), motor(10_100.0));
        let read = |part| Limits::read(&[file(&folder, "latency.json", part)]).unwrap().unwrap();
        let fit = read(latency(true, 100.0));
        assert!(said(&fit, &[&slow]).ends_with("  a figure\n  it is in time for all motors\n"));
        let text = said(&fit, &[&slow, &fast]);
        assert!(text.ends_with("x: not in time: a step is due every 99 us, but 1 of 1000 is more than 100 us late\n"));
        assert_eq!(fit.json(&[&slow])["refusals"]["x"], Value::Null);
        let unfit = read(latency(false, 4.0));
        assert!(said(&unfit, &[&slow, &fast]).ends_with("  a figure\n  the computer is not fit for steppers\n"));
    }

    #[test]
    fn the_cost_of_an_edge_comes_from_a_file_of_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let late = file(&folder, "latency.json", latency(true, 100.0));
        let edge = json!({ "edge": { "line": "GPIO17", "kernel_ns": 2000.0, "registers_ns": null } });
        let edge = file(&folder, "edge.json", edge);
        let limits = Limits::read(&[late.clone(), edge]).unwrap().unwrap();
        assert_eq!(limits.json(&[&motor(5000.0), &motor(10_000.0)])["edges_share"], 0.06);
        assert!(said(&limits, &[&motor(5000.0)]).ends_with("take at most 2.0 % of a processor\n"));
        let other = file(&folder, "other.json", json!({ "computer": "another board" }));
        let refused = Limits::read(std::slice::from_ref(&other)).unwrap_err();
        assert!(refused.contains("it has no figures: name an output of \"pinion latency --json\""), "{refused}");
        fs::write(&other, fs::read_to_string(&late).unwrap().replace("a board", "another board")).unwrap();
        assert!(Limits::read(&[late, other]).unwrap_err().contains("measure both on one computer"));
        let wrong = folder.path().join("wrong.json");
        fs::write(&wrong, "{}").unwrap();
        assert!(Limits::read(&[wrong]).unwrap_err().contains("pinion latency --json"));
        assert!(Limits::read(&[]).unwrap().is_none());
    }
}
