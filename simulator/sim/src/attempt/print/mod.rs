// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim PRINTER.CFG --print FILE`: a klippy prints the file on the simulated printer, in one clock.

mod file;
mod limits;
mod phase;
mod plot;
mod report;

use std::fs;
use std::io::{BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use pinion::page::Page;
use pinion_firmware::time::CLOCK_FREQ;
use pinion_host::{NoStart, Time};
use pinion_model::{AskedPath, PathPoint, SimProbe, compare};
use pinion_printer_config::{Config, Trouble};
use pinion_system::files::Output;
use serde_json::{Value, json};

use super::report::show;
use super::trial::homes_by_stall;
use super::{Attempt, Form, Host, Watching, unwritten};
use crate::own::serve::{Folder, Own};
use file::GcodeFile;
use limits::Limits;
use phase::{Phase, Sight};
use report::{Heated, Printed, Stopped};

/// Time between two looks at a print.
const LOOK: Duration = Duration::from_secs(1);
/// How long klippy has to be ready.
const READY: Duration = Duration::from_secs(90);
/// How long klippy has for a command of ours.
const COMMAND: Duration = Duration::from_secs(60);
/// How long a print may stay at one line without a motion: a macro waits for ever, or a heater never arrives.
const STILL: Duration = Duration::from_secs(3600);
/// When a person resumes a print that has paused.
const RESUME: Duration = Duration::from_secs(30);
/// Highest number of lines about unknown commands that are kept.
const UNKNOWN_MAX: usize = 20;
/// How often at most.
const PAUSES_MAX: usize = 100;
/// A heater is cold if it misses this much of its target.
const COLD_K: f64 = 2.0;
/// Speed under which nothing moves.
const MOVES_MM_PER_S: f64 = 0.01;
/// Diameter of the filament, for its flow.
const DIAMETER_MM: f64 = 1.75;
/// Width of the bar on a terminal.
const BAR: usize = 30;

/// The options of `--print`.
#[derive(Clone, Debug)]
pub(crate) struct PrintOptions {
    pub(crate) file: PathBuf,
    /// Report each layer.
    pub(crate) layers: bool,
    pub(crate) plot: Option<PathBuf>,
    /// Outputs of `pinion latency --json`.
    pub(crate) latency: Vec<PathBuf>,
}

/// The printer at an instant of a print.
struct Sample {
    at_s: f64,
    phase: Phase,
    mm_per_s: f64,
    mm3_per_s: f64,
    /// In the order of the heaters.
    celsius: Vec<f64>,
}

/// Prints a file. Returns whether it came to its end, or nothing if klippy takes no part in the printer's clock.
///
/// # Errors
///
/// The file cannot be read, or klippy does not start.
pub(crate) fn run(
    attempt: &Attempt,
    options: &PrintOptions,
    (own, printer): (&Own, &Path),
    folder: &Folder,
    probe: &SimProbe,
    (time, watching): (Time, Watching),
    ended: &AtomicBool,
) -> Result<Option<bool>, Trouble> {
    let plot = options.plot.as_deref().map(|path| Output::check(path, &[printer, &options.file])).transpose();
    let plot = plot.map_err(Trouble::new)?;
    let limits = Limits::read(&options.latency).map_err(Trouble::new)?;
    let file = GcodeFile::read(&options.file)?;
    let began = Instant::now();
    offer(&file, own, folder)?;
    let host = match Host::start(attempt.launch(folder), time, watching) {
        Ok(host) => host,
        Err(NoStart::Alone) => return Ok(None),
        Err(NoStart::Trouble(trouble)) => return Err(trouble),
    };
    let mut printing = Print {
        host,
        probe,
        file: &file,
        heaters: Vec::new(),
        samples: Vec::new(),
        pauses: 0,
        line: 1,
        has_begun: false,
        unknown: Vec::new(),
        config: &own.config,
        limits,
    };
    let printed = printing.run();
    let took = began.elapsed();
    printing.host.watch.progress.end();
    if ended.load(Ordering::SeqCst) {
        return Ok(Some(false));
    }
    if let Some(plot) = plot {
        let names: Vec<String> = printing.heaters.iter().map(|heater| heater.name.clone()).collect();
        let drawing = plot::svg(&printing.samples, &names);
        plot.write(|out| out.write_all(drawing.as_bytes())).map_err(Trouble::new)?;
    }
    let page = match attempt.form {
        Form::Json => Page::json(&format!("{}\n", printed.json(printer, (took, &folder.path)))),
        Form::Lines => printed.page(printer, (took, options.layers)),
    };
    show(&page);
    Ok(Some(printed.passed()))
}

/// Reports a mistake in printer.cfg, for programs.
pub(crate) fn refused(printer: &Path, mistake: &Trouble) -> ExitCode {
    let stopped = json!({ "line": null, "text": null, "why": mistake.to_string() });
    let report = json!({ "printer": printer.display().to_string(), "passed": false, "stopped": stopped });
    show(&Page::json(&format!("{report}\n")));
    ExitCode::FAILURE
}

/// Puts the file where klippy looks for files to print.
fn offer(file: &GcodeFile, own: &Own, folder: &Folder) -> Result<(), Trouble> {
    let gcodes = folder.path.join("gcodes");
    let copy = gcodes.join(NAME);
    fs::write(&copy, &file.bytes).map_err(|error| unwritten(&copy, error))?;
    if own.config.section("virtual_sdcard").is_none() {
        // A printer whose host prints by another way.
        let text = fs::read_to_string(&folder.printer_cfg).map_err(|error| unwritten(&folder.printer_cfg, error))?;
        let text = format!("[virtual_sdcard]\npath: {}\n{text}", gcodes.display());
        fs::write(&folder.printer_cfg, text).map_err(|error| unwritten(&folder.printer_cfg, error))?;
    }
    Ok(())
}

/// The name of the copy: names with spaces are a matter of klippy's parser.
const NAME: &str = "print.gcode";

struct Print<'a> {
    host: Host,
    probe: &'a SimProbe,
    file: &'a GcodeFile,
    heaters: Vec<Heated>,
    samples: Vec<Sample>,
    pauses: usize,
    /// The line that klippy runs.
    line: usize,
    /// Filament was laid.
    has_begun: bool,
    /// klippy's words about commands that it does not know. It goes on then.
    unknown: Vec<String>,
    config: &'a Config,
    limits: Option<Limits>,
}

