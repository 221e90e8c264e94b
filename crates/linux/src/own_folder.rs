// SPDX-License-Identifier: GPL-3.0-or-later
//! Folders of our own: the program makes, replaces and removes files only there.
//!
//! A user who may rename files in a folder may put a link in a file's place at any moment. A program of another user,
//! root's above all, would then empty or give away the file behind the link. So a folder is opened once, and judged by
//! its descriptor. Its files are reached below that descriptor, wherever its path leads by then.

#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Component, Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{OFlag, open, openat, readlinkat};
use nix::sys::stat::{FileStat, Mode, SFlag, fstat, mkdirat};
use nix::unistd::{Uid, User, geteuid};

/// Highest number of links that the kernel follows (path_resolution(7)).
const LINKS_MAX: usize = 40;
/// A folder or a link on the way. It cannot be a link's target.
const STEP: OFlag = OFlag::O_PATH.union(OFlag::O_NOFOLLOW).union(OFlag::O_CLOEXEC);
/// Permissions of a folder that is made.
const FOLDER_MODE: Mode = Mode::from_bits_truncate(0o755);

/// A folder where no other user can replace our files. It is ours or root's. If everybody may write there, each user
/// may rename only their own files, as in /tmp.
pub struct OwnFolder(OwnedFd);

impl OwnFolder {
    /// Opens a folder.
    ///
    /// # Errors
    ///
    /// It is missing, or it or a link on the way belongs to another user.
    pub fn open(path: &Path) -> io::Result<OwnFolder> {
        OwnFolder::reach(path, false)
    }

    /// The same. Folders that are missing on the way are made, in folders of our own only.
    ///
    /// # Errors
    ///
    /// One cannot be made, or it or a link on the way belongs to another user.
    pub fn make(path: &Path) -> io::Result<OwnFolder> {
        OwnFolder::reach(path, true)
    }

    fn reach(path: &Path, makes: bool) -> io::Result<OwnFolder> {
        let folder = walk(path, makes)?.there.ok_or(Errno::ENOENT)?;
        judge(&fstat(&folder)?)?;
        Ok(OwnFolder(folder))
    }

    /// The path of a file in it, below the descriptor. It is good as long as this folder is open.
    pub fn at(&self, name: impl AsRef<Path>) -> PathBuf {
        below(&self.0).join(name)
    }

    /// Makes a file for writing. A file that an earlier program has left under this name is removed.
    ///
    /// # Errors
    ///
    /// Those of the kernel.
    pub fn create(&self, name: &str) -> io::Result<File> {
        let path = self.at(name);
        let create = || OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
        match create() {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                std::fs::remove_file(&path)?;
                create()
            }
            created => created,
        }
    }
}

/// The end of a path, reached without a link of another user.
pub struct PathEnd {
    /// The folder of the last name.
    pub folder: OwnedFd,
    /// The last name: not a link.
    pub name: OsString,
    /// The file with this name, opened with `O_PATH`. `None` if there is none.
    pub there: Option<OwnedFd>,
}

/// Follows a path to its end, and the links of root and our own on the way. A link at the end is followed, too.
///
/// # Errors
///
/// A folder on the way is missing. A link on the way belongs to another user, who could lead us to any file.
pub fn end_of_path(path: &Path) -> io::Result<PathEnd> {
    walk(path, false)
}

/// Follows a path. With `makes`, folders that are missing are made, in folders of our own only.
///
/// openat2(2) would not do: it can refuse all links or none, and systemd's `RestrictSUIDSGID=` refuses the call.
fn walk(path: &Path, makes: bool) -> io::Result<PathEnd> {
    let start = |is_absolute| open(if is_absolute { "/" } else { "." }, STEP, Mode::empty());
    let mut folder = start(path.is_absolute())?;
    let mut links = 0;
    // The last one is the next.
    let mut way: Vec<OsString> = steps(path).collect();
    while let Some(name) = way.pop() {
        let step = || openat(&folder, name.as_os_str(), STEP, Mode::empty());
        let next = match step() {
            Err(Errno::ENOENT) if makes => {
                judge(&fstat(&folder)?)?;
                match mkdirat(&folder, name.as_os_str(), FOLDER_MODE) {
                    Ok(()) | Err(Errno::EEXIST) => step()?,
                    Err(error) => return Err(error.into()),
                }
            }
            Err(Errno::ENOENT) if way.is_empty() => return Ok(PathEnd { folder, name, there: None }),
            stepped => stepped?,
        };
        let about = fstat(&next)?;
        if kind(&about) != SFlag::S_IFLNK {
            if way.is_empty() {
                return Ok(PathEnd { folder, name, there: Some(next) });
            }
            folder = next;
            continue;
        }
        if !is_trusted(&about) {
            return Err(of_another("a link on the way to it", &about));
        }
        links += 1;
        if links > LINKS_MAX {
            return Err(Errno::ELOOP.into());
        }
        let target = PathBuf::from(readlinkat(&next, "")?);
        if target.is_absolute() {
            folder = start(true)?;
        }
        way.extend(steps(&target));
    }
    // The path has no name, as `/`, or a link leads to one that has none.
    let there = openat(&folder, ".", STEP, Mode::empty())?;
    Ok(PathEnd { folder, name: ".".into(), there: Some(there) })
}

/// The path of an open file, whatever has its name by now.
pub fn below(file: &impl AsRawFd) -> PathBuf {
    PathBuf::from(format!("/proc/self/fd/{}", file.as_raw_fd()))
}

