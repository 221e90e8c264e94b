// SPDX-License-Identifier: GPL-3.0-or-later
//! The machine that is looked at: its files below a root, its users, its processes.

#![forbid(unsafe_code)]

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::unistd::{User, getegid, geteuid, getgroups};

use crate::cli::settings::Settings;
use crate::cli::{config, run_args};
use crate::foreign;
use crate::klippy::process::{self, Process};
use crate::runtime::helpers;

use super::instance::named_config;
use super::units::{self, setting};

/// Nothing that is read here is as long.
const TEXT_MAX: u64 = 4 << 20;
/// As many links as the kernel follows (path_resolution(7)).
const LINKS_MAX: usize = 40;

/// What the program looks at.
pub(super) struct Machine {
    root: PathBuf,
}

/// A user, with all groups.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Who {
    pub(super) name: String,
    pub(super) uid: u32,
    pub(super) gids: Vec<u32>,
}

/// Access to a file, as bits of its mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Access(u32);

impl Access {
    pub(super) const READ: Access = Access(4);
    pub(super) const WRITE: Access = Access(2);
    pub(super) const READ_WRITE: Access = Access(6);
    pub(super) const SEARCH: Access = Access(1);

    /// Whether a file gives this to its group.
    pub(super) fn is_given_to_group(self, file: &fs::Metadata) -> bool {
        file.mode() >> 3 & self.0 == self.0
    }
}

impl Who {
    /// Whether the file's owner and mode let this user in (path_resolution(7)).
    pub(super) fn may(&self, access: Access, file: &fs::Metadata) -> bool {
        let bits = match () {
            () if self.uid == 0 => return true,
            () if file.uid() == self.uid => file.mode() >> 6,
            () if self.gids.contains(&file.gid()) => file.mode() >> 3,
            () => file.mode(),
        };
        bits & access.0 == access.0
    }
}

/// A process of Pinion's that serves hosts.
pub(super) struct Running {
    pub(super) pid: u32,
    /// The unit that has started it, without `.service`.
    pub(super) unit: Option<String>,
    /// The configuration file that its command line names.
    pub(super) config: Option<String>,
    /// What it runs by, as far as its command line and its configuration file can be read.
    pub(super) settings: Option<Settings>,
}

impl Machine {
    pub(super) fn at(root: &Path) -> Machine {
        Machine { root: root.to_owned() }
    }

    /// Whether it is this one, of which the kernel can be asked more than files tell.
    pub(super) fn is_this(&self) -> bool {
        self.root == Path::new("/")
    }

    /// Where a file of the machine is.
    pub(super) fn path(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        self.root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// How the machine itself calls a file.
    pub(super) fn name(&self, path: &Path) -> PathBuf {
        Path::new("/").join(path.strip_prefix(&self.root).unwrap_or(path))
    }

    /// A file's text without the white space around it. None if there is none or it can not be read.
    pub(super) fn text(&self, path: impl AsRef<Path>) -> Option<String> {
        let bytes = foreign::read(&self.path(path), TEXT_MAX).ok()?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned())
    }

    /// The names in a folder, in order; none if there is no such folder.
    pub(super) fn names(&self, folder: impl AsRef<Path>) -> Vec<String> {
        let entries = fs::read_dir(self.path(folder)).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
        names.sort();
        names
    }

    /// The paths in a folder whose names begin so.
    pub(super) fn beginning(&self, folder: &str, beginning: &str) -> Vec<PathBuf> {
        let names = self.names(folder).into_iter().filter(|name| name.starts_with(beginning));
        names.map(|name| self.path(folder).join(name)).collect()
    }

