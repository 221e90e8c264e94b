// SPDX-License-Identifier: GPL-3.0-or-later
//! The world outside the Pi's pins, simulated by the computer: it sees outputs change and drives inputs. Requests go
//! over the console, with one line for each request and one for the answer.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;

const CONSOLE: &str = "/dev/ttyS1";

/// The computer's end of every line.
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

    /// The level of a line, whatever drives it.
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

    /// Drives an input as soon as an output has risen this many times since the test's beginning.
    pub fn drive_after(&mut self, line: u32, level: bool, count: usize, watched: u32) {
        let level = u8::from(level);
        let answer = self.ask(&format!("drive {line} {level} after {count} rises of {watched}"));
        assert_eq!(answer, "ok");
    }

    /// All levels of an output since the test began, as digits, without its level when it became an output.
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
