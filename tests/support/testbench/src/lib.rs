// SPDX-License-Identifier: GPL-3.0-or-later
//! A micro-controller in virtual time, for tests and benches.
//!
//! - [`board`]: a board that records what the MCU does to its pins; a test plays the devices
//! - [`months`]: hosts of each month, and what their own firmware has
//! - [`rig`]: an MCU on that board, and the host's side of its wire
//! - [`dice`]: random numbers from a seed
//! - [`memory`]: an allocator that counts
//! - [`trial`]: an MCU under any commands, and what must hold

#![deny(unsafe_code)]

pub mod board;
pub mod dice;
pub mod memory;
pub mod months;
pub mod rig;
pub mod trial;
