// SPDX-License-Identifier: GPL-3.0-or-later
//! The host or the wire to it was late: its block, or the refresh of an output.

use crate::file::SSH;

use super::bus::of_bus;
use super::evidence::{Arrival, MS, Record, Span};
use super::power::with_power;
use super::processors::{of_core, of_link};
use super::{Culprit, Judgment, PROMPT, SILENT, on_time, span_text};

/// How long a host may take to send the next block after an acknowledgement.
const REACTION: i64 = 20 * MS;
/// Shortest time without commands of a host that a verdict names.
const SILENCE: i64 = 1500 * MS;
/// Shortest time without a keepalive of a silent host's computer that a verdict names.
const SIGN: i64 = 2500 * MS;

/// The program's input has ended.
pub(super) fn host_lost(record: &Record) -> Judgment {
    let silent = record.last_heard(0).map_or(0, |at| -at);
    let what = match silent {
        SILENCE.. => format!("nothing came over standard input for {}, and then it ended", span_text(silent)),
        _ => "the program that carries the host's bytes closed standard input".to_owned(),
    };
    Judgment::new(Culprit::Wire, what + &on_time(record), "look at its log, and at the network")
}

/// The host asked for an event whose time had passed.
pub(super) fn too_close(record: &Record, due: i64, trouble: &str) -> Judgment {
    let in_time = |came: i64| came - due <= -PROMPT;
    let came = record.stop.block.and_then(|block| record.arrived(block));
    // A time that is not the block's own proves only that the block came in time.
    let Some(Arrival { at: came, .. }) = came.filter(|came| came.is_exact || in_time(came.at)) else {
        let what = format!("the host asked for an event {} after its time", span_text(-due));
        let unknown = Judgment::new(Culprit::Unknown, format!("{what}; it is unknown when its block came"), "");
        return of_core(record, (due, 0)).unwrap_or(unknown);
    };
    let late = came - due;
    // The link leaves blocks in the terminal while the core has no room for them.
    let full = record.full((due - SILENCE, came)).filter(|full| in_time(*full));
    if in_time(came) || full.is_some() {
        let from = if in_time(came) { came } else { full.unwrap_or(came) };
        return of_bus(record, (from, 0)).or_else(|| of_core(record, (from, 0))).unwrap_or_else(|| {
            let what = format!(
                "it is unknown who was late: the host's block came {} before its event, and the core ran it {} after the event",
                span_text(-late),
                span_text(-due)
            );
            Judgment::new(Culprit::Unknown, what, "")
        });
    }
    if late > 0 {
        // A host that waits for acknowledgements cannot send while a bus holds the commands before.
        let held =
            if record.was_released((came - REACTION, came + PROMPT)) { of_bus(record, (due, came)) } else { None };
        if let Some(finding) = held.or_else(|| of_link(record, (due, came))) {
            return finding;
        }
    }
    let event = if trouble.starts_with("stepper ") { "step" } else { "event" };
    let silent = record.last_heard(came).filter(|heard| *heard < due && late > 0 && came - heard > SILENCE);
    if let (Some(wire), Some(heard)) = (&record.trace.head.wire, silent) {
        let what = format!(
            "nothing came over {wire} for {}, and then a block {} after the {event} it was for{}",
            span_text(came - heard),
            span_text(late),
            on_time(record)
        );
        return with_power(record, (heard, 0), Judgment::new(Culprit::Wire, what, wire_remedy(wire)));
    }
    let mut what = match late {
        0.. => format!("the host's block came {} after the {event} it was for", span_text(late)),
        _ => format!("the host's block came only {} before the {event} it was for", span_text(-late)),
    };
    what += &resent(record, (due.min(came) - SILENCE, 0));
    what += &on_time(record);
    let remedy = match &record.trace.head.wire {
        Some(wire) => format!("look at the host's load, and at the wire ({wire})"),
        None => "look at the host's load".to_owned(),
    };
    with_power(record, (due, 0), Judgment::new(Culprit::Host, what, remedy))
}

fn wire_remedy(wire: &str) -> &'static str {
    match wire {
        SSH => "look at the network, and at the log of pinion link on the host's computer",
        _ => "look at the wire, and whether the computer at its other end is on",
    }
}

/// The host did not refresh an output before `due`.
pub(super) fn not_refreshed(record: &Record, due: i64, trouble: &str) -> Judgment {
    // A block may have come in time and wait.
    if let Some(came) = record.pending().filter(|came| *came < due - PROMPT) {
        let found = of_bus(record, (came, 0)).or_else(|| of_core(record, (came, 0)));
        if let Some(found) = found {
            return found;
        }
    }
    let wire = record.trace.head.wire.as_ref();
    if let Some(gone) = record.host_gone() {
        let before = span_text(-gone);
        return match wire {
            Some(wire) => Judgment::new(
                Culprit::Wire,
                format!("the host was gone from {wire} {before} before the stop"),
                wire_remedy(wire),
            ),
            None => {
                let what = format!("the host closed the terminal {before} before the stop");
                Judgment::new(Culprit::Host, what, "its log says why it ended")
            }
        };
    }
    let Some(before) = record.last_block() else {
        return Judgment::new(Culprit::Unknown, format!("it is unknown when the host sent something: {trouble}"), "");
    };
    // The host waits for an acknowledgement.
    if -before > SILENT
        && let Some(finding) = of_bus(record, (before, 0))
    {
        return finding;
    }
    if -before < SILENCE {
        let what = format!(
            "the host sent its last block {} before the stop, but did not refresh an output in time{}: {trouble}",
            span_text(-before),
            on_time(record)
        );
        return with_power(record, (before, 0), Judgment::new(Culprit::Host, what, ""));
    }
    if let Some(finding) = of_link(record, (before, 0)) {
        return finding;
    }
    let heard = record.last_heard(0).unwrap_or(before);
    let was_alive = record.was_alive((heard, 0));
    // While its host says nothing, `pinion link` sends a keepalive every two seconds.
    let longest = if was_alive { SIGN } else { SILENCE };
    if let Some(wire) = wire.filter(|_| -heard > longest) {
        let came = if record.has_garbage((heard, 0)) { "only garbage" } else { "nothing" };
        let what = format!("{came} came over {wire} for {}{}", span_text(-heard), on_time(record));
        return with_power(record, (before, 0), Judgment::new(Culprit::Wire, what, wire_remedy(wire)));
    }
    let alive = match (record.asked((before + PROMPT, 0)), was_alive) {
        (true, _) => ", but it still asked for the clock",
        (false, true) => ", but its computer sent keepalives",
        (false, false) => "",
    };
    let resent = resent(record, (before, 0));
    let what = format!("the host sent no commands for {}{alive}{resent}{}", span_text(-before), on_time(record));
    with_power(record, (before, 0), Judgment::new(Culprit::Host, what, "look at its log, and at its load"))
}

/// How often the host sent blocks again, as a clause behind others.
fn resent(record: &Record, span: Span) -> String {
    match record.blocks_again(span) {
        0 => String::new(),
        1 => "; it sent a block again, without an acknowledgement in time".to_owned(),
        blocks => format!("; it sent {blocks} blocks again, without acknowledgements in time"),
    }
}