    /// The first of these files that is there.
    pub(super) fn first<'a>(&self, paths: &[&'a str]) -> Option<&'a str> {
        paths.iter().find(|path| self.path(path).exists()).copied()
    }

    /// Follows symbolic links as the machine itself would: all paths on the way, the last of which is no
    /// link.
    pub(super) fn follow(&self, path: &Path) -> io::Result<Vec<PathBuf>> {
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

    /// A user by name, from the machine's files.
    pub(super) fn user(&self, name: &str) -> Option<Who> {
        let passwd = self.text("/etc/passwd")?;
        let fields: Vec<&str> =
            passwd.lines().map(|line| line.split(':').collect::<Vec<_>>()).find(|fields| fields[0] == name)?;
        let (uid, gid) = (fields.get(2)?.parse().ok()?, fields.get(3)?.parse().ok()?);
        let groups = self.text("/etc/group").unwrap_or_default();
        let member = |line: &str| {
            let mut fields = line.split(':').skip(2);
            let gid = fields.next()?.parse().ok()?;
            fields.next()?.split(',').any(|member| member == name).then_some(gid)
        };
        let gids = std::iter::once(gid).chain(groups.lines().filter_map(member)).collect();
        Some(Who { name: name.to_owned(), uid, gids })
    }

    /// The user of a process, with the groups that it has, which are those of the time when it was
    /// started.
    pub(super) fn user_of(&self, pid: u32) -> Option<Who> {
        let status = self.text(format!("/proc/{pid}/status"))?;
        let numbers = |field: &str| -> Vec<u32> {
            let line = status.lines().find_map(|line| line.strip_prefix(field)).unwrap_or_default();
            line.split_whitespace().filter_map(|number| number.parse().ok()).collect()
        };
        let uid = *numbers("Uid:").get(1)?;
        let gids = numbers("Gid:").get(1).copied().into_iter().chain(numbers("Groups:")).collect();
        Some(Who { name: self.user_name(uid), uid, gids })
    }

    fn user_name(&self, uid: u32) -> String {
        self.name_of("/etc/passwd", uid)
    }

    pub(super) fn group_name(&self, gid: u32) -> String {
        self.name_of("/etc/group", gid)
    }

    /// The group of a file, if membership of it is no more than a way to such files: root's would be.
    pub(super) fn common_group(&self, file: &fs::Metadata) -> Option<String> {
        let group = self.group_name(file.gid());
        (group != "root" && group != "0").then_some(group)
    }

    /// The number of a group, given by name or number.
    pub(super) fn gid_of(&self, group: &str) -> Option<u32> {
        let text = self.text("/etc/group").unwrap_or_default();
        let mut lines = text.lines().map(|line| line.split(':').collect::<Vec<_>>());
        let line = lines.find(|fields| fields[0] == group);
        line.map_or_else(|| group.parse().ok(), |fields| fields.get(2)?.parse().ok())
    }

    /// The name that a number has in /etc/passwd or /etc/group; the number if it has none.
    fn name_of(&self, file: &str, number: u32) -> String {
        let text = self.text(file).unwrap_or_default();
        let has = |line: &&str| line.split(':').nth(2) == Some(&number.to_string());
        let name = text.lines().find(has).and_then(|line| line.split(':').next());
        name.map_or_else(|| number.to_string(), str::to_owned)
    }

    /// How a file's owner, group and mode are written: `root:gpio 0660`.
    pub(super) fn ownership(&self, file: &fs::Metadata) -> String {
        let (user, group) = (self.user_name(file.uid()), self.group_name(file.gid()));
        format!("{user}:{group} {:04o}", file.mode() & 0o7777)
    }

    /// The processes, in the order in which they were started.
    pub(super) fn processes(&self) -> Vec<Process> {
        let mut processes = process::all(&self.path("/proc")).unwrap_or_default();
        processes.sort_by_key(|process| (process.started, process.pid));
        processes
    }

    /// The Pinions that run, without their helpers.
    pub(super) fn running(&self) -> Vec<Running> {
        let running = |process: Process| {
            let program = process.arguments.first()?;
            let pid = process.pid;
            let is_helper = |name: String| helpers::NAMES.iter().any(|helper| name.as_bytes() == helper.to_bytes());
            if program.file_name()? != "pinion" || self.text(format!("/proc/{pid}/comm")).is_some_and(is_helper) {
                return None;
            }
            let arguments = process.arguments.iter().map(|argument| argument.clone().into_os_string());
            let settings = match run_args(arguments) {
                Ok(args) => {
                    let (given, file) = args?.into_parts();
                    let file =
                        file.map_or_else(|| Ok(Default::default()), |file| config::load_foreign(&self.path(file)));
                    file.ok().map(|file| given.or(file).settings())
                }
                // Another version of Pinion.
                Err(_) => None,
            };
            let words: Vec<_> = process.arguments.iter().map(|word| word.to_string_lossy()).collect();
            let config = named_config(words.iter().map(AsRef::as_ref));
            Some(Running { pid, unit: self.unit_of(pid), config, settings })
        };
        self.processes().into_iter().filter_map(running).collect()
    }

    /// The unit whose program a process of ours or klippy's is, without `.service`: that of its control group
    /// (systemd.resource-control(5)). None if it was started from a user's session or manager, which `sudo systemctl`
    /// does not reach, or by another service's program, as by cron.
    pub(super) fn unit_of(&self, pid: u32) -> Option<String> {
        let groups = self.text(format!("/proc/{pid}/cgroup"))?;
        let unit = process::unit(&groups)?;
        // A unit that the folders of units do not have, as that of a template, is taken at its name.
        let text = units::text(self, unit).unwrap_or_default();
        let starts_it = setting(&text, "ExecStart").is_none_or(|command| {
            let command = command.to_lowercase();
            ["pinion", "klippy", "klipper"].iter().any(|program| command.contains(program))
        });
        starts_it.then(|| unit.to_owned())
    }

    /// Who has started this program, if this machine is looked at, and it is not root, who may do anything.
    pub(super) fn caller(&self) -> Option<Who> {
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

#[cfg(test)]
mod tests {
    use super::super::tests::Tree;

    #[test]
    fn the_unit_of_a_process_is_the_one_that_starts_it_again() {
        let tree = Tree::new();
        let unit = |group: &str| {
            tree.put("proc/7/cgroup", &format!("0::{group}\n"));
            tree.machine().unit_of(7)
        };
        assert_eq!(unit("/system.slice/system-pinion.slice/pinion-mcu@b.service").as_deref(), Some("pinion-mcu@b"));
        assert_eq!(unit("/user.slice/user-1000.slice/session-2.scope"), None);
        assert_eq!(unit("/user.slice/user-1000.slice/user@1000.service"), None);
        assert_eq!(unit("/user.slice/user-1000.slice/user@1000.service/app.slice/klipper.service"), None);
        tree.put("lib/systemd/system/cron.service", "[Service]\nExecStart=/usr/sbin/cron -f -P $EXTRA_OPTS\n");
        assert_eq!(unit("/system.slice/cron.service"), None);
        // The program's name may stand in a variable's only.
        tree.put("etc/systemd/system/klipper.service", "[Service]\nExecStart=/home/pi/env/bin/python $KLIPPER_ARGS\n");
        assert_eq!(unit("/system.slice/klipper.service").as_deref(), Some("klipper"));
        tree.put("etc/systemd/system/mine.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        assert_eq!(unit("/system.slice/mine.service").as_deref(), Some("mine"));
    }
}
