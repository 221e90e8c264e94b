// SPDX-License-Identifier: GPL-3.0-or-later
//! The tests that run in the lab's guest, as root, against real kernel drivers.
//!
//! `cargo test --test lab` runs them; docs/develop/lab.md tells how to add one. Each test
//! has a process of its own. Those in the modules `timing` and `pinion` run on a
//! VM whose time counts instructions.

// What tests share.
mod gpio_sim;
mod program;
mod sysfs;
mod trace;
mod uapi;

mod adc;
mod can;
mod gpio;
mod i2c;
mod one_wire;
mod pinion;
mod pwm;
mod spi;
mod timing;
mod watchdog;
