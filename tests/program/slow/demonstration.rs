// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --demo`: a simulated printer homes and heats in real time.

use std::fs;

use nix::sys::signal::Signal;
use pinion_testkit::wait;

use crate::process::{Pinion, closed_pipe, folder_with, printed};

/// The built-in printer with a bed that warms up within seconds.
fn quick_printer() -> String {
    let printer = printed(&["sim", "--print-board"]);
    let quick = printer.replace("heat_capacity_j_per_k = 400.0", "heat_capacity_j_per_k = 60.0");
    assert_ne!(quick, printer, "the built-in printer's bed is another one");
    quick
}

/// Whether the demonstration's error about a homed axis can come from timers of the MCU that were this late. On a busy
/// computer without real time they are late.
fn comes_of_lateness(wrong: &str, late_us: f64) -> bool {
    // Every axis of the built-in printer homes at 4000 steps per second. Both of the compared times may be late.
    let steps = 2.0 * 0.004 * late_us;
    let numbers = wrong.split(|c: char| !c.is_ascii_digit()).filter_map(|number| number.parse::<f64>().ok());
    let [went, expected, apart, allowed] = numbers.collect::<Vec<_>>()[..] else { return false };
    let beyond = apart.max((went - expected).abs()) - allowed;
    wrong.contains(" homed: endstop after ") && wrong.ends_with(" allowed") && beyond > 0.0 && beyond <= steps
}

/// What went wrong in a demonstration because timers of its MCU were late.
fn wrong_of_lateness<'a>(out: &'a str, log: &str) -> Vec<&'a str> {
    let late_us = log.rsplit_once(" us, at most ").unwrap().1.split_once(" us").unwrap().0.parse().unwrap();
    let wrong: Vec<&str> = out.lines().filter(|line| line.starts_with("WRONG ")).collect();
    assert!(wrong.iter().all(|wrong| comes_of_lateness(wrong, late_us)), "{out}\n{log}");
    wrong
}

#[test]
fn only_a_late_mcu_may_home_worse_than_allowed() {
    let wrong =
        "WRONG x homed: endstop after 4820 steps (4800 expected), the second time 6 steps off, at most 3 allowed";
    assert!(comes_of_lateness(wrong, 2200.0) && !comes_of_lateness(wrong, 2100.0));
    assert!(!comes_of_lateness(&wrong.replace("4820", "4801").replace('6', "2"), 1e6), "something else is wrong");
    assert!(!comes_of_lateness(&format!("{wrong}; the second time it ended by PastEnd"), 1e6));
    assert!(!comes_of_lateness("WRONG heater_bed at target: 30.0 °C of 45 ± 1.0 °C for 3 s", 1e6));
}

#[test]
#[ignore = "slow"]
fn the_demonstration_is_right() {
    let (_folder, toml) = folder_with("quick.toml", &quick_printer());
    let args = ["sim", "-r", toml.to_str().unwrap(), "--demo"];
    wait::in_time(|_| {
        let mut pinion = Pinion::start(&args);
        let status = pinion.end();
        let (out, log) = (pinion.out(), pinion.log());
        assert!(!log.contains("shutdown: Timer too close: "), "{log}");
        let wrong = wrong_of_lateness(&out, &log);
        let (code, verdict) =
            if wrong.is_empty() { (0, "\nall of it was right") } else { (1, "\nNOT all of it was right") };
        assert_eq!(status.code(), Some(code), "{out}\n{log}");
        for shown in ["identified", "x homed", "y homed", "z homed", "heater_bed at target", "no shutdown", verdict] {
            assert!(out.contains(shown), "no \"{shown}\" in:\n{out}");
        }
    });
}

#[test]
#[ignore = "slow"]
fn the_demonstration_fails_where_something_is_wrong() {
    wait::in_time(|_| {
        // Axes against a wall at their endstops lose the steps of the way to a stop.
        let walled = quick_printer().replace("microsteps = 16", "microsteps = 16\novertravel_mm = 0.0");
        let (_folder, toml) = folder_with("walled.toml", &walled);
        let mut pinion = Pinion::start(&["sim", "-r", toml.to_str().unwrap(), "--demo"]);
        let status = pinion.end();
        assert_eq!(status.code(), Some(1), "{}", pinion.out());
        let out = pinion.out();
        assert!(out.contains("NOT all of it was right"), "{out}");
        // Each axis is right as far as the MCU sees it.
        wrong_of_lateness(&out, &pinion.log());
        assert!(out.contains(" axis stands at 0.000 mm, 1 steps lost"), "{out}");
    });
}

#[test]
#[ignore = "slow"]
fn a_simulated_printer_of_which_nobody_reads_goes_on_to_serve_its_host() {
    wait::in_time(|_| {
        let (folder, toml) = folder_with("quick.toml", &quick_printer());
        let log = fs::File::create(folder.path().join("log")).unwrap();
        let mut pinion = Pinion::start_to(folder, &["sim", "-r", toml.to_str().unwrap()], closed_pipe(), log);
        // The demonstration's own host leaves when it ends.
        pinion.logged("host gone");
        let mut client = pinion.client();
        assert!(!client.status().unwrap().is_shutdown);
        drop(client);
        pinion.signal(Signal::SIGINT);
        assert_eq!(pinion.end().code(), Some(0));
        assert!(!pinion.log().contains("panicked"), "{}", pinion.log());
    });
}
