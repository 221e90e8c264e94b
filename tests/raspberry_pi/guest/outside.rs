// SPDX-License-Identifier: GPL-3.0-or-later
//! The world outside of the Pi's pins, which the host plays: it sees outputs change
//! and drives inputs. It is asked over the console, one line for each wish and one for
//! the answer.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;

const CONSOLE: &str = "/dev/ttyS1";

/// The host's end of every line.
pub struct Outside {
    to: File,
    from: BufReader<File>,
}

impl Outside {
    pub fn new() -> Outside {
        assert!(Path::new("/run/pinion-tests").exists(), "this drives pins: it runs on the emulated Pi only");
        let open = || OpenOptions::new().read(true).write(true).open(CONSOLE).expect("the console");
        Outside { to: open(), from: BufReader::new(open()) }
    }

    /// The level of a line, whoever drives it.
    pub fn level(&mut self, line: u32) -> bool {
        match self.ask(&format!("level {line}")).as_str() {
            "0" => false,
            "1" => true,
            other => panic!("level answered {other:?}"),
        }
    }

    /// Drives an input.
    pub fn drive(&mut self, line: u32, level: bool) {
        let answer = self.ask(&format!("drive {line} {}", u8::from(level)));
        assert_eq!(answer, "ok");
    }

    /// Drives an input as soon as an output has risen so many times, counted from the
    /// test's beginning.
    pub fn drive_after(&mut self, line: u32, level: bool, count: usize, watched: u32) {
        let level = u8::from(level);
        let answer = self.ask(&format!("drive {line} {level} after {count} rises of {watched}"));
        assert_eq!(answer, "ok");
    }

    /// Every level that an output took on since the test began, as digits. The level
    /// that it was given while it became an output is not among them.
    pub fn edges(&mut self, line: u32) -> String {
        self.ask(&format!("edges {line}"))
    }

    fn ask(&mut self, wish: &str) -> String {
        self.to.write_all(format!("raspberry-pi: {wish}\n").as_bytes()).expect("the console");
        let mut answer = String::new();
        self.from.read_line(&mut answer).expect("the console");
        answer.trim().to_owned()
    }
}
