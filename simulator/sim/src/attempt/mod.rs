// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim PRINTER.CFG --try`: a klippy on the user's configuration does what every owner does after a change.

pub(crate) mod paced;
pub(crate) mod place;
pub(crate) mod print;
mod report;
pub(crate) mod rights;
mod steps;
mod trial;
mod watching;

use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::builder::PossibleValuesParser;
use pinion_host::{Launch, NoStart, Running, Time};
use pinion_model::SimProbe;
use pinion_printer_config::{Place, Trouble};

use crate::own::serve::{Folder, Own};
use print::PrintOptions;
pub(crate) use report::Form;
use report::{Outcome, Report};
use steps::STEPS;
use trial::Trial;
pub(crate) use watching::{Host, Watching};

/// The work of klippy on the printer.
#[derive(Clone, Debug)]
pub(crate) enum Task {
    /// The steps of every owner after a change (`--try`).
    Try,
    /// It prints a file (`--print`).
    Print(PrintOptions),
    /// It runs at this many times the pace of real time (`--speed`).
    Serve(f64),
}

/// The options of `--try`, `--print` and `--speed`.
#[derive(Clone, Debug)]
pub(crate) struct Attempt {
    pub(crate) task: Task,
    pub(crate) klipper: PathBuf,
    pub(crate) python: PathBuf,
    /// A file to print in place of the small one.
    pub(crate) gcode: Option<PathBuf>,
    /// klippy and the printer have the computer's clock.
    pub(crate) real_time: bool,
    /// Only these steps, if there are any.
    pub(crate) only: Vec<String>,
    pub(crate) form: Form,
    /// The klippy, while it runs.
    pub(crate) running: Running,
}

impl Attempt {
    /// A klippy on the copy in a folder.
    fn launch<'a>(&'a self, folder: &'a Folder) -> Launch<'a> {
        Launch {
            klipper: &self.klipper,
            python: &self.python,
            folder: &folder.path,
            printer_cfg: &folder.printer_cfg,
            command: rights::confined(),
            running: self.running.clone(),
        }
    }
}

/// Tries a printer. Returns whether nothing failed, or nothing if klippy takes no part in the printer's clock. `ended` is
/// set when the program is asked to end.
pub(crate) fn run(
    attempt: &Attempt,
    (own, printer): (&Own, &Path),
    folder: &Folder,
    probe: &SimProbe,
    (time, watching): (Time, Watching),
    ended: &AtomicBool,
) -> Option<bool> {
    let mut report = Report::new(attempt.form);
    let began = time.now();
    let host = match Host::start(attempt.launch(folder), time, watching) {
        Ok(host) => host,
        Err(NoStart::Alone) => return None,
        Err(_) if ended.load(Ordering::SeqCst) => return Some(false),
        Err(NoStart::Trouble(trouble)) => {
            report.add("ready", Outcome::Failed { cause: trouble.to_string(), place: None }, Duration::ZERO);
            report.end(printer, Some(&folder.path));
            return Some(false);
        }
    };
    let mut trial = Trial::new(attempt, folder, own, probe, host);
    for step in STEPS {
        if ended.load(Ordering::SeqCst) {
            break;
        }
        if !attempt.only.is_empty() && step.name != "ready" && !attempt.only.iter().any(|only| only == step.name) {
            continue;
        }
        let since = if step.name == "ready" { began } else { trial.host.now() };
        let now = trial.host.now();
        trial.host.watch.progress.begin(step.name, now);
        let outcome = match &trial.broken {
            Some(why) => Outcome::Skipped(format!("not tried: {why}")),
            None => {
                let outcome = (step.run)(&mut trial).map_or_else(|outcome| outcome, Outcome::Passed);
                trial.judged(outcome)
            }
        };
        if ended.load(Ordering::SeqCst) {
            break;
        }
        if outcome.is_failure() {
            trial.recover(step.name);
        }
        report.add(step.name, outcome, trial.host.now().saturating_sub(since));
    }
    if ended.load(Ordering::SeqCst) {
        return Some(false);
    }
    if let Err(trouble) = trial.keep() {
        log::warn!("{trouble}");
    }
    drop(trial);
    report.end(printer, Some(&folder.path));
    Some(report.passed())
}

/// Reports a mistake that is found before klippy starts.
pub(crate) fn refused(printer: &Path, mistake: Trouble, form: Form) -> ExitCode {
    let mut report = Report::new(form);
    let (cause, place) = without_place(mistake);
    report.add("read", Outcome::Failed { cause, place }, Duration::ZERO);
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

/// A file of the folder cannot be written.
fn unwritten(path: &Path, error: io::Error) -> Trouble {
    Trouble::new(format!("it cannot be written: {error}")).of(path.display()).remedy("free space")
}

/// The names of the steps, for the command line.
pub(crate) fn steps() -> PossibleValuesParser {
    PossibleValuesParser::new(STEPS.iter().map(|step| step.name))
}

/// The klippy for `--try`.
///
/// # Errors
///
/// There is none.
pub(crate) fn klipper(named: Option<PathBuf>) -> Result<PathBuf, Trouble> {
    named.ok_or_else(|| {
        Trouble::new("it needs a klippy").remedy("name a checkout of Klipper or Kalico: --klipper ~/klipper")
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
