// SPDX-License-Identifier: GPL-3.0-or-later
//! A host's bytes at the link, with a core in virtual time.
#![no_main]

pinion_fuzz::target!(pinion::runtime::fuzz::link);
