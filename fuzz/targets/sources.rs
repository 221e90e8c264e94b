// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's sources, as the search for the host reads them.
#![no_main]

pinion_fuzz::target!(pinion::klippy::sources::fuzz);
