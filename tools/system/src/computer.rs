// SPDX-License-Identifier: GPL-3.0-or-later
//! The computer: its files below a root, and its users.

use std::env;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Read};
use std::os::fd::AsFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::unistd::{User, getegid, geteuid, getgroups, getuid};

use pinion_linux::foreign;
use pinion_printer_config::{Disk, Files, NAMES_MAX, is_pattern, matching, names_in};
use pinion_runtime::klippy::process::Ids;

use crate::board::Board;

/// Longest text that is read. Every file that is read here is shorter.
const TEXT_MAX: u64 = 4 << 20;
/// Highest number of links that the kernel follows (path_resolution(7)).
const LINKS_MAX: usize = 40;
/// The computer that the program looks at.
pub struct Computer {
    root: PathBuf,
    /// The user that has called this program.
    pub(crate) caller: Option<u32>,
    /// The name of its board. A mounted card has no device tree that says so.
    pub(crate) board: Option<String>,
}

/// A user, with all groups.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Who {
    /// The name, or the number without one.
    pub name: String,
    /// The number of the user.
    pub uid: u32,
    /// The numbers of all groups.
    pub gids: Vec<u32>,
}

/// Access to a file, as bits of its mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Access(u32);

impl Access {
    /// To read.
    pub const READ: Access = Access(4);
    /// To write.
    pub const WRITE: Access = Access(2);
    /// To read and write.
    pub const READ_WRITE: Access = Access(6);
    /// To reach what is in a folder.
    pub const SEARCH: Access = Access(1);

    /// Whether a file gives this access to its group.
    pub fn is_given_to_group(self, file: &fs::Metadata) -> bool {
        file.mode() >> 3 & self.0 == self.0
    }
}

impl Who {
    /// Whether the file's owner and mode let this user in.
    pub fn may(&self, access: Access, file: &fs::Metadata) -> bool {
        let ids = Ids { uids: vec![self.uid; 2], gids: self.gids.clone() };
        ids.may(access.0, (file.uid(), file.gid(), file.mode()))
    }
}

impl Computer {
    /// The computer whose files are below this folder.
    pub fn at(root: &Path) -> Computer {
        // The user behind sudo. Only root's word counts: anybody else may set the variable to anything.
        let behind_root = || env::var("SUDO_UID").ok()?.parse().ok();
        let user = getuid();
        let caller = if user.is_root() { behind_root() } else { Some(user.as_raw()) };
        Computer::below(root, caller)
    }

    /// The computer whose files are below this folder, for a program that this user has called.
    pub fn below(root: &Path, caller: Option<u32>) -> Computer {
        Computer { root: root.to_owned(), caller, board: None }
    }

    /// The computer whose files are below a folder that the user names, and its board. `/.` is this computer.
    ///
    /// # Errors
    ///
    /// One line: there is no such folder, or no board has this name.
    pub fn named(root: &Path, board: Option<&str>) -> Result<(Computer, Option<Board>), String> {
        // Changes are made below the folder's descriptor, and a path relative to it would mean another one.
        let mut computer = match fs::canonicalize(root) {
            Ok(root) if root.is_dir() => Computer::at(&root),
            _ => {
                return Err(format!(
                    "{}: there is no such folder: name the one where the system's files are, such as /mnt",
                    root.display()
                ));
            }
        };
        let board = Board::of(&computer, board)?;
        computer.board = board.as_ref().map(|board| board.name.clone());
        Ok((computer, board))
    }

    /// True for the live system (root is `/`). Its kernel knows more than its files.
    pub fn is_this(&self) -> bool {
        self.root == Path::new("/")
    }

    /// The option that makes a command look at this computer, with a space before it.
    pub fn root_option(&self) -> String {
        if self.is_this() { String::new() } else { format!(" --root {}", foreign::word(self.root.display())) }
    }

    /// Where this program finds a file of the computer.
    pub fn path(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        self.root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// The path of a file on the computer itself.
    pub fn name(&self, path: &Path) -> PathBuf {
        Path::new("/").join(path.strip_prefix(&self.root).unwrap_or(path))
    }

    /// A file's text without the white space around it. `None` if the file is missing or cannot be read.
    pub fn text(&self, path: impl AsRef<Path>) -> Option<String> {
        let bytes = foreign::read(&self.resolve(path.as_ref()).ok()?, TEXT_MAX).ok()?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned())
    }

    /// The files that an absolute pattern of `*`, `?` and `[...]` finds, in order, as paths for this program. A path
    /// without any of these finds itself, even if the file is missing.
    pub fn matching(&self, pattern: impl AsRef<Path>) -> Vec<PathBuf> {
        let pattern = pattern.as_ref();
        if !is_pattern(&pattern.to_string_lossy()) {
            return vec![self.path(pattern)];
        }
        let found = matching(self, pattern, &mut { NAMES_MAX }).unwrap_or_default();
        found.into_iter().map(|path| self.path(path)).collect()
    }

