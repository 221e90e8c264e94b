// SPDX-License-Identifier: GPL-3.0-or-later
//! Serial ports, through the kernel's terminals.

#![forbid(unsafe_code)]

use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::stat::{major, minor};
use nix::sys::termios::{ControlFlags, FlushArg, SetArg, cfmakeraw, tcdrain, tcflush, tcgetattr, tcsetattr};

use pinion_firmware::board::SerialPort;
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

use crate::gpio::not_permitted;
use crate::sys::{self, LineFaults};
use crate::{LOOK_AT_LOG, attributes};

/// The baud rates that a driver understands (TMC2209 data sheet, "UART Interface": 9600 to 500k). It measures the rate
/// from the first bits of each message.
const RATES_HZ: std::ops::RangeInclusive<u32> = 9_600..=500_000;
/// The rates for a port that does not have the wanted one, the nearest to 40,000 first.
const STANDARD_RATES_HZ: [u32; 4] = [38_400, 57_600, 19_200, 115_200];
/// Longest time that a port may need to take bytes.
const SEND_TIMEOUT: Duration = Duration::from_secs(1);
const NOT_WHOLE: &str = "look at the kernel's log (dmesg), plug its adapter in again, then FIRMWARE_RESTART";

/// A serial port of this computer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Uart {
    /// Its name in /dev, for example `ttyAMA1`.
    pub name: String,
    /// The numbers of its device.
    pub device: (u32, u32),
    /// Other names in /dev: `serial0`, and `serial/by-id/...` for a port on USB.
    pub links: Vec<String>,
    /// Whether the kernel writes its messages to the port.
    pub is_console: bool,
}

/// The serial ports in `class` (/sys/class/tty), in order. Terminals without hardware are no ports.
pub(super) fn scan(dev: &Path, class: &Path) -> Vec<Uart> {
    let consoles = attributes::text(&class.join("console/active")).unwrap_or_default();
    let links: Vec<(String, String)> = ["", "serial/by-id/"]
        .into_iter()
        .flat_map(|folder| attributes::names(&dev.join(folder)).into_iter().map(move |name| format!("{folder}{name}")))
        .filter(|name| name.starts_with("serial"))
        .filter_map(|name| attributes::target(&dev.join(&name)).map(|target| (name, target)))
        .collect();
    let port = |name: String| {
        let folder = class.join(&name);
        // The driver of PC ports makes terminals for ports that are not there. Their type is 0.
        if !folder.join("device").exists() || attributes::text(&folder.join("type")).is_some_and(|type_| type_ == "0") {
            return None;
        }
        let (major, minor) =
            attributes::text(&folder.join("dev"))?.split_once(':').map(|(a, b)| (a.parse(), b.parse()))?;
        Some(Uart {
            device: (major.ok()?, minor.ok()?),
            links: links.iter().filter(|(_, target)| *target == name).map(|(link, _)| link.clone()).collect(),
            is_console: consoles.split_whitespace().any(|console| console == name),
            name,
        })
    };
    attributes::names(class).into_iter().filter_map(port).collect()
}

/// Whether a file is a pseudo terminal (admin-guide/devices.txt: the majors of Unix98 PTY slaves).
pub fn is_pseudo_terminal(file: &Metadata) -> bool {
    file.file_type().is_char_device() && (136..=143).contains(&major(file.rdev()))
}

/// Opens the terminal at this path: raw, with eight data bits, no parity and one stop bit. No other program may open it
/// until the file is closed. The lock keeps out programs that ask for it, even those of root.
fn open_raw(path: &Path) -> Result<Flock<File>, Trouble> {
    let flags = libc::O_NOCTTY | libc::O_NONBLOCK;
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(flags)
        .open(path)
        .map_err(|error| cannot_open(path, &error))?;
    let file = Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, errno)| match errno {
        Errno::EWOULDBLOCK => in_use(),
        errno => Trouble::new(format!("it cannot be locked: {errno}")).remedy(LOOK_AT_LOG),
    })?;
    let mut settings = tcgetattr(&*file).map_err(no_port)?;
    // The kernel forgets this when the port is closed, however Pinion ends. But a pseudo terminal lives as long as the
    // program at its other end, for example socat, and would refuse the next Pinion.
    if !file.metadata().is_ok_and(|about| is_pseudo_terminal(&about)) {
        sys::make_exclusive(&*file).map_err(no_port)?;
    }
    cfmakeraw(&mut settings);
    settings.control_flags.remove(ControlFlags::CSTOPB | ControlFlags::CRTSCTS);
    // No modem line matters.
    settings.control_flags.insert(ControlFlags::CREAD | ControlFlags::CLOCAL);
    tcsetattr(&*file, SetArg::TCSANOW, &settings).map_err(no_port)?;
    Ok(file)
}

