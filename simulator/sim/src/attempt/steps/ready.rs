// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy starts and knows every MCU.

use super::Seen;
use crate::attempt::report::Outcome;
use crate::attempt::trial::Trial;
use crate::own::{Kind, kind_of};

pub(super) fn ready(trial: &mut Trial<'_>) -> Seen {
    if let Err(words) = trial.until_ready() {
        let mut sections = trial.config().sections().iter().filter(|section| !trial.is_left_out(section));
        let missing = sections.find(|section| kind_of(section.kind()) != Kind::Known);
        return Err(match (trial.failed(words, None), missing) {
            (Outcome::Failed { cause, place }, Some(section)) => {
                Outcome::Failed { cause: format!("{cause} ([{}] is not simulated)", section.name), place }
            }
            (failed, _) => failed,
        });
    }
    match trial.host.objects() {
        Ok(objects) => trial.objects = objects,
        Err(refused) => return Err(trial.failed(format!("klippy names no objects: {refused}"), None)),
    }
    let count = trial.own.mcus.len();
    Ok(format!("klippy is ready, with {count} MCU{}", if count == 1 { "" } else { "s" }))
}
