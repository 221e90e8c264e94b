// SPDX-License-Identifier: GPL-3.0-or-later
//! The files of a configuration: how they are read, and how an include's pattern finds them.

use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};

use glob::{MatchOptions, Pattern};
use pinion_linux::foreign;

/// Longest file.
const FILE_MAX: u64 = 4 << 20;
/// Highest number of names that all patterns of a configuration look at.
pub const NAMES_MAX: usize = 100_000;

/// A place with files.
pub trait Files {
    /// The text of a file.
    ///
    /// # Errors
    ///
    /// It cannot be read, or is no configuration.
    fn text(&self, path: &Path) -> io::Result<String>;

    /// The names in a folder, in any order, but no more than `most`. Empty if it cannot be read.
    fn names(&self, folder: &Path, most: usize) -> Vec<String>;

    /// Whether a pattern may find this path.
    fn is_there(&self, path: &Path) -> bool;

    /// The same path for two names of one file, as Python's `os.path.abspath` makes it.
    fn whole(&self, path: &Path) -> PathBuf;
}

/// The files of this computer.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

impl Files for Disk {
    fn text(&self, path: &Path) -> io::Result<String> {
        let bytes = foreign::read(path, FILE_MAX + 1)?;
        if bytes.len() as u64 > FILE_MAX {
            let cause = format!("it is longer than {} MiB", FILE_MAX >> 20);
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, cause));
        }
        String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8 text"))
    }

    fn names(&self, folder: &Path, most: usize) -> Vec<String> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        names_in(folder, most)
    }

    fn is_there(&self, path: &Path) -> bool {
        // Python finds a link that leads nowhere, too.
        path.symlink_metadata().is_ok()
    }

    fn whole(&self, path: &Path) -> PathBuf {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        normal(&path)
    }
}

/// Whether Python's `glob.has_magic` says that a name is a pattern.
pub fn is_pattern(name: &str) -> bool {
    name.contains(['*', '?', '['])
}

/// A path without `.` and `..`, by its text alone.
pub(crate) fn normal(path: &Path) -> PathBuf {
    let mut whole = PathBuf::new();
    for component in path.components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir if whole.file_name().is_some() => _ = whole.pop(),
            Component::ParentDir if whole.has_root() => {}
            other => whole.push(other),
        }
    }
    whole
}

/// The names in a folder of this computer, but no more than `most`.
pub fn names_in(folder: &Path, most: usize) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten().take(most);
    entries.filter_map(|entry| entry.file_name().into_string().ok()).collect()
}

/// The paths that match a pattern of Python's `glob.glob`, sorted as klippy sorts them. Each folder and each name in it
/// takes one of `names_left`.
///
/// # Errors
///
/// No names are left.
pub fn matching(files: &dyn Files, pattern: &Path, names_left: &mut usize) -> io::Result<Vec<PathBuf>> {
    let options = MatchOptions { require_literal_leading_dot: true, ..MatchOptions::new() };
    let mut found = vec![PathBuf::new()];
    for component in pattern.components() {
        let name = match component {
            Component::Normal(name) => name.to_str().filter(|name| is_pattern(name)),
            _ => None,
        };
        // Python takes a wrong pattern as a name.
        let Some(pattern) = name.and_then(|name| Pattern::new(name).ok()) else {
            found.iter_mut().for_each(|path| path.push(component));
            continue;
        };
        let mut inside = Vec::new();
        for folder in found {
            let names = files.names(&folder, *names_left);
            *names_left = names_left.saturating_sub(names.len() + 1);
            if *names_left == 0 {
                return Err(io::Error::other(format!("the patterns look at more than {NAMES_MAX} names")));
            }
            let matches = names.iter().filter(|name| pattern.matches_with(name, options));
            inside.extend(matches.map(|name| folder.join(name)));
        }
        found = inside;
    }
    found.retain(|path| files.is_there(path));
    found.sort();
    Ok(found)
}
