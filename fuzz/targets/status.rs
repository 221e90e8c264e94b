// SPDX-License-Identifier: GPL-3.0-or-later
//! A document of `pinion status`, and its pages.
#![no_main]

pinion_fuzz::target!(pinion::cli::fuzz::status);
