// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices by the names that a host or a link gives them.
//!
//! A name may be anything: a configuration, a link in /tmp or a false host chose it. A finding says who may
//! get access to the file behind the name. So a name counts only if it means a device of the expected kind.

use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use nix::sys::stat::{major, minor};

use super::Computer;
use pinion_linux::uart::is_pseudo_terminal;

/// A serial port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Port {
    /// Its own name in /dev, such as `ttyAMA0`.
    There(String),
    /// Nothing has this name.
    Missing,
    /// The name cannot be one of a serial port, or it is another file's.
    Other,
}

impl Computer {
    /// The serial port of a name such as `ttyAMA0`, `serial0` or `serial/by-id/usb-FTDI-port0`, the names that Pinion
    /// gives to ports (pinion-linux, `uart.rs`).
    pub fn port(&self, name: &str) -> Port {
        let is_name = |name: &str| {
            let is_usual = |c: char| c.is_ascii_alphanumeric() || "_.:+-".contains(c);
            name.chars().all(is_usual) && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        };
        let own = |name: &str| name.strip_prefix("tty").is_some_and(|rest| !rest.is_empty());
        let by_link = name.strip_prefix("serial/by-id/").or_else(|| name.strip_prefix("serial/by-path/"));
        if !is_name(by_link.unwrap_or(name)) || by_link.is_none() && !own(name) && !name.starts_with("serial") {
            return Port::Other;
        }
        let Ok(way) = self.follow(&Path::new("/dev").join(name)) else { return Port::Missing };
        let found = way.last().map(PathBuf::as_path).unwrap_or(Path::new(""));
        // The target of a link in a folder of /dev begins with `../../`.
        let device = found.file_name().and_then(|name| name.to_str()).filter(|device| own(device) && is_name(device));
        let is_it = |device: &&str| {
            let at = self.path(format!("/dev/{device}"));
            let same = fs::canonicalize(found).is_ok_and(|found| fs::canonicalize(&at).is_ok_and(|at| at == found));
            same && fs::symlink_metadata(at).is_ok_and(|about| self.is_device(&about, "tty"))
        };
        device.filter(is_it).map_or(Port::Other, |device| Port::There(device.to_owned()))
    }

    /// Whether this file is a pseudo terminal on /dev/pts.
    pub fn is_terminal(&self, path: &Path, about: &fs::Metadata) -> bool {
        let number = self.name(path).to_str().and_then(|path| path.strip_prefix("/dev/pts/")?.parse::<u32>().ok());
        number.is_some() && (!self.is_this() || is_pseudo_terminal(about))
    }

    /// Whether a file is a device of this subsystem. The /dev of a system that does not run has no devices.
    fn is_device(&self, about: &fs::Metadata, subsystem: &str) -> bool {
        if !about.file_type().is_char_device() {
            return !self.is_this() && about.is_file();
        }
        self.subsystem(about).is_none_or(|own| own == subsystem)
    }

    /// The subsystem of a device. `None` if it is unknown.
    pub fn subsystem(&self, device: &fs::Metadata) -> Option<String> {
        let (major, minor) = (major(device.rdev()), minor(device.rdev()));
        let subsystem = fs::read_link(self.path(format!("/sys/dev/char/{major}:{minor}/subsystem"))).ok()?;
        Some(subsystem.file_name()?.to_string_lossy().into_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    #[test]
    fn a_port_is_what_udev_names_so_and_nothing_else() {
        let tree = Tree::empty();
        for file in [
            "dev/ttyAMA0",
            "dev/ttyUSB0",
            "dev/sda",
            "dev/serial/by-id/x",
            "etc/shadow",
            "etc/ttyS9",
            "run/docker.sock",
        ] {
            tree.put(file, "");
        }
        tree.link("dev/serial0", "ttyAMA0");
        tree.link("dev/serial1", "/dev/ttyUSB0");
        tree.link("dev/serial/by-id/usb-FTDI-port0", "../../ttyUSB0");
        tree.link("dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0", "../../ttyUSB0");
        let port = |name: &str| tree.computer().port(name);
        for (name, device) in [
            ("ttyAMA0", "ttyAMA0"),
            ("serial0", "ttyAMA0"),
            ("serial1", "ttyUSB0"),
            ("serial/by-id/usb-FTDI-port0", "ttyUSB0"),
            ("serial/by-path/pci-0000:00:14.0-usb-0:1:1.0", "ttyUSB0"),
        ] {
            assert_eq!(port(name), Port::There(device.to_owned()), "{name}");
        }
        assert_eq!([port("ttyUSB1"), port("serial2"), port("serial/by-id/usb-gone")], [const { Port::Missing }; 3]);
        // Links that lead to another kind of file, or out of /dev.
        tree.link("dev/ttyX0", "sda");
        tree.link("dev/ttyX1", "../etc/shadow");
        tree.link("dev/ttyX2", "/run/docker.sock");
        tree.link("dev/ttyX3", "../etc/ttyS9");
        tree.link("dev/ttyX4", "/etc/ttyS9");
        tree.put("dev/ttyS9", "");
        for name in [
            "serial/../sda",
            "serial/../../run/docker.sock",
            "serial/by-id/../../sda",
            "serial/by-id/..",
            "serial/by-id/",
            "serial/by-id/x",
            "serial/x/ttyAMA0",
            "ttyAMA0/../sda",
            "tty/../sda",
            "../dev/ttyAMA0",
            "/dev/ttyAMA0",
            "tty",
            "",
            "sda",
            "ttyX0",
            "ttyX1",
            "ttyX2",
            "ttyX3",
            "ttyX4",
            "ttyS0;reboot",
            "ttyS0 $(id)",
            "tty\u{202e}0",
        ] {
            assert_eq!(port(name), Port::Other, "{name}");
        }
        // A folder is no port.
        tree.put("dev/ttyFolder/x", "");
        assert_eq!(port("ttyFolder"), Port::Other);
    }

    #[test]
    fn of_the_running_system_the_kind_of_the_device_counts() {
        let here = Computer::at(Path::new("/"));
        let about = |path: &str| fs::metadata(path).unwrap();
        assert!(!here.is_terminal(Path::new("/dev/null"), &about("/dev/null")));
        assert!(!here.is_terminal(Path::new("/dev/pts/0"), &about("/etc/passwd")));
        assert!(!here.is_device(&about("/etc/passwd"), "tty") && !here.is_device(&about("/dev/null"), "tty"));
        let pty = nix::pty::openpty(None, None).unwrap();
        let terminal = nix::unistd::ttyname(&pty.slave).unwrap();
        assert!(here.is_terminal(&terminal, &fs::metadata(&terminal).unwrap()), "{terminal:?}");
    }
}
