// SPDX-License-Identifier: GPL-3.0-or-later
//! The file at a link's place: one judgment for the program that puts the link there, for `pinion run --check` and
//! for `pinion doctor`.

use std::fs;
use std::path::Path;

use pinion_firmware::trouble::Trouble;

/// The file at a link's place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Nothing, or nothing that can be seen.
    Free,
    /// A symbolic link, which another one replaces.
    Link,
    /// A folder.
    Folder,
    /// Any other file.
    File,
}

impl Place {
    /// The file at `path`.
    pub fn of(path: &Path) -> Place {
        match fs::symlink_metadata(path) {
            Ok(found) if found.file_type().is_symlink() => Place::Link,
            Ok(found) if found.is_dir() => Place::Folder,
            Ok(_) => Place::File,
            Err(_) => Place::Free,
        }
    }

    /// Why no link can be put there; `None` if one can. Users know the link as `link`.
    pub fn obstacle(self, link: &Path) -> Option<Trouble> {
        let link = link.display();
        match self {
            Place::Free | Place::Link => None,
            Place::Folder => Some(
                Trouble::new(format!("{link} is a folder"))
                    .remedy("choose another path with -I, such as one in that folder"),
            ),
            Place::File => Some(
                Trouble::new(format!("{link} exists but is not a symbolic link"))
                    .remedy("remove it, or choose another path with -I"),
            ),
        }
    }
}
