// SPDX-License-Identifier: GPL-3.0-or-later
//! A finding of `pinion doctor` or `pinion run --check`, with its level and its remedy.

use serde::{Serialize, Serializer};
use serde_json::json;

use pinion_firmware::trouble::Trouble;

/// The level of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Nothing needs to be fixed.
    Ok,
    /// Something works worse than it could, or may not work, or is unknown.
    Warning,
    /// Something does not work.
    Error,
}

impl Level {
    /// Its name, for people.
    pub fn name(self) -> &'static str {
        match self {
            Level::Ok => "ok",
            Level::Warning => "warning",
            Level::Error => "error",
        }
    }
}

/// A finding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// The check's name, in one word that stays the same in all versions.
    pub check: &'static str,
    /// Its level.
    pub status: Level,
    /// The state, and the remedy: a command or another step.
    pub trouble: Trouble,
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
    pub fn ok(check: &'static str, trouble: impl Into<Trouble>) -> Finding {
        Finding::of(check, Level::Ok, trouble)
    }

    /// The state may be a reason why something does not work well.
    pub fn warning(check: &'static str, trouble: impl Into<Trouble>, remedy: impl Into<Box<str>>) -> Finding {
        Finding::of(check, Level::Warning, trouble).or(remedy)
    }

    /// The state is the reason why something does not work.
    pub fn error(check: &'static str, trouble: impl Into<Trouble>, remedy: impl Into<Box<str>>) -> Finding {
        Finding::of(check, Level::Error, trouble).or(remedy)
    }

    /// A finding of this level, with the remedy in `trouble`.
    pub fn of(check: &'static str, status: Level, trouble: impl Into<Trouble>) -> Finding {
        Finding { check, status, trouble: trouble.into() }
    }

    /// The same with a remedy, for a state that is fine but may be unwanted.
    pub fn or(self, remedy: impl Into<Box<str>>) -> Finding {
        Finding { trouble: self.trouble.remedy(remedy), ..self }
    }
}