    /// The first of these files that exists.
    pub fn first<'a>(&self, paths: &[&'a str]) -> Option<&'a str> {
        paths.iter().find(|path| self.exists(path)).copied()
    }

    /// Whether a file is there.
    pub fn exists(&self, path: impl AsRef<Path>) -> bool {
        self.resolve(path.as_ref()).is_ok_and(|path| path.exists())
    }

    /// Where this program finds the file behind a path. Each link on the way leads where it leads on the computer itself:
    /// an absolute link on a mounted card stays on the card. A name that is missing stays as it is.
    pub fn resolve(&self, path: &Path) -> io::Result<PathBuf> {
        if self.is_this() {
            return Ok(path.to_owned());
        }
        let steps = |path: &Path| -> Vec<OsString> {
            let names =
                path.components().rev().filter(|step| matches!(step, Component::Normal(_) | Component::ParentDir));
            names.map(|step| step.as_os_str().to_owned()).collect()
        };
        // The last one is the next.
        let mut way = steps(path);
        let mut found = PathBuf::from("/");
        let mut links = 0;
        while let Some(step) = way.pop() {
            if step == ".." {
                found.pop();
                continue;
            }
            let next = found.join(&step);
            let Ok(target) = fs::read_link(self.path(&next)) else {
                found = next;
                continue;
            };
            links += 1;
            if links > LINKS_MAX {
                return Err(io::Error::from_raw_os_error(libc::ELOOP));
            }
            if target.is_absolute() {
                found = PathBuf::from("/");
            }
            way.extend(steps(&target));
        }
        Ok(self.path(found))
    }

    /// The same, but a link at the end stays one.
    pub fn unfollowed(&self, path: &Path) -> io::Result<PathBuf> {
        let folder = self.resolve(path.parent().unwrap_or(path))?;
        Ok(path.file_name().map_or(folder.clone(), |name| folder.join(name)))
    }

    /// Follows symbolic links as the computer itself would. Returns all paths on the way. The last one is no link.
    pub fn follow(&self, path: &Path) -> io::Result<Vec<PathBuf>> {
        let mut way = vec![self.path(path)];
        for _ in 0..LINKS_MAX {
            let last = &way[way.len() - 1];
            if !fs::symlink_metadata(last)?.file_type().is_symlink() {
                return Ok(way);
            }
            let target = fs::read_link(last)?;
            let next = match target.is_absolute() {
                true => self.path(target),
                false => last.parent().unwrap_or(&self.root).join(target),
            };
            way.push(next);
        }
        Err(io::Error::from_raw_os_error(libc::ELOOP))
    }

    /// The lines of /etc/passwd or /etc/group, in fields.
    fn fields(&self, file: &str) -> Vec<Vec<String>> {
        let text = self.text(file).unwrap_or_default();
        text.lines().map(|line| line.split(':').map(str::to_owned).collect()).collect()
    }

    /// A user by name, from the computer's files.
    pub fn user(&self, name: &str) -> Option<Who> {
        let fields = self.fields("/etc/passwd").into_iter().find(|fields| fields[0] == name)?;
        let (uid, gid) = (fields.get(2)?.parse().ok()?, fields.get(3)?.parse().ok()?);
        let mut groups = self.fields("/etc/group");
        groups.retain(|fields| fields.get(3).is_some_and(|members| members.split(',').any(|member| member == name)));
        let gids = std::iter::once(gid).chain(groups.iter().filter_map(|fields| fields[2].parse().ok())).collect();
        Some(Who { name: name.to_owned(), uid, gids })
    }

    /// A user's name, or the number without one.
    pub fn user_name(&self, uid: u32) -> String {
        self.name_of("/etc/passwd", uid)
    }

    /// A group's name, or the number without one.
    pub fn group_name(&self, gid: u32) -> String {
        self.name_of("/etc/group", gid)
    }

    /// The group of a file, if membership only opens files of this kind. root's group would open more.
    pub fn common_group(&self, file: &fs::Metadata) -> Option<String> {
        let group = self.group_name(file.gid());
        (group != "root" && group != "0").then_some(group)
    }

    /// The number of a group, given by name or number.
    pub fn gid_of(&self, group: &str) -> Option<u32> {
        let named = self.fields("/etc/group").into_iter().find(|fields| fields[0] == group);
        named.map_or_else(|| group.parse().ok(), |fields| fields.get(2)?.parse().ok())
    }

    /// The name of a number in /etc/passwd or /etc/group. Without a name it is the number itself.
    fn name_of(&self, file: &str, number: u32) -> String {
        let number = number.to_string();
        let named = self.fields(file).into_iter().find(|fields| fields.get(2) == Some(&number));
        named.map_or(number, |fields| fields[0].clone())
    }

    /// A file's owner, group and mode as text: `root:gpio 0660`.
    pub fn ownership(&self, file: &fs::Metadata) -> String {
        let (user, group) = (self.user_name(file.uid()), self.group_name(file.gid()));
        format!("{user}:{group} {:04o}", file.mode() & 0o7777)
    }

    /// The user that has started this program. `None` for root, which may do anything, and if another computer is
    /// looked at.
    pub fn caller(&self) -> Option<Who> {
        let uid = geteuid();
        if uid.is_root() || !self.is_this() {
            return None;
        }
        let name = User::from_uid(uid).ok().flatten().map_or_else(|| uid.to_string(), |user| user.name);
        let groups = getgroups().unwrap_or_default();
        let gids = std::iter::once(getegid()).chain(groups).map(nix::unistd::Gid::as_raw).collect();
        Some(Who { name, uid: uid.as_raw(), gids })
    }
}

