// SPDX-License-Identifier: GPL-3.0-or-later
//! Changes of files: planned as whole texts, shown as lines, made at once.
//!
//! A file is replaced by a rename: a program that is killed leaves the old file or the new one. Files are reached below the
//! descriptor of their folder ([`OwnFolder`]), never through a link in their place. Files of printer.cfg's owner are written
//! with that user's rights, so a link cannot make us overwrite somebody else's file. The folder is locked during the changes.
//!
//! A file that was there is copied before its first change. When the last change is taken back, the copy goes, too.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};
use nix::unistd::geteuid;

use pinion_linux::foreign::{self, word};
use pinion_linux::own_folder::OwnFolder;
use pinion_system::Computer;
use pinion_system::files::{self, Unwritten};
use pinion_system::rights::Rights;

/// Longest file that is changed. A printer.cfg has some 100 kB at most.
const BYTES_MAX: u64 = 4 << 20;
/// The word that each of our own lines in another's file has.
pub(super) const MARK: &str = "pinion add";

/// A change of one file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Edit {
    /// The file, as a path of the computer.
    pub(super) file: PathBuf,
    /// Its text before. `None`: the file is new.
    pub(super) old: Option<String>,
    /// Its text after. `None`: the file goes.
    pub(super) new: Option<String>,
}

impl Edit {
    /// The lines that go and those that come, in order.
    pub(super) fn lines(&self) -> (Vec<&str>, Vec<&str>) {
        fn without<'a>(text: Option<&'a str>, other: Option<&str>) -> Vec<&'a str> {
            let mut others: Vec<&str> = other.unwrap_or_default().lines().collect();
            let lines = text.unwrap_or_default().lines().filter(|line| {
                let same = others.iter().position(|other| other == line);
                same.map(|at| others.swap_remove(at)).is_none()
            });
            lines.collect()
        }
        let (old, new) = (self.old.as_deref(), self.new.as_deref());
        (without(old, new), without(new, old))
    }
}

/// Reads and changes files of one owner, root or the owner of printer.cfg, with that user's rights.
pub(super) struct Editor<'a> {
    pub(super) computer: &'a Computer,
    /// User and group whose files these are. `None`: the caller's.
    owner: Option<(u32, u32)>,
    /// The files that are not UTF-8. Each of their bytes is a character here, as in Latin-1.
    bytewise: RefCell<BTreeSet<PathBuf>>,
}

impl<'a> Editor<'a> {
    pub(super) fn new(computer: &'a Computer, owner: Option<(u32, u32)>) -> Editor<'a> {
        Editor { computer, owner, bytewise: RefCell::default() }
    }

    /// Whether only root may change these files.
    pub(super) fn is_root_s(&self) -> bool {
        self.owner.is_none()
    }

    fn rights(&self) -> io::Result<Rights> {
        Rights::of(self.owner)
    }

    /// The text of a file. `None` if there is none.
    ///
    /// # Errors
    ///
    /// One line: a link or another kind of file is in its place, or it cannot be read.
    pub(super) fn read(&self, file: &Path) -> Result<Option<String>, String> {
        let read = || {
            let _rights = self.rights()?;
            let (folder, name) = match self.folder(file, false) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
                found => found?,
            };
            bytes_in(&folder, &name)
        };
        let bytes = read().map_err(|error| failed(file, &error))?;
        Ok(bytes.map(|bytes| match String::from_utf8(bytes) {
            Ok(text) => text,
            Err(error) => {
                self.bytewise.borrow_mut().insert(file.to_owned());
                error.into_bytes().into_iter().map(char::from).collect()
            }
        }))
    }

    fn folder(&self, file: &Path, makes: bool) -> io::Result<(OwnFolder, String)> {
        let name = file.file_name().and_then(|name| name.to_str());
        let name = name.ok_or_else(|| io::Error::other("its name is not usable"))?;
        let path = self.computer.resolve(file.parent().unwrap_or(Path::new("/")))?;
        let folder = if makes { OwnFolder::make(&path)? } else { OwnFolder::open(&path)? };
        // Below --root no link is left on the way. One that comes now could lead out of it.
        if !self.computer.is_this() && fs::canonicalize(folder.at("."))? != path {
            return Err(io::Error::other("a link has appeared in its path: run this command again"));
        }
        Ok((folder, name.to_owned()))
    }

