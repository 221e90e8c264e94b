// SPDX-License-Identifier: GPL-3.0-or-later
//! The verdict over a trace: who was late, by how much, and what to do about it.
//!
//! A stop that is about a time has a span in which it went wrong. It begins when the work was due, or when the host's
//! block came, and ends with the stop. The one who took at least half of this span is the culprit. Without evidence against
//! anybody the verdict says what is known, and accuses nobody.

use pinion_firmware::shutdown::reason;
use pinion_firmware::time::Ticks;

use bus::of_hanging;
use death::{died, hung};
use evidence::{MS, Record};
use host::{host_lost, not_refreshed, too_close};
use processors::{late_step, of_core};

use super::file::{End, Trace};

mod bus;
mod death;
mod evidence;
mod host;
mod power;
mod processors;
mod standstill;

/// Longest time that the core needs for a block that waits for nothing.
const PROMPT: i64 = MS;
/// How late a timer may be while nobody complains.
const LATE: i64 = MS;
/// How late a timer has to be so that a stop for another reason mentions it.
const VERY_LATE: i64 = 10 * MS;
/// Shortest silence of a core that hangs. An idle core beats more often.
const SILENT: i64 = 500 * MS;
/// Beginnings of the texts for outputs that the host did not refresh.
const MISSED: &str = "Missed scheduling of next";

/// Who was late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Culprit {
    /// Nobody. If the MCU stopped, it had another reason.
    Nobody,
    /// The host.
    Host,
    /// The wire to the host, or all of the computer at its other end.
    Wire,
    /// A bus, or a device on it.
    Bus,
    /// Other programs, which had the processors.
    Processors,
    /// A call of the core to a driver or the kernel took long.
    Driver,
    /// There was more to do than this computer can do.
    Work,
    /// Nothing ran: the program was stopped, or the whole computer.
    Standstill,
    /// The power supply, or heat.
    Power,
    /// Somebody who killed the program, or a fault in it.
    Death,
    /// It is not known.
    Unknown,
}

/// A verdict.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verdict {
    /// Who was late.
    pub culprit: Culprit,
    /// One line: who was late and by how much, and the remedy as an imperative.
    pub text: String,
}

/// A verdict in the making.
struct Judgment {
    culprit: Culprit,
    what: String,
    remedy: String,
}

impl Judgment {
    fn new(culprit: Culprit, what: impl Into<String>, remedy: impl Into<String>) -> Judgment {
        Judgment { culprit, what: what.into(), remedy: remedy.into() }
    }
}
/// Judges a trace.
pub fn verdict(trace: &Trace) -> Verdict {
    let record = Record::of(trace, matches!(trace.head.end, End::Shutdown { .. }));
    let Judgment { culprit, what, remedy } = match &trace.head.end {
        End::Shutdown { reason, trouble } => stopped(&record, reason, trouble),
        End::Died => died(&record),
        End::Hung { diagnosis } => hung(&record, diagnosis),
        End::Asked => asked(&record),
    };
    Verdict { culprit, text: if remedy.is_empty() { what } else { format!("{what}: {remedy}") } }
}

/// The core noticed that it gave no beat for a second or more, or that the computer was suspended.
fn stood_still(record: &Record, trouble: &str) -> Judgment {
    let gap = record.gap((record.first_of_core().unwrap_or(0).min(0), 0));
    // The clock of the events stands still while the computer is suspended.
    let found = if gap.1 - gap.0 > SILENT && gap.1 > -PROMPT { of_core(record, gap) } else { None };
    found.unwrap_or_else(|| Judgment::new(Culprit::Standstill, format!("everything stood still: {trouble}"), ""))
}

/// Why the MCU stopped.
fn stopped(record: &Record, text: &str, trouble: &str) -> Judgment {
    if text == reason::BUS_HANGS.text() {
        return of_hanging(record)
            .unwrap_or_else(|| Judgment::new(Culprit::Bus, format!("a bus did not answer: {trouble}"), ""));
    }
    if text == reason::HOST_LOST.text() {
        return host_lost(record);
    }
    let Some(due) = record.stop.due.filter(|due| *due <= 0) else {
        return match text {
            _ if text == reason::TIMER_PAST.text() => stood_still(record, trouble),
            _ if text == reason::TIMER_TOO_CLOSE.text() || text.starts_with(MISSED) => {
                Judgment::new(Culprit::Unknown, format!("it is unknown who was late: {trouble}"), "")
            }
            _ => other_reason(record, trouble),
        };
    };
    if text == reason::TIMER_TOO_CLOSE.text() {
        too_close(record, due, trouble)
    } else if text.starts_with(MISSED) {
        not_refreshed(record, due, trouble)
    } else {
        late_step(record, due, trouble)
    }
}

/// A stop that was not about a time.
fn other_reason(record: &Record, trouble: &str) -> Judgment {
    match record.latest_timer().filter(|(_, late)| *late >= VERY_LATE) {
        Some((at, late)) => {
            let what = of_core(record, (at - late, at))
                .map_or_else(|| format!("a timer was {} late", span_text(late)), |finding| finding.what);
            let before = span_text((-at).max(0));
            Judgment::new(Culprit::Nobody, format!("{trouble}; {before} before, {what}, which did not stop it"), "")
        }
        None => Judgment::new(Culprit::Nobody, format!("nobody was late: {trouble}"), ""),
    }
}

/// The recording of a program that works.
fn asked(record: &Record) -> Judgment {
    if let Some(finding) = of_hanging(record) {
        return finding;
    }
    let Some((at, late)) = record.latest_timer() else {
        return Judgment::new(Culprit::Unknown, "no timer is in the recording: nobody can have been late", "");
    };
    if late < LATE {
        return Judgment::new(Culprit::Nobody, format!("nobody was late{}", on_time(record)), "");
    }
    let mut finding = of_core(record, (at - late, at)).unwrap_or_else(|| {
        Judgment::new(Culprit::Unknown, format!("it is unknown why a timer was {} late", span_text(late)), "")
    });
    finding.what += &format!(" ({} before the end of the recording)", span_text((-at).max(0)));
    finding
}

/// How late the core was, as a clause behind others.
fn on_time(record: &Record) -> String {
    record.latest_timer().map_or_else(String::new, |(_, late)| {
        format!("; the core was never later than {}", span_text(late.max(MS / 10)))
    })
}

/// A span in ticks for people.
fn span_text(ticks: i64) -> String {
    let ms = ticks as f64 / f64::from(Ticks::from_ms(1).0);
    if ms < 1000.0 { format!("{ms:.1} ms") } else { format!("{:.1} s", ms / 1000.0) }
}

#[cfg(test)]
mod tests;
