// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion-sim` from outside. Most of its tests are those of `pinion sim` in `tests/program`; for them too,
//! cargo builds the program because this test is here.

use std::process::{Command, Output};

fn pinion_sim(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_pinion-sim")).args(arguments).output().expect("the program")
}

#[test]
fn it_says_its_version_and_what_it_can_do() {
    let version = pinion_sim(&["--version"]);
    assert!(version.status.success());
    let version = String::from_utf8(version.stdout).unwrap();
    assert!(version.contains(env!("CARGO_PKG_VERSION")), "{version}");
    let help = String::from_utf8(pinion_sim(&["--help"]).stdout).unwrap();
    for command in ["run", "dict", "console"] {
        assert!(help.lines().any(|line| line.trim_start().starts_with(command)), "{command}: {help}");
    }
}

#[test]
fn a_printer_that_is_not_there_is_refused() {
    let refused = pinion_sim(&["/nonexistent/printer.cfg"]);
    assert_eq!(refused.status.code(), Some(1));
    let error = String::from_utf8(refused.stderr).unwrap();
    assert!(error.contains("/nonexistent/printer.cfg: Unable to open config file"), "{error}");
}
