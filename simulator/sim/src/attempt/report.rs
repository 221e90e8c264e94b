// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of `--try`: one line for each step, then a verdict.

use std::io::{IsTerminal, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use pinion::page::{Page, print};
use pinion::terminal::ERASE_LINE;
use pinion_linux::foreign::plain;
use pinion_printer_config::Place;

/// Prints a page. What it says is also in the exit status, so a reader that is gone is no failure.
pub(super) fn show(page: &Page) {
    if let Err(error) = print(page) {
        log::warn!("{error}");
    }
}

/// How a step ended.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outcome {
    Passed(String),
    Failed {
        cause: String,
        place: Option<Place>,
    },
    /// It was not tried, and why.
    Skipped(String),
}

impl Outcome {
    /// The outcome with this place, if a failure has none.
    pub(super) fn at(self, at: &Place) -> Outcome {
        match self {
            Outcome::Failed { cause, place: None } => Outcome::Failed { cause, place: Some(at.clone()) },
            other => other,
        }
    }

    /// Whether nothing shows that the step works.
    pub(super) fn is_failure(&self) -> bool {
        matches!(self, Outcome::Failed { .. })
    }

    /// The result's word, its text, and the place of a mistake.
    fn parts(&self) -> (&'static str, String, Option<&Place>) {
        match self {
            Outcome::Passed(seen) => ("passed", seen.clone(), None),
            Outcome::Skipped(why) => ("skipped", why.clone(), None),
            Outcome::Failed { cause, place } => ("failed", cause.clone(), place.as_ref()),
        }
    }
}

/// A step.
struct Step {
    name: &'static str,
    outcome: Outcome,
    took: Duration,
}

/// The form of the report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    Lines,
    Json,
}

/// A line on a terminal about what is under way.
pub(super) struct Progress {
    is_shown: bool,
    doing: String,
    /// When it began, by the printer's clock and by the computer's.
    began: (Duration, Instant),
    shown: Option<Instant>,
    /// The text after the times.
    more: String,
}

/// Real time between two lines.
const SHOW: Duration = Duration::from_millis(200);

impl Progress {
    pub(super) fn new(form: Form) -> Progress {
        let is_shown = form == Form::Lines && std::io::stdout().is_terminal();
        Progress {
            is_shown,
            doing: String::new(),
            began: (Duration::ZERO, Instant::now()),
            shown: None,
            more: String::new(),
        }
    }

    /// Something begins, at this time of the printer.
    pub(super) fn begin(&mut self, doing: &str, now: Duration) {
        (self.doing, self.began, self.shown) = (plain(doing).into_owned(), (now, Instant::now()), None);
        self.more.clear();
        self.show(now);
    }

    /// Sets the text after the times.
    pub(super) fn say(&mut self, more: String) {
        self.more = more;
    }

    /// Takes the line away.
    pub(super) fn end(&self) {
        if self.is_shown {
            let _ = write!(std::io::stdout(), "\r{ERASE_LINE}");
        }
    }

    /// Shows the line, if the last one is old.
    pub(super) fn show(&mut self, now: Duration) {
        if !self.is_shown || self.shown.is_some_and(|shown| shown.elapsed() < SHOW) {
            return;
        }
        self.shown = Some(Instant::now());
        let (printer, computer) = (now.saturating_sub(self.began.0).as_secs(), self.began.1.elapsed().as_secs());
        let mut out = std::io::stdout();
        let Progress { doing, more, .. } = self;
        let _ = write!(out, "\r{ERASE_LINE}  ...  {doing}: {printer} s of the printer in {computer} s{more}");
        let _ = out.flush();
    }
}

/// All steps.
pub(super) struct Report {
    form: Form,
    steps: Vec<Step>,
    began: Instant,
}

impl Report {
    pub(super) fn new(form: Form) -> Report {
        Report { form, steps: Vec::new(), began: Instant::now() }
    }

    /// A step ended. It took this long on the printer.
    pub(super) fn add(&mut self, name: &'static str, outcome: Outcome, took: Duration) {
        if self.form == Form::Lines {
            let mut page = Page::default();
            let (result, text, place) = outcome.parts();
            let mark = match result {
                "passed" => "ok",
                "skipped" => "-",
                _ => "FAIL",
            };
            let place = place.map_or_else(String::new, |place| format!("{place}: "));
            let seconds = if result == "passed" { format!(" ({:.1} s)", took.as_secs_f64()) } else { String::new() };
            page.line(format_args!("{mark:<6}{name:<12} {place}{text}{seconds}"));
            self.erase();
            show(&page);
        }
        self.steps.push(Step { name, outcome, took });
    }

    fn erase(&self) {
        let mut out = std::io::stdout();
        if out.is_terminal() {
            let _ = write!(out, "\r{ERASE_LINE}");
        }
    }

    fn failed(&self) -> impl Iterator<Item = &Step> {
        self.steps.iter().filter(|step| step.outcome.is_failure())
    }

    /// Whether nothing failed.
    pub(super) fn passed(&self) -> bool {
        self.failed().next().is_none()
    }

    /// Writes the verdict, and a line for the CI. The folder is missing if klippy was not started.
    pub(super) fn end(&self, printer: &Path, folder: Option<&Path>) {
        let mut page = Page::default();
        match self.form {
            Form::Json => page = Page::json(&format!("{}\n", self.json(printer, folder))),
            Form::Lines => {
                let failed: Vec<&str> = self.failed().map(|step| step.name).collect();
                let name = printer.display();
                match &failed[..] {
                    [] => page.line(format_args!("{name} works here: everything that was tried passed")),
                    failed => page.line(format_args!("{name} does NOT work here: {} failed", failed.join(", "))),
                }
                let printer: Duration = self.steps.iter().map(|step| step.took).sum();
                let (printer, computer) = (printer.as_secs_f64(), self.began.elapsed().as_secs_f64());
                page.line(format_args!("{printer:.0} s of the printer took {computer:.0} s"));
                if let Some(folder) = folder {
                    page.line(format_args!("the logs and the copy for klippy are in {}", folder.display()));
                }
            }
        }
        // GitHub shows such a line at its place in the file.
        if std::env::var_os("GITHUB_ACTIONS").is_some() && self.form == Form::Lines {
            for step in self.failed() {
                let (_, text, place) = step.outcome.parts();
                let at = place.map_or_else(
                    || format!("file={}", printer.display()),
                    |place| format!("file={},line={}", place.file.display(), place.line),
                );
                page.line(format_args!("::error {at},title={}::{text}", step.name));
            }
        }
        show(&page);
    }

    fn json(&self, printer: &Path, folder: Option<&Path>) -> Value {
        let steps = self.steps.iter().map(|step| {
            let (result, text, place) = step.outcome.parts();
            json!({
                "step": step.name,
                "result": result,
                "text": text,
                "file": place.map(|place| place.file.display().to_string()),
                "line": place.map(|place| place.line),
                "seconds": (step.took.as_secs_f64() * 10.0).round() / 10.0,
            })
        });
        json!({
            "printer": printer.display().to_string(),
            "passed": self.passed(),
            "folder": folder.map(|folder| folder.display().to_string()),
            "steps": steps.collect::<Vec<Value>>(),
        })
    }
}
