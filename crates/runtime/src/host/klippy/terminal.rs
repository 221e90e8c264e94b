// SPDX-License-Identifier: GPL-3.0-or-later
//! The process that has a terminal open, found through /proc (proc(5)).

use std::fs;
use std::io;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

use serde::{Deserialize, Serialize};

use pinion_linux::foreign;

use super::process::{self, Ids, PROC_BYTES_MAX, Process};

/// Highest number of open files of a process that are inspected. klippy has less than a hundred.
const OPEN_FILES_MAX: usize = 4096;
/// Highest number of inspected files of all processes that may not open the terminal. Any user can have
/// many processes with many files. To inspect one takes 2 us to 20 us.
const UNLIKELY_FILES_MAX: usize = 10_000;

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
    /// The device cannot be inspected.
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

/// Finds the process that has a terminal open, other than this one. `proc` is /proc.
///
/// # Errors
///
/// `proc` itself cannot be read.
pub fn find(proc: &Path, terminal: Terminal) -> io::Result<Search> {
    // The kernel does not say who has a terminal open. To inspect a process costs a call for each of its files. So the
    // processes that may open the terminal come first, klippys come before others, and a parent comes before its
    // children.
    let candidate = |process: Process| {
        let status = foreign::read(&proc.join(process.pid.to_string()).join("status"), PROC_BYTES_MAX).ok()?;
        let is_let_in = Ids::of(&String::from_utf8_lossy(&status)).is_some_and(|ids| terminal.lets_in(&ids));
        Some((!is_let_in, !process.is_klippy(), process.started, process.pid, process))
    };
    let mut candidates: Vec<_> = process::all(proc)?.into_iter().filter_map(candidate).collect();
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

/// The process, other than this one, that serves the terminal `device`: it has the master end open. `None` if this
/// program may look into no process that does.
///
/// # Errors
///
/// The terminal cannot be inspected, or `proc` itself cannot be read.
pub fn server(proc: &Path, device: &Path) -> io::Result<Option<Process>> {
    let terminal = Terminal::of(device)?;
    let pid = process::pids(proc)?.find(|pid| serves(proc, *pid, terminal));
    Ok(pid.and_then(|pid| process::of(proc, pid)))
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
    use nix::fcntl::OFlag;
    use nix::pty::{OpenptyResult, grantpt, posix_openpt, ptsname_r, unlockpt};
    use std::os::unix::fs::OpenOptionsExt;
    use std::path::PathBuf;
    use std::process::{Child, Command, Stdio};

    /// A terminal whose ends no other test's process inherits, even if it is started at this moment: openpty(3) cannot
    /// open them like that.
    fn terminal() -> (OpenptyResult, PathBuf) {
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let device = PathBuf::from(ptsname_r(&master).unwrap());
        let slave = fs::File::options().read(true).write(true).custom_flags(OFlag::O_NOCTTY.bits()).open(&device);
        (OpenptyResult { master: master.into(), slave: slave.unwrap().into() }, device)
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
        put(proc.path(), 10, &KLIPPY, (54_321, 54_321), &many);
        for pid in 11..15 {
            put(proc.path(), pid, &KLIPPY, (54_321, 54_321), &[]);
            // The same files: making them takes most of this test's time.
            let files = proc.path().join(pid.to_string()).join("fd");
            fs::remove_dir(&files).unwrap();
            std::os::unix::fs::symlink(proc.path().join("10/fd"), files).unwrap();
        }
        put(proc.path(), 20, &KLIPPY, (54_321, 54_321), &[&device]);
        assert_eq!(found(), None, "the search has an end");
        put(proc.path(), 90, &["host"], (990, 990), &[&device]);
        assert_eq!(found(), Some(90), "the terminal's owner");
        // As su is while it asks for a password: it has the files of its caller, and root's rights.
        let su = "Uid:\t54321\t0\t0\t0\nGid:\t54321\t54321\t54321\t54321\nGroups:\t\n";
        fs::write(proc.path().join("20/status"), su).unwrap();
        assert_eq!(found(), Some(90), "who calls su is not root");
    }
}
