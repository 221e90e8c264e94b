// SPDX-License-Identifier: GPL-3.0-or-later
//! Fields of the texts in /proc (proc(5)). docs/develop/architecture.md, "Data of others", says why not the crate
//! `procfs`.

#![forbid(unsafe_code)]

/// A field of /proc/PID/stat from the third on, by its number in proc_pid_stat(5).
pub fn stat_field(stat: &[u8], number: usize) -> Option<&str> {
    // The second field, the name in parentheses, may hold anything.
    let name_ends = stat.iter().rposition(|byte| *byte == b')')?;
    let fields = std::str::from_utf8(&stat[name_ends + 1..]).ok()?;
    fields.split_whitespace().nth(number.checked_sub(3)?)
}

/// A field of /proc/PID/status, such as `CapEff`.
pub fn status_field<'a>(status: &'a str, name: &str) -> Option<&'a str> {
    status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':')).map(str::trim)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_may_hold_anything() {
        let stat = b"42 (a\xff) S 1) S 4 5";
        assert_eq!(
            [2, 3, 4, 5, 6].map(|number| stat_field(stat, number)),
            [None, Some("S"), Some("4"), Some("5"), None]
        );
        assert_eq!([&b""[..], b")", b"("].map(|stat| stat_field(stat, 3)), [None; 3]);
        assert_eq!(stat_field(b") (", 3), Some("("), "no text makes it panic");
    }

    #[test]
    fn fields_of_a_status() {
        let status = "Name:\tUid: 3\nUid:\t1000\t1001\nGroups:\t\n";
        assert_eq!(status_field(status, "Uid"), Some("1000\t1001"));
        assert_eq!((status_field(status, "Groups"), status_field(status, "Gid")), (Some(""), None));
    }
}
