// SPDX-License-Identifier: GPL-3.0-or-later
//! The host, from outside: the search for its process, and facts from klippy's process and sources.

pub mod klippy;
pub(crate) mod search;
