// SPDX-License-Identifier: GPL-3.0-or-later
//! The process that has a terminal open, found through /proc (proc(5)).

#![forbid(unsafe_code)]

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};

use pinion_linux::foreign;
use pinion_linux::proc::{stat_field, status_field};

/// Longest part of a command line that is looked at. A process may have one of megabytes.
const COMMAND_LINE_BYTES_MAX: u64 = 16 << 10;
/// Longest part of the other files in /proc/PID that is looked at.
const PROC_BYTES_MAX: u64 = 4096;
/// Number of the field in /proc/PID/stat that says when a process was started.
const STARTTIME: usize = 22;
/// Highest number of open files of a process that are looked at. klippy has less than a hundred.
const OPEN_FILES_MAX: usize = 4096;
/// Highest number of open files that are looked at of all processes that may not open the terminal. Any user can have
/// many processes with many files. To inspect one takes 2 us to 20 us.
const UNLIKELY_FILES_MAX: usize = 10_000;
/// The major numbers of pseudo terminals (admin-guide/devices.txt).
const PSEUDO_MAJORS: std::ops::RangeInclusive<u64> = 136..=143;

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

/// The process that has the terminal open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Search {
    /// This process.
    Found(Process),
    /// No process that this program may look into. It may not look into these processes of klippy.
    Hidden(Vec<Process>),
    /// Nobody.
    Nobody,
}

/// A terminal by its numbers: its own, and the number of the devpts that it is on. Containers have terminals of the
/// same numbers, on devices of their own. Its owner, group and mode say who may open it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Terminal {
    number: u64,
    devpts: u64,
    owner: u32,
    group: u32,
    mode: u32,
}

impl Terminal {
    /// The terminal of a device, such as `/dev/pts/3`.
    ///
    /// # Errors
    ///
    /// The device cannot be looked at.
    pub fn of(device: &Path) -> io::Result<Terminal> {
        fs::metadata(device).map(|about| Terminal {
            number: about.rdev(),
            devpts: about.dev(),
            owner: about.uid(),
            group: about.gid(),
            mode: about.mode(),
        })
    }

    /// Whether these users may open it. A program with the set-user-ID bit counts as its caller's: any user can have
    /// many processes of su, with many files.
    fn lets_in(self, ids: &Ids) -> bool {
        const READ_WRITE: u32 = 6;
        let is_one_user = ids.uids.iter().all(|uid| *uid == ids.user());
        is_one_user && ids.may(READ_WRITE, (self.owner, self.group, self.mode))
    }