/// How far a port's real rate may be from the wanted one: a receiver still finds the tenth bit of a byte.
const RATE_ERROR_MAX: f64 = 0.025;

/// Finds the port that a path leads to, as far as that is possible without opening it.
///
/// # Errors
///
/// It is gone, no port, or the kernel's console.
pub fn find_line(path: &Path) -> Result<PathBuf, Trouble> {
    let found = || {
        let target = fs::canonicalize(path).map_err(|error| cannot_open(path, &error))?;
        let is_port = |about: Metadata| about.file_type().is_char_device() && is_terminal(about.rdev());
        if !fs::metadata(&target).is_ok_and(is_port) {
            return Err(no_port(Errno::ENOTTY));
        }
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let consoles = attributes::text(&Path::new(crate::places::TTY).join("console/active")).unwrap_or_default();
        if consoles.split_whitespace().any(|console| console == name) {
            return Err(console());
        }
        Ok(target)
    };
    found().map_err(|trouble| trouble.of(path.display()))
}

/// Whether one of the kernel's drivers of terminals and serial ports has this device.
fn is_terminal(device: u64) -> bool {
    // Without this file only opening shows it.
    let Ok(drivers) = fs::read_to_string("/proc/tty/drivers") else { return true };
    drivers.lines().any(|driver| has_device(driver, major(device), minor(device)))
}

/// A driver's line ends with its major number, its minor numbers such as `64-95`, and its type (fs/proc/proc_tty.c).
fn has_device(driver: &str, major: u64, minor: u64) -> bool {
    let mut words = driver.split_whitespace().rev().skip(1);
    let (Some(minors), Some(its_major)) = (words.next(), words.next()) else { return false };
    let (first, last) = minors.split_once('-').unwrap_or((minors, minors));
    let number = |text: &str| text.parse::<u64>().ok();
    number(its_major) == Some(major) && number(first) <= Some(minor) && Some(minor) <= number(last)
}

/// Opens a port as the line to a host, at this rate in baud. Without one it keeps its rate.
///
/// # Errors
///
/// It is gone, another program's, no port or the kernel's console, or it does not have the rate.
pub fn open_line(path: &Path, baud: Option<u32>) -> Result<Flock<File>, Trouble> {
    let target = find_line(path)?;
    let opened = || {
        let file = open_raw(&target)?;
        let Some(baud) = baud else { return Ok(file) };
        let real = sys::set_rate(&*file, baud).map_err(|error| {
            Trouble::new(format!("it does not have {baud} baud: {error}"))
                .remedy("name another rate, in printer.cfg too")
        })?;
        if (f64::from(real) / f64::from(baud) - 1.0).abs() > RATE_ERROR_MAX {
            return Err(Trouble::new(format!("the port rounds {baud} baud to {real}"))
                .remedy("name another rate, in printer.cfg too"));
        }
        Ok(file)
    };
    opened().map_err(|trouble| trouble.of(path.display()))
}

/// An open serial port: eight data bits, no parity, one stop bit. No other program may open it.
#[derive(Debug)]
pub(super) struct Port {
    /// The lock keeps out programs that ask for it, even those of root.
    file: Flock<File>,
    name: String,
    /// The faults so far, and whether the port counts them.
    faults: Option<LineFaults>,
}

impl Port {
    /// Opens a port at this rate, or at another one that it has.
    pub(super) fn open(dev: &Path, uart: &Uart, rate_hz: u32) -> Result<Port, Shutdown> {
        Port::try_open(dev, uart, rate_hz)
            .map_err(|trouble| Shutdown::because(reason::SERIAL_OPEN, trouble.of(dev.join(&uart.name).display())))
    }

