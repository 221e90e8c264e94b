// SPDX-License-Identifier: GPL-3.0-or-later
//! A bus, or a device on it, kept the host's commands waiting.

use super::evidence::{Job, MS, Record, Span};
use super::{Culprit, Judgment, span_text};

/// Shortest job under way that a verdict names while the program works.
const HANGS: i64 = 1000 * MS;

/// A command waited for a bus for half of this span.
pub(super) fn of_bus(record: &Record, span: Span) -> Option<Judgment> {
    let held = record.held(span);
    if held * 2 < span.1 - span.0 {
        return None;
    }
    let what = match record.longest_job(span) {
        Some(job) if job.is_open => return Some(hanging(record, &job)),
        Some(job) if (job.span.1 - job.span.0) * 2 >= held => format!(
            "{} took {} for one job{}, and the host's commands waited for it",
            job.bus,
            span_text(job.span.1 - job.span.0),
            sender(record, job.oid)
        ),
        Some(job) => {
            format!("the host's commands waited {} for {}{}", span_text(held), job.bus, sender(record, job.oid))
        }
        None => format!("the host's commands waited {} for a bus", span_text(held)),
    };
    Some(Judgment::new(Culprit::Bus, what, "use a higher rate, or another bus for the device"))
}

/// A bus hangs.
pub(super) fn of_hanging(record: &Record) -> Option<Judgment> {
    record.hanging().filter(|job| -job.span.0 > HANGS).map(|job| hanging(record, &job))
}

fn hanging(record: &Record, job: &Job) -> Judgment {
    let what = format!("{} has not answered for {}{}", job.bus, span_text(-job.span.0), sender(record, job.oid));
    Judgment::new(Culprit::Bus, what, "check the power and the wires of its devices, and dmesg")
}

/// The sender of a job, as a clause behind others.
fn sender(record: &Record, oid: Option<u8>) -> String {
    oid.and_then(|oid| record.trace.head.names.objects.get(&oid))
        .map_or_else(String::new, |object| format!(" ({object})"))
}
