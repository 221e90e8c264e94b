// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim printer.cfg --try` on configurations of Klipper's own repository, as they are and with a mistake.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::checkout;
use crate::klippy::{pinion_path, python};

/// Tries a printer.cfg, and returns the results of its steps.
fn tried(checkout: &Path, cfg: &Path, steps: &[&str]) -> (bool, Vec<Value>) {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(pinion_path());
    command.args(["sim", "-r"]).arg(cfg).args(["--try", "--json", "--klipper"]).arg(checkout);
    command.args(["--python", &python(), "--folder"]).arg(folder.path().join("sim"));
    steps.iter().for_each(|step| _ = command.args(["--only", step]));
    let done = command.output().unwrap();
    let log = String::from_utf8_lossy(&done.stderr);
    let report: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|error| panic!("{error}\n{log}"));
    let passed = report["passed"].as_bool().unwrap();
    assert_eq!(done.status.success(), passed, "{report}\n{log}");
    (passed, report["steps"].as_array().unwrap().clone())
}

/// A cartesian printer, one with drivers on a UART and a probe, CoreXY on SPI, and a delta printer.
const PRINTERS: [&str; 4] = [
    "printer-creality-ender3-v2-2020.cfg",
    "printer-artillery-genius-pro-2022.cfg",
    "generic-bigtreetech-skr-v1.4.cfg",
    "printer-anycubic-kossel-2016.cfg",
];

#[test]
fn printers_of_klippers_own_repository_home_and_print() {
    let Some(checkout) = checkout("printers_of_klippers_own_repository_home_and_print") else { return };
    for name in PRINTERS {
        let (passed, steps) = tried(&checkout, &checkout.join("config").join(name), &["homed", "printed"]);
        assert!(passed, "{name}: {steps:?}");
        let names: Vec<&str> = steps.iter().map(|step| step["step"].as_str().unwrap()).collect();
        assert_eq!(names, ["ready", "homed", "printed"]);
    }
}

#[test]
fn a_mistake_fails_with_its_line() {
    let Some(checkout) = checkout("a_mistake_fails_with_its_line") else { return };
    let text = fs::read_to_string(checkout.join("config/printer-creality-ender3-v2-2020.cfg")).unwrap();
    for (from, to, step, words) in [
        ("[fan]\npin: PA0", "[fan]\npin: PA1", "ready", "pin PA1 used multiple times in config"),
        ("[fan]", "[fun]", "ready", "Section 'fun' is not a valid config section"),
        ("max_accel", "max_acceleration: 1\nmax_accel", "ready", "Option 'max_acceleration' is not valid"),
    ] {
        let changed = text.replacen(from, to, 1);
        assert_ne!(changed, text, "{from}");
        let line = changed[..changed.find(to).unwrap()].matches('\n').count() + to.matches('\n').count();
        let folder = tempfile::tempdir().unwrap();
        let cfg = folder.path().join("printer.cfg");
        fs::write(&cfg, changed).unwrap();
        let (passed, steps) = tried(&checkout, &cfg, &["homed"]);
        let failed = steps.iter().find(|found| found["step"] == step).unwrap();
        assert!(!passed && failed["result"] == "failed", "{steps:?}");
        assert!(failed["text"].as_str().unwrap().contains(words), "{failed}");
        let found = failed["line"].as_u64().unwrap() as usize;
        assert!(found.abs_diff(line + 1) <= 1, "{failed}: line {line}");
    }
}
