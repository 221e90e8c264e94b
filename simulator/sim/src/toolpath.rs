// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --toolpath` and `--compare`: the path that the motors went, written and compared when the program ends.

use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use clap::Args;

use pinion::failed;
use pinion::page::{Page, aligned, print};
use pinion_firmware::time::{Clock, Ticks};
use pinion_firmware::trouble::Trouble;
use pinion_model::{
    AskedPath, Body, Comparison, Distances, Recorder, RingWatch, SimProbe, compare, write_gcode, write_stl, write_svg,
};
use pinion_system::files::{self, Output};

/// Longest G-code file.
const GCODE_MIB: u64 = 1024;
/// Time between two reads of the steps.
const READ_PERIOD: Duration = Duration::from_millis(50);
/// How late a step may be made.
const LATE: Ticks = Ticks::from_ms(450);

/// Options about the path of the motors.
#[derive(Args, Clone, Debug)]
pub(crate) struct PathArgs {
    /// At the end, write the path that the motors went: layers seen from above (.svg), the filament as a body (.stl),
    /// or moves (.gcode). It serves a host, without the demonstration
    #[arg(long, value_name = "FILE", conflicts_with_all = ["demo", "print_config", "print_board"])]
    toolpath: Option<PathBuf>,
    /// At the end, print how far the motors' path was from the one that this file asks for. It serves a host,
    /// without the demonstration
    #[arg(long, value_name = "FILE.gcode", conflicts_with_all = ["demo", "print_config", "print_board"])]
    pub(crate) compare: Option<PathBuf>,
    /// The distance along x and y above which `--compare` ends with exit status 1
    #[arg(long, value_name = "MM", requires = "compare", default_value_t = 0.1)]
    within: f64,
}

/// The exports of the path.
#[derive(Clone, Copy)]
enum Form {
    Drawing,
    Solid,
    Moves,
}

/// The files of the options, checked before the printer starts.
pub(crate) struct Files {
    toolpath: Option<(Output, Form)>,
    compare: Option<(PathBuf, AskedPath)>,
    within_mm: f64,
}

impl Files {
    /// Checks the files; `None` without the options. The command reads `inputs`.
    pub(crate) fn check(args: &PathArgs, inputs: &[&Path]) -> Result<Option<Files>, String> {
        if args.toolpath.is_none() && args.compare.is_none() {
            return Ok(None);
        }
        let compare = match &args.compare {
            Some(path) => Some((path.clone(), asked(path).map_err(|error| error.to_string())?)),
            None => None,
        };
        if !(args.within.is_finite() && args.within > 0.0) {
            return Err(format!("--within {} is not a distance: give millimeters above 0", args.within));
        }
        let toolpath = match args.toolpath.as_deref() {
            Some(path) => Some((Output::check(path, inputs)?, form(path)?)),
            None => None,
        };
        Ok(Some(Files { toolpath, compare, within_mm: args.within }))
    }
}

/// The path that a G-code file asks for.
fn asked(path: &Path) -> Result<AskedPath, Trouble> {
    let file = path.display().to_string();
    let opened = files::open(path, GCODE_MIB)
        .map_err(|error| Trouble::new(error.to_string()).of(&file).remedy("name a readable G-code file"))?;
    AskedPath::read(BufReader::new(opened), &file)
}

/// The form by the file's extension.
fn form(path: &Path) -> Result<Form, String> {
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    match extension.to_ascii_lowercase().as_str() {
        "svg" => Ok(Form::Drawing),
        "stl" => Ok(Form::Solid),
        "gcode" => Ok(Form::Moves),
        _ => Err(format!("{}: the extension says no form: name it .svg, .stl or .gcode", path.display())),
    }
}

/// The path that is recorded, until the program ends.
pub(crate) struct PathRecord {
    files: Files,
    probe: SimProbe,
    recorded: Arc<Mutex<Recorded>>,
    /// A thread that reads it, if nobody else does.
    reader: Option<(Sender<()>, JoinHandle<()>)>,
}

struct Recorded {
    recorder: Recorder,
    rings: Vec<RingWatch>,
    prints: bool,
}

impl Recorded {
    fn read(&mut self, now: Clock) {
        self.recorder.read(now);
        let settled = Clock::from_ticks(now.ticks().saturating_sub(LATE.0.into()));
        self.rings.iter_mut().for_each(|ring| ring.read(settled));
        if !self.prints && self.recorder.points().last().is_some_and(|last| last.layer > 0) {
            // Homing stops abruptly, and rings more than any print.
            self.prints = true;
            self.rings.iter_mut().for_each(RingWatch::forget);
        }
    }
}

fn lock(recorded: &Mutex<Recorded>) -> MutexGuard<'_, Recorded> {
    recorded.lock().unwrap_or_else(PoisonError::into_inner)
}

impl PathRecord {
    /// Records from now on. Somebody has to call [`PathRecord::reader`]'s function while time passes.
    pub(crate) fn new(files: Files, probe: SimProbe) -> PathRecord {
        let recorded = Recorded { recorder: probe.recorder(), rings: probe.rings(), prints: false };
        PathRecord { files, probe, recorded: Arc::new(Mutex::new(recorded)), reader: None }
    }

