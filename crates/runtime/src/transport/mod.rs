// SPDX-License-Identifier: GPL-3.0-or-later
//! The ways between a host and the MCU, in a file each. Each implements [`Transport`].

use std::fmt;
use std::io;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use pinion_firmware::mcu::Wire;
use pinion_firmware::trouble::Trouble;

pub mod can;
pub(crate) mod place;
pub(crate) mod pty;
mod serial;
pub(crate) mod served;
pub(crate) mod stdio;
pub(crate) mod terminal_group;

use can::{CanBus, CanbusUuid};
use pty::{Access, Pty};
use serial::SerialLine;
use stdio::Stdio;

/// The rate of a serial line if none is named: klippy's own default (`baud` in `[mcu]`).
const BAUD: u32 = 250_000;
/// The lowest rate that klippy accepts (`baud` in `[mcu]`).
const BAUD_MIN: u32 = 2400;
/// Terminals of a USB gadget are named so. Their rate means nothing.
const GADGET: &str = "ttyGS";

/// A way to the host, open or about to be opened again.
///
/// The thread that serves the host waits for [`Transport::event`] or [`Transport::due`], whichever is first. It then calls
/// [`Transport::read`].
pub(crate) trait Transport {
    /// Where the host finds the MCU, for example a path.
    fn place(&self) -> String;

    /// More about that place: the terminal behind a link, a rate, a UUID.
    fn detail(&self) -> String;

    /// The terminal that a host on this computer opens.
    fn terminal(&self) -> Option<&Path> {
        None
    }

    /// The wire, as the dictionary has it.
    fn wire(&self) -> Wire {
        Wire::Terminal
    }

    /// A descriptor: readable when there is something to read, writable when there is room for bytes. `None` while the
    /// link is closed.
    fn event(&self) -> Option<BorrowedFd<'_>>;

    /// When to read or write although the descriptor reports nothing (CLOCK_MONOTONIC).
    fn due(&self) -> Option<Duration> {
        None
    }

    /// Reads the bytes that have come. `hung_up`: the descriptor has hung up.
    ///
    /// # Errors
    ///
    /// The link does not work any more.
    fn read(&mut self, buffer: &mut [u8], hung_up: bool) -> io::Result<Input>;

    /// Writes as many bytes as there is room for. Returns how many.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize>;

    /// Call this when bytes came while no host was there. False: their writer has gone already.
    fn meet_host(&mut self) -> bool {
        true
    }

    /// How long a host that is there may be silent. klippy asks for the time each second. `None`: the kernel reports
    /// when a host goes.
    fn silence_max(&self) -> Option<Duration> {
        Some(Duration::from_secs(5))
    }

    /// The host is gone. Bytes that it has not read are dropped.
    fn part_from_host(&mut self) {}

    /// The fault of another program on the same wire, if it must stop the MCU.
    fn intrusion(&mut self) -> Option<pinion_firmware::shutdown::Shutdown> {
        None
    }
}

/// The program's use of the link's place. `is_open`: the link is not waiting for its port or interface.
pub(crate) fn serving(is_open: bool) -> &'static str {
    if is_open { "serving on" } else { "waiting for" }
}

/// The result of a read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Input {
    /// This many bytes came, or none.
    Bytes(usize),
    /// The host is gone.
    Gone,
    /// The host is gone, and no other can come.
    Over,
}

/// The name of a way to the host, as `--link` has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkName {
    /// A pseudo terminal, behind a symbolic link at this path.
    Pty(PathBuf),
    /// A serial port or the port of a USB gadget, with its rate in baud.
    Serial(PathBuf, Option<u32>),
    /// A CAN interface, and the node's UUID there. Without one it is this computer's.
    Can(String, Option<CanbusUuid>),
    /// Standard input and output.
    Stdio,
}

impl LinkName {
    /// Whether the host runs on this computer.
    pub fn is_local(&self) -> bool {
        matches!(self, LinkName::Pty(_))
    }

    /// Opens it. `access` is for a pseudo terminal.
    ///
    /// # Errors
    ///
    /// The path is taken, the port is another program's or not there, or the kernel refuses it.
    pub(crate) fn open(&self, access: &Access) -> Result<Box<dyn Transport>, Trouble> {
        Ok(match self {
            LinkName::Pty(path) => Box::new(Pty::open(path, access)?),
            LinkName::Serial(path, baud) => Box::new(SerialLine::open(path, *baud)?),
            LinkName::Can(interface, uuid) => Box::new(CanBus::open(interface, *uuid)?),
            LinkName::Stdio => Box::new(Stdio::open()?),
        })
    }
}

