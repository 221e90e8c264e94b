// SPDX-License-Identifier: GPL-3.0-or-later
//! The flight recorder: events, the rings and the files that hold them, and their verdict and exports.
//!
//! - `event`: what is recorded, 16 bytes each
//! - `ring`: the memory that a thread records into
//! - `file`: a trace, from the rings to a file and back
//! - `folder`: where the files are, and their names
//! - `verdict`: who was late
//! - `history`: what each thread did, in words and from when to when
//! - `timeline`, `vcd`, `perfetto`, `svg`: exports of a history

#![forbid(unsafe_code)]

pub mod event;
pub mod file;
pub mod folder;
mod history;
pub mod perfetto;
pub mod ring;
pub mod svg;
pub mod timeline;
pub mod vcd;
pub mod verdict;
