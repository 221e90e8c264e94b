// SPDX-License-Identifier: GPL-3.0-or-later
//! Whether a running program serves the terminal that a link leads to. A second program at the same link would take
//! the host from the first one.

use std::fmt;
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;

use crate::host::klippy::process::{self, Process};
use crate::host::klippy::terminal::server;
use pinion_linux::foreign;
use pinion_linux::uart::is_pseudo_terminal;

/// Highest number of links that the kernel follows (path_resolution(7)).
const LINKS_MAX: usize = 40;
/// Longest part of /proc/PID/cgroup that is read.
const GROUPS_BYTES_MAX: u64 = 4096;
/// How much younger than its link a served terminal may be. klipper_mcu changes the terminal's mode after it has made
/// the link.
const YOUNGER_MAX_S: i64 = 1;
/// The programs that serve hosts, each with its name for people.
const PROGRAMS: [(&str, &str); 3] =
    [("pinion", "Pinion"), ("pinion-sim", "Pinion"), ("klipper_mcu", "Klipper's own klipper_mcu")];

/// A terminal that a running program serves.
#[derive(Debug)]
pub struct Served {
    link: PathBuf,
    device: PathBuf,
    /// The program's name for people. `None` for a program that does not serve hosts.
    program: Option<&'static str>,
    pid: Option<u32>,
    unit: Option<String>,
    /// Whether a link on the way to the terminal is neither root's, nor ours, nor the terminal's owner's.
    is_planted: bool,
}

/// The terminal behind a link, if a running program serves it.
///
/// The kernel removes a terminal when its program ends. The next terminal, for example a login's, gets the same number.
/// So a terminal that is younger than its link belongs to another program. (`systemd/link` has the same rule.)
pub fn served(link: &Path) -> Option<Served> {
    let way = follow(link);
    let [.., last_link, device] = &way[..] else { return None };
    let terminal = fs::metadata(device).ok()?;
    if !is_pseudo_terminal(&terminal) {
        return None;
    }
    let proc = Path::new("/proc");
    let server = server(proc, device).ok().flatten();
    if server.as_ref().is_some_and(|server| has_another_link(proc, server, &way)) {
        return None;
    }
    if server.as_ref().and_then(known).is_none() && is_younger(&terminal, &fs::symlink_metadata(last_link).ok()?) {
        return None;
    }
    let trusted = [0, geteuid().as_raw(), terminal.uid()];
    let is_of_another = |link: &PathBuf| fs::symlink_metadata(link).is_ok_and(|about| !trusted.contains(&about.uid()));
    let is_planted = way.iter().take_while(|path| *path != device).any(is_of_another);
    let server = server.or_else(|| hidden_server(proc, &way, &terminal));
    let groups = server.as_ref().and_then(|server| {
        let groups = foreign::read(&proc.join(server.pid.to_string()).join("cgroup"), GROUPS_BYTES_MAX).ok()?;
        String::from_utf8(groups).ok()
    });
    let unit = groups.as_deref().and_then(process::unit);
    Some(Served {
        link: link.to_owned(),
        device: device.clone(),
        program: server.as_ref().and_then(known),
        pid: server.map(|process| process.pid),
        // A program that cron started, for example, belongs to cron's unit.
        unit: unit.filter(|unit| unit.contains("pinion") || unit.contains("klipper")).map(str::to_owned),
        is_planted,
    })
}

/// The path, and each path to which its links lead, in order. (The kernel itself does not follow another user's link in
/// /tmp.)
fn follow(link: &Path) -> Vec<PathBuf> {
    let mut way = vec![link.to_owned()];
    while way.len() <= LINKS_MAX
        && let Some(last) = way.last()
        && let Ok(target) = fs::read_link(last)
    {
        let next = last.parent().unwrap_or(Path::new("")).join(target);
        way.push(next);
    }
    way
}

/// Whether the program's command line names another link. Then an earlier program, whose terminal had the same number,
/// left this link behind.
fn has_another_link(proc: &Path, server: &Process, way: &[PathBuf]) -> bool {
    let Some(link) = server.arguments.iter().skip_while(|argument| *argument != Path::new("-I")).nth(1) else {
        return false;
    };
    let Ok(folder) = fs::read_link(proc.join(server.pid.to_string()).join("cwd")) else { return false };
    let link = folder.join(link);
    // Do not compare names: one link may have several.
    let identity = |path: &Path| fs::symlink_metadata(path).ok().map(|about| (about.dev(), about.ino()));
    // The program may have a terminal and no link yet.
    let theirs = identity(&link);
    theirs.is_none() || way.iter().all(|path| identity(path) != theirs)
}

/// Whether the terminal was made after the link. A later change, for example of its mode, also makes it younger.
fn is_younger(terminal: &Metadata, link: &Metadata) -> bool {
    (terminal.ctime() - YOUNGER_MAX_S, terminal.ctime_nsec()) > (link.mtime(), link.mtime_nsec())
}

/// The name for people of a program that serves hosts.
fn known(process: &Process) -> Option<&'static str> {
    PROGRAMS
        .iter()
        .find(|(name, _)| process.program().is_some_and(|program| program == *name))
        .map(|(_, called)| *called)
}

