// SPDX-License-Identifier: GPL-3.0-or-later
//! A picture of a simulated printer, and a server that shows it as a webcam.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

mod focus;
mod laid;
mod lens;
mod machine;
mod paint;
mod panel;
mod picture;
pub mod scene;
mod server;
mod studio;

pub use picture::{Layout, Picture};
pub use server::{Limits, STREAMS_MAX, serve};
