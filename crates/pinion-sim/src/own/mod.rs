// SPDX-License-Identifier: GPL-3.0-or-later
//! Somebody's own printer.cfg as a simulated printer.
//!
//! - `translate`: sections become a description, as a table of TOML; `motion`, `heat`, `devices` are its parts
//! - `sensors`: the tables of thermistors and amplifiers
//! - `known`: the sections of Klipper and Kalico
//! - `serve`: the folder with the copy that klippy gets

#![forbid(unsafe_code)]

pub(crate) mod args;
mod description;
mod devices;
mod drivers;
mod heat;
mod known;
mod motion;
pub(crate) mod run;
mod sensors;
pub(crate) mod serve;
mod translate;

pub(crate) use translate::Pace;
#[cfg(test)]
use translate::{Translated, translate};

#[cfg(test)]
mod tests;
