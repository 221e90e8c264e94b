// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion lets Klipper use this computer's GPIO pins and buses. It is a drop-in replacement for klipper_mcu.
//!
//! This crate is the program's command line ([`cli`]). docs/develop/architecture.md describes the other crates.

#![forbid(unsafe_code)]
// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod cli;
