// SPDX-License-Identifier: GPL-3.0-or-later
//! The flight recorder's tapes: events, the rings that hold them, the file that they are kept in, and what they say.
//!
//! - `event`: what is recorded, 16 bytes each
//! - `ring`: the memory that a thread records into
//! - `file`: a trace, from the rings to a file and back
//! - `folder`: where the files are, and their names
//! - `verdict`: who was late

#![forbid(unsafe_code)]

pub mod event;
pub mod file;
pub mod folder;
pub mod ring;
pub mod verdict;
