// SPDX-License-Identifier: GPL-3.0-or-later
//! A real klippy on the simulated printer: with a user's host.
//!
//! Both have one clock, so no computer is too slow for them. What is about real time is in `real_time`: the program
//! `pinion`, its links, a process that dies.
//!
//! Needs a checkout of Klipper in `KLIPPER_DIR`. Also needs, in `KLIPPER_PYTHON` (python3 if unset), a Python with
//! klippy's requirements (scripts/klippy-requirements.txt there). Without the checkout every test here is skipped, and
//! says so.

mod add;
mod drivers;
mod filament;
mod hosts;
mod kinematics;
mod klippy;
mod leveling;
mod months;
mod own_printer;
mod print;
mod printer;
mod printer_cfg;
mod probes;
mod real_time;
mod regression;
mod rings;
mod sections;
mod seeds;
mod servo;
mod shown;
mod toolpath;
mod tools;

use std::io::Write;
use std::path::PathBuf;

/// The checkout, or a visible skip. It bypasses the test harness, which captures the output of tests.
fn checkout(test: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("KLIPPER_DIR").map(PathBuf::from);
    if folder.is_none() {
        let _ = writeln!(
            std::io::stderr(),
            "\nSKIPPED {test}: KLIPPER_DIR is not set; set it to a checkout of Klipper to test with a real klippy"
        );
    }
    folder
}