    fn is(self, file: &fs::Metadata) -> bool {
        file.file_type().is_char_device() && (file.rdev(), file.dev()) == (self.number, self.devpts)
    }
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
    /// The ones in a text of /proc/PID/status.
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

/// Finds the process that has a terminal open, other than this one. `proc` is /proc.
///
/// # Errors
///
/// `proc` itself cannot be looked at.
pub fn find(proc: &Path, terminal: Terminal) -> io::Result<Search> {
    // The kernel does not say who has a terminal open. To inspect a process costs a call for each of its files. So the
    // processes that may open the terminal come first, klippys come before others, and a parent comes before its
    // children.
    let candidate = |process: Process| {
        let status = foreign::read(&proc.join(process.pid.to_string()).join("status"), PROC_BYTES_MAX).ok()?;
        let is_let_in = Ids::of(&String::from_utf8_lossy(&status)).is_some_and(|ids| terminal.lets_in(&ids));
        Some((!is_let_in, !process.is_klippy(), process.started, process.pid, process))
    };
    let mut candidates: Vec<_> = all(proc)?.into_iter().filter_map(candidate).collect();
    candidates.sort_by_key(|(refused, other, started, pid, _)| (*refused, *other, *started, *pid));
    let mut hidden = Vec::new();
    let mut unlikely = UNLIKELY_FILES_MAX;
    for (is_refused, _, _, pid, process) in candidates {
        let mut files = OPEN_FILES_MAX;
        let left = if is_refused { &mut unlikely } else { &mut files };
        match has_open(proc, pid, terminal, left) {
            Ok(true) if !serves(proc, pid, terminal) => return Ok(Search::Found(process)),
            // A process that may not open the terminal is no host that is hidden.
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied && !is_refused && process.is_klippy() => {
                hidden.push(process);
            }
            // It is not the host, or it has ended.
            Ok(_) | Err(_) => {}
        }
    }
    Ok(if hidden.is_empty() { Search::Nobody } else { Search::Hidden(hidden) })
}

/// Whether a file is a pseudo terminal.
pub fn is_pseudo_terminal(file: &fs::Metadata) -> bool {
    file.file_type().is_char_device() && PSEUDO_MAJORS.contains(&nix::sys::stat::major(file.rdev()))
}

/// The process, other than this one, that serves the terminal `device`: it has the master end open. `None` if this
/// program may look into no process that does.
///
/// # Errors
///
/// The terminal or `proc` itself cannot be looked at.
pub fn server(proc: &Path, device: &Path) -> io::Result<Option<Process>> {
    let terminal = Terminal::of(device)?;
    let pid = pids(proc)?.find(|pid| serves(proc, *pid, terminal));
    Ok(pid.and_then(|pid| Process::read(proc, pid, arguments(proc, pid))))
}

/// All processes except this one and the kernel's threads, which have no command line.
///
/// # Errors
///
/// `proc` itself cannot be looked at.
pub fn all(proc: &Path) -> io::Result<Vec<Process>> {
    let named = pids(proc)?.map(|pid| (pid, arguments(proc, pid))).filter(|(_, arguments)| !arguments.is_empty());
    Ok(named.filter_map(|(pid, arguments)| Process::read(proc, pid, arguments)).collect())
}

/// The process with this number.
pub fn of(proc: &Path, pid: u32) -> Option<Process> {
    Process::read(proc, pid, arguments(proc, pid))
}

/// The numbers of all processes except this one.
fn pids(proc: &Path) -> io::Result<impl Iterator<Item = u32>> {
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
/// groups of any name. So the unit is what stands in systemd's own hierarchy directly in a slice of the system.
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

/// The place of klippy in its command line, and klippy's folder: the folder of `klippy.py`, or the one that `-m klippy`
/// names.
fn program(arguments: &[PathBuf]) -> Option<(usize, &Path)> {
    let is_script = |argument: &PathBuf| argument.file_name().is_some_and(|name| name == "klippy.py");
    let is_module = |pair: &[PathBuf]| {
        pair[0].as_os_str() == "-m" && (pair[1].as_os_str() == "klippy" || pair[1].as_os_str() == "klippy.klippy")
    };
    match arguments.iter().position(is_script) {
        Some(at) => Some((at, arguments[at].parent()?)),
        None => Some((arguments.windows(2).position(is_module)? + 1, Path::new("klippy"))),
    }
}

/// klippy's folder, if a command line is klippy's.
pub fn klippy(arguments: &[PathBuf]) -> Option<&Path> {
    program(arguments).map(|(_, folder)| folder)
}

/// The configuration that klippy's command line names.
pub fn klippy_config(arguments: &[PathBuf]) -> Option<&Path> {
    // These options of klippy/klippy.py, and of Kalico's klippy/printer.py, take a value.
    const WITH_VALUE: [&str; 15] = [
        "-i",
        "--debuginput",
        "-I",
        "--input-tty",
        "-a",
        "--api-server",
        "--api-server-user",
        "--api-server-group",
        "--api-server-file-mode",
        "-l",
        "--logfile",
        "-o",
        "--debugoutput",
        "-d",
        "--dictionary",
    ];
    let (at, _) = program(arguments)?;
    let mut words = arguments[at + 1..].iter();
    while let Some(word) = words.next() {
        if WITH_VALUE.iter().any(|option| word.as_os_str() == *option) {
            words.next();
        } else if !word.as_os_str().as_bytes().starts_with(b"-") {
            return Some(word);
        }
    }
    None
}

/// The socket of the API server that klippy's command line names.
pub fn klippy_api(arguments: &[PathBuf]) -> Option<&Path> {
    let (at, _) = program(arguments)?;
    let is_option = |word: &PathBuf| word.as_os_str() == "-a" || word.as_os_str() == "--api-server";
    arguments[at + 1..].windows(2).find(|pair| is_option(&pair[0])).map(|pair| pair[1].as_path())
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

/// Whether a process has the master end of the terminal open, as Pinion itself. The `tty-index` in the fdinfo of a
/// master names its terminal (proc_pid_fdinfo(5)).
fn serves(proc: &Path, pid: u32, terminal: Terminal) -> bool {
    let process = proc.join(pid.to_string());
    // A container has terminals of its own, with the same numbers.
    if fs::metadata(process.join("root/dev/pts")).is_ok_and(|devpts| devpts.dev() != terminal.devpts) {
        return false;
    }
    let index = format!("tty-index:\t{}", nix::sys::stat::minor(terminal.number));
    let Ok(files) = fs::read_dir(process.join("fdinfo")) else { return false };
    let files = files.flatten().take(OPEN_FILES_MAX);
    let mut infos = files.filter_map(|file| foreign::read(&file.path(), PROC_BYTES_MAX).ok());
    infos.any(|info| info.split(|byte| *byte == b'\n').any(|line| line == index.as_bytes()))
}

/// Whether a process has the terminal open. `left` is the number of files that may still be inspected.
fn has_open(proc: &Path, pid: u32, terminal: Terminal, left: &mut usize) -> io::Result<bool> {
    for entry in fs::read_dir(proc.join(pid.to_string()).join("fd"))? {
        if *left == 0 {
            break;
        }
        *left -= 1;
        let file = match fs::metadata(entry?.path()) {
            // The file was closed after the folder was read.
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            file => file?,
        };
        if terminal.is(&file) {
            return Ok(true);
        }
    }
    Ok(false)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::{FcntlArg, FdFlag, fcntl};
    use nix::pty::{OpenptyResult, openpty};
    use nix::unistd::ttyname;
    use std::process::{Child, Command, Stdio};

    /// A terminal whose ends no other test's process inherits.
    fn terminal() -> (OpenptyResult, PathBuf) {
        let pty = openpty(None, None).unwrap();
        for end in [&pty.master, &pty.slave] {
            fcntl(end, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC)).unwrap();
        }
        let device = ttyname(&pty.slave).unwrap();
        (pty, device)
    }

    fn look(device: &Path) -> io::Result<Search> {
        find(Path::new("/proc"), Terminal::of(device)?)
    }

    /// A process that has the terminal open as its input, called like klippy.
    fn host(device: &Path, script: &Path) -> Child {
        let terminal = fs::File::open(device).unwrap();
        // A shell ignores the arguments after its script.
        let host = Command::new("/bin/sh")
            .args(["-c", "read line", "sh"])
            .arg(script)
            .stdin(Stdio::from(terminal))
            .spawn()
            .unwrap();
        // For a moment a process that has become another program has no command line yet.
        let line = format!("/proc/{}/cmdline", host.id());
        while fs::read(&line).is_ok_and(|line| line.is_empty()) {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        host
    }

    #[test]
    fn the_process_that_has_the_terminal_open_is_found_among_all() {
        let (_pty, device) = terminal();
        assert_eq!(look(&device).unwrap(), Search::Nobody, "this process does not count");
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("klippy.py");
        fs::write(&script, "").unwrap();
        let mut host = host(&device, &script);
        let found = look(&device).unwrap();
        let Search::Found(process) = found else { panic!("{found:?}") };
        assert_eq!(process.pid, host.id());
        let reached = process.klippy_folder(Path::new("/proc")).unwrap();
        assert!(reached.join("klippy.py").exists(), "{reached:?}");
        assert!(reached.ends_with(folder.path().strip_prefix("/").unwrap()), "{reached:?}");
        host.kill().unwrap();
        host.wait().unwrap();
        assert_eq!(look(&device).unwrap(), Search::Nobody);
    }

    #[test]
    fn who_serves_the_terminal_is_no_host() {
        let (pty, device) = terminal();
        // This program has both ends open, as Pinion has while no host is there.
        let mut server = Command::new("/bin/sh")
            .args(["-c", "read line"])
            .stdin(Stdio::from(pty.slave.try_clone().unwrap()))
            .stderr(Stdio::from(pty.master.try_clone().unwrap()))
            .spawn()
            .unwrap();
        assert_eq!(look(&device).unwrap(), Search::Nobody);
        let mut host = host(&device, Path::new("klippy.py"));
        let found = look(&device).unwrap();
        let Search::Found(process) = found else { panic!("{found:?}") };
        assert_eq!(process.pid, host.id());
        for child in [&mut server, &mut host] {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    #[test]
    fn a_terminal_of_the_same_number_elsewhere_is_another() {
        let (_pty, device) = terminal();
        let mut host = host(&device, Path::new("klippy.py"));
        // A file is always on another device than the terminal.
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(look(file.path()).unwrap(), Search::Nobody);
        host.kill().unwrap();
        host.wait().unwrap();
    }

    #[test]
    fn a_terminal_of_the_same_number_in_a_container_is_served_by_another() {
        let (_pty, device) = terminal();
        let terminal = Terminal::of(&device).unwrap();
        let proc = tempfile::tempdir().unwrap();
        let process = proc.path().join("7");
        fs::create_dir_all(process.join("fdinfo")).unwrap();
        let info = format!("pos:\t0\ntty-index:\t{}\n", nix::sys::stat::minor(terminal.number));
        fs::write(process.join("fdinfo/3"), info).unwrap();
        assert!(serves(proc.path(), 7, terminal));
        fs::create_dir_all(process.join("root/dev")).unwrap();
        std::os::unix::fs::symlink("/dev/pts", process.join("root/dev/pts")).unwrap();
        assert!(serves(proc.path(), 7, terminal), "it has the same terminals");
        fs::remove_file(process.join("root/dev/pts")).unwrap();
        fs::create_dir(process.join("root/dev/pts")).unwrap();
        assert!(!serves(proc.path(), 7, terminal));
    }

    /// A folder like /proc, with a process of this user and this group that has these files open.
    fn put(proc: &Path, pid: u32, arguments: &[&str], (uid, gid): (u32, u32), files: &[&Path]) {
        let folder = proc.join(pid.to_string());
        fs::create_dir_all(folder.join("fd")).unwrap();
        fs::write(folder.join("cmdline"), arguments.join("\0")).unwrap();
        fs::write(folder.join("stat"), format!("{pid} (x) S {} 0", ["1"; 20].join(" "))).unwrap();
        let status = format!("Uid:\t{uid}\t{uid}\t{uid}\t{uid}\nGid:\t{gid}\t{gid}\t{gid}\t{gid}\nGroups:\t\n");
        fs::write(folder.join("status"), status).unwrap();
        for (number, file) in files.iter().enumerate() {
            std::os::unix::fs::symlink(file, folder.join("fd").join(number.to_string())).unwrap();
        }
    }

    #[test]
    fn processes_that_may_not_open_the_terminal_come_last_and_only_some_of_their_files_are_looked_at() {
        const KLIPPY: [&str; 2] = ["python3", "/tmp/klippy/klippy.py"];
        let (_pty, device) = terminal();
        let terminal = Terminal { owner: 990, group: 5, mode: 0o20660, ..Terminal::of(&device).unwrap() };
        let proc = tempfile::tempdir().unwrap();
        let null = Path::new("/dev/null");
        let found = || match find(proc.path(), terminal).unwrap() {
            Search::Found(process) => Some(process.pid),
            _ => None,
        };
        // Another user's, older than the host. It got the terminal from somebody who may open it.
        put(proc.path(), 10, &KLIPPY, (54_321, 54_321), &[null, &device]);
        assert_eq!(found(), Some(10), "a terminal may be handed on");
        // A host that is no klippy, of a member of the terminal's group.
        put(proc.path(), 90, &["host"], (1000, 5), &[null, &device]);
        assert_eq!(found(), Some(90));
        put(proc.path(), 91, &KLIPPY, (1000, 5), &[&device]);
        assert_eq!(found(), Some(91), "klippys come before others");
        for pid in [10, 90, 91] {
            fs::remove_dir_all(proc.path().join(pid.to_string())).unwrap();
        }
        let many = vec![null; UNLIKELY_FILES_MAX / 4];
        (10..15).for_each(|pid| put(proc.path(), pid, &KLIPPY, (54_321, 54_321), &many));
        put(proc.path(), 20, &KLIPPY, (54_321, 54_321), &[&device]);
        assert_eq!(found(), None, "the search has an end");
        put(proc.path(), 90, &["host"], (990, 990), &[&device]);
        assert_eq!(found(), Some(90), "the terminal's owner");
        // As su is while it asks for a password: it has the files of its caller, and root's rights.
        let su = "Uid:\t54321\t0\t0\t0\nGid:\t54321\t54321\t54321\t54321\nGroups:\t\n";
        fs::write(proc.path().join("20/status"), su).unwrap();
        assert_eq!(found(), Some(90), "who calls su is not root");
    }

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
    fn klippy_is_found_by_its_script_or_its_module() {
        let folder = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy(&arguments).map(Path::to_owned)
        };
        assert_eq!(folder("nice -n 5 python3 -u /a/klippy/klippy.py p.cfg"), Some("/a/klippy".into()));
        assert_eq!(folder("python3 klippy.py p.cfg"), Some("".into()));
        assert_eq!(folder("python3 -m klippy p.cfg"), Some("klippy".into()));
        assert_eq!(folder("python3 -m klippy.klippy p.cfg"), Some("klippy".into()));
        assert_eq!(folder("python3 -m http.server klippy"), None);
    }

    #[test]
    fn the_api_server_is_the_one_of_klippy_s_options() {
        let api = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy_api(&arguments).map(Path::to_owned)
        };
        let socket = Some("/c/klippy.sock".into());
        assert_eq!(api("python3 /a/klippy/klippy.py /b/p.cfg -I /c/tty -a /c/klippy.sock -l /c/log"), socket);
        assert_eq!(api("python3 -m klippy --api-server /c/klippy.sock /b/p.cfg"), socket);
        for none in ["python3 /a/klippy.py /b/p.cfg", "python3 /a/klippy.py /b/p.cfg -a", "socat -a /c/klippy.sock"] {
            assert_eq!(api(none), None, "{none}");
        }
    }

    #[test]
    fn the_configuration_is_what_is_no_option_of_klippy_s() {
        let config = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy_config(&arguments).map(Path::to_owned)
        };
        for line in [
            "python3 /a/klippy/klippy.py /b/p.cfg -I /c/klippy.serial -l /c/klippy.log -a /c/klippy.sock",
            "python3 /a/klippy/klippy.py -v -l /c/klippy.log --api-server=/c/klippy.sock /b/p.cfg",
            "python3 -m klippy --api-server-group klipper /b/p.cfg",
        ] {
            assert_eq!(config(line), Some("/b/p.cfg".into()), "{line}");
        }
        assert_eq!(config("python3 /a/klippy/klippy.py -l /c/klippy.log"), None);
        assert_eq!(config("python3 /b/p.cfg"), None);
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
