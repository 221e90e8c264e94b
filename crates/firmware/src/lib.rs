// SPDX-License-Identifier: GPL-3.0-or-later
//! A Klipper micro-controller without I/O.
//!
//! - [`feature`]: one file per Klipper feature, and the list of them all
//! - [`mcu`]: the MCU: oids, timers, move queue, shutdown
//! - [`board`]: what the MCU asks of the hardware, and buses made of bare lines
//! - [`time`], [`shutdown`], [`lateness`]: the words that all of these share

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod board;
pub mod feature;
pub mod lateness;
pub mod mcu;
pub mod shutdown;
pub mod time;

pub use pinion_protocol as protocol;
