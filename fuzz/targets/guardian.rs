// SPDX-License-Identifier: GPL-3.0-or-later
//! Messages to the guardian.
#![no_main]

pinion_fuzz::target!(pinion::runtime::fuzz::guardian);
