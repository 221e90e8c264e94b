// SPDX-License-Identifier: GPL-3.0-or-later
//! The pseudo terminal that the host opens, and the symbolic link that leads to it.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, chown, symlink};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use log::{info, warn};
use nix::errno::Errno;
use nix::fcntl::{FcntlArg, FdFlag, Flock, FlockArg, OFlag, fcntl};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::pty::openpty;
use nix::sys::termios::{FlowArg, FlushArg, SetArg, Termios, cfmakeraw, tcflow, tcflush, tcgetattr, tcsetattr};
use nix::unistd::{geteuid, read, ttyname, write};

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::monotonic;
use pinion_linux::sys;

use super::{Input, Transport};
use crate::transport::place::Place;
use crate::transport::served::served;
use crate::transport::terminal_group::{CLOSED, TerminalGroup};
use crate::trouble::refused;
use pinion_linux::own_folder::OwnFolder;

/// Folder in which a service's stop command may leave a file in place of the link.
const TMP: &str = "/tmp";
/// The stop command of Klipper's own service writes this to the link's path, even if no program serves there.
const FORCE_SHUTDOWN: &str = "FORCE_SHUTDOWN";
/// How often the terminal is restored while no host is there. There is no event when a client has changed it.
const RESTORE_EVERY: Duration = Duration::from_secs(1);
/// How long to wait for another program that makes its link in the same folder. Any user may lock that folder.
const TURN_MAX: Duration = Duration::from_secs(3);
/// How often to check if that program has unlocked the folder.
const TURN_LOOK: Duration = Duration::from_millis(10);

/// A terminal that a host finds by a symbolic link.
///
/// The kernel reports that the host is gone: the master hangs up when the last process has closed the slave end. So our
/// own slave end is closed while a host is there. It is open while no host is there: otherwise the master would report a
/// hang-up all that time.
pub(crate) struct Pty {
    master: OwnedFd,
    /// Our own slave end, open while no host is there.
    slave: Option<OwnedFd>,
    /// The terminal's settings before a client changed them.
    settings: Termios,
    /// When to restore the terminal for the next host (CLOCK_MONOTONIC). `None` while a host is there.
    restore_at: Option<Duration>,
    access: Access,
    device: PathBuf,
    symlink: PathBuf,
}

/// Who may open the terminal.
#[derive(Clone, Debug)]
pub struct Access {
    /// Permission bits.
    pub mode: u32,
    /// Name or number of the group. `None` means `tty`. If that is not permitted, the terminal keeps the group that the
    /// system has given it.
    pub group: Option<String>,
}

impl Pty {
    /// Opens a terminal and puts the symbolic link in place.
    ///
    /// # Errors
    ///
    /// The path is taken, the group is not this user's, or the kernel has no terminal.
    pub(crate) fn open(symlink: &Path, access: &Access) -> Result<Pty, Trouble> {
        // Of several programs that start at once, the first one serves the link. The others find it served.
        let _turn = turn(symlink);
        if let Some(served) = served(symlink) {
            return Err(format!("{served}, or choose another path with -I").into());
        }
        let pty = Pty::unlinked(symlink, access)?;
        place_symlink(&pty.device, symlink)?;
        if let Err(error) = OwnFolder::open(folder_of(symlink)) {
            warn!(
                "another user can replace the link {}, and hosts then find another program: {error}: choose a path in a folder of your own with -I",
                symlink.display()
            );
        }
        Ok(pty)
    }

    /// A raw terminal to which no symbolic link leads yet.
    fn unlinked(symlink: &Path, access: &Access) -> Result<Pty, Trouble> {
        let pty = Pty::try_unlinked(symlink, access).map_err(|error| {
            refused("no pseudo terminal can be opened", error).remedy("mount /dev/pts, or raise LimitNOFILE")
        })?;
        grant(&pty.device, access)?;
        Ok(pty)
    }

    fn try_unlinked(symlink: &Path, access: &Access) -> nix::Result<Pty> {
        let pty = openpty(None, None)?;
        let mut settings = tcgetattr(&pty.slave)?;
        cfmakeraw(&mut settings);
        tcsetattr(&pty.slave, SetArg::TCSANOW, &settings)?;
        for fd in [&pty.master, &pty.slave] {
            fcntl(fd, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC))?;
        }
        fcntl(&pty.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
        Ok(Pty {
            device: ttyname(&pty.slave)?,
            master: pty.master,
            slave: Some(pty.slave),
            settings,
            restore_at: Some(monotonic() + RESTORE_EVERY),
            access: access.clone(),
            symlink: symlink.to_owned(),
        })
    }

