// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion lets Klipper use this computer's GPIO pins and buses. It is a drop-in replacement for klipper_mcu.
//!
//! This crate is the program. docs/develop/architecture.md describes the other crates. It contains:
//!
//! - [`cli`]: the subcommands
//! - [`runtime`]: threads, pty, real time, signals
//! - [`klippy`]: facts about a host, found from outside
//! - `foreign`: data of others: files that may be anything, and names that may contain anything
//! - `own_folder`: the folders where the program makes and removes files
//! - `throttled`: a Raspberry Pi's power and temperature
//! - `status`: the status of a running Pinion, as `pinion status` prints it
//! - [`trace`]: recordings of the last seconds: events, files, who was late, and exports

// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod cli;
mod foreign;
pub mod klippy;
mod own_folder;
mod proc;
pub mod runtime;
mod status;
mod throttled;
pub mod trace;

use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Firmware, Wire};

/// The program's description as an MCU.
pub const FIRMWARE: Firmware = Firmware {
    features: FEATURES,
    app: "Pinion",
    version: concat!("pinion-", env!("PINION_VERSION")),
    build_versions: concat!("rustc: ", env!("PINION_COMPILER")),
    license: "GNU GPLv3",
    wire: Wire::Terminal,
};
