// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion lets Klipper use this computer's GPIO pins and buses. It is a drop-in replacement for klipper_mcu.
//!
//! This crate is the program. docs/develop/architecture.md describes the other crates. It contains:
//!
//! - [`cli`]: the subcommands
//! - [`runtime`]: threads, pty, real time, signals
//! - [`klippy`]: what can be known of a host from outside
//! - `foreign`: what others write: files that may be anything, and names that may hold anything
//! - `status`: what a running Pinion tells, as `pinion status` prints it

// Printing panics when nobody reads, these when something is not as was thought: tests may.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod cli;
mod foreign;
pub mod klippy;
mod proc;
pub mod runtime;
mod status;

use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::Firmware;

/// What the program is as an MCU.
pub const FIRMWARE: Firmware = Firmware {
    features: FEATURES,
    app: "Pinion",
    version: concat!("pinion-", env!("PINION_VERSION")),
    build_versions: concat!("rustc: ", env!("PINION_COMPILER")),
    license: "GNU GPLv3",
};