/// Whether the kernel may have a network interface of this name.
fn is_interface(name: &str) -> bool {
    (1..libc::IFNAMSIZ).contains(&name.len()) && !name.contains(['/', ' ']) && !name.starts_with('.')
}

impl FromStr for LinkName {
    type Err = String;

    fn from_str(text: &str) -> Result<LinkName, String> {
        let (kind, rest) = text.split_once(':').unwrap_or((text, ""));
        let (place, more) = rest.split_once(',').map_or((rest, None), |(place, more)| (place, Some(more)));
        match (kind, place, more) {
            // A path may contain a comma.
            ("pty", _, _) if !rest.is_empty() => Ok(LinkName::Pty(rest.into())),
            ("serial", port, _) if !port.is_empty() && !port.starts_with('/') => {
                Err(format!("{port} is not the path of a port, such as /dev/ttyAMA0"))
            }
            ("serial", port, None) if !port.is_empty() => {
                let is_gadget =
                    Path::new(port).file_name().is_some_and(|name| name.to_string_lossy().starts_with(GADGET));
                Ok(LinkName::Serial(port.into(), (!is_gadget).then_some(BAUD)))
            }
            ("serial", port, Some(baud)) if !port.is_empty() => match baud.parse() {
                Ok(baud) if baud >= BAUD_MIN => Ok(LinkName::Serial(port.into(), Some(baud))),
                Ok(baud) => Err(format!("klippy does not accept {baud} baud: name {BAUD_MIN} or more, such as {BAUD}")),
                Err(_) => Err(format!("{baud} is not a rate in baud, such as {BAUD}")),
            },
            ("can", interface, uuid) if is_interface(interface) => {
                Ok(LinkName::Can(interface.into(), uuid.map(str::parse).transpose()?))
            }
            ("stdio", "", None) => Ok(LinkName::Stdio),
            _ => Err("there are the links pty:PATH, serial:/dev/PORT[,BAUD], can:INTERFACE[,UUID] and stdio".into()),
        }
    }
}

impl fmt::Display for LinkName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            LinkName::Pty(path) => write!(f, "pty:{}", path.display()),
            LinkName::Serial(port, None) => write!(f, "serial:{}", port.display()),
            LinkName::Serial(port, Some(baud)) => write!(f, "serial:{},{baud}", port.display()),
            LinkName::Can(interface, None) => write!(f, "can:{interface}"),
            LinkName::Can(interface, Some(uuid)) => write!(f, "can:{interface},{uuid}"),
            LinkName::Stdio => f.write_str("stdio"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_have_names() {
        for (name, shown) in [
            ("pty:/tmp/a,b", "pty:/tmp/a,b"),
            ("serial:/dev/ttyAMA0", "serial:/dev/ttyAMA0,250000"),
            ("serial:/dev/ttyAMA0,115200", "serial:/dev/ttyAMA0,115200"),
            ("serial:/dev/ttyAMA0,2400", "serial:/dev/ttyAMA0,2400"),
            ("serial:/dev/ttyGS0", "serial:/dev/ttyGS0"),
            ("can:can0", "can:can0"),
            ("can:can0,0123456789AB", "can:can0,0123456789ab"),
            ("stdio", "stdio"),
        ] {
            let link: LinkName = name.parse().unwrap();
            assert_eq!(link.to_string(), shown);
            assert_eq!(shown.parse(), Ok(link));
        }
        for name in [
            "",
            "pty",
            "pty:",
            "serial:",
            "serial:,9600",
            "tcp:host",
            "can:",
            "can:../x",
            "can:can0,1",
            "stdio:x",
            "serial:/dev/ttyAMA0,fast",
            "serial:/dev/ttyAMA0,9",
            "serial:/dev/ttyAMA0,2399",
            "serial:/dev/ttyAMA0,-250000",
            "serial:/dev/ttyAMA0,99999999999",
            "serial:ttyS0",
            "serial:ttyS0,250000",
        ] {
            assert!(name.parse::<LinkName>().is_err(), "{name}");
        }
    }
}
