// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of the dialects: sets of forms for hosts whose sources cannot be read.

use std::fmt;
use std::str::FromStr;

/// The host software whose messages an MCU has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DialectName {
    /// Klipper v0.11 (November 2022).
    V0_11,
    /// Klipper v0.12 (November 2023).
    V0_12,
    /// Klipper v0.13 (April 2025).
    V0_13,
    /// Klipper's master branch (August 2026).
    Master,
    /// Kalico's main branch (July 2026).
    Kalico,
    /// The messages of Klipper v0.13, its master and Kalico, for an unknown host. A host finds a message by its name
    /// alone. So this dialect has one form for each name: v0.13's form, or else master's, or else Kalico's. Master and
    /// Kalico often use v0.13's form too (docs/guide/dialects.md).
    Union,
}

use DialectName::{Kalico, Master, Union, V0_11, V0_12, V0_13};

impl DialectName {
    /// All of them.
    pub const ALL: [DialectName; 6] = [V0_11, V0_12, V0_13, Master, Kalico, Union];
    /// The dialects of known hosts, the oldest first.
    pub const OF_HOSTS: [DialectName; 5] = [V0_11, V0_12, V0_13, Master, Kalico];

    /// Its name on the command line, in the log and in the documents.
    pub const fn name(self) -> &'static str {
        match self {
            V0_11 => "v0.11",
            V0_12 => "v0.12",
            V0_13 => "v0.13",
            Master => "master",
            Kalico => "kalico",
            Union => "union",
        }
    }

    /// The dialects whose messages it has. The first one that has a message decides its form.
    pub(super) fn parts(&self) -> &[DialectName] {
        match self {
            Union => &[V0_13, Master, Kalico],
            _ => std::slice::from_ref(self),
        }
    }
}

impl fmt::Display for DialectName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for DialectName {
    type Err = String;

    fn from_str(text: &str) -> Result<DialectName, String> {
        DialectName::ALL
            .into_iter()
            .find(|dialect| dialect.name() == text)
            .ok_or_else(|| format!("there are the dialects {}", DialectName::ALL.map(DialectName::name).join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_dialect_is_found_by_its_name() {
        for dialect in DialectName::ALL {
            assert_eq!(dialect.to_string().parse(), Ok(dialect));
        }
        let refused = "v0.10".parse::<DialectName>().unwrap_err();
        assert!(refused.contains("v0.11, v0.12, v0.13, master, kalico, union"), "{refused}");
    }
}
