// SPDX-License-Identifier: GPL-3.0-or-later
//! The tests that run in the VM of `tests/kernel`, as root, against real kernel drivers.
//!
//! `cargo test --test kernel` runs them. docs/develop/test-kernel.md explains how to add one. Each test has its own
//! process. The tests in the modules `selftest::timing`, `figures` and `pinion` run on a VM with a time that counts
//! instructions.

// Shared by the tests.
mod gpio_sim;
mod mock;
mod program;
mod register_file;
mod sysfs;
mod trace;
mod uapi;

mod figures;
mod pinion;
mod selftest;
