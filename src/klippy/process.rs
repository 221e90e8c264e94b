// SPDX-License-Identifier: GPL-3.0-or-later
//! The process that has a terminal open, found through /proc (proc(5)).

#![forbid(unsafe_code)]

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

/// A process that may be a host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Process {
    /// Its number.
    pub pid: u32,
    /// When it was started, in clock ticks since the computer was: a number is used anew, the two
    /// together are not.
    pub started: u64,
    /// Its command line.
    pub arguments: Vec<PathBuf>,
}

/// Who has the terminal open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Search {
    /// This process.
    Found(Process),
    /// Nobody whom this program may look into, but these processes of klippy's may not be looked into.
    Hidden(Vec<Process>),
    /// Nobody.
    Nobody,
}

/// Finds the process that has the terminal `device` open, another than this one, and than one that serves it, having
/// its other end open. `proc` is /proc.
///
/// # Errors
///
/// Those of looking at the terminal or at `proc` itself.
pub fn find(proc: &Path, device: &Path) -> io::Result<Search> {
    let terminal = fs::metadata(device)?;
    let mut processes: Vec<Process> = fs::read_dir(proc)?
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok())
        .filter(|pid| *pid != std::process::id())
        .filter_map(|pid| Process::read(proc, pid))
        .collect();
    // A look into a process costs a call for each of its files, so the likely ones come first; of a
    // process and its children the parent.
    processes.sort_by_key(|process| (process.klippy().is_none(), process.started));
    let mut hidden = Vec::new();
    for process in processes {
        match process.has_open(proc, &terminal) {
            Ok(true) if !process.serves(proc, &terminal) => return Ok(Search::Found(process)),
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied && process.klippy().is_some() => {
                hidden.push(process);
            }
            // One that ended meanwhile, or that is none of klippy's.
            Ok(_) | Err(_) => {}
        }
    }
    Ok(if hidden.is_empty() { Search::Nobody } else { Search::Hidden(hidden) })
}

impl Process {
    fn read(proc: &Path, pid: u32) -> Option<Process> {
        let folder = proc.join(pid.to_string());
        let line = fs::read(folder.join("cmdline")).ok()?;
        let arguments = line.split(|byte| *byte == 0).filter(|argument| !argument.is_empty());
        let arguments = arguments.map(|argument| PathBuf::from(OsStr::from_bytes(argument))).collect();
        let stat = fs::read_to_string(folder.join("stat")).ok()?;
        // The second field, the name in parentheses, may hold anything; starttime is the 22nd.
        let (_, fields) = stat.rsplit_once(')')?;
        let started = fields.split_whitespace().nth(19)?.parse().ok()?;
        Some(Process { pid, started, arguments })
    }

    /// The argument that names klippy's program.
    fn klippy(&self) -> Option<&Path> {
        let is_it = |argument: &&PathBuf| argument.file_name().is_some_and(|name| name == "klippy.py");
        self.arguments.iter().find(is_it).map(PathBuf::as_path)
    }

    /// klippy's folder as this program can reach it, should the process be klippy: through the
    /// process's own root (a container's), or, where that is not permitted, as if both had the same.
    pub fn klippy_folder(&self, proc: &Path) -> Option<PathBuf> {
        let folder = proc.join(self.pid.to_string());
        let program = self.klippy()?;
        let program = if program.is_absolute() {
            program.to_owned()
        } else {
            fs::read_link(folder.join("cwd")).ok()?.join(program)
        };
        let inside = program.strip_prefix("/").unwrap_or(&program);
        let through_root = folder.join("root").join(inside);
        let program = if through_root.exists() { through_root } else { program };
        Some(program.parent()?.to_owned())
    }

    /// Whether it has the master end of the terminal open. Which terminal a master belongs to is the `tty-index` of its
    /// fdinfo (proc_pid_fdinfo(5)).
    fn serves(&self, proc: &Path, terminal: &fs::Metadata) -> bool {
        let index = format!("tty-index:\t{}", nix::sys::stat::minor(terminal.rdev()));
        let Ok(files) = fs::read_dir(proc.join(self.pid.to_string()).join("fdinfo")) else { return false };
        let mut told = files.flatten().filter_map(|file| fs::read_to_string(file.path()).ok());
        told.any(|info| info.lines().any(|line| line == index))
    }

