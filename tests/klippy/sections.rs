// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg of the built-in printer, and what may be taken out of it: klippy reads it in its batch
//! mode, without a machine.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use pinion_firmware::mcu::Generation;

use super::checkout;
use super::hosts;
use super::klippy::{batch, without};

/// What klippy does not do without.
const ALWAYS: [&str; 5] = ["mcu", "printer", "stepper_x", "stepper_y", "stepper_z"];
const MOVES: &str = "G28\nG1 X10 Y20 Z5 F3000\nG1 X100 Y100\n";

fn pinion(args: &[&str]) -> Vec<u8> {
    let printed = Command::new(env!("CARGO_BIN_EXE_pinion")).args(args).output().unwrap();
    assert!(printed.status.success(), "{printed:?}");
    printed.stdout
}

/// The names of the sections in use.
fn sections(config: &str) -> Vec<&str> {
    config.lines().filter_map(|line| line.strip_prefix('[')?.strip_suffix(']')).collect()
}

/// The sections that say that they need this one.
fn in_need<'a>(config: &'a str, section: &str) -> Vec<&'a str> {
    let blocks = config.split("\n\n").filter(|block| block.contains(&format!("\n# Needs [{section}].")));
    blocks.filter_map(|block| sections(block).pop()).collect()
}

/// The configuration without a section and those that need it.
fn without_it(config: &str, section: &str) -> String {
    in_need(config, section).into_iter().fold(without(config, section), |rest, other| {
        if sections(&rest).contains(&other) { without_it(&rest, other) } else { rest }
    })
}

/// Takes each section out of a configuration that the host takes whole. `keep` are those that this host
/// does not do without.
fn take_out_each(checkout: &Path, generation: Generation, config: &str, keep: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let dictionary = folder.path().join("dict");
    std::fs::write(&dictionary, pinion(&["dict", "--board", "sim", "--dialect", generation.name()])).unwrap();
    let sections = sections(config);
    let next = AtomicUsize::new(0);
    let work = || {
        while let Some(section) = sections.get(next.fetch_add(1, Ordering::Relaxed)) {
            if ALWAYS.contains(section) || keep.contains(section) {
                continue;
            }
            let said = batch(checkout, &dictionary, &without_it(config, section), MOVES);
            assert!(said.is_ok(), "{generation} without [{section}]: {}", said.unwrap_err());
            if !in_need(config, section).is_empty() {
                let said = batch(checkout, &dictionary, &without(config, section), MOVES);
                assert!(said.is_err(), "{generation}: {:?} do without [{section}]", in_need(config, section));
            }
        }
    };
    thread::scope(|scope| {
        (0..thread::available_parallelism().map_or(1, usize::from)).for_each(|_| drop(scope.spawn(work)));
    });
    let out = batch(checkout, &dictionary, config, MOVES).unwrap_or_else(|error| panic!("{generation}: {error}"));
    assert!(out.len() > 1000, "{generation} wrote only {} bytes", out.len());
}

fn built_in() -> String {
    String::from_utf8(pinion(&["sim", "--print-config"])).unwrap()
}

#[test]
fn klippy_does_without_any_section_of_printer_cfg() {
    let Some(checkout) = checkout("klippy_does_without_any_section_of_printer_cfg") else { return };
    take_out_each(&checkout, Generation::Master, &built_in(), &[]);
}

#[test]
fn kalico_does_without_any_section_of_printer_cfg() {
    let Some(checkout): Option<PathBuf> = hosts::checkout(Generation::Kalico) else { return };
    let config = built_in();
    // As the section says.
    let angle = config.split("\n\n").find(|block| block.starts_with("[angle y]")).unwrap();
    assert!(angle.contains("Kalico"), "{angle}");
    take_out_each(&checkout, Generation::Kalico, &without(&config, "angle y"), &["virtual_sdcard"]);
}
