// SPDX-License-Identifier: GPL-3.0-or-later
//! Informs the service manager about the program's state: sd_notify(3).

use std::env;
use std::ffi::OsStr;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::Duration;

use pinion_firmware::trouble::Trouble;
use pinion_linux::foreign::plain;

use crate::trouble::refused;

/// A socket to the service manager, if there is one.
pub(crate) struct Notify(Option<UnixDatagram>);

impl Notify {
    /// Connects to the socket that the environment names in `NOTIFY_SOCKET`, if it names one.
    pub(crate) fn from_env() -> Result<Notify, Trouble> {
        match env::var_os("NOTIFY_SOCKET") {
            Some(name) => Notify::to(&name),
            None => Ok(Notify(None)),
        }
    }

    fn to(name: &OsStr) -> Result<Notify, Trouble> {
        let connect = || {
            let address = match name.as_bytes() {
                [b'@', rest @ ..] => SocketAddr::from_abstract_name(rest)?,
                _ => SocketAddr::from_pathname(name)?,
            };
            let socket = UnixDatagram::unbound()?;
            // The link sends these messages. It must not block on a busy service manager.
            socket.set_nonblocking(true)?;
            socket.connect_addr(&address)?;
            Ok(Notify(Some(socket)))
        };
        connect().map_err(|error: io::Error| {
            refused(format_args!("the service manager cannot be notified: NOTIFY_SOCKET {name:?}"), error)
                .remedy("let the service see /run/systemd")
        })
    }

    /// Sends assignments such as `READY=1`, one per line.
    pub(crate) fn send(&self, assignments: &str) {
        if let Some(socket) = &self.0 {
            // A lost message does no harm: state and watchdog messages are sent again and again.
            let _ = socket.send(assignments.as_bytes());
        }
    }

    /// Sends the line that `systemctl status` shows.
    pub(crate) fn status(&self, status: &str) {
        // A line feed would begin an assignment of its own.
        self.send(&format!("STATUS={}", plain(status)));
    }
}

/// How often the service manager gets a keepalive: at half of its limit (`WatchdogSec=`). `None` if it sets no limit.
pub(crate) fn watchdog_interval() -> Option<Duration> {
    let variable = |name| env::var(name).ok();
    interval(variable("WATCHDOG_USEC"), variable("WATCHDOG_PID"), std::process::id())
}

fn interval(usec: Option<String>, pid: Option<String>, own: u32) -> Option<Duration> {
    let usec: u64 = usec?.parse().ok()?;
    let ours = pid.is_none_or(|pid| pid.parse() == Ok(own));
    (ours && usec > 0).then(|| Duration::from_micros(usec / 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heard(socket: &UnixDatagram) -> String {
        let mut buffer = [0; 256];
        let len = socket.recv(&mut buffer).unwrap();
        String::from_utf8(buffer[..len].into()).unwrap()
    }

    #[test]
    fn a_socket_with_a_path() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        let notify = Notify::to(path.as_os_str()).unwrap();
        notify.send("READY=1\nSTATUS=serving");
        assert_eq!(heard(&socket), "READY=1\nSTATUS=serving");
    }

    #[test]
    fn an_abstract_socket() {
        let name = format!("pinion-test-{}", std::process::id());
        let socket = UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(&name).unwrap()).unwrap();
        let notify = Notify::to(OsStr::new(&format!("@{name}"))).unwrap();
        notify.status("host attached\nMAINPID=1");
        assert_eq!(heard(&socket), "STATUS=host attached?MAINPID=1");
    }

    #[test]
    fn nobody_reads_and_nobody_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let _socket = UnixDatagram::bind(&path).unwrap();
        let notify = Notify::to(path.as_os_str()).unwrap();
        for _ in 0..10_000 {
            notify.send("WATCHDOG=1");
        }
        let error = Notify::to(folder.path().join("other").as_os_str()).err().unwrap();
        assert!(error.to_string().contains("NOTIFY_SOCKET"), "{error}");
        Notify(None).send("READY=1");
    }

    #[test]
    fn intervals() {
        let text = |text: &str| Some(text.to_owned());
        assert_eq!(interval(text("3000000"), text("7"), 7), Some(Duration::from_millis(1500)));
        assert_eq!(interval(text("3000000"), None, 7), Some(Duration::from_millis(1500)));
        assert_eq!(interval(text("3000000"), text("8"), 7), None);
        assert_eq!(interval(text("0"), None, 7), None);
        assert_eq!(interval(text("soon"), None, 7), None);
        assert_eq!(interval(None, None, 7), None);
    }
}
