// SPDX-License-Identifier: GPL-3.0-or-later
//! A copy of a configuration in a folder of its own, in which chosen options differ.
//!
//! A file keeps its place relative to the main one, so the includes stay as they are. Files that are not below the main
//! one's folder get a place in [`OUTSIDE`], and the line that includes them names it.

use std::collections::{HashMap, HashSet};
use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::files::normal;
use crate::{Config, Trouble};

/// The folder for files that are not below the main one's folder.
const OUTSIDE: &str = "outside";

/// A section that is another one in the copy.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Change {
    /// The whole name of the section.
    pub section: String,
    /// It is left out as a whole. Otherwise only options are.
    pub left_out: bool,
    /// The text that comes in the place of a section that is left out.
    pub instead: Option<String>,
    /// The options that go.
    pub without: Vec<String>,
    /// The options that come.
    pub with: Vec<(String, String)>,
}

/// Writes the copy. Returns the path of its main file.
///
/// # Errors
///
/// A file cannot be written.
pub fn write(config: &Config, changes: &[Change], folder: &Path) -> Result<PathBuf, Trouble> {
    let main = config.files.first().map_or_else(|| Path::new("printer.cfg").into(), |file| file.path.clone());
    let home = normal(main.parent().unwrap_or(Path::new("")));
    let mut places: HashMap<Arc<Path>, PathBuf> = HashMap::new();
    for (number, file) in config.files.iter().enumerate() {
        let name = file.path.file_name().unwrap_or_default();
        let below = normal(&file.path).strip_prefix(&home).ok().map(Path::to_owned);
        let below = below.filter(|path| path.is_relative() && !path.starts_with(".."));
        let place = below.unwrap_or_else(|| Path::new(OUTSIDE).join(number.to_string()).join(name));
        places.insert(file.path.clone(), place);
    }
    let mut opened = HashSet::new();
    for file in &config.files {
        let text = changed(config, changes, &file.path, &places, &mut opened, &file.text);
        let path = folder.join(&places[&file.path]);
        let written = path
            .parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| write_like(&file.path, &path, text.as_bytes()));
        written.map_err(|error| {
            let trouble = Trouble::new(format!("the copy cannot be written: {error}"));
            trouble.of(path.display()).remedy("free space, or name another folder")
        })?;
    }
    Ok(folder.join(&places[&main]))
}

/// Writes a copy again, with the permissions of its source, which may have secrets.
///
/// # Errors
///
/// Those of the kernel.
pub fn write_like(source: &Path, copy: &Path, bytes: &[u8]) -> io::Result<()> {
    // Without a source, as in tests, it is readable for everybody.
    let mode = fs::metadata(source).map_or(0o644, |about| about.permissions().mode() & 0o777);
    match fs::remove_file(copy) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    OpenOptions::new().write(true).create_new(true).mode(mode).open(copy)?.write_all(bytes)
}

/// The text of a file in the copy. `opened` has the sections with options that came already.
fn changed(
    config: &Config,
    changes: &[Change],
    path: &Arc<Path>,
    places: &HashMap<Arc<Path>, PathBuf>,
    opened: &mut HashSet<String>,
    text: &str,
) -> String {
    let mut lines: Vec<String> = text.split('\n').map(str::to_owned).collect();
    let change_of = |section: &str| changes.iter().find(|change| change.section == section);
    for entry in config.entries.iter().filter(|entry| entry.file == *path) {
        let change = change_of(&config.sections[entry.section].name);
        if change.is_some_and(|change| change.left_out || change.without.contains(&entry.key)) {
            entry.lines.clone().for_each(|number| comment_out(&mut lines, number));
        }
    }
    for include in config.includes.iter().filter(|include| include.place.file == *path) {
        let is_outside = |file: &Arc<Path>| places.get(file).is_some_and(|place| place.starts_with(OUTSIDE));
        let inside = places.get(path).is_some_and(|place| !place.starts_with(OUTSIDE));
        if inside && !include.found.iter().any(is_outside) {
            continue;
        }
        // The path from this file's place in the copy to the others.
        let depth = places.get(path).and_then(|place| place.parent()).map_or(0, |parent| parent.components().count());
        let up: PathBuf = std::iter::repeat_n("..", depth).collect();
        let named = include.found.iter().filter_map(|file| places.get(file));
        let named: Vec<String> = named.map(|place| format!("[include {}]", up.join(place).display())).collect();
        if let Some(line) = lines.get_mut(include.place.line - 1) {
            *line = named.join("\n");
        }
    }
    for (name, place) in config.headers.iter().filter(|(_, place)| place.file == *path) {
        let Some(change) = change_of(name) else { continue };
        let is_first = opened.insert(name.clone());
        if change.left_out {
            comment_out(&mut lines, place.line);
            // In front of the SAVE_CONFIG block, if the section is in it: each line there has a mark.
            let is_saved = lines.get(place.line - 1).is_some_and(|line| line.starts_with("#*#"));
            let at = match is_saved {
                true => lines.iter().position(|line| line.starts_with("#*# <-")).and_then(|at| at.checked_sub(1)),
                false => Some(place.line - 1),
            };
            let line = at.and_then(|at| lines.get_mut(at));
            if let (true, Some(text), Some(line)) = (is_first, &change.instead, line) {
                *line = format!("{text}\n{line}");
            }
            continue;
        }
        if !is_first {
            continue;
        }
        if let Some(line) = lines.get_mut(place.line - 1) {
            for (key, value) in &change.with {
                line.push_str(&format!("\n{key}: {value}"));
            }
        }
    }
    lines.join("\n")
}

fn comment_out(lines: &mut [String], number: usize) {
    // klippy ignores the whole SAVE_CONFIG block if a line has lost its mark.
    const MARK: &str = "#*# ";
    let Some(line) = lines.get_mut(number - 1).filter(|line| *line != MARK.trim_end()) else { return };
    let at = if line.starts_with(MARK) { MARK.len() } else { 0 };
    if !line[at..].starts_with("# ") {
        line.insert_str(at, "# ");
    }
}
