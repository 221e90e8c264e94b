// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run` on the Pi's own pins.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;

use super::gpio::until;

/// The link to its terminal.
pub const LINK: &str = "/tmp/tty";
const LOG: &str = "/tmp/log";
/// Timeout of the client.
const CLIENT_TIMEOUT: Duration = Duration::from_secs(20);

/// How Pinion writes and reads the lines.
#[derive(Clone, Copy, Debug)]
pub enum Way {
    Kernel,
    /// The chip's registers. Debian's kernel has no `/dev/gpiomem`.
    Registers,
}

/// Tests of both ways, as `kernel::name` and `registers::name`, from functions that take a [`Way`].
macro_rules! both_ways {
    ($($name:ident),+ $(,)?) => {
        mod kernel {
            $(#[test]
            fn $name() {
                super::$name(super::Way::Kernel);
            })+
        }
        mod registers {
            $(#[test]
            fn $name() {
                super::$name(super::Way::Registers);
            })+
        }
    };
}
pub(super) use both_ways;

/// A running `pinion`, ended on drop. Its log is printed then.
pub struct Pinion(Child);

impl Pinion {
    /// Starts it in real time, as on a printer.
    pub fn start(way: Way) -> Pinion {
        Pinion::with(match way {
            Way::Kernel => "off",
            Way::Registers => "/dev/mem",
        })
    }

    /// The same with this value of `--fast-gpio`.
    pub fn with(fast_gpio: &str) -> Pinion {
        let _ = fs::remove_file(LINK);
        let log = File::create(LOG).expect("the log");
        let child =
            Command::new("pinion").args(["run", "-r", "-I", LINK, "--fast-gpio", fast_gpio]).stderr(log).spawn();
        Pinion(child.expect("pinion on the path"))
    }

    /// Waits until a line of the log contains this, and returns the line. A thread of its own writes the log.
    pub fn wait_for_line(&self, part: &str) -> String {
        let find = || {
            let log = fs::read_to_string(LOG).expect("the log");
            log.lines().find(|line| line.contains(part)).map(str::to_owned)
        };
        until(part, || find().is_some());
        find().expect("a line that was there")
    }

    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.0.id().cast_signed()), signal).expect("a process");
    }

    /// How long its core has had the processor, in nanoseconds of the guest's time.
    pub fn core_ns(&self) -> u64 {
        let threads = fs::read_dir(format!("/proc/{}/task", self.0.id())).expect("its threads");
        let read = |thread: &Path, file: &str| fs::read_to_string(thread.join(file)).unwrap_or_default();
        let threads = threads.map(|thread| thread.expect("a thread").path());
        let core = threads.into_iter().find(|thread| read(thread, "comm").trim() == "core").expect("a core");
        // The first number of schedstat.
        read(&core, "schedstat").split(' ').next().and_then(|ns| ns.parse().ok()).expect("a time")
    }

    /// Whether it has ended.
    pub fn has_ended(&mut self) -> bool {
        self.0.try_wait().expect("our child").is_some()
    }

    pub fn client(&self) -> Client {
        Client::connect(Path::new(LINK), CLIENT_TIMEOUT).expect("a micro-controller")
    }

    /// Kills it with SIGKILL.
    pub fn kill(&mut self) {
        self.0.kill().expect("a running program");
        self.0.wait().expect("its end");
    }
}

impl Drop for Pinion {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
        println!("--- pinion's log\n{}---", fs::read_to_string(LOG).unwrap_or_default());
    }
}
