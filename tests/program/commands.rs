// SPDX-License-Identifier: GPL-3.0-or-later
//! The subcommands.

use std::fs;

use nix::sys::signal::Signal;

use crate::process::{Pinion, folder_with, output};

/// The built-in printer with a bed that is warm within seconds.
fn quick_printer() -> String {
    let printer = output(&["sim", "--print-board"]);
    let printer = String::from_utf8(printer.stdout).unwrap();
    let quick = printer.replace("heat_capacity_j_per_k = 400.0", "heat_capacity_j_per_k = 60.0");
    assert_ne!(quick, printer, "the built-in printer's bed is another one");
    quick
}

#[test]
fn the_demonstration_is_right_and_draws_its_picture() {
    let (folder, toml) = folder_with("quick.toml", &quick_printer());
    let svg = folder.path().join("homing.svg");
    let mut pinion =
        Pinion::start(&["sim", "-r", toml.to_str().unwrap(), "--demo", "--picture", svg.to_str().unwrap()]);
    assert_eq!(pinion.end().code(), Some(0), "{}\n{}", pinion.out(), pinion.log());
    let out = pinion.out();
    for shown in ["identified", "x homed", "y homed", "z homed", "heater_bed at target", "all of it was right"] {
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

#[test]
fn the_dictionary_has_what_the_firmware_has() {
    let dictionary = output(&["dict"]).stdout;
    let dictionary: serde_json::Value = serde_json::from_slice(&dictionary).unwrap();
    let config = &dictionary["config"];
    for (name, value) in [
        ("CLOCK_FREQ", 50_000_000),
        ("ADC_MAX", 4095),
        ("PWM_MAX", 32768),
        ("STATS_SUMSQ_BASE", 256),
        ("STEPPER_STEP_BOTH_EDGE", 1),
    ] {
        assert_eq!(config[name], value, "{name}");
    }
    assert_eq!(config["MCU"], "linux");
    assert!(config["RECEIVE_WINDOW"].as_u64().is_some_and(|window| window >= 512));
    let pins = &dictionary["enumerations"]["pin"];
    assert_eq!(pins["gpio0"], serde_json::json!([0, 288]));
    assert_eq!(pins["gpiochip8/gpio0"], serde_json::json!([2304, 288]));
    assert_eq!(pins["analog0"], serde_json::json!([4096, 8]));
    for key in ["version", "build_versions", "app", "license"] {
        assert!(dictionary[key].as_str().is_some_and(|text| !text.is_empty()), "{key}");
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
