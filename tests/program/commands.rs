// SPDX-License-Identifier: GPL-3.0-or-later
//! The subcommands.

use std::fs;
use std::process::{Command, Stdio};

use nix::sys::signal::Signal;
use serde_json::Value;

use crate::process::{Pinion, closed_pipe, folder_with, output};

/// The built-in printer with a bed that is warm within seconds.
fn quick_printer() -> String {
    let printer = output(&["sim", "--print-board"]);
    let printer = String::from_utf8(printer.stdout).unwrap();
    let quick = printer.replace("heat_capacity_j_per_k = 400.0", "heat_capacity_j_per_k = 60.0");
    assert_ne!(quick, printer, "the built-in printer's bed is another one");
    quick
}

/// Whether this is what the demonstration says of an axis that was homed as far off as it may have
/// gone while the machine's timers were so late: without real time a busy computer sees to that.
fn comes_of_lateness(wrong: &str, late_us: f64) -> bool {
    // Every axis of the built-in printer homes at 4000 steps a second; each of the two times that
    // are compared may be late.
    let steps = 2.0 * 0.004 * late_us;
    let numbers = wrong.split(|c: char| !c.is_ascii_digit()).filter_map(|number| number.parse::<f64>().ok());
    let [went, expected, apart, allowed] = numbers.collect::<Vec<_>>()[..] else { return false };
    let beyond = apart.max((went - expected).abs()) - allowed;
    wrong.contains(" homed: endstop after ") && wrong.ends_with(" allowed") && beyond > 0.0 && beyond <= steps
}

#[test]
fn only_a_late_machine_may_home_worse_than_allowed() {
    let wrong =
        "WRONG x homed: endstop after 4820 steps (4800 expected), the second time 6 steps off, at most 3 allowed";
    assert!(comes_of_lateness(wrong, 2200.0) && !comes_of_lateness(wrong, 2100.0));
    assert!(!comes_of_lateness(&wrong.replace("4820", "4801").replace('6', "2"), 1e6), "something else is wrong");
    assert!(!comes_of_lateness(&format!("{wrong}; the second time it ended by PastEnd"), 1e6));
    assert!(!comes_of_lateness("WRONG heater_bed at target: 30.0 °C of 45 ± 1.0 °C for 3 s", 1e6));
}

#[test]
fn the_demonstration_is_right_and_draws_its_picture() {
    let (folder, toml) = folder_with("quick.toml", &quick_printer());
    let svg = folder.path().join("homing.svg");
    let args = ["sim", "-r", toml.to_str().unwrap(), "--demo", "--picture", svg.to_str().unwrap()];
    let mut pinion = Pinion::start(&args);
    let mut status = pinion.end();
    // Where the host itself, which has a quarter of a second, comes too late the machine stops.
    for _ in 0..2 {
        if !pinion.log().contains("shutdown: Timer too close: ") {
            break;
        }
        pinion = Pinion::start(&args);
        status = pinion.end();
    }
    let (out, log) = (pinion.out(), pinion.log());
    let late_us = log.rsplit_once(" us, at most ").unwrap().1.split_once(" us").unwrap().0.parse().unwrap();
    let wrong: Vec<&str> = out.lines().filter(|line| line.starts_with("WRONG ")).collect();
    assert!(wrong.iter().all(|wrong| comes_of_lateness(wrong, late_us)), "{out}\n{log}");
    let (code, verdict) =
        if wrong.is_empty() { (0, "\nall of it was right") } else { (1, "\nNOT all of it was right") };
    assert_eq!(status.code(), Some(code), "{out}\n{log}");
    for shown in ["identified", "x homed", "y homed", "z homed", "heater_bed at target", "no shutdown", verdict] {
        assert!(out.contains(shown), "no \"{shown}\" in:\n{out}");
    }
    assert!(fs::read_to_string(svg).unwrap().ends_with("</svg>\n"));
}

#[test]
fn the_demonstration_fails_where_something_is_wrong() {
    // Axes that stand against a wall at their endstops lose the steps of the way to a stop.
    let walled = quick_printer().replace("microsteps = 16", "microsteps = 16\novertravel_mm = 0.0");
    let (_folder, toml) = folder_with("walled.toml", &walled);
    let mut pinion = Pinion::start(&["sim", "-r", toml.to_str().unwrap(), "--demo"]);
    let status = pinion.end();
    assert_eq!(status.code(), Some(1), "{}", pinion.out());
    assert!(pinion.out().contains("NOT all of it was right"), "{}", pinion.out());
}

#[test]
fn a_demonstration_that_is_interrupted_ends_without_a_complaint() {
    let mut pinion = Pinion::start(&["sim"]);
    pinion.until("the homing", || pinion.out().contains("home x"));
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(!pinion.log().contains("ERROR"), "{}", pinion.log());
    assert!(!pinion.out().contains("until Ctrl-C"), "{}", pinion.out());
}

#[test]
fn dict_prints_what_identify_serves() {
    let (_folder, file) = folder_with("dict", "");
    let printed = output(&["dict", "--board", "sim", "-o", file.to_str().unwrap()]);
    assert!(printed.status.success());
    let pinion = Pinion::simulated(&[]);
    let served = pinion.client().dictionary().json().unwrap();
    assert_eq!(fs::read(&file).unwrap(), served);
    assert_eq!(output(&["dict", "--board", "sim"]).stdout, served);
}

