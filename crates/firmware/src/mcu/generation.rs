// SPDX-License-Identifier: GPL-3.0-or-later
//! The generations of hosts, and the sets of generations that use a message.
//!
//! To add a generation, add it here with its name and its parent. It then has the parent's messages.
//! docs/guide/dialects.md describes the remaining steps.

#![forbid(unsafe_code)]

use std::fmt;
use std::str::FromStr;

/// A version of klippy that an MCU can serve.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Generation {
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
}

use Generation::{Kalico, Master, V0_11, V0_12, V0_13};

impl Generation {
    /// All of them, the oldest first.
    pub const ALL: [Generation; 5] = [V0_11, V0_12, V0_13, Master, Kalico];

    /// Its name on the command line, in the log and in the documents.
    pub const fn name(self) -> &'static str {
        match self {
            V0_11 => "v0.11",
            V0_12 => "v0.12",
            V0_13 => "v0.13",
            Master => "master",
            Kalico => "kalico",
        }
    }

    /// The generation that this one developed from.
    const fn parent(self) -> Option<Generation> {
        match self {
            V0_11 => None,
            V0_12 => Some(V0_11),
            V0_13 => Some(V0_12),
            Master => Some(V0_13),
            // Kalico is a fork. It has a newer message of Klipper's master only if Kalico adopted it.
            Kalico => Some(V0_13),
        }
    }

    /// Its bit in a set.
    const fn bit(self) -> u8 {
        1 << self as u8
    }

    /// Whether this is `ancestor`, or developed from it.
    const fn grew_out_of(self, ancestor: Generation) -> bool {
        let mut this = Some(self);
        while let Some(generation) = this {
            if generation as u8 == ancestor as u8 {
                return true;
            }
            this = generation.parent();
        }
        false
    }
}

impl fmt::Display for Generation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A set of generations: the ones that use a form of a message.
///
/// A new generation is in every set that its parent is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Generations(u8);

/// This generation and all that developed from it.
pub const fn since(first: Generation) -> Generations {
    let mut bits = 0;
    let mut at = 0;
    while at < Generation::ALL.len() {
        if Generation::ALL[at].grew_out_of(first) {
            bits |= Generation::ALL[at].bit();
        }
        at += 1;
    }
    Generations(bits)
}

/// This generation and all its ancestors.
pub const fn until(last: Generation) -> Generations {
    let mut bits = 0;
    let mut at = 0;
    while at < Generation::ALL.len() {
        if last.grew_out_of(Generation::ALL[at]) {
            bits |= Generation::ALL[at].bit();
        }
        at += 1;
    }
    Generations(bits)
}

/// This generation alone.
pub const fn only(generation: Generation) -> Generations {
    Generations(generation.bit())
}

impl Generations {
    /// Every generation.
    pub const ALL: Generations = Generations((1 << Generation::ALL.len()) - 1);

    /// The members of this set that are `first` or developed from it.
    pub const fn since(self, first: Generation) -> Generations {
        Generations(self.0 & since(first).0)
    }

    /// The members of this set that are `last` or its ancestors.
    pub const fn until(self, last: Generation) -> Generations {
        Generations(self.0 & until(last).0)
    }

    /// This set, `first`, and all that developed from `first`.
    pub const fn and(self, first: Generation) -> Generations {
        Generations(self.0 | since(first).0)
    }

    /// This set without `first` and all that developed from `first`.
    pub const fn except(self, first: Generation) -> Generations {
        Generations(self.0 & !since(first).0)
    }

    /// Whether `generation` is one of this set.
    pub const fn contains(self, generation: Generation) -> bool {
        self.0 & generation.bit() != 0
    }
}

/// Which dialect an MCU speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DialectName {
    /// The dialect of hosts of one generation.
    Of(Generation),
    /// The messages of Klipper v0.13, its master and Kalico, for an unknown host. A host finds a message by its name
    /// alone. So this dialect has one form for each name: v0.13's form, or else master's, or else Kalico's. Master and
    /// Kalico often use v0.13's form too (docs/guide/dialects.md).
    Union,
}

impl DialectName {
    /// All of them.
    pub fn all() -> impl Iterator<Item = DialectName> {
        Generation::ALL.into_iter().map(DialectName::Of).chain([DialectName::Union])
    }

    /// The generations whose messages it has. The first one that has a message decides its form. Behavior that no form
    /// decides is the first generation's.
    pub(super) fn generations(&self) -> &[Generation] {
        match self {
            DialectName::Of(generation) => std::slice::from_ref(generation),
            DialectName::Union => &[V0_13, Master, Kalico],
        }
    }
}

impl fmt::Display for DialectName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DialectName::Of(generation) => generation.fmt(f),
            DialectName::Union => f.write_str("union"),
        }
    }
}

impl FromStr for Generation {
    type Err = String;

    fn from_str(text: &str) -> Result<Generation, String> {
        let names = || Generation::ALL.map(Generation::name).join(", ");
        let found = Generation::ALL.into_iter().find(|generation| generation.name() == text);
        found.ok_or_else(|| format!("there are the generations {}", names()))
    }
}

impl FromStr for DialectName {
    type Err = String;

    fn from_str(text: &str) -> Result<DialectName, String> {
        DialectName::all().find(|name| name.to_string() == text).ok_or_else(|| {
            let names: Vec<String> = DialectName::all().map(|name| name.to_string()).collect();
            format!("there are the dialects {}", names.join(", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn members(set: Generations) -> Vec<Generation> {
        Generation::ALL.into_iter().filter(|generation| set.contains(*generation)).collect()
    }

    #[test]
    fn a_fork_has_what_it_grew_out_of() {
        assert_eq!(members(Generations::ALL), Generation::ALL);
        assert_eq!(members(since(V0_13)), [V0_13, Master, Kalico]);
        assert_eq!(members(since(Master)), [Master]);
        assert_eq!(members(until(V0_12)), [V0_11, V0_12]);
        assert_eq!(members(until(V0_13).and(Kalico)), [V0_11, V0_12, V0_13, Kalico]);
        assert_eq!(members(since(V0_12).until(V0_13)), [V0_12, V0_13]);
        assert_eq!(members(since(V0_12).except(Kalico)), [V0_12, V0_13, Master]);
        assert_eq!(members(Generations::ALL.except(V0_13)), [V0_11, V0_12]);
        assert_eq!(members(only(V0_13).and(Kalico)), [V0_13, Kalico]);
    }

    #[test]
    fn every_dialect_is_found_by_its_name() {
        for name in DialectName::all() {
            assert_eq!(name.to_string().parse(), Ok(name));
        }
        for generation in Generation::ALL {
            assert_eq!(generation.name().parse(), Ok(generation));
        }
        let refused = "v0.10".parse::<DialectName>().unwrap_err();
        assert!(refused.contains("v0.11, v0.12, v0.13, master, kalico, union"), "{refused}");
    }
}
