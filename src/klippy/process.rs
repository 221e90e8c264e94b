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

use crate::foreign;
use crate::proc::stat_field;

/// Longest part of a command line that is looked at. A process may have one of megabytes.
const COMMAND_LINE_BYTES_MAX: u64 = 16 << 10;
/// Longest part of the other files in /proc/PID that is looked at.
const PROC_BYTES_MAX: u64 = 4096;
/// Number of the field in /proc/PID/stat that says when a process was started.
const STARTTIME: usize = 22;
/// Highest number of open files of a process that are looked at. klippy has less than a hundred.
const OPEN_FILES_MAX: usize = 4096;

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
/// same numbers, on devices of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Terminal {
    number: u64,
    devpts: u64,
}

impl Terminal {
    /// The terminal of a device, such as `/dev/pts/3`.
    ///
    /// # Errors
    ///
    /// The device cannot be looked at.
    pub fn of(device: &Path) -> io::Result<Terminal> {
        fs::metadata(device).map(|about| Terminal { number: about.rdev(), devpts: about.dev() })
    }

    fn is(self, file: &fs::Metadata) -> bool {
        file.file_type().is_char_device() && (file.rdev(), file.dev()) == (self.number, self.devpts)
    }
}

/// Finds the process that has a terminal open, other than this one. `proc` is /proc.
///
/// # Errors
///
/// `proc` itself cannot be looked at.
pub fn find(proc: &Path, terminal: Terminal) -> io::Result<Search> {
    let mut klippys = Vec::new();
    let mut others = Vec::new();
    for pid in pids(proc)? {
        let arguments = arguments(proc, pid);
        if klippy(&arguments).is_some() {
            klippys.extend(Process::read(proc, pid, arguments));
        } else if !arguments.is_empty() {
            others.push(pid);
        }
    }
    // A look into a process costs a call for each of its files. So the likely processes come first, and a parent comes
    // before its children.
    klippys.sort_by_key(|process| process.started);
    let mut hidden = Vec::new();
    for process in klippys {
        match has_open(proc, process.pid, terminal) {
            Ok(true) if !serves(proc, process.pid, terminal) => return Ok(Search::Found(process)),
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => hidden.push(process),
            // It is not the host, or it ended meanwhile.
            Ok(_) | Err(_) => {}
        }
    }
    for pid in others {
        if let Ok(true) = has_open(proc, pid, terminal)
            && !serves(proc, pid, terminal)
            && let Some(process) = Process::read(proc, pid, arguments(proc, pid))
        {
            return Ok(Search::Found(process));
        }
    }
    Ok(if hidden.is_empty() { Search::Nobody } else { Search::Hidden(hidden) })
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

/// All processes except this one.
///
/// # Errors
///
/// `proc` itself cannot be looked at.
pub fn all(proc: &Path) -> io::Result<Vec<Process>> {
    Ok(pids(proc)?.filter_map(|pid| Process::read(proc, pid, arguments(proc, pid))).collect())
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

    /// Whether it carries a host of another computer: `pinion attach`.
    pub fn is_attach(&self) -> bool {
        self.program().is_some_and(|program| program == "pinion")
            && self.arguments.get(1).is_some_and(|command| command == Path::new("attach"))
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
/// the process was started from a user's session or manager, which `sudo systemctl` does not reach.
pub(crate) fn unit(groups: &str) -> Option<&str> {
    let is_user = |name: &str| name.starts_with("user@") || name.starts_with("user-");
    if groups.split(['/', '\n']).any(is_user) {
        return None;
    }
    groups.lines().find_map(|line| line.rsplit('/').next()?.strip_suffix(".service"))
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
pub(crate) fn klippy(arguments: &[PathBuf]) -> Option<&Path> {
    program(arguments).map(|(_, folder)| folder)
}

/// The configuration that klippy's command line names.
pub(crate) fn klippy_config(arguments: &[PathBuf]) -> Option<&Path> {
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
    let index = format!("tty-index:\t{}", nix::sys::stat::minor(terminal.number));
    let Ok(files) = fs::read_dir(proc.join(pid.to_string()).join("fdinfo")) else { return false };
    let files = files.flatten().take(OPEN_FILES_MAX);
    let mut told = files.filter_map(|file| foreign::read(&file.path(), PROC_BYTES_MAX).ok());
    told.any(|info| info.split(|byte| *byte == b'\n').any(|line| line == index.as_bytes()))
}

/// Whether a process has the terminal open.
fn has_open(proc: &Path, pid: u32, terminal: Terminal) -> io::Result<bool> {
    for entry in fs::read_dir(proc.join(pid.to_string()).join("fd"))?.take(OPEN_FILES_MAX) {
        let file = match fs::metadata(entry?.path()) {
            // The file was closed meanwhile.
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
