// SPDX-License-Identifier: GPL-3.0-or-later
//! The checks for any value, and the error for a wrong value.

use std::collections::HashSet;

pub(crate) use pinion_firmware::trouble::Trouble;

use super::pin::is_klippy_name;

/// The allowed range of a number.
pub(crate) enum Bound {
    Any,
    NotNegative,
    AboveZero,
}

/// Checks that all parts of a kind have names, and that the names are unique.
pub(crate) fn unique<'a>(kind: &str, mut names: impl Iterator<Item = &'a String>) -> Result<(), Trouble> {
    let mut seen = HashSet::new();
    names.try_for_each(|name| {
        if !is_klippy_name(name) {
            no_name(kind, name)
        } else if !seen.insert(name) {
            wrong(kind, "name", &format!("two have the name `{name}`"), "rename one")
        } else {
            Ok(())
        }
    })
}

/// The error for a name that klippy would not accept.
pub(crate) fn no_name(whose: &str, name: &str) -> Result<(), Trouble> {
    wrong(whose, "name", &format!("`{name}` is not a name"), "use letters, digits, `_`, `-`, `.` and `/`")
}

/// Checks that the description has an entry with this name; `kind` is its table.
pub(crate) fn there_is<'a>(
    whose: &str,
    key: &str,
    name: &str,
    mut names: impl Iterator<Item = &'a String>,
    kind: &str,
) -> Result<(), Trouble> {
    if names.any(|other| other == name) {
        return Ok(());
    }
    wrong(whose, key, &format!("there is no `{name}`"), &format!("name an {kind}"))
}

/// The error of a key.
pub(crate) fn fault(whose: &str, key: &str, cause: &str, remedy: &str) -> Trouble {
    Trouble::new(cause).remedy(remedy).of(format_args!("{whose}, key `{key}`"))
}

/// The error of a key, as a result.
pub(crate) fn wrong(whose: &str, key: &str, cause: &str, remedy: &str) -> Result<(), Trouble> {
    Err(fault(whose, key, cause, remedy))
}

/// Highest number in a description. A larger number describes no printer, and could overflow a position or a time.
const MAX_NUMBER: f64 = 1e9;

/// Highest number of lights in a strip.
const MAX_LIGHTS: u32 = 1000;

/// Checks the number of lights of a strip.
pub(crate) fn check_lights(whose: &str, count: u32) -> Result<(), Trouble> {
    check(whose, "count", count.into(), Bound::AboveZero)?;
    if count > MAX_LIGHTS {
        return wrong(whose, "count", &format!("{count} is too many"), &format!("{MAX_LIGHTS} at most"));
    }
    Ok(())
}

/// Checks that a number is in its range.
pub(crate) fn check(whose: &str, key: &str, value: f64, bound: Bound) -> Result<(), Trouble> {
    let fault = match bound {
        _ if !(-MAX_NUMBER..=MAX_NUMBER).contains(&value) => "is out of range",
        Bound::NotNegative if value < 0.0 => "is below zero",
        Bound::AboveZero if value < 1.0 / MAX_NUMBER => "is not above zero",
        _ => return Ok(()),
    };
    wrong(whose, key, &format!("{value} {fault}"), "set a value of the printer's")
}

/// Checks a probe's offsets from the nozzle.
pub(crate) fn check_offsets(whose: &str, offsets_mm: [f64; 3]) -> Result<(), Trouble> {
    let mut keys = ["x_offset_mm", "y_offset_mm", "z_offset_mm"].into_iter().zip(offsets_mm);
    keys.try_for_each(|(key, mm)| check(whose, key, mm, Bound::Any))
}
