// SPDX-License-Identifier: GPL-3.0-or-later
//! The code that several test suites share.
//!
//! - [`arguments`]: the command line of a suite
//! - [`cache`], [`apt`], [`tools`], [`process`]: the folder for a suite's downloads, and the programs that it runs
//! - [`here`]: whether this computer lets a test run
//! - [`kernel`], [`initramfs`]: the boot files of a virtual machine
//! - [`browser`]: a page as a person sees it
//! - [`names`]: names that others chose, for property tests
//! - [`simulator`]: the program `pinion-sim`
//! - [`markdown`]: the pages for users, and the blocks in them
//! - [`mistakes`]: a printer.cfg, and mistakes in it
//! - [`wait`]: how a test waits for another thread or process

#![forbid(unsafe_code)]

use std::io;
use std::path::Path;

pub mod apt;
pub mod arguments;
pub mod browser;
pub mod cache;
pub mod here;
pub mod initramfs;
pub mod kernel;
pub mod markdown;
pub mod mistakes;
pub mod names;
pub mod process;
pub mod simulator;
pub mod tools;
pub mod wait;

/// A file's error, with what failed on which path.
fn describe(action: &str, path: &Path, error: &io::Error) -> String {
    format!("cannot {action} {}: {error}", path.display())
}
