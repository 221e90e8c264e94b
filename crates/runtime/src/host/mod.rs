// SPDX-License-Identifier: GPL-3.0-or-later
//! The host, from outside: the search for its process, and what klippy's process and sources tell.

#![forbid(unsafe_code)]

pub mod klippy;
pub(crate) mod search;
