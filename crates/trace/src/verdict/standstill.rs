// SPDX-License-Identifier: GPL-3.0-or-later
//! Nothing ran: the program was stopped, or the whole computer.

use super::evidence::{Record, Span};
use super::{Culprit, Judgment, span_text};

/// Nothing of the program ran in a span. `is_counted`: the kernel's account says that it did not wait for a processor.
pub(super) fn standstill(record: &Record, gap: Span, is_counted: bool) -> Judgment {
    let long = span_text(gap.1 - gap.0);
    let (what, remedy) = match record.guardian_went_on(gap) {
        Some(true) => (
            format!("Pinion stood still for {long}, and the guardian went on"),
            "find out who stopped it (SIGSTOP, a frozen control group)",
        ),
        Some(false) => (
            format!("Pinion and its guardian stood still for {long}"),
            "find out who stopped both (a frozen control group), or paused or suspended the computer",
        ),
        None => (
            format!("everything stood still for {long}"),
            "find out who stopped Pinion, or paused or suspended the computer",
        ),
    };
    let other = if is_counted { "" } else { ", or which real-time work had all processors" };
    Judgment::new(Culprit::Standstill, what, format!("{remedy}{other}"))
}