    fn try_open(dev: &Path, uart: &Uart, rate_hz: u32) -> Result<Port, Trouble> {
        if uart.is_console {
            return Err(console());
        }
        let file = open_raw(&dev.join(&uart.name))?;
        set_rate(&file, rate_hz)?;
        let faults = sys::line_faults(&*file).ok();
        Ok(Port { file, name: uart.name.clone(), faults })
    }

    /// Waits until the port is readable or writable. False: not within the time.
    fn wait(&self, flags: PollFlags, limit: Duration) -> io::Result<bool> {
        let end = Instant::now() + limit;
        loop {
            let mut polled = [PollFd::new(self.file.as_fd(), flags)];
            // The kernel gets whole milliseconds.
            let left = end.saturating_duration_since(Instant::now()) + Duration::from_millis(1);
            match poll(&mut polled, PollTimeout::try_from(left).unwrap_or(PollTimeout::MAX)) {
                Ok(count) => return Ok(count > 0),
                Err(Errno::EINTR) => {}
                Err(errno) => return Err(errno.into()),
            }
        }
    }

    fn try_send(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        tcflush(&*self.file, FlushArg::TCIFLUSH)?;
        while !bytes.is_empty() {
            match (&*self.file).write(bytes) {
                Ok(count) => bytes = &bytes[count..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    if !self.wait(PollFlags::POLLOUT, SEND_TIMEOUT)? {
                        return Err(ErrorKind::TimedOut.into());
                    }
                }
                Err(error) => return Err(error),
            }
        }
        loop {
            match tcdrain(&*self.file) {
                Err(Errno::EINTR) => {}
                drained => return Ok(drained?),
            }
        }
    }

    fn try_receive(&mut self, bytes: &mut [u8], limit: Duration) -> io::Result<usize> {
        if !self.wait(PollFlags::POLLIN, limit)? {
            return Ok(0);
        }
        match (&*self.file).read(bytes) {
            // It was readable, so this is the end: the port is gone.
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(0),
            read => read,
        }
    }

    fn failed(&self, what: &str, error: &io::Error) -> Trouble {
        Trouble::new(format!("/dev/{} cannot {what}: {error}", self.name)).remedy(NOT_WHOLE)
    }
}

impl SerialPort for Port {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.try_send(bytes).map_err(|error| self.failed("send", &error))
    }

    fn receive(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble> {
        self.try_receive(bytes, limit).map_err(|error| self.failed("receive", &error))
    }

    fn faults(&mut self) -> Option<String> {
        let now = sys::line_faults(&*self.file).ok()?;
        let before = self.faults.replace(now)?;
        let counts = [
            (now.framing.wrapping_sub(before.framing), "framing error"),
            (now.overrun.wrapping_sub(before.overrun), "overrun"),
            (now.breaks.wrapping_sub(before.breaks), "break"),
        ];
        let counted = counts.iter().filter(|(count, _)| *count > 0);
        let words: Vec<String> =
            counted.map(|(count, what)| format!("{count} {what}{}", if *count == 1 { "" } else { "s" })).collect();
        (!words.is_empty()).then(|| words.join(", "))
    }
}

/// Sets the rate, or another one that the drivers of motors also understand.
fn set_rate(port: &File, rate_hz: u32) -> Result<(), Trouble> {
    let mut refused = String::new();
    for rate_hz in [rate_hz].into_iter().chain(STANDARD_RATES_HZ) {
        match sys::set_rate(port, rate_hz) {
            Ok(real_hz) if RATES_HZ.contains(&real_hz) => return Ok(()),
            Ok(real_hz) => refused = format!("the port rounds it to {real_hz}"),
            Err(error) => refused = error.to_string(),
        }
    }
    Err(Trouble::new(format!("it has neither {rate_hz} baud nor another rate: {refused}")).remedy("use another port"))
}

fn console() -> Trouble {
    Trouble::new("the kernel writes its messages to it").remedy(
        "remove its console= from the kernel's command line (on a Raspberry Pi in cmdline.txt, or with raspi-config), and reboot",
    )
}

fn in_use() -> Trouble {
    Trouble::new("another program uses it").remedy("end that program (pinion doctor names a login or Bluetooth)")
}

fn no_port(error: impl Into<io::Error>) -> Trouble {
    let error = error.into();
    Trouble::new(format!("this is not a working serial port: {error}"))
        .remedy("choose another (pinion pins lists them)")
}