/// The program of another user that likely serves the terminal. It belongs to the terminal's owner. A program whose
/// command line names a link on the way to the terminal comes first. The oldest one comes next, because a program starts
/// before its guardian.
fn hidden_server(proc: &Path, way: &[PathBuf], terminal: &Metadata) -> Option<Process> {
    let is_owner = |process: &Process| {
        fs::metadata(proc.join(process.pid.to_string())).is_ok_and(|about| about.uid() == terminal.uid())
    };
    let names_link = |process: &Process| process.arguments.iter().any(|argument| way.contains(argument));
    let processes = process::all(proc).ok()?.into_iter();
    processes
        .filter(|process| known(process).is_some() && is_owner(process) && process.is_hidden(proc))
        .min_by_key(|process| (!names_link(process), process.started, process.pid))
}

impl fmt::Display for Served {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Served { link, device, program, pid, unit, is_planted } = self;
        let served_by = program.unwrap_or("another program");
        write!(f, "{} leads to {}, which {served_by} serves", link.display(), device.display())?;
        pid.map_or(Ok(()), |pid| write!(f, " (process {pid})"))?;
        if *is_planted {
            // Any user can make a link in /tmp to the terminal of a program that has nothing to do with it.
            return write!(f, ": remove the link, which another user has made");
        }
        match (program, unit, pid) {
            // Any user can make a link in /tmp to any terminal, for example to the terminal of root's login.
            (None, _, Some(_)) => write!(f, ": remove the link, unless that program has made it"),
            (_, Some(unit), Some(_)) => write!(f, ": stop it (sudo systemctl stop {})", foreign::word(unit)),
            (_, None, Some(pid)) => write!(f, ": stop it (sudo kill {pid})"),
            (.., None) => write!(f, ": stop it (sudo pinion doctor may name it)"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::AT_FDCWD;
    use nix::pty::openpty;
    use nix::sys::stat::{UtimensatFlags, utimensat};
    use nix::sys::time::{TimeSpec, TimeValLike as _};
    use nix::unistd::ttyname;
    use std::os::unix::fs::{PermissionsExt, symlink};

    #[test]
    fn a_terminal_is_served_unless_it_is_younger_than_its_link() {
        let folder = tempfile::tempdir().unwrap();
        let (own, link) = (folder.path().join("own"), folder.path().join("link"));
        assert!(served(&link).is_none(), "there is nothing");
        symlink("own", &link).unwrap();
        symlink("/dev/pts/no-longer-there", &own).unwrap();
        assert!(served(&link).is_none(), "its program has ended");
        fs::remove_file(&own).unwrap();
        symlink("/dev/null", &own).unwrap();
        assert!(served(&link).is_none(), "that is no terminal");
        fs::remove_file(&own).unwrap();
        let pty = openpty(None, None).unwrap();
        let device = ttyname(&pty.slave).unwrap();
        symlink(&device, &own).unwrap();
        // As klipper_mcu does.
        fs::set_permissions(&device, fs::Permissions::from_mode(0o660)).unwrap();
        let found = served(&link).unwrap().to_string();
        let expected = format!("{} leads to {}, which another program serves", link.display(), device.display());
        assert!(found.starts_with(&expected), "{found}");
        // The link of an ended program, and a new terminal with the same number.
        let hour_ago = TimeSpec::seconds(fs::symlink_metadata(&own).unwrap().mtime() - 3600);
        utimensat(AT_FDCWD, &own, &hour_ago, &hour_ago, UtimensatFlags::NoFollowSymlink).unwrap();
        assert!(served(&link).is_none(), "it is another's terminal");
    }

    /// Any user can have one program's link lead to another program's terminal.
    #[test]
    fn a_link_of_another_user_stops_no_program() {
        if !pinion_testkit::here::is_root() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("klipper_host_mcu");
        let pty = openpty(None, None).unwrap();
        symlink(ttyname(&pty.slave).unwrap(), &link).unwrap();
        for owner in [0, 65_534] {
            std::os::unix::fs::lchown(&link, Some(owner), None).unwrap();
            let found = served(&link).unwrap();
            let said = Served { program: Some("Pinion"), pid: Some(7), ..found }.to_string();
            let remedy =
                if owner == 0 { "stop it (sudo kill 7)" } else { "remove the link, which another user has made" };
            assert!(said.ends_with(&format!("which Pinion serves (process 7): {remedy}")), "{said}");
        }
    }

    #[test]
    fn a_round_of_links_leads_nowhere() {
        let folder = tempfile::tempdir().unwrap();
        symlink("b", folder.path().join("a")).unwrap();
        symlink("a", folder.path().join("b")).unwrap();
        assert!(served(&folder.path().join("a")).is_none());
    }

    #[test]
    fn the_command_that_stops_the_program_is_named() {
        let by = |program, unit: Option<&str>, pid| {
            let (link, device) = ("/tmp/klipper_host_mcu".into(), "/dev/pts/3".into());
            let unit = unit.map(str::to_owned);
            Served { link, device, program, pid, unit, is_planted: false }.to_string()
        };
        let said = |unit, pid| by(Some("Pinion"), unit, pid);
        let begins = "/tmp/klipper_host_mcu leads to /dev/pts/3, which Pinion serves";
        let by_unit = format!("{begins} (process 7): stop it (sudo systemctl stop pinion-mcu)");
        assert_eq!(said(Some("pinion-mcu"), Some(7)), by_unit);
        assert_eq!(said(None, Some(7)), format!("{begins} (process 7): stop it (sudo kill 7)"));
        assert_eq!(said(None, None), format!("{begins}: stop it (sudo pinion doctor may name it)"));
        // The link is another user's, and the terminal is of root's login.
        for unit in [Some("ssh"), None] {
            let said = by(None, unit, Some(7));
            assert!(
                !said.contains("sudo") && said.ends_with("remove the link, unless that program has made it"),
                "{said}"
            );
        }
    }
}
