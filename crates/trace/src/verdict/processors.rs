// SPDX-License-Identifier: GPL-3.0-or-later
//! The core or the link did not get to its work: processors, drivers, too much work.

use crate::event::Watched;

use super::evidence::{MS, QUIET, Record, Scheduling, Span};
use super::power::with_power;
use super::standstill::standstill;
use super::{Culprit, Judgment, PROMPT, on_time, span_text};

/// Fewest events of a core that works all the time.
const FLOOD: usize = 4;
/// A kernel does not wake a thread that late, unless everything stood still.
const ASLEEP: i64 = 300 * MS;
/// Shortest time that counts as lost in the kernel's account. Each sleep costs a little.
const LOST: i64 = 5 * MS;

/// A timer ran so long after `due` that the MCU stopped.
pub(super) fn late_step(record: &Record, due: i64, trouble: &str) -> Judgment {
    let span = (due, 0);
    if let Some(finding) = of_core(record, span) {
        return finding;
    }
    let what = match record.latest_timer() {
        // Each of its steps waited for the pulse of the one before.
        Some((_, worst)) if worst < -due / 2 => {
            let what = format!("steps were closer together than their pulses{}: {trouble}", on_time(record));
            return Judgment::new(Culprit::Work, what, "");
        }
        _ => format!("it is unknown why an event was {} late: {trouble}", span_text(-due)),
    };
    with_power(record, span, Judgment::new(Culprit::Unknown, what, ""))
}

/// The host's block waited in the terminal for half of this span, because the link did not run.
pub(super) fn of_link(record: &Record, span: Span) -> Option<Judgment> {
    let half = (span.1 - span.0) / 2;
    let waited = record.account(Watched::Link, span).map_or(0, |account| account.waited);
    if waited >= half && waited > PROMPT {
        return Some(starved(record, span, "the link to the host", waited));
    }
    // The core stood still as well.
    let core = record.latest_within((span.0, 0)).max(record.latest_wake(span));
    if core >= half && core > PROMPT { of_core(record, span) } else { None }
}

/// The core did not do its work for half of this span.
pub(super) fn of_core(record: &Record, span: Span) -> Option<Judgment> {
    let late = span.1 - span.0;
    let half = late / 2;
    let account = record.account(Watched::Core, span);
    let waited = account.as_ref().map_or(0, |account| account.waited);
    let stolen = record.stolen(span);
    if stolen >= half && stolen > waited && stolen > 0 {
        let what = format!("a hypervisor took {} of processor time while an event waited", span_text(stolen));
        return Some(Judgment::new(Culprit::Standstill, what, "give this virtual machine processors of its own"));
    }
    if waited >= half && waited > 0 {
        return Some(with_power(record, span, starved(record, span, "the core", waited.min(late))));
    }
    let gap = record.gap(span);
    let gap_long = gap.1 - gap.0;
    if gap_long < half.max(1) {
        let ran = account.map(|account| account.ran);
        let is_flood =
            !record.did_sleep(span) && record.events_of_core(span) >= FLOOD && ran.is_none_or(|ran| ran >= half);
        let what = format!("the core worked all the time and was {} late", span_text(late));
        let remedy = "fewer steps a second: lower the speed or the microsteps";
        return is_flood.then(|| with_power(record, span, Judgment::new(Culprit::Work, what, remedy)));
    }
    let others = record.others_went_on(gap);
    let woke_late = record.latest_wake((gap.0, span.1 + PROMPT)) >= half;
    // A core that works and is on time writes nothing for this long.
    if gap_long <= QUIET && !woke_late && record.latest_within((span.0, span.1 + QUIET)) < half {
        return None;
    }
    let lost = account.as_ref().and_then(|account| account.lost);
    let ran = account.as_ref().is_some_and(|account| account.ran >= half);
    if ran && lost.is_some_and(|lost| lost < half) && !woke_late {
        return Some(driver(record, span, gap_long));
    }
    let overslept = woke_late && gap_long > ASLEEP;
    if !others && (overslept || record.sampler_missed(gap) || record.guardian_went_on(gap) == Some(false)) {
        return Some(standstill(record, gap, account.is_some()));
    }
    account?;
    if woke_late {
        let what = format!("the kernel woke the core {} late, though it did not wait for a processor", span_text(late));
        let remedy = "use a PREEMPT_RT kernel, and look for what blocks interrupts, such as a hypervisor";
        return Some(with_power(record, span, Judgment::new(Culprit::Driver, what, remedy)));
    }
    if others {
        return Some(driver(record, span, gap_long));
    }
    lost.filter(|lost| *lost >= half.max(LOST)).map(|_| {
        let what = format!(
            "it is unknown why the core did nothing for {}: it did not wait for a processor, so a call blocked it, or everything stood still",
            span_text(gap_long)
        );
        with_power(record, span, Judgment::new(Culprit::Unknown, what, ""))
    })
}

fn driver(record: &Record, span: Span, took: i64) -> Judgment {
    let what = format!("one call to a driver or the kernel kept the core for {}", span_text(took));
    with_power(record, span, Judgment::new(Culprit::Driver, what, "look for its device in dmesg"))
}

fn starved(record: &Record, span: Span, who: &str, waited: i64) -> Judgment {
    let what = format!("{who} waited {} for a processor", span_text(waited));
    let (why, remedy) = match record.scheduling(span) {
        _ if !record.trace.head.realtime => {
            (": it does not run in real time", "run Pinion in real time (-r, as the service does)")
        }
        Scheduling::Refused => (": it may not run in real time", "do what the log's warning about real time says"),
        Scheduling::UsedUp => (
            ": it had used up its real-time share",
            "lower the speed, or free it of the limit (sysctl kernel.sched_rt_runtime_us=-1)",
        ),
        Scheduling::RealTime => (
            ": other real-time work had it",
            "look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
        ),
    };
    Judgment::new(Culprit::Processors, what + why, remedy)
}
