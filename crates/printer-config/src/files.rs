// SPDX-License-Identifier: GPL-3.0-or-later
//! The files of a configuration: how they are read, and how an include's pattern finds them.

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};

use glob::{MatchOptions, Pattern};
use pinion_linux::foreign;

/// Longest file.
const FILE_MAX: u64 = 4 << 20;
/// Highest number of names that an include's pattern looks at.
const NAMES_MAX: usize = 20_000;

/// A place with files.
pub trait Files {
    /// The text of a file.
    ///
    /// # Errors
    ///
    /// It cannot be read, or is no configuration.
    fn text(&self, path: &Path) -> io::Result<String>;

    /// The paths that exist and that match a pattern of Python's `glob.glob`, sorted as klippy sorts them.
    ///
    /// # Errors
    ///
    /// It would look at too many names.
    fn matching(&self, pattern: &Path) -> io::Result<Vec<PathBuf>>;

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
        String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is no UTF-8 text"))
    }

    fn matching(&self, pattern: &Path) -> io::Result<Vec<PathBuf>> {
        let mut found = vec![PathBuf::new()];
        let mut names = 0;
        for component in pattern.components() {
            let literal = match component {
                Component::Normal(name) => name.to_str().filter(|name| is_pattern(name)),
                _ => None,
            };
            found = match literal.map(Pattern::new) {
                Some(Ok(pattern)) => expand(&found, &pattern, &mut names)?,
                // Python takes a wrong pattern as a name.
                Some(Err(_)) | None => found.into_iter().map(|path| path.join(component)).collect(),
            };
        }
        // Python finds a link that leads nowhere, too.
        found.retain(|path| path.symlink_metadata().is_ok());
        found.sort();
        Ok(found)
    }

    fn whole(&self, path: &Path) -> PathBuf {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        normal(&path)
    }
}

/// Whether Python's `glob.has_magic` says that a name is a pattern.
pub(crate) fn is_pattern(name: &str) -> bool {
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

/// The names in these folders that match.
fn expand(folders: &[PathBuf], pattern: &Pattern, names: &mut usize) -> io::Result<Vec<PathBuf>> {
    let options = MatchOptions { require_literal_leading_dot: true, ..MatchOptions::new() };
    let mut found = Vec::new();
    for folder in folders {
        let place = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let Ok(entries) = fs::read_dir(place) else { continue };
        for entry in entries.flatten() {
            *names += 1;
            if *names > NAMES_MAX {
                return Err(io::Error::other(format!("its pattern looks at more than {NAMES_MAX} names")));
            }
            let name = entry.file_name();
            if name.to_str().is_some_and(|name| pattern.matches_with(name, options)) {
                found.push(folder.join::<&OsStr>(&name));
            }
        }
    }
    Ok(found)
}
