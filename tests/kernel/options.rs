// SPDX-License-Identifier: GPL-3.0-or-later
//! The command line: the useful part of libtest's options, and the suite's own.

use std::env;
use std::process;

use super::guest_program::OtherProgram;
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
  --shell            A shell in the guest instead of tests; Ctrl-A X ends it";

/// The selected tests and the way to run them.
#[derive(Default)]
pub struct Options {
    filters: Vec<String>,
    skips: Vec<String>,
    exact: bool,
    only_ignored: bool,
    pub flavour: Option<Flavour>,
    pub programs: Vec<OtherProgram>,
    pub list: bool,
    pub show_output: bool,
    pub shell: bool,
}

impl Options {
    /// Exits after an error, and for `--help`.
    pub fn from_args() -> Options {
        Options::parse(env::args().skip(1)).unwrap_or_else(|mistake| {
            eprintln!("{mistake}\n\n{USAGE}");
            process::exit(2)
        })
    }

    fn parse(args: impl Iterator<Item = String>) -> Result<Options, String> {
        let mut options = Options::default();
        // `--name=value` and `--name value` mean the same.
        let mut args = args.flat_map(|arg| match arg.split_once('=') {
            Some((name, value)) if name.starts_with("--") => vec![name.into(), value.into()],
            _ => vec![arg],
        });
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
            match arg.as_str() {
                "-h" | "--help" => {
                    println!("{USAGE}");
                    process::exit(0)
                }
                "--exact" => options.exact = true,
                "--skip" => options.skips.push(value()?),
                "--list" => options.list = true,
                "--nocapture" | "--no-capture" | "--show-output" => options.show_output = true,
                "--flavour" => options.flavour = Some(value()?.parse()?),
                "--program" => options.programs.push(value()?.parse()?),
                "--shell" => options.shell = true,
                "--ignored" => options.only_ignored = true,
                // `cargo test -- ...` passes the same words to every test program.
                "--include-ignored" | "-q" | "--quiet" => {}
                "--test-threads" | "--color" | "--format" => drop(value()?),
                unknown if unknown.starts_with('-') => {
                    return Err(format!("unknown option {unknown}"));
                }
                filter => options.filters.push(filter.into()),
            }
        }
        Ok(options)
    }

    /// Whether the test runs on this flavor. The name is the test's name in the report.
    pub fn selects(&self, flavour: Flavour, name: &str) -> bool {
        let matches = |filter: &String| match self.exact {
            true => name == *filter,
            false => name.contains(filter),
        };
        !self.only_ignored
            && self.flavour.is_none_or(|only| only == flavour)
            && (self.filters.is_empty() || self.filters.iter().any(matches))
            && !self.skips.iter().any(matches)
    }
}
