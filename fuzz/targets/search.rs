// SPDX-License-Identifier: GPL-3.0-or-later
//! Messages of the search for the host.
#![no_main]

pinion_fuzz::target!(pinion::runtime::fuzz::search);
