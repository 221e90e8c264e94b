// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion: a Klipper micro-controller made of a Linux process.
//!
//! The layers, lower never imports higher (docs/architecture.md):
//!
//! - [`cli`]: the program's subcommands
//! - [`runtime`]: threads, pty, real time, signals
//! - [`feature`]: one file per Klipper feature, and the list of them all
//! - [`mcu`]: the machine: oids, timers, move queue, shutdown
//! - [`board`]: what the machine asks of the hardware; the linux and the sim board
//! - [`wire`]: bytes only: VLQ, CRC, message blocks, formats, dictionary
//! - [`time`], [`shutdown`], [`lateness`], `foreign`: the words that all layers share; `sys` holds every `unsafe`
//!
//! [`host`] is the other end of the wire: a small client for demonstrations and tests.

// Printing panics when nobody reads, these when something is not as was thought: tests may.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

// The fake board of the tests in tests/machine, which call this crate by its name.
#[cfg(test)]
extern crate self as pinion;
#[cfg(test)]
#[allow(dead_code)]
#[path = "../tests/machine/bench.rs"]
mod bench;

pub mod board;
pub mod cli;
pub mod feature;
mod foreign;
pub mod host;
pub mod klippy;
pub mod lateness;
pub mod mcu;
pub mod runtime;
pub mod shutdown;
#[allow(unsafe_code)]
mod sys;
pub mod time;
pub mod wire;