/// The computer's configurations of klippy. A link leads where it leads on that computer.
impl Files for Computer {
    fn text(&self, path: &Path) -> io::Result<String> {
        Ok(String::from_utf8_lossy(&foreign::read(&self.resolve(path)?, TEXT_MAX)?).into_owned())
    }

    fn names(&self, folder: &Path, most: usize) -> Vec<String> {
        self.resolve(folder).map(|folder| names_in(&folder, most)).unwrap_or_default()
    }

    fn is_there(&self, path: &Path) -> bool {
        let about = self.unfollowed(path).and_then(fs::symlink_metadata);
        // A file in a folder that this user may not search may be there.
        !about.is_err_and(|error| [io::ErrorKind::NotFound, io::ErrorKind::NotADirectory].contains(&error.kind()))
    }

    fn whole(&self, path: &Path) -> PathBuf {
        Disk.whole(path)
    }
}

/// The first bytes of a program's output. `None` if the program does not end within two seconds.
pub fn output(command: &mut Command) -> Option<String> {
    const OUTPUT_TIMEOUT: Duration = Duration::from_secs(2);
    const BYTES_MAX: usize = 4096;
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().ok()?;
    let end = Instant::now() + OUTPUT_TIMEOUT;
    let mut stdout = child.stdout.take()?;
    let mut bytes = Vec::new();
    let is_whole = loop {
        let left = end.saturating_duration_since(Instant::now());
        let mut chunk = [0; BYTES_MAX];
        let ready = poll(&mut [PollFd::new(stdout.as_fd(), PollFlags::POLLIN)], PollTimeout::try_from(left).ok()?);
        match ready {
            Ok(1..) => match stdout.read(&mut chunk) {
                Ok(count @ 1..) if bytes.len() < BYTES_MAX => bytes.extend_from_slice(&chunk[..count]),
                Ok(_) => break true,
                Err(_) => break false,
            },
            Err(Errno::EINTR) => {}
            _ => break false,
        }
    };
    // It has closed its output, writes too much, or hangs. It is left alone if it does not end.
    let _ = child.kill();
    is_whole.then(|| String::from_utf8_lossy(&bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    #[test]
    fn a_longer_path_of_the_root_folder_is_this_computer() {
        for root in ["/", "/.", "/proc/.."] {
            assert!(Computer::named(Path::new(root), None).unwrap().0.is_this(), "{root}");
        }
        assert!(Computer::named(Path::new("/nonexistent"), None).is_err());
    }

    #[test]
    fn patterns_name_what_is_there() {
        let tree = Tree::empty();
        for file in ["a/x.cfg", "a/.x.cfg", "b/y.cfg", "b/y.cfg.bak", "b/z1.cfg"] {
            tree.put(file, "");
        }
        let computer = tree.computer();
        let matching = |pattern: &str| -> Vec<String> {
            let paths = computer.matching(pattern);
            paths.iter().map(|path| computer.name(path).display().to_string()).collect()
        };
        assert_eq!(matching("/*/*.cfg"), ["/a/x.cfg", "/b/y.cfg", "/b/z1.cfg"]);
        assert_eq!(matching("/a/.*"), ["/a/.x.cfg"]);
        assert_eq!(matching("/b/[xz]?.cfg"), ["/b/z1.cfg"]);
        assert_eq!(matching("/*/x.cfg"), ["/a/x.cfg"], "and not one in the other folder");
        assert_eq!(matching("/a/../b/*.bak"), ["/a/../b/y.cfg.bak"]);
        assert_eq!(matching("/none/*").len() + matching("/a/[").len(), 0);
        assert_eq!(matching("/none"), ["/none"]);
        // This takes no time, though there are many ways to try it.
        tree.put(&format!("c/{}", "a".repeat(200)), "");
        assert_eq!(matching(&format!("/c/{}", "*a".repeat(40))).len(), 1);
        assert!(matching(&format!("/c/{}b", "*a".repeat(40))).is_empty());
    }
}