    /// A function that reads the steps until now.
    pub(crate) fn reader(&self) -> impl FnMut() + Send + 'static {
        let (recorded, probe) = (self.recorded.clone(), self.probe.clone());
        move || lock(&recorded).read(probe.now())
    }

    /// Records from now on, with a thread that reads. Start it before the MCU runs: a real-time thread passes its scheduling
    /// on.
    pub(crate) fn record(files: Files, probe: SimProbe) -> io::Result<PathRecord> {
        let record = PathRecord::new(files, probe);
        let (stop, stopped) = mpsc::channel::<()>();
        let mut read = record.reader();
        let thread = thread::Builder::new().name("toolpath".into()).spawn(move || {
            while stopped.recv_timeout(READ_PERIOD) == Err(RecvTimeoutError::Timeout) {
                read();
            }
        })?;
        Ok(PathRecord { reader: Some((stop, thread)), ..record })
    }

    /// Writes and compares the path after the MCU has ended. The exit status is 1 if something is wrong with it.
    pub(crate) fn end(self) -> ExitCode {
        let PathRecord { files, probe, recorded, reader } = self;
        if let Some((stop, thread)) = reader {
            drop(stop);
            if thread.join().is_err() {
                return failed("the path was not recorded: report this with the log");
            }
        }
        let mut recorded = lock(&recorded);
        let now = probe.now();
        recorded.recorder.end(now);
        recorded.rings.iter_mut().for_each(|ring| ring.read(now));
        let points = recorded.recorder.points();
        let mut page = Page::default();
        let mut troubles = Vec::new();
        if let Some((output, form)) = &files.toolpath {
            match write(output, *form, &recorded.recorder) {
                Ok(said) => page.line(said),
                Err(error) => troubles.push(error),
            }
        }
        if recorded.recorder.gaps() > 0 {
            let gaps = recorded.recorder.gaps();
            troubles.push(format!("the path has {gaps} gaps: the computer was busy for too long: run less beside it"));
        }
        if recorded.recorder.is_full() {
            troubles.push("the path was too long, so its end is missing: print a shorter file".to_owned());
        }
        if let Some((path, asked)) = &files.compare {
            let lost: Vec<_> = probe.axes().filter(|axis| axis.lost_steps > 0).collect();
            for axis in lost {
                let (name, count) = (axis.name, axis.lost_steps);
                troubles
                    .push(format!("axis {name} lost {count} steps at an end of its travel: look at the moves there"));
            }
            match compare(points, asked) {
                Ok(found) => report(&mut page, &mut troubles, path, &found, files.within_mm),
                Err(trouble) => troubles.push(trouble.of(path.display()).to_string()),
            }
            for ring in &recorded.rings {
                if let Some(seen) = ring.seen() {
                    page.line(format_args!(
                        "behind a move the head rings along {} at {} Hz: {:.4} mm off at most, {:.4} mm on average",
                        ring.axis(),
                        ring.hz(),
                        seen.greatest_mm,
                        seen.mean_mm
                    ));
                }
            }
        }
        if let Err(error) = print(&page) {
            troubles.push(error);
        }
        troubles.iter().for_each(|trouble| log::error!("{trouble}"));
        if troubles.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
    }
}

/// Writes the path, and says what was written.
fn write(output: &Output, form: Form, recorder: &Recorder) -> Result<String, String> {
    let points = recorder.points();
    let (file, count) = (output.path(), points.len());
    output.write(|out| match form {
        Form::Drawing => {
            write_svg(points, recorder.filament_step_mm(), out)?;
            Ok(format!("drawn: {file} ({count} points)"))
        }
        Form::Moves => {
            write_gcode(points, out)?;
            Ok(format!("written: {file} ({count} points)"))
        }
        Form::Solid => {
            let Body { off_mm, left_out } = write_stl(points, recorder.filament_step_mm(), out)?;
            let left_out = if left_out > 0 { format!(", {left_out} lines had no room") } else { String::new() };
            Ok(format!("written: {file} (at most {off_mm} mm off the path{left_out})"))
        }
    })
}

/// Adds the comparison to the page.
fn report(page: &mut Page, troubles: &mut Vec<String>, path: &Path, found: &Comparison, within_mm: f64) {
    let file = path.display();
    let head = ["layer", "z mm", "greatest mm", "at line", "mean mm", "greatest z mm", "path mm"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let row = |layer: String, z: String, found: &Distances| {
        let Distances { greatest_mm, line, mean_mm, greatest_z_mm, length_mm } = found;
        let numbers = [greatest_mm, mean_mm, greatest_z_mm].map(|mm| format!("{mm:.4}"));
        let [greatest, mean, greatest_z] = numbers;
        vec![layer, z, greatest, line.to_string(), mean, greatest_z, format!("{length_mm:.0}")]
    };
    rows.extend(found.layers.iter().map(|(layer, z_mm, found)| row(layer.to_string(), format!("{z_mm:.2}"), found)));
    rows.push(row("all".into(), String::new(), &found.all));
    page.line(format_args!("the motors' path beside {file}:"));
    aligned(&rows).iter().for_each(|line| page.line(line));
    if let Some(line) = found.ends_at_line {
        troubles.push(format!("{file}:{line}: the motors' path ends here: print the whole file"));
    }
    if found.all.greatest_mm > within_mm {
        let Distances { greatest_mm, line, .. } = found.all;
        troubles.push(format!(
            "{file}:{line}: the motors were {greatest_mm:.3} mm off, above --within {within_mm}: look for late \
             steps in the log, and for what printer.cfg changes here"
        ));
    }
}
