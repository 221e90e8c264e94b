// SPDX-License-Identifier: GPL-3.0-or-later
//! Processes in /proc (proc(5)): command lines, users, units and paths as the process sees them.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Component, Path, PathBuf};

use pinion_linux::foreign;
use pinion_linux::proc::{stat_field, status_field};

use super::command_line::{klippy, klippy_api, klippy_config};

/// Longest part of a command line that is read. A process may have one of megabytes.
const COMMAND_LINE_BYTES_MAX: u64 = 16 << 10;
/// Longest part of the other files in /proc/PID that is read.
pub(super) const PROC_BYTES_MAX: u64 = 4096;
/// Number of the field in /proc/PID/stat that says when a process was started.
const STARTTIME: usize = 22;

/// A process that may be a host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Process {
    /// Its number.
    pub pid: u32,
    /// When it was started, in clock ticks since the computer's start. A process number is used again, but never with
    /// the same start.
    pub started: u64,
    /// Its command line.
    pub arguments: Vec<PathBuf>,
}

/// The users and groups of a process (proc_pid_status(5)).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ids {
    /// The user that started it, the effective one, the saved one, and the one for files.
    pub uids: Vec<u32>,
    /// The effective group, and the further ones.
    pub gids: Vec<u32>,
}

impl Ids {
    /// The users and groups in a text of /proc/PID/status.
    pub fn of(status: &str) -> Option<Ids> {
        let numbers = |field: &str| -> Vec<u32> {
            let numbers = status_field(status, field).unwrap_or_default().split_whitespace();
            numbers.filter_map(|number| number.parse().ok()).collect()
        };
        let uids = numbers("Uid");
        let gids = numbers("Gid").get(1).copied().into_iter().chain(numbers("Groups")).collect();
        (uids.len() >= 2).then_some(Ids { uids, gids })
    }

    /// The effective user.
    pub fn user(&self) -> u32 {
        self.uids[1]
    }

    /// Whether a file's owner, group and mode give them this access (path_resolution(7)).
    pub fn may(&self, access: u32, (owner, group, mode): (u32, u32, u32)) -> bool {
        let bits = match () {
            () if self.user() == 0 => return true,
            () if owner == self.user() => mode >> 6,
            () if self.gids.contains(&group) => mode >> 3,
            () => mode,
        };
        bits & access == access
    }
}

/// All processes except this one and the kernel's threads, which have no command line.
///
/// # Errors
///
/// `proc` itself cannot be read.
pub fn all(proc: &Path) -> io::Result<Vec<Process>> {
    let named = pids(proc)?.map(|pid| (pid, arguments(proc, pid))).filter(|(_, arguments)| !arguments.is_empty());
    Ok(named.filter_map(|(pid, arguments)| Process::read(proc, pid, arguments)).collect())
}

/// The process with this number.
pub fn of(proc: &Path, pid: u32) -> Option<Process> {
    Process::read(proc, pid, arguments(proc, pid))
}

/// The numbers of all processes except this one.
pub(super) fn pids(proc: &Path) -> io::Result<impl Iterator<Item = u32>> {
    let pids = fs::read_dir(proc)?.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    Ok(pids.filter(|pid| *pid != std::process::id()))
}

impl Process {
    fn read(proc: &Path, pid: u32, arguments: Vec<PathBuf>) -> Option<Process> {
        let stat = foreign::read(&proc.join(pid.to_string()).join("stat"), PROC_BYTES_MAX).ok()?;
        let started = stat_field(&stat, STARTTIME)?.parse().ok()?;
        Some(Process { pid, started, arguments })
    }

    /// The file name of its program, as it was called.
    pub fn program(&self) -> Option<&OsStr> {
        self.arguments.first()?.file_name()
    }

    /// Whether its open files are unknown, because it is another user's.
    pub fn is_hidden(&self, proc: &Path) -> bool {
        fs::read_dir(proc.join(self.pid.to_string()).join("fdinfo")).is_err()
    }

    /// Whether it was started as `pinion`, or as `pinion run` with a simulated board, which is another program.
    pub fn is_pinion(&self) -> bool {
        let runs = || self.has_command("run");
        self.program().is_some_and(|program| program == "pinion" || program == "pinion-sim" && runs())
    }

    /// Whether it carries a host of another computer: `pinion attach`.
    pub fn is_attach(&self) -> bool {
        self.is_pinion() && self.has_command("attach")
    }

    fn has_command(&self, name: &str) -> bool {
        self.arguments.get(1).is_some_and(|command| command == Path::new(name))
    }

    /// Whether it was started like klippy.
    pub fn is_klippy(&self) -> bool {
        klippy(&self.arguments).is_some()
    }

    /// klippy's folder as this program can reach it. `None` if the process is not klippy.
    pub fn klippy_folder(&self, proc: &Path) -> Option<PathBuf> {
        self.reach(proc, klippy(&self.arguments)?)
    }

    /// klippy's configuration as this program can reach it. `None` if the process is not klippy.
    pub fn klippy_config(&self, proc: &Path) -> Option<PathBuf> {
        self.reach(proc, klippy_config(&self.arguments)?)
    }

    /// klippy's API server as this program can reach it. `None` without one, or if the process is not klippy.
    pub fn klippy_api(&self, proc: &Path) -> Option<PathBuf> {
        self.reach(proc, klippy_api(&self.arguments)?)
    }

    /// A path of the process as this program can reach it. It leads through the process's own root (a container's). If
    /// that is not permitted, both are taken to have the same root.
    fn reach(&self, proc: &Path, path: &Path) -> Option<PathBuf> {
        let folder = proc.join(self.pid.to_string());
        let mut path = path.to_owned();
        if path.is_relative() {
            path = fs::read_link(folder.join("cwd")).ok()?.join(path);
        }
        let through_root = inside(&folder.join("root"), &path);
        Some(if through_root.exists() { through_root } else { path })
    }
}