/// The firmware's own dictionary, that of Klipper 84104bbbd (August 2026) built as `linux` process.
const KLIPPER_MASTER: &str = include_str!("../dictionaries/klipper-master.json");

/// Texts of the firmware's shutdowns that can not come about here: its threads, allocator, timers and
/// limits are not ours. No host matches on them (klippy/extras/error_mcu.py).
const NOT_OURS: [&str; 14] = [
    "Could not start DS18B20 reader thread",
    "Could not start DS18B20 reader thread (cond init)",
    "Could not start DS18B20 reader thread (mutex init)",
    "Error getting monotonic clock time",
    "Invalid move request size",
    "Message encode error",
    "Too many spi devices",
    "Unable to set non-blocking on spi device",
    "Unable to write to spi",
    "alloc_chunk failed",
    "alloc_chunks failed",
    "bus_type i2c unsupported",
    "bus_type spi unsupported",
    "sentinel timer called",
];

#[test]
fn the_dictionary_has_what_the_firmware_has() {
    let ours: Value = serde_json::from_slice(&output(&["dict"]).stdout).unwrap();
    let theirs: Value = serde_json::from_str(KLIPPER_MASTER).unwrap();
    for kind in ["commands", "responses"] {
        let mut formats: Vec<&str> = ours[kind].as_object().unwrap().keys().map(String::as_str).collect();
        formats.sort_unstable();
        let wanted: Vec<&str> = theirs[kind].as_array().unwrap().iter().filter_map(Value::as_str).collect();
        assert_eq!(formats, wanted, "{kind}");
    }
    for (name, value) in theirs["config"].as_object().unwrap() {
        assert_eq!(&ours["config"][name], value, "{name}");
    }
    assert!(ours["config"]["RECEIVE_WINDOW"].as_u64().is_some_and(|window| window >= 512));
    for (enumeration, names) in theirs["enumerations"].as_object().unwrap() {
        for (name, value) in names.as_object().unwrap() {
            assert_eq!(&ours["enumerations"][enumeration][name], value, "{enumeration} {name}");
        }
    }
    let texts = ours["enumerations"]["static_string_id"].as_object().unwrap();
    let missing: Vec<&str> = theirs["static_strings"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    let missing: Vec<&str> = missing.into_iter().filter(|text| !texts.contains_key(*text)).collect();
    assert_eq!(missing, NOT_OURS);
    for key in ["version", "build_versions", "app", "license"] {
        assert!(ours[key].as_str().is_some_and(|text| !text.is_empty()), "{key}");
    }
}

#[test]
fn a_board_that_is_none_is_explained() {
    let (_folder, toml) = folder_with("bad.toml", "[[axis]]\nname = \"x\"\nstep_pin = \"s\"\nwheels = 4\n");
    let board = format!("sim:{}", toml.display());
    let mut pinion = Pinion::start(&["run", "--board", &board]);
    assert_eq!(pinion.end().code(), Some(1));
    assert!(pinion.log().contains("wheels"), "{}", pinion.log());
    let refused = output(&["run", "--board", "toaster"]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("linux, sim and sim:FILE.toml"));
}

#[test]
fn latency_judges_the_machine() {
    let (_folder, svg) = folder_with("latency.svg", "");
    let measured = output(&["latency", "--seconds", "2", "--svg", svg.to_str().unwrap()]);
    let text = String::from_utf8(measured.stdout).unwrap();
    assert!(measured.status.success(), "{text}");
    for part in ["idle:", "under load:", "wake-ups", "edges", "verdict: "] {
        assert!(text.contains(part), "no \"{part}\" in:\n{text}");
    }
    assert!(fs::read_to_string(svg).unwrap().ends_with("</svg>\n"));
}

#[test]
fn a_reader_that_has_seen_enough_changes_nothing_but_what_is_printed() {
    for args in [
        &["sim", "--print-config"][..],
        &["sim", "--print-board"],
        &["dict", "--board", "sim"],
        &["pins"],
        &["latency", "--seconds", "2"],
    ] {
        let child = Command::new(env!("CARGO_BIN_EXE_pinion"))
            .args(args)
            .stdout(closed_pipe())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let closed = child.wait_with_output().unwrap();
        let log = String::from_utf8(closed.stderr).unwrap();
        assert!(!log.contains("panicked"), "{args:?}: {log}");
        // A machine without pins has none to list.
        let expected = if args == ["pins"] { output(args).status.code() } else { Some(0) };
        assert_eq!(closed.status.code(), expected, "{args:?}: {log}");
    }
}

#[test]
fn a_simulated_printer_of_which_nobody_reads_goes_on_to_serve_its_host() {
    let (folder, toml) = folder_with("quick.toml", &quick_printer());
    let log = fs::File::create(folder.path().join("log")).unwrap();
    let mut pinion = Pinion::start_to(folder, &["sim", "-r", toml.to_str().unwrap()], closed_pipe(), log);
    // The demonstration's own host leaves at its end.
    pinion.logged("host gone");
    let mut client = pinion.client();
    assert!(!client.status().unwrap().is_shutdown);
    drop(client);
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(!pinion.log().contains("panicked"), "{}", pinion.log());
}
