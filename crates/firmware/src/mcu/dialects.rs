// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of the dialects, and the sets of dialects that have a message.
//!
//! To add a dialect, add it here with its name and its parent. It then has the parent's messages.
//! docs/guide/dialects.md describes the remaining steps.

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

    /// The dialect that this one developed from.
    const fn parent(self) -> Option<DialectName> {
        match self {
            V0_11 | Union => None,
            V0_12 => Some(V0_11),
            V0_13 => Some(V0_12),
            Master => Some(V0_13),
            // Kalico is a fork. It has a newer message of Klipper's master only if Kalico adopted it.
            Kalico => Some(V0_13),
        }
    }

    /// The dialects whose messages it has. The first one that has a message decides its form. Behavior that no
    /// form decides is the first one's.
    pub(super) fn parts(&self) -> &[DialectName] {
        match self {
            Union => &[V0_13, Master, Kalico],
            _ => std::slice::from_ref(self),
        }
    }

    /// Its bit in a set.
    const fn bit(self) -> u8 {
        1 << self as u8
    }

    /// Whether this is `ancestor`, or developed from it.
    const fn grew_out_of(self, ancestor: DialectName) -> bool {
        let mut this = Some(self);
        while let Some(dialect) = this {
            if dialect as u8 == ancestor as u8 {
                return true;
            }
            this = dialect.parent();
        }
        false
    }
}

impl fmt::Display for DialectName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A set of dialects of hosts, for example the dialects that have a form of a message.
///
/// A new dialect is in every set that its parent is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dialects(u8);

/// This dialect and all that developed from it.
pub const fn since(first: DialectName) -> Dialects {
    let mut bits = 0;
    let mut at = 0;
    while at < DialectName::OF_HOSTS.len() {
        if DialectName::OF_HOSTS[at].grew_out_of(first) {
            bits |= DialectName::OF_HOSTS[at].bit();
        }
        at += 1;
    }
    Dialects(bits)
}

/// This dialect and all its ancestors.
pub const fn until(last: DialectName) -> Dialects {
    let mut bits = 0;
    let mut at = 0;
    while at < DialectName::OF_HOSTS.len() {
        if last.grew_out_of(DialectName::OF_HOSTS[at]) {
            bits |= DialectName::OF_HOSTS[at].bit();
        }
        at += 1;
    }
    Dialects(bits)
}

/// This dialect alone.
pub const fn only(dialect: DialectName) -> Dialects {
    Dialects(dialect.bit())
}

impl Dialects {
    /// Every dialect.
    pub const ALL: Dialects = Dialects((1 << DialectName::OF_HOSTS.len()) - 1);

    /// The members of this set that are `first` or developed from it.
    pub const fn since(self, first: DialectName) -> Dialects {
        Dialects(self.0 & since(first).0)
    }

    /// The members of this set that are `last` or its ancestors.
    pub const fn until(self, last: DialectName) -> Dialects {
        Dialects(self.0 & until(last).0)
    }

    /// This set, `first`, and all that developed from `first`.
    pub const fn and(self, first: DialectName) -> Dialects {
        Dialects(self.0 | since(first).0)
    }

    /// This set without `first` and all that developed from `first`.
    pub const fn except(self, first: DialectName) -> Dialects {
        Dialects(self.0 & !since(first).0)
    }

    /// Whether `dialect` is one of this set.
    pub const fn contains(self, dialect: DialectName) -> bool {
        self.0 & dialect.bit() != 0
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

    fn members(set: Dialects) -> Vec<DialectName> {
        DialectName::OF_HOSTS.into_iter().filter(|dialect| set.contains(*dialect)).collect()
    }

    #[test]
    fn a_fork_has_what_it_grew_out_of() {
        assert_eq!(members(Dialects::ALL), DialectName::OF_HOSTS);
        assert_eq!(members(since(V0_13)), [V0_13, Master, Kalico]);
        assert_eq!(members(since(Master)), [Master]);
        assert_eq!(members(until(V0_12)), [V0_11, V0_12]);
        assert_eq!(members(until(V0_13).and(Kalico)), [V0_11, V0_12, V0_13, Kalico]);
        assert_eq!(members(since(V0_12).until(V0_13)), [V0_12, V0_13]);
        assert_eq!(members(since(V0_12).except(Kalico)), [V0_12, V0_13, Master]);
        assert_eq!(members(Dialects::ALL.except(V0_13)), [V0_11, V0_12]);
        assert_eq!(members(only(V0_13).and(Kalico)), [V0_13, Kalico]);
    }

    #[test]
    fn every_dialect_is_found_by_its_name() {
        for dialect in DialectName::ALL {
            assert_eq!(dialect.to_string().parse(), Ok(dialect));
        }
        let refused = "v0.10".parse::<DialectName>().unwrap_err();
        assert!(refused.contains("v0.11, v0.12, v0.13, master, kalico, union"), "{refused}");
    }
}