/// The systemd unit that a text of /proc/PID/cgroup names, without `.service` (systemd.resource-control(5)). `None` if
/// the process was started from a user's session or manager, which `sudo systemctl` does not reach, or in a container.
///
/// Only root and systemd make groups outside of a user's slice. Below a user's manager and in a container, others make
/// groups of any name. So the unit is the name directly below a slice of the system, in systemd's own hierarchy.
pub fn unit(groups: &str) -> Option<&str> {
    let path = groups.lines().find_map(|line| {
        let (_, rest) = line.split_once(':')?;
        let (controllers, path) = rest.split_once(':')?;
        ["", "name=systemd"].contains(&controllers).then_some(path).filter(|path| *path != "/")
    })?;
    let mut names = path.strip_prefix('/')?.split('/').skip_while(|name| is_slice_of_the_system(name));
    names.next()?.strip_suffix(".service").filter(|unit| !unit.is_empty() && !unit.starts_with("user@"))
}

fn is_slice_of_the_system(name: &str) -> bool {
    let of_others = ["user.slice", "machine.slice"].contains(&name) || name.starts_with("user-");
    name.ends_with(".slice") && !of_others
}

/// The command line of a process. It is empty for the kernel's threads.
fn arguments(proc: &Path, pid: u32) -> Vec<PathBuf> {
    let file = proc.join(pid.to_string()).join("cmdline");
    let line = foreign::read(&file, COMMAND_LINE_BYTES_MAX).unwrap_or_default();
    let arguments = line.split(|byte| *byte == 0).filter(|argument| !argument.is_empty());
    arguments.map(|argument| PathBuf::from(OsStr::from_bytes(argument))).collect()
}

/// Highest number of links that the kernel follows in a path.
const LINKS_MAX: usize = 40;

/// The file that has the absolute `path` for a process whose root is `root`. If the kernel followed a link that begins
/// at the root, it would lead to this program's own files. They may be another container's, or a home that the service
/// cannot see.
fn inside(root: &Path, path: &Path) -> PathBuf {
    let mut links = 0;
    let mut reached = PathBuf::new();
    let push = |left: &mut Vec<OsString>, path: &Path| {
        let names = path.components().rev().filter(|part| matches!(part, Component::Normal(_) | Component::ParentDir));
        left.extend(names.map(|part| part.as_os_str().to_owned()));
    };
    let mut left = Vec::new();
    push(&mut left, path);
    while let Some(name) = left.pop() {
        if name == ".." {
            reached.pop();
            continue;
        }
        let next = reached.join(name);
        match fs::read_link(root.join(&next)) {
            Ok(target) if links < LINKS_MAX => {
                links += 1;
                if target.is_absolute() {
                    reached = PathBuf::new();
                }
                push(&mut left, &target);
            }
            _ => reached = next,
        }
    }
    root.join(reached)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn access_is_given_by_owner_group_and_mode() {
        let of = |uids: &str, groups: &str| {
            Ids::of(&format!("Name:\tx\nUid:\t{uids}\nGid:\t7\t8\t8\t8\nGroups:\t{groups}\n")).unwrap()
        };
        let may = |ids: &Ids, mode| ids.may(6, (1000, 5, mode));
        assert!(may(&of("1\t0\t1\t1", ""), 0o000), "root");
        assert!(may(&of("1\t1000\t1\t1", ""), 0o600) && !may(&of("1\t1000\t1\t1", "5"), 0o066));
        assert!(may(&of("2\t2\t2\t2", "4 5"), 0o060) && !may(&of("2\t2\t2\t2", "5"), 0o606));
        assert!(may(&of("2\t2\t2\t2", "4"), 0o006) && !may(&of("2\t2\t2\t2", "4"), 0o664));
        assert_eq!(Ids::of("Name:\tx\n"), None);
    }

    #[test]
    fn a_name_may_hold_anything() {
        let proc = tempfile::tempdir().unwrap();
        let folder = proc.path().join("42");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("cmdline"), b"python3\0/home/pi/klipper/klippy/klippy.py\0printer.cfg\0").unwrap();
        let fields: Vec<String> = (4..=52).map(|field| field.to_string()).collect();
        let stat = [b"42 (a\xff) S 1) S ", fields.join(" ").as_bytes()].concat();
        fs::write(folder.join("stat"), stat).unwrap();
        let process = Process::read(proc.path(), 42, arguments(proc.path(), 42)).unwrap();
        assert_eq!(process.started, 22);
        assert_eq!(process.klippy_folder(proc.path()).unwrap(), Path::new("/home/pi/klipper/klippy"));
    }

    #[test]
    fn links_lead_where_the_process_sees_them_lead() {
        use std::os::unix::fs::symlink;
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        fs::create_dir_all(root.join("home/pi/kalico/klippy")).unwrap();
        symlink("/home/pi/kalico", root.join("home/pi/klipper")).unwrap();
        symlink("../pi/klipper", root.join("home/pi/relative")).unwrap();
        symlink("round", root.join("home/round")).unwrap();
        let klippy = root.join("home/pi/kalico/klippy");
        for path in ["/home/pi/klipper/klippy", "/home/pi/relative/klippy", "/../home/./pi/relative/klippy"] {
            assert_eq!(inside(root, Path::new(path)), klippy, "{path}");
        }
        assert!(!inside(root, Path::new("/home/round/klippy")).exists());
    }
}
