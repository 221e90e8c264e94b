// SPDX-License-Identifier: GPL-3.0-or-later
//! The words of descriptions.

#![forbid(unsafe_code)]

pub(crate) mod thermistor;
