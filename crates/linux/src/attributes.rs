// SPDX-License-Identifier: GPL-3.0-or-later
//! Reads the kernel's attributes: the small files, links and folders of sysfs, debugfs and /dev.

#![forbid(unsafe_code)]

use std::fs;
use std::path::Path;

/// A file's text without the white space around it. `None` if there is no text.
pub(super) fn text(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?.trim().to_owned();
    (!text.is_empty()).then_some(text)
}

/// The name of a symbolic link's target.
pub(super) fn target(link: &Path) -> Option<String> {
    fs::read_link(link).ok()?.file_name()?.to_str().map(str::to_owned)
}

/// The names in a folder, in order.
pub(super) fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.sort();
    names
}
