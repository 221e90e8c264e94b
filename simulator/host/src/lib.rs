// SPDX-License-Identifier: GPL-3.0-or-later
//! A klippy on a simulated printer, in one clock.
//!
//! - [`Host`]: a klippy of a checkout, and the calls of its API
//! - [`OneClock`]: the clock that klippy and the MCUs of a simulated printer share
//! - [`Time`]: that clock, or the computer's

#![forbid(unsafe_code)]

mod clock;
mod hang;
mod klippy;
mod mcu;
mod process;
mod time;
mod workers;

pub use clock::{MCUS, OneClock, Stop, forms, start};
pub use hang::Hang;
pub use klippy::{Host, Launch, NoStart, Refused, Running, Watch};
pub use time::Time;
