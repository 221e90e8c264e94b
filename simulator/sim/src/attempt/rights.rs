// SPDX-License-Identifier: GPL-3.0-or-later
//! The rights of a trial. Templates in a printer.cfg are programs: klippy does not fence them. So a trial that root starts
//! leaves root's rights before it reads anything, and klippy gets no capability, no new rights and no network.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt, chown};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};

use nix::unistd::{Uid, User, geteuid};
use pinion_linux::own_folder::OwnFolder;
use pinion_printer_config::Trouble;

/// The user and the group "nobody" of Debian.
const NOBODY: u32 = 65_534;

/// Starts this program again as an ordinary user, if root runs it: as the one who called sudo, or as the owner of the
/// printer.cfg, or as nobody. `folder` becomes that user's, if it is new or empty. With `realtime` the program keeps the
/// right to real time.
///
/// # Errors
///
/// The folder is another user's. The program cannot be started.
pub(crate) fn leave_root(printer_cfg: &Path, folder: Option<&Path>, realtime: bool) -> Result<(), Trouble> {
    if !geteuid().is_root() {
        return Ok(());
    }
    let caller = std::env::var("SUDO_UID").ok().and_then(|uid| uid.parse().ok());
    let uid = user_of_trial(caller, fs::metadata(printer_cfg).ok().map(|about| about.uid()));
    let user = User::from_uid(Uid::from_raw(uid)).ok().flatten();
    let gid = user.as_ref().map_or(NOBODY, |user| user.gid.as_raw());
    let kept = if realtime { "-all,+sys_nice,+ipc_lock" } else { "-all" };
    let failed = |error: io::Error| {
        let cause = format!("the trial cannot leave root's rights: {error}");
        Trouble::new(cause).remedy("install util-linux, or run it as an ordinary user")
    };
    if let Some(folder) = folder {
        give(folder, uid, gid).map_err(|error| {
            Trouble::new(error.to_string()).of(folder.display()).remedy("name a new folder in a folder of yours")
        })?;
    }
    let name = user.as_ref().map_or_else(|| uid.to_string(), |user| user.name.clone());
    log::info!("the trial leaves root's rights: it runs as {name}");
    pinion::logging::finish();
    let program = std::env::current_exe().map_err(failed)?;
    let mut setpriv = Command::new("setpriv");
    setpriv.arg(format!("--reuid={uid}")).arg(format!("--regid={gid}"));
    setpriv.arg(if user.is_some() { "--init-groups" } else { "--clear-groups" });
    for set in ["inh-caps", "ambient-caps", "bounding-set"] {
        setpriv.arg(format!("--{set}={kept}"));
    }
    setpriv.arg("--no-new-privs").arg(program).args(std::env::args_os().skip(1));
    // Folders of root's, where this user may write nothing.
    setpriv.env_remove("STATE_DIRECTORY").env_remove("XDG_STATE_HOME").env_remove("XDG_RUNTIME_DIR");
    setpriv.env("HOME", user.map_or_else(|| "/nonexistent".into(), |user| user.dir));
    Err(failed(setpriv.exec()))
}

/// Gives a folder to a user, if it is new or empty. One with files is that user's already, or is refused later.
fn give(folder: &Path, uid: u32, gid: u32) -> io::Result<()> {
    let own = match OwnFolder::make(folder) {
        // That of an earlier trial.
        Err(_) if fs::symlink_metadata(folder).is_ok_and(|about| about.is_dir() && about.uid() == uid) => return Ok(()),
        made => made?,
    };
    if fs::read_dir(own.at("."))?.next().is_none() {
        chown(own.at("."), Some(uid), Some(gid))?;
    }
    Ok(())
}

/// The user of a trial that root starts, from the caller of sudo and the owner of the printer.cfg.
fn user_of_trial(caller: Option<u32>, owner: Option<u32>) -> u32 {
    [caller, owner].into_iter().flatten().find(|uid| *uid != 0).unwrap_or(NOBODY)
}

/// A command that runs the program of its arguments, in which klippy has no capability and gets no rights. It ends when this program does, however that ends. It
/// has no network if the kernel permits that.
pub(crate) fn confined() -> Command {
    // Without a network of its own, it still has this one.
    let alone = ["--user", "--map-current-user", "--net"];
    let may_be_alone = Command::new("unshare").args(alone).arg("true").stderr(Stdio::null()).status();
    let mut command = if may_be_alone.is_ok_and(|status| status.success()) {
        let mut unshare = Command::new("unshare");
        unshare.args(alone).arg("setpriv");
        unshare
    } else {
        log::info!("klippy keeps this computer's network: the kernel permits no namespace without one");
        Command::new("setpriv")
    };
    command.args(["--no-new-privs", "--inh-caps=-all", "--ambient-caps=-all", "--pdeathsig=KILL"]);
    command
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_caller_of_sudo_comes_before_the_files_owner_and_root_never_counts() {
        for (caller, owner, user) in [
            (Some(1000), Some(1001), 1000),
            (None, Some(1001), 1001),
            (Some(0), Some(1001), 1001),
            (Some(0), Some(0), NOBODY),
            (None, None, NOBODY),
        ] {
            assert_eq!(user_of_trial(caller, owner), user, "{caller:?} {owner:?}");
        }
    }
}
