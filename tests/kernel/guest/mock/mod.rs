// SPDX-License-Identifier: GPL-3.0-or-later
//! The mocks of `tests/kit/modules`, as tests set and read them.

pub mod adc;
pub mod i2c;
pub mod pwm;
