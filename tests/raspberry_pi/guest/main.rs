// SPDX-License-Identifier: GPL-3.0-or-later
//! The tests that run on an emulated Raspberry Pi, as root, against the driver of its GPIO chip.
//! `make test-raspberry-pi` runs them. docs/develop/test-raspberry-pi.md explains more.

mod outside;
mod program;

mod gpio;
mod homing;
mod registers;
