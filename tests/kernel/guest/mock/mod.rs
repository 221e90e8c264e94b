// SPDX-License-Identifier: GPL-3.0-or-later
//! The mocks of `tests/support/testkit/modules`, as tests set and read them.

pub mod adc;
pub mod i2c;
pub mod pwm;
