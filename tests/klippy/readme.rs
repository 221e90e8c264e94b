// SPDX-License-Identifier: GPL-3.0-or-later
//! The README's configuration, as a user copies it, given to klippy in batch mode.

use std::fs;
use std::process::Command;

use serde_json::{Value, json};

use crate::{checkout, klippy::python};

const README: &str = include_str!("../../README.md");
/// What a printer has beside.
const PRINTER: &str = "[mcu]\nserial: /dev/null\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n";
/// The names that it gives to pins of a computer, which this one has not got.
const PINS: [(&str, u32); 2] = [("GPIO17", 17), ("ads1115/voltage0", 4096)];

/// The lines from this one on that are indented, as a block of Markdown is.
fn block(first: &str) -> String {
    let lines = README.lines().skip_while(|line| line.trim() != first);
    let lines: Vec<&str> = lines.take_while(|line| line.is_empty() || line.starts_with("    ")).collect();
    lines.iter().map(|line| format!("{}\n", line.trim_start())).collect()
}

#[test]
fn klippy_takes_the_configuration_of_the_readme() {
    let Some(checkout) = checkout("klippy_takes_the_configuration_of_the_readme") else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let config = block("[mcu host]");
    assert!(config.contains("[temperature_sensor"), "the README has no such configuration any more: {config}");
    fs::write(path("printer.cfg"), format!("{PRINTER}{config}")).unwrap();
    let dictionary = Command::new(env!("CARGO_BIN_EXE_pinion")).arg("dict").output().unwrap().stdout;
    let mut dictionary: Value = serde_json::from_slice(&dictionary).unwrap();
    for (name, number) in PINS {
        assert!(config.contains(name), "{name}");
        dictionary["enumerations"]["pin"][name] = json!(number);
    }
    fs::write(path("dict"), dictionary.to_string()).unwrap();
    fs::write(path("g.gcode"), "SET_PIN PIN=light VALUE=1\n").unwrap();
    let batch = Command::new(python())
        .arg(checkout.join("klippy/klippy.py"))
        .arg(path("printer.cfg"))
        .arg("-i")
        .arg(path("g.gcode"))
        .arg("-o")
        .arg(path("out"))
        .arg("-d")
        .arg(path("dict"))
        .arg("-d")
        .arg(format!("host={}", path("dict").display()))
        .output()
        .unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&batch.stdout), String::from_utf8_lossy(&batch.stderr));
    assert!(batch.status.success() && !said.contains("Error"), "{said}\n{config}");
}