impl Print<'_> {
    fn run(&mut self) -> Printed {
        self.host.watch.progress.begin(&self.file.name(), self.host.now());
        let before: Vec<u64> = self.probe.axes().map(|axis| axis.lost_steps).collect();
        let ready = self.host.until_ready(READY);
        self.host.watch.recorder = Some(self.probe.recorder());
        self.host.watch.paces = Some(self.probe.paces());
        let began = self.host.now();
        let stopped = match ready {
            Ok(()) => self.follow(began).err(),
            Err(words) => Some(words),
        };
        // Moves that klippy has planned are still on their way.
        let stopped = stopped.or_else(|| self.finish().err());
        let total_s = self.host.now().saturating_sub(began).as_secs_f64();
        // The report does not depend on it.
        let _ = self.host.sleep(Duration::from_millis(600));
        let (points, trouble) = self.path();
        let asked = AskedPath::read(BufReader::new(self.file.bytes.as_slice()), &self.file.name());
        let compared = match trouble {
            Some(trouble) => Err(trouble),
            None => asked.and_then(|asked| compare(&points, &asked)).map_err(|trouble| trouble.to_string()),
        };
        let lost = self.probe.axes().zip(before).map(|(axis, before)| (axis.name.to_owned(), axis.lost_steps - before));
        let lost = lost.filter(|(axis, steps)| *steps > 0 && !homes_by_stall(self.config, axis)).collect();
        let stopped = stopped.map(|why| Stopped { line: self.line, text: self.file.text(self.line), why });
        let phases = Phase::ALL.map(|phase| {
            let starts = std::iter::once(0.0).chain(self.samples.iter().map(|sample| sample.at_s));
            let of_phase = self.samples.iter().zip(starts).filter(|(sample, _)| sample.phase == phase);
            // The sum of nothing is -0.0.
            (phase, of_phase.map(|(sample, from)| sample.at_s - from).sum::<f64>() + 0.0)
        });
        Printed {
            file: self.file.name(),
            total_s,
            phases: phases.to_vec(),
            layers: layers(&points),
            filament_mm: points.iter().map(|point| f64::from(point.laid_mm)).sum(),
            motors: self.host.watch.paces.take().map_or_else(Vec::new, |paces| paces.most().cloned().collect()),
            limits: self.limits.take(),
            heaters: self.heaters.clone(),
            compared,
            lost,
            unknown: self.unknown.clone(),
            pauses: self.pauses,
            stopped,
        }
    }

    /// Waits for the end of all motion. M400 ends without an error if klippy stops during it.
    fn finish(&mut self) -> Result<(), String> {
        self.host.gcode("M400", STILL).map_err(|refused| refused.to_string())?;
        match self.host.state().map_err(|refused| refused.to_string())? {
            (state, _) if state == "ready" => Ok(()),
            (_, words) => Err(first_line(&words)),
        }
    }

    /// The path that was recorded, and why it is not the whole one.
    fn path(&mut self) -> (Vec<PathPoint>, Option<String>) {
        let Some(mut recorder) = self.host.watch.recorder.take() else { return (Vec::new(), None) };
        recorder.end(self.probe.now());
        let trouble = match recorder.gaps() {
            _ if recorder.is_full() => Some("the path was too long, so its end is missing".to_owned()),
            0 => None,
            gaps => Some(format!("the path has {gaps} gaps")),
        };
        (recorder.points().to_vec(), trouble)
    }

    /// Starts the print, and follows it to its end. The error is why it stopped.
    fn follow(&mut self, began: Duration) -> Result<(), String> {
        let heaters = self.host.heaters().map_err(|refused| refused.to_string())?;
        self.heaters = heaters.into_iter().map(Heated::new).collect();
        let start = format!("SDCARD_PRINT_FILE FILENAME={NAME}");
        self.host.gcode(&start, COMMAND).map_err(|refused| refused.to_string())?;
        let (mut still_since, mut last) = (self.host.now(), (0, [0.0; 3]));
        let mut paused_since = None;
        loop {
            self.host.sleep(LOOK).map_err(|stop| format!("klippy is gone: {stop}"))?;
            let heaters: Vec<String> = self.heaters.iter().map(|heater| heater.name.clone()).collect();
            let more = ["print_stats", "virtual_sdcard", "toolhead", "motion_report", "webhooks"];
            let objects: Vec<&str> = heaters.iter().map(String::as_str).chain(more).collect();
            let status = self.host.query(&objects).map_err(|refused| refused.to_string())?;
            let offset = status["virtual_sdcard"]["file_position"].as_u64().unwrap_or_default();
            let state = status["print_stats"]["state"].as_str().unwrap_or_default().to_owned();
            match state.as_str() {
                "complete" => {}
                // A print that is cancelled from elsewhere has no place any more.
                "cancelled" | "standby" if offset == 0 => {}
                // The place behind the line that has cancelled it.
                "cancelled" => self.line = self.file.line_at(offset - 1),
                _ => self.line = self.file.line_at(offset),
            }
            let unknown = self.host.said.drain(..).filter(|line| line.contains("Unknown command:"));
            self.unknown.extend(unknown.take(UNKNOWN_MAX.saturating_sub(self.unknown.len())));
            if status["webhooks"]["state"] != "ready" {
                return Err(first_line(status["webhooks"]["state_message"].as_str().unwrap_or_default()));
            }
            self.see(&status, began, &state);
            match state.as_str() {
                "complete" => return Ok(()),
                "error" => return Err(first_line(status["print_stats"]["message"].as_str().unwrap_or_default())),
                "cancelled" | "standby" => return Err("the print was cancelled".into()),
                "paused" => {
                    let since = *paused_since.get_or_insert(self.host.now());
                    if self.host.now() - since >= RESUME {
                        paused_since = None;
                        self.pauses += 1;
                        if self.pauses > PAUSES_MAX {
                            return Err(format!("it has paused {} times", self.pauses));
                        }
                        self.host.gcode("RESUME", STILL).map_err(|refused| refused.to_string())?;
                    }
                }
                _ => paused_since = None,
            }
            let place = (offset, self.probe.nozzle_mm());
            if place != last {
                (still_since, last) = (self.host.now(), place);
            } else if self.host.now() - still_since > STILL {
                return Err(format!("nothing has moved for {} min", STILL.as_secs() / 60));
            }
        }
    }

    /// Takes in what klippy says about itself.
    fn see(&mut self, status: &Value, began: Duration, state: &str) {
        let mut is_cold = false;
        let mut celsius = Vec::new();
        for heater in &mut self.heaters {
            let of = |key: &str| status[heater.name.as_str()][key].as_f64().unwrap_or_default();
            let (now, target) = (of("temperature"), of("target"));
            heater.see(now, target);
            is_cold |= target > 0.0 && now < target - COLD_K;
            celsius.push(now);
        }
        let number = |object: &str, key: &str| status[object][key].as_f64().unwrap_or_default();
        let mm_per_s = number("motion_report", "live_velocity");
        let filament_mm_per_s = number("motion_report", "live_extruder_velocity");
        let homed = status["toolhead"]["homed_axes"].as_str().unwrap_or_default();
        let point = self.host.watch.recorder.as_ref().and_then(|recorder| recorder.points().last());
        let has_begun = point.is_some_and(|point| point.layer > 0);
        if has_begun && !self.has_begun {
            // Homing and probing stop abruptly, as no print does.
            self.has_begun = true;
            self.host.watch.paces = Some(self.probe.paces());
        }
        let sight = Sight {
            line: &self.file.text(self.line),
            is_paused: state == "paused",
            moves: mm_per_s > MOVES_MM_PER_S,
            is_cold,
            is_homed: ["x", "y", "z"].iter().all(|axis| homed.contains(axis)),
            has_begun,
        };
        let phase = Phase::of(sight);
        let area_mm2 = std::f64::consts::PI * (DIAMETER_MM / 2.0).powi(2);
        self.samples.push(Sample {
            at_s: self.host.now().saturating_sub(began).as_secs_f64(),
            phase,
            mm_per_s,
            mm3_per_s: filament_mm_per_s.max(0.0) * area_mm2,
            celsius,
        });
        let share = number("virtual_sdcard", "progress").clamp(0.0, 1.0);
        let full = (share * BAR as f64) as usize;
        let bar = format!(" [{}{}] {:.0} %", "#".repeat(full), "-".repeat(BAR - full), share * 100.0);
        self.host.watch.progress.say(bar);
    }
}

/// The first line of klippy's words, which says it.
fn first_line(words: &str) -> String {
    words.lines().map(str::trim).find(|line| !line.is_empty()).unwrap_or("klippy says nothing").to_owned()
}

/// How long each layer took, and its height.
fn layers(points: &[PathPoint]) -> Vec<(f64, f64)> {
    let mut firsts: Vec<&PathPoint> = Vec::new();
    for point in points.iter().filter(|point| point.layer > 0) {
        if firsts.last().is_none_or(|first| first.layer != point.layer) {
            firsts.push(point);
        }
    }
    let Some(last) = points.last() else { return Vec::new() };
    let ends = firsts.iter().skip(1).copied().chain([last]);
    let took = |(first, end): (&&PathPoint, &PathPoint)| {
        (end.at.since(first.at) as f64 / f64::from(CLOCK_FREQ), first.nozzle_mm[2])
    };
    firsts.iter().zip(ends).map(took).collect()
}
