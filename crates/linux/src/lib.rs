// SPDX-License-Identifier: GPL-3.0-or-later
//! The pins and buses of this computer.

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod adc;
mod attributes;
mod board;
pub mod can;
pub mod clock;
pub mod foreign;
pub mod gpio;
mod guard;
pub mod i2c;
mod inventory;
pub mod own_folder;
pub mod parker;
pub mod pins;
mod places;
pub mod proc;
pub mod pwm;
pub mod spi;
#[allow(unsafe_code)]
pub mod sys;
pub mod sysfs;
pub mod throttled;
pub mod uart;
mod w1;

pub use board::LinuxBoard;
pub use guard::Guard;
pub use inventory::Inventory;

/// The remedy if only the kernel knows more.
pub const LOOK_AT_LOG: &str = "look at the kernel's log (dmesg)";
