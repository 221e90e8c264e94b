// SPDX-License-Identifier: GPL-3.0-or-later
//! The rights with which a user's files are read and written: the user's own.

use std::io;

use nix::unistd::{Gid, Uid, getegid, geteuid, getgroups, setegid, seteuid, setgroups};

/// The rights of a file's owner, for as long as this exists. Without root's rights it changes nothing.
pub struct Rights(Option<(Uid, Gid, Vec<Gid>)>);

impl Rights {
    /// Takes the rights of this user and group.
    ///
    /// # Errors
    ///
    /// The kernel refuses them.
    pub fn of(owner: Option<(u32, u32)>) -> io::Result<Rights> {
        let Some((uid, gid)) = owner.filter(|(uid, _)| *uid != 0 && geteuid().is_root()) else {
            return Ok(Rights(None));
        };
        let rights = Rights(Some((geteuid(), getegid(), getgroups()?)));
        setgroups(&[Gid::from_raw(gid)])?;
        setegid(Gid::from_raw(gid))?;
        seteuid(Uid::from_raw(uid))?;
        Ok(rights)
    }
}

impl Drop for Rights {
    fn drop(&mut self) {
        let Some((uid, gid, groups)) = self.0.take() else { return };
        let back = seteuid(uid).and_then(|()| setegid(gid)).and_then(|()| setgroups(&groups));
        if let Err(error) = back {
            // Nothing after this may run with a mixture of rights.
            log::error!("this program does not get root's rights back: {error}: run the command again");
            log::logger().flush();
            std::process::exit(1);
        }
    }
}
