// SPDX-License-Identifier: GPL-3.0-or-later
//! Reads a printer.cfg as klippy does (klippy/configfile.py and Python's configparser), with the line of each option.
//!
//! - [`Config`]: sections and options after all includes and the SAVE_CONFIG block
//! - [`Section`]: an option as a text, number, choice or list, with klippy's words for what klippy would refuse
//! - [`pins`]: names of pins, `[board_pins]` and uses
//! - [`copy`]: a copy of all files in a folder of its own, in which chosen options differ
//!
//! The files may come from anybody. Each is bounded, and so are the numbers of files, includes, sections and options.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod copy;
mod files;
mod parse;
pub mod pins;
mod read;
mod values;

use std::collections::HashMap;
use std::fmt;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;

pub use files::{Disk, Files, NAMES_MAX, is_pattern, matching, names_in};
pub use parse::included;
pub use pinion_firmware::trouble::Trouble;
pub use values::Limit;

/// A line of a file. [`fmt::Display`] writes `file:line`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The file, as it was named.
    pub file: Arc<Path>,
    /// Its line, counted from 1.
    pub line: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.file.display(), self.line)
    }
}

/// An option and its value.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    /// Its name, in lower case.
    pub key: String,
    /// Its value; lines after the first one follow a line feed.
    pub value: String,
    /// Its first line.
    pub place: Place,
}

/// A section, with the options of all places where it is opened.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// Its whole name, for example `stepper_x` or `heater_fan hotend`.
    pub name: String,
    /// The line that opens it first.
    pub place: Place,
    settings: Vec<Setting>,
    by_key: HashMap<String, usize>,
}

/// The lines of an option in a file, for a copy of the file.
#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) file: Arc<Path>,
    /// Its index in [`Config::sections`].
    pub(crate) section: usize,
    pub(crate) key: String,
    pub(crate) lines: RangeInclusive<usize>,
}

/// A line `[include ...]` and the files that it names.
#[derive(Clone, Debug)]
pub(crate) struct Include {
    pub(crate) place: Place,
    pub(crate) found: Vec<Arc<Path>>,
}

/// A file that was read.
#[derive(Clone, Debug)]
pub(crate) struct SourceFile {
    pub(crate) path: Arc<Path>,
    pub(crate) text: String,
}

/// A whole configuration.
#[derive(Clone, Debug, Default)]
pub struct Config {
    sections: Vec<Section>,
    by_name: HashMap<String, usize>,
    settings: usize,
    pub(crate) files: Vec<SourceFile>,
    pub(crate) includes: Vec<Include>,
    pub(crate) entries: Vec<Entry>,
    /// The lines that open a section, in the order of reading.
    pub(crate) headers: Vec<(String, Place)>,
}

impl Config {
    /// All sections, in the order of their first lines.
    pub fn sections(&self) -> &[Section] {
        &self.sections
    }

    /// A section by its whole name.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.by_name.get(name).map(|place| &self.sections[*place])
    }

    /// The sections with this first word: the one with this name, and those with another word behind it.
    pub fn of_kind(&self, kind: &str) -> impl Iterator<Item = &Section> {
        self.sections.iter().filter(move |section| section.kind() == kind)
    }

    /// The files that open a section, once for each line that does.
    pub fn files_of(&self, section: &str) -> impl Iterator<Item = &Path> {
        self.headers.iter().filter(move |(name, _)| name == section).map(|(_, place)| &*place.file)
    }

    /// The path of each file that was read, the main one first.
    pub fn paths(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(|file| &*file.path)
    }
}

#[cfg(test)]
mod tests;