/// The names on a path, the last one first.
fn steps(path: &Path) -> impl Iterator<Item = OsString> {
    let names = path.components().rev().filter(|step| matches!(step, Component::Normal(_) | Component::ParentDir));
    names.map(|name| name.as_os_str().to_owned())
}

fn kind(about: &FileStat) -> SFlag {
    SFlag::from_bits_truncate(about.st_mode) & SFlag::S_IFMT
}

fn is_trusted(about: &FileStat) -> bool {
    [0, geteuid().as_raw()].contains(&about.st_uid)
}

/// Whether files may be made in this folder.
fn judge(about: &FileStat) -> io::Result<()> {
    let mode = Mode::from_bits_truncate(about.st_mode);
    if kind(about) != SFlag::S_IFDIR {
        return Err(Errno::ENOTDIR.into());
    }
    if !is_trusted(about) {
        return Err(of_another("the folder", about));
    }
    if mode.contains(Mode::S_IWOTH) && !mode.contains(Mode::S_ISVTX) {
        return Err(io::Error::other("everybody may replace files in the folder"));
    }
    Ok(())
}

fn of_another(what: &str, about: &FileStat) -> io::Error {
    let owner = User::from_uid(Uid::from_raw(about.st_uid)).ok().flatten();
    let owner = owner.map_or_else(|| about.st_uid.to_string(), |user| user.name);
    io::Error::new(io::ErrorKind::PermissionDenied, format!("{what} belongs to another user, {owner}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, chown, lchown, symlink};

    fn refusal(path: &Path) -> String {
        OwnFolder::make(path).err().unwrap().to_string()
    }

    #[test]
    fn files_are_made_below_the_folder_that_was_opened() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("state/pinion");
        assert_eq!(OwnFolder::open(&path).err().unwrap().kind(), io::ErrorKind::NotFound);
        let folder = OwnFolder::make(&path).unwrap();
        // A process with our number has left this, or somebody who was there before.
        let other = root.path().join("other");
        fs::write(&other, "theirs").unwrap();
        symlink(&other, path.join("file")).unwrap();
        drop(folder.create("file").unwrap());
        assert_eq!(fs::read(&other).unwrap(), b"theirs");
        assert_eq!(fs::symlink_metadata(path.join("file")).unwrap().permissions().mode() & 0o7777, 0o600);
        // The path leads elsewhere now.
        let moved = root.path().join("moved");
        fs::rename(&path, &moved).unwrap();
        symlink("/", &path).unwrap();
        drop(folder.create("late").unwrap());
        assert!(moved.join("late").is_file() && folder.at("late").is_file());
    }

    #[test]
    fn our_own_links_are_followed_as_far_as_they_go() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir_all(root.path().join("a/b")).unwrap();
        symlink("a", root.path().join("relative")).unwrap();
        symlink(root.path().join("relative/b"), root.path().join("absolute")).unwrap();
        for path in ["a/b", "relative/b", "absolute", "a/../relative/./b"] {
            drop(OwnFolder::open(&root.path().join(path)).unwrap().create(&path.replace('/', "-")).unwrap());
        }
        assert_eq!(fs::read_dir(root.path().join("a/b")).unwrap().count(), 4);
        symlink("loop", root.path().join("loop")).unwrap();
        assert_eq!(refusal(&root.path().join("loop")), io::Error::from(Errno::ELOOP).to_string());
        fs::write(root.path().join("file"), "").unwrap();
        for path in ["file", "file/below"] {
            assert_eq!(refusal(&root.path().join(path)), io::Error::from(Errno::ENOTDIR).to_string());
        }
    }

    #[test]
    fn a_folder_where_everybody_may_rename_is_refused() {
        let root = tempfile::tempdir().unwrap();
        for (mode, is_own) in [(0o755, true), (0o775, true), (0o1777, true), (0o777, false)] {
            fs::set_permissions(root.path(), fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(OwnFolder::open(root.path()).is_ok(), is_own, "{mode:o}");
            assert_eq!(OwnFolder::make(&root.path().join(format!("{mode:o}"))).is_ok(), is_own, "{mode:o}");
        }
    }

    /// Attacks on root by the user of the service.
    #[test]
    fn neither_a_folder_nor_a_link_of_another_user_is_used_even_by_root() {
        if !pinion_testkit::here::is_root() {
            return;
        }
        let nobody = Some(65534);
        let root = tempfile::tempdir().unwrap();
        let (theirs, ours) = (root.path().join("theirs"), root.path().join("ours"));
        fs::create_dir(&theirs).unwrap();
        fs::create_dir(&ours).unwrap();
        chown(&theirs, nobody, None).unwrap();
        for path in [theirs.clone(), theirs.join("missing/folder")] {
            assert!(refusal(&path).starts_with("the folder belongs to another user, "), "{}", refusal(&path));
        }
        assert_eq!(fs::read_dir(&theirs).unwrap().count(), 0, "something was made there");
        let link = root.path().join("link");
        symlink(&ours, &link).unwrap();
        assert!(OwnFolder::open(&link).is_ok());
        lchown(&link, nobody, None).unwrap();
        for path in [link.clone(), link.join("new")] {
            assert!(refusal(&path).starts_with("a link on the way to it belongs to another user, "));
        }
        assert_eq!(fs::read_dir(&ours).unwrap().count(), 0, "something was made there");
    }
}
