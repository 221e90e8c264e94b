// SPDX-License-Identifier: GPL-3.0-or-later
//! What several test suites share.
//!
//! - [`cache`], [`tools`], [`process`]: where a suite keeps its downloads, and the programs that it runs
//! - [`kernel`], [`initramfs`]: what a virtual machine boots
//! - [`markdown`]: the pages for users, and the blocks in them

#![forbid(unsafe_code)]

pub mod cache;
pub mod initramfs;
pub mod kernel;
pub mod markdown;
pub mod process;
pub mod tools;
