// SPDX-License-Identifier: GPL-3.0-or-later
//! The program died or hangs.

use super::bus::of_hanging;
use super::evidence::Record;
use super::processors::of_core;
use super::{Culprit, Judgment, SILENT, span_text};

/// The program is gone.
pub(super) fn died(record: &Record) -> Judgment {
    let last = record.last_of_core();
    let what = match last {
        Some(last) => {
            format!("Pinion died at most {} after the core's last event{}", span_text((-last).max(0)), doing(record))
        }
        None => "Pinion died".to_owned(),
    };
    Judgment::new(Culprit::Death, what, "look for a panic in its log, and for who killed it (dmesg: out of memory)")
}

/// The guardian killed a program that had no heartbeat.
pub(super) fn hung(record: &Record, diagnosis: &str) -> Judgment {
    // Without a silent core, an output is not at its shutdown value.
    let silent = record.last_of_core().filter(|last| -last > SILENT);
    let found = of_hanging(record).or_else(|| of_core(record, (silent?, 0)));
    if let Some(finding) = found {
        return Judgment { what: format!("Pinion hung: {}", finding.what), ..finding };
    }
    let last = silent.map_or_else(String::new, |last| {
        format!("; the core's last event was {} before{}", span_text(-last), doing(record))
    });
    Judgment::new(Culprit::Death, format!("Pinion hung: {diagnosis}{last}"), "report it with its log")
}

/// The core's last command, as a clause behind others.
fn doing(record: &Record) -> String {
    record.last_command().map_or_else(String::new, |command| format!(" (the last command was {command})"))
}