    /// Restores the terminal, if that is due. A client may leave it closed to others (TIOCEXCL), stopped (tcflow(3)) or
    /// with other settings. The next host could then not open or use it.
    pub(crate) fn restore(&mut self) {
        if self.restore_at.is_none_or(|at| monotonic() < at) {
            return;
        }
        self.restore_at = Some(monotonic() + RESTORE_EVERY);
        let Err(error) = self.try_restore() else { return };
        let left = self.device.display().to_string();
        match self.replace() {
            Ok(()) => warn!(
                "{left} can no longer be used: {error}: {} leads to {} now, and hosts find it there",
                self.symlink.display(),
                self.device.display()
            ),
            Err(trouble) => warn!("{left} can no longer be used: {error}: {trouble} (tried again until it works)"),
        }
    }

    fn try_restore(&mut self) -> io::Result<()> {
        let slave = match self.slave.take() {
            Some(slave) => slave,
            None => sys::pty_slave(self.master.as_fd())?,
        };
        sys::make_shared(&slave)?;
        sys::use_usual_discipline(&slave)?;
        tcflow(&slave, FlowArg::TCOON)?;
        tcsetattr(&slave, SetArg::TCSANOW, &self.settings)?;
        self.slave = Some(slave);
        Ok(())
    }

    /// Puts a new terminal in place of this one. The kernel hangs up for everybody who has the old one open.
    pub(crate) fn replace(&mut self) -> Result<(), Trouble> {
        let fresh = Pty::unlinked(&self.symlink, &self.access)?;
        if self.is_linked() {
            place_symlink(&fresh.device, &self.symlink)?;
        }
        *self = fresh;
        Ok(())
    }

    /// Whether the link leads to this terminal. Another program may have put its own link there since.
    fn is_linked(&self) -> bool {
        fs::read_link(&self.symlink).is_ok_and(|target| target == self.device)
    }
}