fn cannot_open(path: &Path, error: &io::Error) -> Trouble {
    match error.kind() {
        ErrorKind::NotFound => Trouble::new("it is gone").remedy("plug its adapter in, then FIRMWARE_RESTART"),
        ErrorKind::PermissionDenied => not_permitted(path, error.raw_os_error().unwrap_or(libc::EACCES)),
        ErrorKind::ResourceBusy => in_use(),
        _ => Trouble::new(format!("it cannot be opened: {error}")).remedy(LOOK_AT_LOG),
    }
}

/// The error for a port that has gone since its name was published.
pub(super) fn gone() -> Shutdown {
    Shutdown::because(reason::SERIAL_OPEN, "this serial port is gone")
        .remedy("plug its adapter in, then FIRMWARE_RESTART (pinion pins lists the ports)")
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::OFlag;
    use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::thread;

    /// A pseudo terminal in place of a port. The test has the other end.
    fn open() -> (PtyMaster, Uart, Result<Port, Shutdown>) {
        let other_end = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY).unwrap();
        grantpt(&other_end).unwrap();
        unlockpt(&other_end).unwrap();
        let name = ptsname_r(&other_end).unwrap().strip_prefix("/dev/").unwrap().to_owned();
        let uart = Uart { name, device: (0, 0), links: vec![], is_console: false };
        let port = Port::open(Path::new("/dev"), &uart, 40_000);
        (other_end, uart, port)
    }

    #[test]
    fn a_port_is_a_device_of_a_driver_of_terminals() {
        for (line, device, is_its) in [
            ("serial               /dev/ttyS       4 64-95 serial", (4, 64), true),
            ("serial               /dev/ttyS       4 64-95 serial", (4, 95), true),
            ("serial               /dev/ttyS       4 64-95 serial", (4, 96), false),
            ("serial               /dev/ttyS       4 64-95 serial", (4, 63), false),
            ("serial               /dev/ttyS       4 64-95 serial", (5, 64), false),
            ("serial               /dev/ttyS       4      64 serial", (4, 64), true),
            ("serial               /dev/ttyS       4      64 serial", (4, 65), false),
            ("pty_slave            /dev/pts      136 0-1048575 pty:slave", (136, 7), true),
            ("", (0, 0), false),
            ("a b c d", (0, 0), false),
        ] {
            assert_eq!(has_device(line, device.0, device.1), is_its, "{line} {device:?}");
        }
        for other in ["/dev/null", "/dev/zero"] {
            let said = find_line(Path::new(other)).unwrap_err().to_string();
            assert!(said.starts_with(&format!("{other}: this is not a working serial port")), "{said}");
        }
    }

    const SOON: Duration = Duration::from_millis(20);
    const LONG: Duration = Duration::from_secs(10);

    #[test]
    fn each_byte_arrives_unchanged_in_both_directions() {
        let (mut other_end, _, port) = open();
        let mut port = port.unwrap();
        let all: Vec<u8> = (0..=255).collect();
        for bytes in all.chunks(8) {
            port.send(bytes).unwrap();
            let mut there = [0; 8];
            other_end.read_exact(&mut there).unwrap();
            assert_eq!(there, bytes);
            // The echo, and the answer.
            other_end.write_all(&there).unwrap();
            other_end.write_all(&there).unwrap();
            let mut back = Vec::new();
            while back.len() < 16 {
                let mut some = [0; 16];
                let count = port.receive(&mut some[back.len()..], LONG).unwrap();
                assert!(count > 0, "after {back:?}");
                back.extend_from_slice(&some[back.len()..][..count]);
            }
            assert_eq!(back, [bytes, bytes].concat());
        }
    }

    #[test]
    fn it_waits_for_a_byte_and_drops_what_came_before_a_message() {
        let (mut other_end, _, port) = open();
        let mut port = port.unwrap();
        let mut some = [0; 8];
        let began = Instant::now();
        assert_eq!(port.receive(&mut some, SOON).unwrap(), 0);
        assert!(began.elapsed() >= SOON);
        other_end.write_all(&[1, 2, 3]).unwrap();
        port.wait(PollFlags::POLLIN, LONG).unwrap();
        port.send(&[4]).unwrap();
        assert_eq!(port.receive(&mut some, SOON).unwrap(), 0, "they are dropped");
        let late = thread::spawn(move || {
            thread::sleep(SOON);
            other_end.write_all(&[5]).unwrap();
            other_end
        });
        assert_eq!((port.receive(&mut some, LONG).unwrap(), some[0]), (1, 5));
        drop(late.join().unwrap());
    }

    #[test]
    fn a_port_that_vanishes_fails() {
        let (other_end, _, port) = open();
        let mut port = port.unwrap();
        drop(other_end);
        let trouble = port.receive(&mut [0; 8], LONG).unwrap_err();
        assert!(trouble.to_string().contains("cannot receive: "), "{trouble}");
        let trouble = port.send(&[1]).unwrap_err();
        assert!(trouble.to_string().contains("cannot send: ") && trouble.remedy.is_some(), "{trouble}");
    }

    #[test]
    fn a_port_that_another_program_uses_is_refused() {
        let (_other_end, uart, port) = open();
        let again = Port::open(Path::new("/dev"), &uart, 40_000).unwrap_err();
        assert_eq!(again.reason, reason::SERIAL_OPEN);
        assert!(again.to_string().contains("another program uses it: end that program"), "{again}");
        drop(port);
        Port::open(Path::new("/dev"), &uart, 40_000).unwrap();
    }

    #[test]
    fn it_has_the_rate_and_eight_bits() {
        let (_other_end, _, port) = open();
        let port = port.unwrap();
        assert_eq!(sys::rate(&*port.file).unwrap(), 40_000);
        let settings = tcgetattr(&*port.file).unwrap();
        assert_eq!(settings.control_flags & ControlFlags::CSIZE, ControlFlags::CS8);
        assert!(!settings.control_flags.intersects(ControlFlags::PARENB | ControlFlags::CSTOPB));
    }

    #[test]
    fn what_is_no_port_is_refused() {
        let dev = tempfile::tempdir().unwrap();
        fs::write(dev.path().join("ttyS0"), "").unwrap();
        for (name, is_console, said) in [
            ("ttyS0", false, "ttyS0: this is not a working serial port"),
            ("ttyS1", false, "ttyS1: it is gone: plug"),
            ("ttyS0", true, "the kernel writes its messages to it: remove its console="),
        ] {
            let uart = Uart { name: name.into(), device: (0, 0), links: vec![], is_console };
            let stop = Port::open(dev.path(), &uart, 40_000).unwrap_err();
            assert!(stop.to_string().contains(said), "{stop}");
        }
    }

    #[test]
    fn ports_are_the_terminals_with_hardware() {
        let root = tempfile::tempdir().unwrap();
        let (dev, class) = (root.path().join("dev"), root.path().join("class"));
        fs::create_dir_all(dev.join("serial/by-id")).unwrap();
        for (name, device, type_) in [
            ("ttyAMA1", "204:65", Some("32")),
            ("ttyS0", "4:64", Some("0")),
            ("ttyS1", "4:65", Some("4")),
            ("ttyUSB0", "188:0", None),
        ] {
            fs::create_dir_all(class.join(name).join("device")).unwrap();
            fs::write(class.join(name).join("dev"), format!("{device}\n")).unwrap();
            type_.map_or(Ok(()), |type_| fs::write(class.join(name).join("type"), type_)).unwrap();
            fs::write(dev.join(name), "").unwrap();
        }
        fs::create_dir_all(class.join("tty0")).unwrap();
        fs::create_dir_all(class.join("console")).unwrap();
        fs::write(class.join("console/active"), "tty0 ttyS1\n").unwrap();
        symlink("ttyAMA1", dev.join("serial0")).unwrap();
        symlink("../../ttyUSB0", dev.join("serial/by-id/usb-FTDI-port0")).unwrap();
        let found = scan(&dev, &class);
        let port = |name: &str, device, links: &[&str], is_console| Uart {
            name: name.into(),
            device,
            links: links.iter().map(|link| (*link).to_owned()).collect(),
            is_console,
        };
        assert_eq!(
            found,
            [
                port("ttyAMA1", (204, 65), &["serial0"], false),
                port("ttyS1", (4, 65), &[], true),
                port("ttyUSB0", (188, 0), &["serial/by-id/usb-FTDI-port0"], false),
            ]
        );
    }
}
