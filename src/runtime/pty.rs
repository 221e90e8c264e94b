// SPDX-License-Identifier: GPL-3.0-or-later
//! The pseudo terminal that the host opens, and the link that leads to it.

#![forbid(unsafe_code)]

use std::fs;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use log::warn;
use nix::errno::Errno;
use nix::fcntl::{FcntlArg, FdFlag, OFlag, fcntl};
use nix::pty::openpty;
use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify};
use nix::sys::termios::{FlushArg, SetArg, cfmakeraw, tcflush, tcgetattr, tcsetattr};
use nix::unistd::{Gid, Group, chown, read, ttyname, write};

/// Whose the terminal is when nobody says.
const USUAL_GROUP: &str = "tty";

/// A terminal whose slave end stands at `link`.
pub(super) struct Pty {
    master: OwnedFd,
    /// Kept open, so that a host that goes away does not hang up the terminal.
    slave: OwnedFd,
    device: PathBuf,
    link: PathBuf,
    watch: Inotify,
    /// How many times the slave end is open, ourselves left out.
    hosts: usize,
}

/// Who may open the terminal.
#[derive(Clone, Debug)]
pub struct Access {
    /// Permission bits.
    pub mode: u32,
    /// Group name or number. `None` is `tty` where that is permitted, and the system's choice
    /// where not.
    pub group: Option<String>,
}

fn said<T>(result: Result<T, impl Into<io::Error>>, what: &str) -> io::Result<T> {
    result.map_err(|error| {
        let error = error.into();
        io::Error::new(error.kind(), format!("{what}: {error}"))
    })
}

impl Pty {
    /// Opens a terminal and puts the link in place.
    pub(super) fn open(link: &Path, access: &Access) -> io::Result<Pty> {
        let pty = said(openpty(None, None), "no pseudo terminal can be opened (is /dev/pts mounted?)")?;
        let mut raw = said(tcgetattr(&pty.slave), "the terminal's settings")?;
        cfmakeraw(&mut raw);
        said(tcsetattr(&pty.slave, SetArg::TCSANOW, &raw), "the terminal's settings")?;
        for fd in [&pty.master, &pty.slave] {
            said(fcntl(fd, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC)), "the terminal's descriptor")?;
        }
        said(fcntl(&pty.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)), "the terminal's descriptor")?;
        let device = said(ttyname(&pty.slave), "the terminal's name")?;
        grant(&device, access)?;
        let watch = said(Inotify::init(InitFlags::IN_NONBLOCK | InitFlags::IN_CLOEXEC), "inotify")?;
        said(watch.add_watch(&device, AddWatchFlags::IN_OPEN | AddWatchFlags::IN_CLOSE), "inotify on the terminal")?;
        place_link(&device, link)?;
        Ok(Pty { master: pty.master, slave: pty.slave, device, link: link.to_owned(), watch, hosts: 0 })
    }

    /// The slave end's device.
    pub(super) fn device(&self) -> &Path {
        &self.device
    }

    /// Where the host finds it.
    pub(super) fn link(&self) -> &Path {
        &self.link
    }

    /// Reads what the host wrote; nothing is 0 bytes.
    pub(super) fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match read(&self.master, buffer) {
            Ok(len) => Ok(len),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(0),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes what the terminal has room for.
    pub(super) fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        match write(&self.master, bytes) {
            Ok(len) => Ok(len),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(0),
            Err(error) => Err(error.into()),
        }
    }

    /// Takes in who opened and closed the terminal: whether a host is there now.
    pub(super) fn attached(&mut self) -> bool {
        while let Ok(events) = self.watch.read_events() {
            for event in events {
                if event.mask.contains(AddWatchFlags::IN_Q_OVERFLOW) {
                    // Who came and went is lost. A host that is there must not be left without
                    // answers, and one that is not takes none: it is there until it closes.
                    self.hosts = 1;
                } else if event.mask.contains(AddWatchFlags::IN_OPEN) {
                    self.hosts += 1;
                } else if event.mask.intersects(AddWatchFlags::IN_CLOSE) {
                    self.hosts = self.hosts.saturating_sub(1);
                }
            }
        }
        self.hosts > 0
    }

    /// Drops what the host that went away did not read.
    pub(super) fn discard_output(&self) {
        // Without success the next host skips some old blocks.
        let _ = tcflush(&self.slave, FlushArg::TCIFLUSH);
    }

    pub(super) fn master(&self) -> BorrowedFd<'_> {
        self.master.as_fd()
    }

    pub(super) fn watch(&self) -> BorrowedFd<'_> {
        self.watch.as_fd()
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        // Somebody else's link is left alone.
        if fs::read_link(&self.link).is_ok_and(|target| target == self.device) {
            let _ = fs::remove_file(&self.link);
        }
    }
}

fn grant(device: &Path, access: &Access) -> io::Result<()> {
    let about = |what: &str| format!("{what} of {}", device.display());
    said(fs::set_permissions(device, fs::Permissions::from_mode(access.mode)), &about("the mode"))?;
    match &access.group {
        Some(name) => give(device, name),
        // Nobody asked for it: the C program leaves the group alone, and so runs as any user.
        None => give(device, USUAL_GROUP).or_else(|error| {
            let gid = fs::metadata(device)?.gid();
            warn!("{error}: it stays with group {gid}; a klippy of another user can not open it");
            Ok(())
        }),
    }
}

fn give(device: &Path, name: &str) -> io::Result<()> {
    let gid = match name.parse() {
        Ok(gid) => Gid::from_raw(gid),
        Err(_) => {
            let group = said(Group::from_name(name), &format!("looking for the group {name}"))?;
            let missing = || io::Error::other(format!("there is no group {name}: create it or choose another with -g"));
            group.ok_or_else(missing)?.gid
        }
    };
    if fs::metadata(device)?.gid() == gid.as_raw() {
        return Ok(());
    }
    let what = format!(
        "giving {} to the group {name} (only root or a member may: add the user to it, or choose another with -g)",
        device.display()
    );
    said(chown(device, None, Some(gid)), &what)
}

fn place_link(device: &Path, link: &Path) -> io::Result<()> {
    match fs::symlink_metadata(link) {
        Ok(found) if !found.file_type().is_symlink() => {
            return Err(io::Error::other(format!(
                "{} exists and is no symbolic link: remove it, or choose another path with -I",
                link.display()
            )));
        }
        _ => {}
    }
    // A rename replaces a stale link in one step: a host never finds none.
    let mut fresh = link.as_os_str().to_owned();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = PathBuf::from(fresh);
    let what =
        format!("the link {} can not be made (does the directory exist, and may we write there?)", link.display());
    said(std::os::unix::fs::symlink(device, &fresh), &what)?;
    said(fs::rename(&fresh, link), &what).inspect_err(|_| drop(fs::remove_file(&fresh)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    #[test]
    fn a_host_that_came_amid_too_many_events_to_count_is_there_and_can_go() {
        let folder = tempfile::tempdir().unwrap();
        let mut pty = Pty::open(&folder.path().join("tty"), &Access { mode: 0o600, group: None }).unwrap();
        let queue: usize =
            fs::read_to_string("/proc/sys/fs/inotify/max_queued_events").unwrap().trim().parse().unwrap();
        for _ in 0..queue / 2 + 10 {
            drop(File::open(pty.device()).unwrap());
        }
        let host = File::open(pty.device()).unwrap();
        assert!(pty.attached());
        drop(host);
        assert!(!pty.attached());
    }
}
