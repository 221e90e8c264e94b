// SPDX-License-Identifier: GPL-3.0-or-later
//! Somebody's own printer.cfg as a simulated printer.
//!
//! - `translate`: sections become a description, as a table of TOML; `motion`, `heat`, `devices`, `drivers` are its parts
//! - `translator`: the pins, buses and notes that these parts share
//! - `sensors`: the tables of thermistors and amplifiers
//! - `klippy`: klippy's own verdict; without a klippy, `rules` and `claims` find the most frequent mistakes
//! - `known`: the sections of Klipper and Kalico; `plugins`: those that the copy is without
//! - `serve`: the folder with the copy that klippy gets

pub(crate) mod args;
mod chips;
mod claims;
mod description;
mod devices;
mod drivers;
mod heat;
mod klippy;
mod known;
mod motion;
mod plugins;
mod rules;
pub(crate) mod run;
mod sensors;
pub(crate) mod serve;
mod translate;
mod translator;

pub(crate) use known::{Kind, kind_of};
#[cfg(test)]
use translate::{Translated, translate};
pub(crate) use translator::Pace;

#[cfg(test)]
mod tests;
