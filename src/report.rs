// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of `pinion doctor` and `pinion run --check`: findings in groups.

use std::process::ExitCode;

use serde::Serialize;
use serde_json::json;

use pinion_system::finding::{Finding, Level};

use super::failed;
use super::page::{Page, print};

/// Findings under a heading.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Group {
    pub(crate) name: &'static str,
    pub(crate) findings: Vec<Finding>,
}

impl Group {
    pub(crate) fn new(name: &'static str, findings: Vec<Finding>) -> Group {
        Group { name, findings }
    }
}

/// The report for people: a line for each finding, with the remedy below it.
pub(crate) fn text(groups: &[Group]) -> Page {
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
pub(crate) fn json(groups: &[Group]) -> Page {
    let [warnings, errors] = [Level::Warning, Level::Error].map(|level| count(groups, level));
    Page::json(&format!("{:#}\n", json!({ "groups": groups, "errors": errors, "warnings": warnings })))
}

/// The program's exit status: 1 if anything does not work.
pub(crate) fn status(groups: &[Group]) -> ExitCode {
    if count(groups, Level::Error) == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Prints a report, and returns the program's exit status.
pub(crate) fn finish(page: &Page, groups: &[Group]) -> ExitCode {
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
