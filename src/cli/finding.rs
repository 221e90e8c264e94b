// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of `pinion doctor` and `pinion run --check`: findings, each with its level and its remedy.

use std::process::ExitCode;

use serde::{Serialize, Serializer};
use serde_json::json;

use pinion_firmware::trouble::Trouble;

use super::failed;
use super::page::{Page, print};

/// The level of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Level {
    /// Nothing needs to be fixed.
    Ok,
    /// Something works worse than it could, or may not work, or is unknown.
    Warning,
    /// Something does not work.
    Error,
}

impl Level {
    fn name(self) -> &'static str {
        match self {
            Level::Ok => "ok",
            Level::Warning => "warning",
            Level::Error => "error",
        }
    }
}

/// A finding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Finding {
    /// The check's name, in one word that stays the same in all versions.
    pub(super) check: &'static str,
    pub(super) status: Level,
    /// The state, and the remedy: a command or another step.
    pub(super) trouble: Trouble,
}

impl Serialize for Finding {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Finding { check, status, trouble } = self;
        json!({ "check": check, "status": status, "found": trouble.found(), "remedy": trouble.remedy })
            .serialize(serializer)
    }
}

impl Finding {
    /// The state is as it should be.
    pub(super) fn ok(check: &'static str, trouble: impl Into<Trouble>) -> Finding {
        Finding::of(check, Level::Ok, trouble)
    }

    /// The state may be a reason why something does not work well.
    pub(super) fn warning(check: &'static str, trouble: impl Into<Trouble>, remedy: impl Into<Box<str>>) -> Finding {
        Finding::of(check, Level::Warning, trouble).or(remedy)
    }

    /// The state is the reason why something does not work.
    pub(super) fn error(check: &'static str, trouble: impl Into<Trouble>, remedy: impl Into<Box<str>>) -> Finding {
        Finding::of(check, Level::Error, trouble).or(remedy)
    }

    /// A finding of this level, with the remedy in `trouble`.
    pub(super) fn of(check: &'static str, status: Level, trouble: impl Into<Trouble>) -> Finding {
        Finding { check, status, trouble: trouble.into() }
    }

    /// The same with a remedy, for a state that is fine but may be unwanted.
    pub(super) fn or(self, remedy: impl Into<Box<str>>) -> Finding {
        Finding { trouble: self.trouble.remedy(remedy), ..self }
    }
}

/// Findings under a heading.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Group {
    pub(super) name: &'static str,
    pub(super) findings: Vec<Finding>,
}

impl Group {
    pub(super) fn new(name: &'static str, findings: Vec<Finding>) -> Group {
        Group { name, findings }
    }
}

/// The report for people: a line for each finding, with the remedy below it.
pub(super) fn text(groups: &[Group]) -> Page {
    let mut page = Page::default();
    for Group { name, findings } in groups.iter().filter(|group| !group.findings.is_empty()) {
        page.line(name);
        for Finding { status, trouble, .. } in findings {
            page.line(format_args!("  {:<8} {}", status.name(), trouble.found()));
            if let Some(remedy) = &trouble.remedy {
                page.line(format_args!("           -> {remedy}"));
            }
        }
    }
    let [warnings, errors] = [Level::Warning, Level::Error].map(|level| count(groups, level));
    page.line(format_args!("{errors} error{}, {warnings} warning{}", plural(errors), plural(warnings)));
    page
}

/// The report for programs.
pub(super) fn json(groups: &[Group]) -> Page {
    let [warnings, errors] = [Level::Warning, Level::Error].map(|level| count(groups, level));
    Page::json(&format!("{:#}\n", json!({ "groups": groups, "errors": errors, "warnings": warnings })))
}

/// The program's exit status: 1 if anything does not work.
pub(super) fn status(groups: &[Group]) -> ExitCode {
    if count(groups, Level::Error) == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Prints a report, and returns the program's exit status.
pub(super) fn finish(page: &Page, groups: &[Group]) -> ExitCode {
    print(page).map_or_else(failed, |()| status(groups))
}

fn count(groups: &[Group], level: Level) -> usize {
    groups.iter().flat_map(|group| &group.findings).filter(|finding| finding.status == level).count()
}

fn plural(count: usize) -> &'static str {
    if count == 1 { "" } else { "s" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;

    fn groups() -> Vec<Group> {
        vec![
            Group::new(
                "kernel",
                vec![
                    Finding::ok("preempt_rt", "it is PREEMPT_RT"),
                    Finding::warning("governor", "it is ondemand", "cpupower frequency-set -g performance"),
                ],
            ),
            Group::new("nothing", vec![]),
            Group::new("pty", vec![Finding::error("link", "there is none", "start it")]),
        ]
    }

    #[test]
    fn people_get_lines_and_remedies() {
        assert_eq!(
            text(&groups()).to_string(),
            "\
kernel
  ok       it is PREEMPT_RT
  warning  it is ondemand
           -> cpupower frequency-set -g performance
pty
  error    there is none
           -> start it
1 error, 1 warning
"
        );
    }

    proptest! {
        #[test]
        fn whatever_was_found_stays_in_its_line(name in any_name()) {
            let groups = |name: &str| [Group::new("pty", vec![Finding::error("link", name, name)])];
            for show in [text, json] {
                assert_plain(&show(&groups(&name)).to_string(), show(&groups("x")).lines().count());
            }
        }
    }

    #[test]
    fn programs_get_the_same() {
        let value: serde_json::Value = serde_json::from_str(&json(&groups()).to_string()).unwrap();
        assert_eq!(value["errors"], 1);
        assert_eq!(value["groups"][0]["name"], "kernel");
        let finding = &value["groups"][0]["findings"][1];
        assert_eq!((&finding["check"], &finding["status"]), (&json!("governor"), &json!("warning")));
        assert!(value["groups"][0]["findings"][0]["remedy"].is_null());
    }
}
