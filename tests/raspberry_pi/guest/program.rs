// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run` on the Pi's own pins.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

use pinion_client::Client;

const LINK: &str = "/tmp/tty";
const LOG: &str = "/tmp/log";
/// Timeout of the client.
const CLIENT_TIMEOUT: Duration = Duration::from_secs(20);

/// A running `pinion`, ended on drop. Its log is printed then.
pub struct Pinion(Child);

impl Pinion {
    /// Starts it in real time, as on a printer.
    pub fn start() -> Pinion {
        let _ = fs::remove_file(LINK);
        let log = File::create(LOG).expect("the log");
        let child = Command::new("pinion").args(["run", "-r", "-I", LINK]).stderr(log).spawn();
        Pinion(child.expect("pinion on the path"))
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