    fn write(&self, file: &Path, text: &str) -> io::Result<()> {
        let _rights = self.rights()?;
        let (folder, name) = self.folder(file, true)?;
        let is_bytewise = self.bytewise.borrow().contains(file);
        let bytes = match is_bytewise {
            true => text.chars().map(|c| u8::try_from(c).unwrap_or(b'?')).collect(),
            false => text.as_bytes().to_vec(),
        };
        let there = match fs::symlink_metadata(folder.at(&name)) {
            Ok(about) if !about.is_file() => return Err(io::Error::other("it is not a regular file")),
            Ok(about) => Some(about),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(error),
        };
        let replaced = files::replace(&folder.at(""), name.as_ref(), there.as_ref(), |out| out.write_all(&bytes));
        replaced.map_err(|unwritten| match unwritten {
            Unwritten::Failed(error) => error,
            Unwritten::Beside(fresh, error) => {
                let _ = fs::remove_file(folder.at(fresh));
                error
            }
        })
    }

    /// Fails if somebody has protected the file: a rename would replace it all the same.
    fn refuse_read_only(&self, file: &Path) -> Result<(), String> {
        let about = self.computer.resolve(file).and_then(fs::symlink_metadata);
        match about {
            Ok(about) if about.mode() & 0o200 == 0 => {
                let path = file.display();
                Err(format!(
                    "{path} is read-only: chmod u+w {}, then run this command again",
                    word(self.computer.path(file).display())
                ))
            }
            _ => Ok(()),
        }
    }

    /// Fails if one of these files could not be replaced, and changes nothing.
    pub(super) fn probe(&self, files: impl Iterator<Item = PathBuf>) -> Result<(), String> {
        for file in files {
            self.refuse_read_only(&file)?;
            let probed = || {
                let _rights = self.rights()?;
                let (folder, name) = match self.folder(&file, false) {
                    Err(error) if error.kind() == io::ErrorKind::NotFound => return self.refuse_dangling(&file),
                    found => found?,
                };
                let (fresh, _) = files::beside(&folder.at(""), name.as_ref(), None)?;
                match fs::remove_file(folder.at(fresh)) {
                    // Another call that makes its changes has swept it away.
                    Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
                    removed => removed,
                }
            };
            probed().map_err(|error| failed(&file, &error))?;
        }
        Ok(())
    }

    /// Fails if the folder of a file is a link that leads nowhere.
    fn refuse_dangling(&self, file: &Path) -> io::Result<()> {
        let folder = file.parent().unwrap_or(file);
        match fs::symlink_metadata(self.computer.unfollowed(folder)?) {
            Ok(about) if about.is_symlink() => {
                Err(io::Error::other(format!("{} is a link that leads nowhere: remove it", folder.display())))
            }
            _ => Ok(()),
        }
    }

    fn remove(&self, file: &Path) -> io::Result<()> {
        let _rights = self.rights()?;
        let (folder, name) = self.folder(file, false)?;
        fs::remove_file(folder.at(name))
    }

    /// Removes the new file that a killed program has left beside a file. While another call makes its changes, the new file
    /// may be that call's, and stays.
    pub(super) fn sweep(&self, file: &Path) {
        if let Some(folder) = file.parent()
            && let Ok(_lock) = self.lock(folder, false)
        {
            self.sweep_locked(file);
        }
    }

    fn sweep_locked(&self, file: &Path) {
        if let Ok(_rights) = self.rights()
            && let Ok((folder, name)) = self.folder(file, false)
        {
            files::sweep(&folder.at(""), name.as_ref());
            files::sweep(&folder.at(""), copy_of(Path::new(&name)).as_os_str());
        }
    }

    /// Removes a folder that has become empty.
    pub(super) fn tidy(&self, folder: &Path) {
        if let Ok(_rights) = self.rights()
            && let Ok((parent, name)) = self.folder(folder, false)
        {
            // It may hold other files, or be gone.
            let _ = fs::remove_dir(parent.at(name));
        }
    }

    /// Makes the changes. Returns a line about each copy.
    ///
    /// # Errors
    ///
    /// One line with the file and the cause, and the files that are changed already.
    pub(super) fn make(&self, edits: &[Edit]) -> Result<Vec<String>, String> {
        edits.iter().try_for_each(|edit| self.refuse_read_only(&edit.file))?;
        let _locks = self.locked(edits)?;
        edits.iter().for_each(|edit| self.sweep_locked(&edit.file));
        let mut told = Vec::new();
        let mut done: Vec<String> = Vec::new();
        for edit in edits {
            let made = self.make_one(edit, &mut told);
            made.map_err(|why| match &done[..] {
                [] => why,
                done => format!("{why} ({} is already changed)", done.join(", ")),
            })?;
            done.push(edit.file.display().to_string());
        }
        Ok(told)
    }

