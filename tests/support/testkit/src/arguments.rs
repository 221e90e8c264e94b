// SPDX-License-Identifier: GPL-3.0-or-later
//! The command line of a suite that is its own test harness: the useful part of libtest's options.

use std::env;
use std::process;

/// The selected tests and the way to show them.
#[derive(Default)]
pub struct Arguments {
    filters: Vec<String>,
    skips: Vec<String>,
    exact: bool,
    only_ignored: bool,
    /// Show the output of tests that pass, too.
    pub show_output: bool,
}

/// Takes the value of an option.
pub type Value<'a> = &'a mut dyn FnMut() -> Result<String, String>;

impl Arguments {
    /// `own` takes an option of the suite's own. It returns false for an unknown option. The program exits after an
    /// error, and for `--help`.
    pub fn read(usage: &str, own: impl FnMut(&str, Value) -> Result<bool, String>) -> Arguments {
        if env::args().skip(1).any(|arg| arg == "-h" || arg == "--help") {
            println!("{usage}");
            process::exit(0)
        }
        Arguments::parse(env::args().skip(1), own).unwrap_or_else(|mistake| {
            eprintln!("{mistake}\n\n{usage}");
            process::exit(2)
        })
    }

    fn parse(
        args: impl Iterator<Item = String>,
        mut own: impl FnMut(&str, Value) -> Result<bool, String>,
    ) -> Result<Arguments, String> {
        let mut read = Arguments::default();
        // `--name=value` and `--name value` mean the same.
        let mut args = args.flat_map(|arg| match arg.split_once('=') {
            Some((name, value)) if name.starts_with("--") => vec![name.into(), value.into()],
            _ => vec![arg],
        });
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
            match arg.as_str() {
                "--exact" => read.exact = true,
                "--skip" => read.skips.push(value()?),
                "--nocapture" | "--no-capture" | "--show-output" => read.show_output = true,
                "--ignored" => read.only_ignored = true,
                // `cargo test -- ...` passes the same words to every test program.
                "--include-ignored" | "-q" | "--quiet" => {}
                "--test-threads" | "--color" | "--format" => drop(value()?),
                option if option.starts_with('-') => {
                    if !own(option, &mut value)? {
                        return Err(format!("unknown option {option}"));
                    }
                }
                filter => read.filters.push(filter.into()),
            }
        }
        Ok(read)
    }

    /// Whether a test with this name runs.
    pub fn selects(&self, name: &str) -> bool {
        let matches = |filter: &String| match self.exact {
            true => name == *filter,
            false => name.contains(filter),
        };
        !self.only_ignored
            && (self.filters.is_empty() || self.filters.iter().any(matches))
            && !self.skips.iter().any(matches)
    }

    /// Whether the command line names tests.
    pub fn has_filter(&self) -> bool {
        !self.filters.is_empty()
    }

    /// The selection, for another program with libtest.
    pub fn for_libtest(&self) -> Vec<&str> {
        let skips = self.skips.iter().flat_map(|skip| ["--skip", skip]);
        let flags = [("--exact", self.exact), ("--ignored", self.only_ignored)];
        let flags = flags.into_iter().filter_map(|(flag, is_set)| is_set.then_some(flag));
        self.filters.iter().map(String::as_str).chain(skips).chain(flags).collect()
    }
}
