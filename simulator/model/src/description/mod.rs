// SPDX-License-Identifier: GPL-3.0-or-later
//! The types of descriptions, and their checks. It names neither the engine nor a part.

pub(crate) mod axes;
pub(crate) mod boards;
pub(crate) mod buses;
pub(crate) mod check;
#[cfg(test)]
#[path = "../../tests/support/default.rs"]
pub(crate) mod default;
pub(crate) mod heater;
pub(crate) mod kinematics;
pub(crate) mod outputs;
pub(crate) mod pin;
pub(crate) mod printer;
pub(crate) mod rails;
pub(crate) mod sensor;
pub(crate) mod thermistor;
mod validate;

/// The default of a key that is a whole number, for `serde`.
pub(crate) fn whole<const N: u16, T: From<u16>>() -> T {
    T::from(N)
}