    fn make_one(&self, Edit { file, old, new }: &Edit, told: &mut Vec<String>) -> Result<(), String> {
        let at = |file: &Path| {
            let file = file.to_owned();
            move |error: io::Error| failed(&file, &error)
        };
        if self.read(file)? != *old {
            return Err(format!("{} has changed since it was read: run this command again", file.display()));
        }
        let (Some(old), Some(new)) = (old, new) else {
            return match new {
                Some(new) => self.write(file, new).map_err(at(file)),
                None => self.remove(file).map_err(at(file)),
            };
        };
        let copy = copy_of(file);
        if self.bytewise.borrow().contains(file) {
            self.bytewise.borrow_mut().insert(copy.clone());
        }
        if !old.contains(MARK) && new.contains(MARK) {
            self.write(&copy, old).map_err(at(&copy))?;
            told.push(format!("{} is a copy of what was there.", copy.display()));
            return self.write(file, new).map_err(at(file));
        }
        let saved = if new.contains(MARK) { None } else { self.read(&copy)? };
        // The last line of the old file may have had no end.
        let is_as_before = |saved: &&String| saved.trim_end_matches(['\r', '\n']) == new.trim_end_matches(['\r', '\n']);
        match saved.as_ref().filter(is_as_before) {
            Some(saved) => {
                self.write(file, saved).map_err(at(file))?;
                self.remove(&copy).map_err(at(&copy))
            }
            None => {
                if saved.is_some() {
                    told.push(format!(
                        "{} stays: it is a copy of {} from before pinion add",
                        copy.display(),
                        file.display()
                    ));
                }
                self.write(file, new).map_err(at(file))
            }
        }
    }

    /// The change that removes the copy of a file that has no line of ours any more, and is as it was.
    pub(super) fn needless_copy(&self, file: &Path, text: &str) -> Result<Option<Edit>, String> {
        let copy = copy_of(file);
        let saved = if text.contains(MARK) { None } else { self.read(&copy)? };
        Ok(saved.filter(|saved| saved == text).map(|saved| Edit { file: copy, old: Some(saved), new: None }))
    }

    /// Locks of all folders with changes.
    fn locked(&self, edits: &[Edit]) -> Result<Vec<Flock<File>>, String> {
        let folders: BTreeSet<&Path> = edits.iter().filter_map(|edit| edit.file.parent()).collect();
        folders.into_iter().map(|folder| self.lock(folder, true)).collect()
    }

    fn lock(&self, folder: &Path, makes: bool) -> Result<Flock<File>, String> {
        let open = || {
            let _rights = self.rights()?;
            let (inside, _) = self.folder(&folder.join("x"), makes)?;
            File::open(inside.at("."))
        };
        let file = open().map_err(|error| failed(folder, &error))?;
        let lock = Flock::lock(file, FlockArg::LockExclusiveNonblock);
        lock.map_err(|_| format!("another pinion add changes files in {}: run this command again", folder.display()))
    }
}

/// Where a file is copied to before its first change.
pub(super) fn copy_of(file: &Path) -> PathBuf {
    let mut name = file.as_os_str().to_owned();
    name.push(".before-pinion");
    name.into()
}

fn bytes_in(folder: &OwnFolder, name: &str) -> io::Result<Option<Vec<u8>>> {
    let path = folder.at(name);
    match fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
        Ok(about) if about.is_symlink() => Err(io::Error::other("it is a link: name the file that it leads to")),
        Ok(about) if about.len() > BYTES_MAX => Err(io::ErrorKind::FileTooLarge.into()),
        Ok(_) => foreign::read(&path, BYTES_MAX).map(Some),
    }
}

fn failed(file: &Path, error: &io::Error) -> String {
    let remedy = match error.kind() {
        io::ErrorKind::PermissionDenied if !geteuid().is_root() => ": use sudo",
        io::ErrorKind::PermissionDenied => {
            ": its owner may not write there: see ls -ld and lsattr of the file and its folder"
        }
        io::ErrorKind::ReadOnlyFilesystem => ": make the file system writable, then run this command again",
        io::ErrorKind::StorageFull => ": make room, then run this command again",
        _ => "",
    };
    format!("{}: {error}{remedy}", file.display())
}
