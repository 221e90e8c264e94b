// SPDX-License-Identifier: GPL-3.0-or-later
//! The machine in virtual time, through its public API: what a host can see of it, to the
//! tick and the same each time.

// Some of these two is for tests/no_allocation.rs and benches/machine.rs.
#[allow(dead_code)]
mod bench;
#[allow(dead_code)]
mod rig;
mod safe_ends;
mod sleeping_lines;

mod analog_in;
mod any_bytes;
mod base;
mod digital_out;
mod displays;
mod endstop;
mod one_order;
mod pwm_out;
mod remedies;
mod spi;
mod stepper;
mod tmcuart;
