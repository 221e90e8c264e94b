// SPDX-License-Identifier: GPL-3.0-or-later
//! The lines of a file, as Python's configparser reads them after klippy has cut off the comments.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use crate::{Config, Entry, Place, Section, Setting, Trouble};

/// Highest number of sections. The longest known configuration has some hundred.
const SECTIONS_MAX: usize = 5_000;
/// Highest number of options.
const SETTINGS_MAX: usize = 50_000;

/// A line of a file, without its `#` comment.
#[derive(Clone, Copy)]
pub(crate) struct Line<'a> {
    pub(crate) number: usize,
    pub(crate) text: &'a str,
}

/// The name of a section's header, if the line is one: `\[(.+)\]` in Python.
pub(crate) fn header(line: &str) -> Option<&str> {
    let rest = line.strip_prefix('[')?;
    rest.rfind(']').map(|end| &rest[..end]).filter(|name| !name.is_empty())
}

/// The pattern of a line that includes files: `[include macros/*.cfg]`.
pub fn included(line: &str) -> Option<&str> {
    header(uncommented(line)).and_then(|name| name.strip_prefix("include ")).map(str::trim)
}

/// A line before its `#`.
pub(crate) fn uncommented(line: &str) -> &str {
    line.find('#').map_or(line, |at| &line[..at])
}

/// A line before a `;` at its start or behind white space.
fn before_semicolon(line: &str) -> &str {
    let starts = |at: usize| line[..at].chars().next_back().is_none_or(char::is_whitespace);
    let found = line.match_indices(';').map(|(at, _)| at).find(|at| starts(*at));
    found.map_or(line, |at| &line[..at])
}

/// An option while its lines are read.
struct Open {
    section: usize,
    setting: usize,
    entry: usize,
}

impl Config {
    /// Adds lines that are read as a unit: no option goes on beyond them.
    pub(crate) fn add(&mut self, file: &Arc<Path>, lines: &[Line<'_>]) -> Result<(), Trouble> {
        let mut section: Option<usize> = None;
        let mut open: Option<Open> = None;
        let mut indent = 0;
        for line in lines {
            let place = Place { file: file.clone(), line: line.number };
            let at = |trouble: Trouble| trouble.of(&place);
            let uncommented = before_semicolon(line.text);
            let value = uncommented.trim();
            if value.is_empty() {
                // A `;` comment is no empty line of the value. Python looks for a comment in the whole line.
                if uncommented.len() == line.text.len()
                    && let Some(open) = &open
                {
                    self.sections[open.section].settings[open.setting].value.push('\n');
                }
                continue;
            }
            let here = line.text.len() - line.text.trim_start().len();
            if let Some(open) = open.as_ref().filter(|_| here > indent) {
                let setting = &mut self.sections[open.section].settings[open.setting];
                setting.value.push('\n');
                setting.value.push_str(value);
                let entry = &mut self.entries[open.entry];
                entry.lines = *entry.lines.start()..=line.number;
                continue;
            }
            indent = here;
            if let Some(name) = header(value) {
                section = Some(self.open(name, place.clone()).map_err(at)?);
                open = None;
                continue;
            }
            let Some(section) = section else {
                return Err(at("File contains no section headers.".into()).remedy("begin with [printer]"));
            };
            let Some((key, text)) = value.split_once(['=', ':']).filter(|(key, _)| !key.trim().is_empty()) else {
                let cause = format!("Source contains parsing errors: '{}'", value.escape_debug());
                return Err(at(cause.into()).remedy("write `option: value`, and indent the lines of a value"));
            };
            open = Some(self.set(section, key.trim().to_lowercase(), text.trim(), &place).map_err(at)?);
        }
        Ok(())
    }

    fn open(&mut self, name: &str, place: Place) -> Result<usize, Trouble> {
        self.headers.push((name.to_owned(), place.clone()));
        if let Some(known) = self.by_name.get(name) {
            return Ok(*known);
        }
        if self.sections.len() == SECTIONS_MAX {
            let cause = format!("there are more than {SECTIONS_MAX} sections");
            return Err(Trouble::new(cause).remedy("remove the sections that do not belong to a printer"));
        }
        self.by_name.insert(name.to_owned(), self.sections.len());
        self.sections.push(Section { name: name.to_owned(), place, settings: Vec::new(), by_key: HashMap::new() });
        Ok(self.sections.len() - 1)
    }

    /// Sets an option. A later value replaces an earlier one.
    fn set(&mut self, section: usize, key: String, value: &str, place: &Place) -> Result<Open, Trouble> {
        self.settings += 1;
        if self.settings > SETTINGS_MAX {
            let cause = format!("there are more than {SETTINGS_MAX} options");
            return Err(Trouble::new(cause).remedy("remove the options that do not belong to a printer"));
        }
        let lines = place.line..=place.line;
        self.entries.push(Entry { file: place.file.clone(), section, key: key.clone(), lines });
        let Section { settings, by_key, .. } = &mut self.sections[section];
        let new = Setting { key, value: value.to_owned(), place: place.clone() };
        let setting = match by_key.get(&new.key) {
            Some(known) => {
                settings[*known] = new;
                *known
            }
            None => {
                by_key.insert(new.key.clone(), settings.len());
                settings.push(new);
                settings.len() - 1
            }
        };
        Ok(Open { section, setting, entry: self.entries.len() - 1 })
    }
}
