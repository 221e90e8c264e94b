// SPDX-License-Identifier: GPL-3.0-or-later
//! Tests of the suite itself: each kernel driver and mock does what the tests of Pinion need.

mod adc;
mod can;
mod gpio;
mod i2c;
mod one_wire;
mod pwm;
mod spi;
mod timing;
mod watchdog;
