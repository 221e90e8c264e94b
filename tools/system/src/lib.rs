// SPDX-License-Identifier: GPL-3.0-or-later
//! Who uses what on a computer: its pins and buses, its klippys, its Pinions.
//!
//! [`Computer`] is this computer, or one on a mounted card. Kernel, boot files, printer.cfg, services and other instances
//! of Pinion say who uses a pin ([`uses`]). `pinion add`, `pinion doctor` and `pinion pins` read this picture.
//!
//! - [`board`]: the boards that are known, with their headers
//! - [`units`], [`manager`], [`running`]: what systemd starts, its settings, the processes
//! - [`instance`], [`settings`], [`config`]: the Pinions, and the settings of each
//! - [`klippy`], [`printer`]: the klippys, and their configurations
//! - [`device`], [`rights`], [`mod@files`]: files in /dev, the rights of a file's owner, files that a command line names

#![forbid(unsafe_code)]
// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod board;
pub mod complete;
mod computer;
pub mod config;
pub mod device;
pub mod files;
pub mod finding;
pub mod instance;
pub mod klippy;
pub mod manager;
pub mod printer;
pub mod rights;
pub mod running;
pub mod settings;
pub mod units;
pub mod uses;

// Public: `src` uses more of them.
#[cfg(test)]
#[path = "../tests/support/boards.rs"]
pub mod boards;
#[cfg(test)]
#[path = "../tests/support/tree.rs"]
pub mod tree;

pub use computer::{Access, Computer, Who, output};
