// SPDX-License-Identifier: GPL-3.0-or-later
//! What can be known of a Klipper host from outside: which process it is, and which messages its
//! sources look up.

#![forbid(unsafe_code)]

pub mod process;
pub mod sources;
