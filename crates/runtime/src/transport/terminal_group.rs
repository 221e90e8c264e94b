// SPDX-License-Identifier: GPL-3.0-or-later
//! The terminal's group: one judgment for the program that gives the terminal to it, and for `pinion run --check`.

use std::fmt;

use nix::unistd::{Gid, Group, User, getegid, geteuid, getgroups};

use pinion_firmware::trouble::Trouble;

/// The group if the configuration names none.
const USUAL: &str = "tty";
/// The effect of a group that the terminal cannot be given to.
pub const CLOSED: &str = "klippys of other users cannot open the terminal";

/// A group that may open the terminal.
pub struct TerminalGroup {
    name: String,
    gid: Gid,
}

impl TerminalGroup {
    /// The group with this name or number; without one `tty`.
    pub fn find(name: Option<&str>) -> Result<TerminalGroup, Trouble> {
        let name = name.unwrap_or(USUAL).to_owned();
        let gid = match name.parse() {
            Ok(gid) => Some(Gid::from_raw(gid)),
            Err(_) => Group::from_name(&name).ok().flatten().map(|group| group.gid),
        };
        match gid {
            Some(gid) => Ok(TerminalGroup { name, gid }),
            None => Err(Trouble::new(format!("there is no group {name}"))
                .remedy(format!("sudo groupadd --system {name}, or choose another with -g"))),
        }
    }

    pub(crate) fn gid(&self) -> u32 {
        self.gid.as_raw()
    }

    /// Whether this user may give files to the group.
    pub fn is_ours(&self) -> bool {
        geteuid().is_root() || self.gid == getegid() || getgroups().is_ok_and(|groups| groups.contains(&self.gid))
    }

    /// That the terminal cannot be given to the group, for this reason.
    pub fn refusal(&self, why: impl fmt::Display) -> Trouble {
        let TerminalGroup { name, gid } = self;
        let user = User::from_uid(geteuid()).ok().flatten().map_or_else(|| geteuid().to_string(), |user| user.name);
        let remedy = match gid.as_raw() {
            // Members of this group could do more than open a terminal.
            0 => "choose another group with -g, such as tty".to_owned(),
            _ => format!("sudo usermod -aG {name} {user}, and log in again, or choose another group with -g"),
        };
        Trouble::new(format!("the terminal cannot be given to the group {name}: {why}")).remedy(remedy)
    }
}

impl fmt::Display for TerminalGroup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}
