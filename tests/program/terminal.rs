// SPDX-License-Identifier: GPL-3.0-or-later
//! The program at a terminal, as a person uses it.

use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::signal::{Signal, kill};
use nix::sys::termios::{LocalFlags, Termios, tcgetattr};
use nix::unistd::Pid;

use crate::process::WAIT_MAX;

/// A program at a terminal of its own, ended on drop.
pub struct AtTerminal {
    child: Child,
    /// `None` after a hang-up.
    master: Option<PtyMaster>,
    slave: File,
    /// The terminal's settings before the program.
    before: Termios,
    shown: Vec<u8>,
    /// Length of `shown` at the last key.
    at_key: usize,
}

impl AtTerminal {
    /// Starts a program with these arguments. Its log goes to `log`; `None` is the terminal.
    pub fn start(command: &mut Command, rows: u16, log: Option<Stdio>) -> AtTerminal {
        // No other child may inherit the master end, because it would keep the terminal open.
        let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC | OFlag::O_NONBLOCK;
        let master = posix_openpt(flags).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let mut options = File::options();
        options.read(true).write(true).custom_flags(OFlag::O_NOCTTY.bits());
        let slave = options.open(ptsname_r(&master).unwrap()).unwrap();
        let end = || Stdio::from(slave.try_clone().unwrap());
        resize(&slave, rows, 100);
        let before = tcgetattr(&slave).unwrap();
        command.stdin(end()).stdout(end()).stderr(log.unwrap_or_else(end));
        // A group of its own, as a shell gives it. In a group whose parents are all in other sessions, as the tests' may
        // be, the kernel stops no process by SIGTSTP.
        let child = command.process_group(0).spawn().unwrap();
        AtTerminal { child, master: Some(master), slave, before, shown: Vec::new(), at_key: 0 }
    }

    /// Everything that the terminal has shown.
    pub fn shown(&self) -> String {
        String::from_utf8_lossy(&self.shown).into_owned()
    }

    /// Whether there was something to read.
    fn read(&mut self) -> bool {
        let mut piece = [0; 4096];
        let read = self.master.as_mut().and_then(|master| master.read(&mut piece).ok()).unwrap_or(0);
        self.shown.extend(&piece[..read]);
        read > 0
    }

    /// Reads until there is a result.
    #[track_caller]
    pub fn wait_for<T>(&mut self, what: &str, mut result: impl FnMut(&mut AtTerminal) -> Option<T>) -> T {
        let end = Instant::now() + WAIT_MAX;
        loop {
            if let Some(result) = result(self) {
                return result;
            }
            assert!(Instant::now() < end, "waited in vain for {what}:\n{}", self.shown());
            if !self.read() {
                thread::sleep(Duration::from_millis(10));
            }
        }
    }

    /// Waits until the terminal has shown this since the last key.
    #[track_caller]
    pub fn until(&mut self, text: &str) {
        self.wait_for(&format!("{text:?}"), |terminal| {
            String::from_utf8_lossy(&terminal.shown[terminal.at_key..]).contains(text).then_some(())
        });
    }

    pub fn press(&mut self, keys: &str) {
        while self.read() {}
        self.at_key = self.shown.len();
        self.master.as_mut().unwrap().write_all(keys.as_bytes()).unwrap();
    }

    /// Gives the terminal another size, as a window does.
    pub fn resize(&mut self, rows: u16, columns: u16) {
        while self.read() {}
        self.at_key = self.shown.len();
        resize(&self.slave, rows, columns);
    }

    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.pid() as i32), signal).unwrap();
    }

    /// Waits for the program's end, and reads the rest of its output.
    #[track_caller]
    pub fn ended(&mut self) -> ExitStatus {
        let status = self.wait_for("the program's end", |terminal| terminal.child.try_wait().unwrap());
        while self.read() {}
        status
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Closes the terminal, as an ssh session that is lost.
    pub fn hang_up(&mut self) {
        self.master = None;
    }

    pub fn slave(&self) -> &File {
        &self.slave
    }

    /// Whether the program gets each key at once.
    pub fn gives_keys(&self) -> bool {
        !tcgetattr(&self.slave).unwrap().local_flags.contains(LocalFlags::ICANON)
    }

    /// Whether the terminal's settings are as before the program.
    pub fn is_given_back(&self) -> bool {
        tcgetattr(&self.slave).unwrap() == self.before
    }
}

fn resize(terminal: &File, rows: u16, columns: u16) {
    let mut size = Command::new("stty");
    size.args(["rows", &rows.to_string(), "cols", &columns.to_string()]).stdin(terminal.try_clone().unwrap());
    assert!(size.status().unwrap().success());
}

impl Drop for AtTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
