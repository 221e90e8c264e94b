// SPDX-License-Identifier: GPL-3.0-or-later
//! The power supply or heat slowed the computer down.

use crate::event::PowerFault;

use super::evidence::{Record, Span};
use super::{Culprit, Judgment};

/// The same finding, if the computer's power was good in that span. Otherwise the power comes first.
pub(super) fn with_power(record: &Record, span: Span, finding: Judgment) -> Judgment {
    let (what, remedy) = match record.power_fault(span) {
        Some(PowerFault::Undervoltage) => {
            ("the power supply's voltage was too low", "use a better power supply and a short, thick cable")
        }
        Some(PowerFault::Hot) => ("the processor was slowed down by heat", "cool it"),
        None => match record.low_frequency(span) {
            Some((mhz, max)) if matches!(finding.culprit, Culprit::Work | Culprit::Driver) => {
                let what = format!("{}, at {mhz} MHz of {max} MHz", finding.what);
                return Judgment::new(Culprit::Power, what, "set the frequency governor to performance");
            }
            _ => return finding,
        },
    };
    Judgment::new(Culprit::Power, format!("{what} then; {}", finding.what), remedy)
}
