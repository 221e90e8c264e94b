// SPDX-License-Identifier: GPL-3.0-or-later
//! The command line.

use super::FIGURES;
use super::guest_program::OtherProgram;
use pinion_testkit::arguments::Arguments;
use pinion_testkit::kernel::Flavour;

const USAGE: &str = "\
Usage: cargo test --test kernel -- [OPTIONS] [FILTERS...]

Runs the tests whose name, as in stock::gpio::a_held_line_names_its_consumer,
contains any of the filters.

Options:
  --exact            A filter is a whole name
  --skip FILTER      Leave out the tests whose name contains this
  --list             Print the names
  --nocapture        Show the output of tests that pass, too
  --flavour NAME     Only this kernel: stock or rt
  --program 'NAME=PATH [ARGUMENTS]'
                     Have the tests of figures measure this program of the
                     host, too: one that takes the options of Klipper's linux MCU
  --print-seconds N  Measure N seconds of each print with klippy, not 30
  --shell            A shell in the guest instead of tests; Ctrl-A X ends it";

/// The selected tests and the way to run them.
pub struct Options {
    arguments: Arguments,
    pub flavour: Option<Flavour>,
    pub programs: Vec<OtherProgram>,
    /// Length of the measured part of a print.
    pub print_seconds: u32,
    pub list: bool,
    pub show_output: bool,
    pub shell: bool,
}

impl Options {
    /// Exits after an error, and for `--help`.
    pub fn from_args() -> Options {
        let (mut flavour, mut programs, mut print_seconds, mut list, mut shell) = (None, Vec::new(), 30, false, false);
        let arguments = Arguments::read(USAGE, |option, value| {
            match option {
                "--list" => list = true,
                "--flavour" => flavour = Some(value()?.parse()?),
                "--program" => programs.push(value()?.parse()?),
                "--print-seconds" => {
                    print_seconds = value()?.parse().map_err(|_| "--print-seconds needs a whole number".to_owned())?;
                }
                "--shell" => shell = true,
                _ => return Ok(false),
            }
            Ok(true)
        });
        Options { show_output: arguments.show_output, arguments, flavour, programs, print_seconds, list, shell }
    }

    /// Whether the test runs on this flavor. The name is the test's name in the report.
    pub fn selects(&self, flavour: Flavour, name: &str) -> bool {
        self.flavour.is_none_or(|only| only == flavour)
            && self.arguments.selects(name)
            && (!name.contains(FIGURES) || self.arguments.has_filter())
    }
}
