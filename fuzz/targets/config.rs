// SPDX-License-Identifier: GPL-3.0-or-later
//! The configuration of `pinion run`: pinion.toml.
#![no_main]

pinion_fuzz::target!(pinion::cli::fuzz::config);