    fn has_open(&self, proc: &Path, terminal: &fs::Metadata) -> io::Result<bool> {
        let folder = proc.join(self.pid.to_string()).join("fd");
        for entry in fs::read_dir(folder)? {
            let file = match fs::metadata(entry?.path()) {
                // It was closed meanwhile.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                file => file?,
            };
            // Containers have terminals of the same numbers, on devices of their own.
            let is_it = file.file_type().is_char_device() && file.rdev() == terminal.rdev();
            if is_it && file.dev() == terminal.dev() {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::{FcntlArg, FdFlag, fcntl};
    use nix::pty::{OpenptyResult, openpty};
    use nix::unistd::ttyname;
    use std::process::{Child, Command, Stdio};

    /// A terminal of which a child inherits what it is given only, as of the program's.
    fn terminal() -> (OpenptyResult, PathBuf) {
        let pty = openpty(None, None).unwrap();
        for end in [&pty.master, &pty.slave] {
            fcntl(end, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC)).unwrap();
        }
        let device = ttyname(&pty.slave).unwrap();
        (pty, device)
    }

    /// A process that has the terminal open as its input, called as klippy is.
    fn host(device: &Path, script: &Path) -> Child {
        let terminal = fs::File::open(device).unwrap();
        // A shell ignores what follows its script.
        Command::new("/bin/sh")
            .args(["-c", "read line", "sh"])
            .arg(script)
            .stdin(Stdio::from(terminal))
            .spawn()
            .unwrap()
    }

    #[test]
    fn the_process_that_has_the_terminal_open_is_found_among_all() {
        let (_pty, device) = terminal();
        assert_eq!(find(Path::new("/proc"), &device).unwrap(), Search::Nobody, "this process does not count");
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("klippy.py");
        fs::write(&script, "").unwrap();
        let mut host = host(&device, &script);
        let found = find(Path::new("/proc"), &device).unwrap();
        let Search::Found(process) = found else { panic!("{found:?}") };
        assert_eq!(process.pid, host.id());
        let reached = process.klippy_folder(Path::new("/proc")).unwrap();
        assert!(reached.join("klippy.py").exists(), "{reached:?}");
        assert!(reached.ends_with(folder.path().strip_prefix("/").unwrap()), "{reached:?}");
        host.kill().unwrap();
        host.wait().unwrap();
        assert_eq!(find(Path::new("/proc"), &device).unwrap(), Search::Nobody);
    }

    #[test]
    fn who_serves_the_terminal_is_no_host() {
        let (pty, device) = terminal();
        // A program that has both ends open, as Pinion has while no host is there.
        let mut server = Command::new("/bin/sh")
            .args(["-c", "read line"])
            .stdin(Stdio::from(pty.slave.try_clone().unwrap()))
            .stderr(Stdio::from(pty.master.try_clone().unwrap()))
            .spawn()
            .unwrap();
        assert_eq!(find(Path::new("/proc"), &device).unwrap(), Search::Nobody);
        let mut host = host(&device, Path::new("klippy.py"));
        let found = find(Path::new("/proc"), &device).unwrap();
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
        // A file is on another device than the terminal, whatever it is.
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(find(Path::new("/proc"), file.path()).unwrap(), Search::Nobody);
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
        fs::write(folder.join("stat"), format!("42 (a) S 1) S {}\n", fields.join(" "))).unwrap();
        let process = Process::read(proc.path(), 42).unwrap();
        assert_eq!(process.started, 22);
        assert_eq!(process.klippy().unwrap(), Path::new("/home/pi/klipper/klippy/klippy.py"));
        assert_eq!(process.klippy_folder(proc.path()).unwrap(), Path::new("/home/pi/klipper/klippy"));
    }
}