fn folder_of(link: &Path) -> &Path {
    link.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Waits until no other program makes a link in this folder. Gives up after [`TURN_MAX`], because another user may hold
/// the lock.
fn turn(symlink: &Path) -> Option<Flock<File>> {
    let mut folder = File::open(folder_of(symlink)).ok()?;
    let until = monotonic() + TURN_MAX;
    loop {
        match Flock::lock(folder, FlockArg::LockExclusiveNonblock) {
            Ok(turn) => return Some(turn),
            Err((back, Errno::EWOULDBLOCK | Errno::EINTR)) if monotonic() < until => folder = back,
            Err(_) => return None,
        }
        thread::sleep(TURN_LOOK);
    }
}

impl Transport for Pty {
    fn place(&self) -> String {
        self.symlink.display().to_string()
    }

    fn detail(&self) -> String {
        self.device.display().to_string()
    }

    fn terminal(&self) -> Option<&Path> {
        Some(&self.device)
    }

    fn event(&self) -> Option<BorrowedFd<'_>> {
        // With neither a host nor our own slave end, the master reports a hang-up all the time.
        (self.restore_at.is_none() || self.slave.is_some()).then(|| self.master.as_fd())
    }

    fn due(&self) -> Option<Duration> {
        self.restore_at
    }

    fn read(&mut self, buffer: &mut [u8], hung_up: bool) -> io::Result<Input> {
        if !hung_up {
            self.restore();
        }
        match read(&self.master, buffer) {
            // The last bytes of a host count, for example a stop of the MCU, even if this thread reads them late.
            Ok(len) if len > 0 || !hung_up => Ok(Input::Bytes(len)),
            // The kernel answers EIO when the host is gone and all its bytes are read.
            Ok(_) | Err(Errno::EIO) if hung_up => Ok(Input::Gone),
            Ok(_) | Err(Errno::EAGAIN | Errno::EINTR | Errno::EIO) => Ok(Input::Bytes(0)),
            Err(error) => Err(error.into()),
        }
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match write(&self.master, bytes) {
            Ok(len) => Ok(len),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(0),
            Err(error) => Err(error.into()),
        }
    }

    /// Closes our slave end, so that the master hangs up when the host closes the terminal. Returns false if the host is
    /// gone already, for example an `echo` in a shell.
    fn meet_host(&mut self) -> bool {
        self.slave = None;
        self.restore_at = None;
        let mut fds = [PollFd::new(self.master.as_fd(), PollFlags::empty())];
        let is_gone = poll(&mut fds, PollTimeout::ZERO).is_ok() && fds[0].any().unwrap_or(true);
        if is_gone {
            self.part_from_host();
        }
        !is_gone
    }

    fn silence_max(&self) -> Option<Duration> {
        None
    }

    /// Opens our slave end again, so that the master no longer reports a hang-up.
    fn part_from_host(&mut self) {
        self.restore_at = Some(Duration::ZERO);
        self.restore();
        if let Some(slave) = &self.slave {
            // If this fails, the next host reads some blocks that were meant for this one, and skips them.
            let _ = tcflush(slave, FlushArg::TCIFLUSH);
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        if self.is_linked() {
            let _ = fs::remove_file(&self.symlink);
        }
    }
}

fn grant(device: &Path, access: &Access) -> Result<(), Trouble> {
    fs::set_permissions(device, fs::Permissions::from_mode(access.mode))
        .map_err(|error| refused(format_args!("the mode of {} cannot be set", device.display()), error))?;
    give(device, access.group.as_deref()).or_else(|trouble| match access.group {
        Some(_) => Err(trouble),
        // The user has not asked for the usual group, so the program runs without it. Only root or a member may give a
        // file to a group. (Klipper's C leaves the group as it is.)
        None => {
            warn!("{}", trouble.of(CLOSED));
            Ok(())
        }
    })
}

fn give(device: &Path, group: Option<&str>) -> Result<(), Trouble> {
    let group = TerminalGroup::find(group)?;
    if fs::metadata(device).is_ok_and(|about| about.gid() == group.gid()) {
        return Ok(());
    }
    chown(device, None, Some(group.gid())).map_err(|error| group.refusal(error))
}

fn place_symlink(device: &Path, link: &Path) -> Result<(), Trouble> {
    let place = Place::of(link);
    let what = format!("the link {} cannot be made", link.display());
    let cannot = |error: io::Error| {
        let remedy = match is_full(&error) {
            true => "free space or remove files there (df, df -i), or choose another path with -I",
            false => "make its folder, let this user write there, or choose another path with -I",
        };
        refused(&what, error).remedy(remedy)
    };
    if place == Place::File && is_left_over(link) {
        fs::remove_file(link).map_err(cannot)?;
        info!("a file with nothing but {FORCE_SHUTDOWN} was in the link's place: removed {}", link.display());
    } else if let Some(obstacle) = place.obstacle(link) {
        return Err(obstacle);
    }
    // A rename replaces a stale link in one step, so that a host finds a link at any time.
    let mut fresh = link.as_os_str().to_owned();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = PathBuf::from(fresh);
    // An earlier process with our number may have left it there in a power cut.
    let _ = fs::remove_file(&fresh);
    let renamed = || fs::rename(&fresh, link).inspect_err(|_| drop(fs::remove_file(&fresh)));
    match symlink(device, &fresh).and_then(|()| renamed()) {
        // There is no room for two links, but the stale one makes room.
        Err(error) if is_full(&error) && place == Place::Link => {
            fs::remove_file(link).and_then(|()| symlink(device, link)).map_err(cannot)
        }
        placed => placed.map_err(cannot),
    }
}

fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

/// Whether a service's stop command left this file in /tmp because there was no link. The file belongs to root or to us,
/// and has nothing else in it. (Klipper's C removes any file.)
fn is_left_over(path: &Path) -> bool {
    let read = || -> io::Result<(fs::Metadata, String)> {
        // Another file may take its place now. So do not follow another user's link, and do not wait for a pipe's writer.
        let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK;
        let file = OpenOptions::new().read(true).custom_flags(flags.bits()).open(path)?;
        let mut content = String::new();
        let found = file.metadata()?;
        file.take(FORCE_SHUTDOWN.len() as u64 + 2).read_to_string(&mut content)?;
        Ok((found, content))
    };
    path.parent() == Some(Path::new(TMP))
        && read().is_ok_and(|(found, content)| {
            found.is_file()
                && [0, geteuid().as_raw()].contains(&found.uid())
                && ["", FORCE_SHUTDOWN].contains(&content.trim_end())
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// A terminal, and how a host opens it.
    fn terminal() -> (tempfile::TempDir, Pty, impl Fn() -> File) {
        let folder = tempfile::tempdir().unwrap();
        let pty = Pty::open(&folder.path().join("tty"), &Access { mode: 0o600, group: None }).unwrap();
        let device = pty.device.clone();
        (folder, pty, move || OpenOptions::new().read(true).write(true).open(&device).unwrap())
    }

    fn hangs_up(pty: &Pty) -> bool {
        let mut fds = [PollFd::new(pty.master.as_fd(), PollFlags::empty())];
        poll(&mut fds, PollTimeout::ZERO).unwrap() > 0
    }

    #[test]
    fn a_host_is_there_until_the_last_process_has_closed_the_terminal() {
        let (_folder, mut pty, open) = terminal();
        assert!(!hangs_up(&pty));
        // Hosts that open and close the terminal without writing make no difference.
        for _ in 0..100 {
            drop(open());
        }
        let (klippy, echo) = (open(), open());
        assert!(pty.meet_host());
        drop(klippy);
        assert!(!hangs_up(&pty));
        drop(echo);
        assert!(hangs_up(&pty));
        pty.part_from_host();
        assert!(!hangs_up(&pty));
    }

    /// klippy's FIRMWARE_RESTART: it stops the MCU, and closes the terminal 30 ms later.
    #[test]
    fn bytes_that_a_host_wrote_before_it_closed_the_terminal_are_read() {
        let (_folder, mut pty, open) = terminal();
        let mut host = open();
        assert!(pty.meet_host());
        host.write_all(b"stop").unwrap();
        drop(host);
        let mut bytes = [0; 3];
        // The kernel may deliver bytes after the hang-up.
        while !hangs_up(&pty) {}
        for (input, text) in [(Input::Bytes(3), "sto"), (Input::Bytes(1), "p")] {
            assert_eq!(pty.read(&mut bytes, true).unwrap(), input);
            assert!(bytes.starts_with(text.as_bytes()));
        }
        assert_eq!(pty.read(&mut bytes, true).unwrap(), Input::Gone);
        pty.part_from_host();
        assert!(!hangs_up(&pty));
    }

    #[test]
    fn only_a_file_of_a_stop_command_gives_way_to_the_link() {
        let access = Access { mode: 0o600, group: None };
        let file = |folder: &Path, content: &str| {
            let mut file = tempfile::Builder::new().prefix("klipper_host_").tempfile_in(folder).unwrap();
            file.write_all(content.as_bytes()).unwrap();
            file.into_temp_path()
        };
        for content in ["", "\n", "FORCE_SHUTDOWN\n"] {
            let path = file(Path::new(TMP), content);
            let pty = Pty::open(&path, &access).unwrap();
            assert_eq!(fs::read_link(&path).unwrap(), pty.device);
        }
        let elsewhere = tempfile::tempdir().unwrap();
        for (folder, content) in [
            (Path::new(TMP), "a letter\n"),
            (Path::new(TMP), "FORCE_SHUTDOWN of somebody's printer\n"),
            (elsewhere.path(), "FORCE_SHUTDOWN\n"),
        ] {
            let path = file(folder, content);
            let error = Pty::open(&path, &access).err().unwrap().to_string();
            assert!(error.contains("exists but is not a symbolic link: remove it"), "{error}");
            assert_eq!(fs::read_to_string(&path).unwrap(), content);
        }
        for folder in [Path::new("/"), elsewhere.path()] {
            let error = Pty::open(folder, &access).err().unwrap().to_string();
            assert!(error.contains("is a folder: choose another path with -I"), "{error}");
        }
    }

    #[test]
    fn a_link_that_a_power_cut_left_half_made_does_not_prevent_the_next_one() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("tty");
        let half_made = folder.path().join(format!("tty.{}", std::process::id()));
        symlink("/dev/pts/no-longer-there", &half_made).unwrap();
        let pty = Pty::open(&link, &Access { mode: 0o600, group: None }).unwrap();
        assert_eq!(fs::read_link(&link).unwrap(), pty.device);
        assert!(fs::symlink_metadata(&half_made).is_err(), "the half-made link is still there");
    }

    #[test]
    fn a_host_that_wrote_and_left_is_read_and_is_gone() {
        let (_folder, mut pty, open) = terminal();
        open().write_all(b"FORCE_SHUTDOWN\n").unwrap();
        assert!(!pty.meet_host());
        let mut heard = [0; 64];
        let Input::Bytes(len) = pty.read(&mut heard, false).unwrap() else { panic!() };
        assert_eq!(heard[..len], *b"FORCE_SHUTDOWN\n");
        assert!(!hangs_up(&pty));
    }

    #[test]
    fn the_next_host_does_not_read_the_bytes_for_the_last_one() {
        let (_folder, mut pty, open) = terminal();
        let mut host = open();
        host.write_all(b"?").unwrap();
        assert!(pty.meet_host());
        pty.write(b"for the last one").unwrap();
        drop(host);
        let mut heard = [0; 64];
        assert_eq!(pty.read(&mut heard, false).unwrap(), Input::Bytes(1));
        assert_eq!(
            pty.read(&mut heard, false).unwrap(),
            Input::Bytes(0),
            "a terminal that hung up has nothing to read"
        );
        pty.part_from_host();
        host = open();
        pty.write(b"for this one").unwrap();
        let len = host.read(&mut heard).unwrap();
        assert_eq!(heard[..len], *b"for this one");
    }
}
