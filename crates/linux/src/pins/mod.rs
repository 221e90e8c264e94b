// SPDX-License-Identifier: GPL-3.0-or-later
//! Pins: their numbers on the wire, and their names.

#![forbid(unsafe_code)]

mod names;
mod number;

pub use names::Names;
pub(crate) use number::{Target, mosi_of};
pub use number::{channel_number, line_number, pwm_number};
