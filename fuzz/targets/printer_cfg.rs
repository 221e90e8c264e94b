// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's configuration, as the doctor reads it.
#![no_main]

pinion_fuzz::target!(pinion::cli::fuzz::printer_cfg);
