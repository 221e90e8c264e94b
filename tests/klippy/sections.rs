// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg of the built-in printer, and the sections that a user may remove. klippy reads it in its batch mode,
//! without an MCU.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use pinion_firmware::mcu::DialectName;

use super::checkout;
use super::hosts;
use super::klippy::{batch, example, pinion_path, without};

/// The sections that klippy cannot omit.
const ALWAYS: [&str; 5] = ["mcu", "printer", "stepper_x", "stepper_y", "stepper_z"];
const MOVES: &str = "G28\nG1 X10 Y20 Z5 F3000\nG1 X100 Y100\n";

pub fn pinion(args: &[&str]) -> Vec<u8> {
    let printed = Command::new(pinion_path()).args(args).output().unwrap();
    assert!(printed.status.success(), "{printed:?}");
    printed.stdout
}

/// The names of the sections in use.
fn sections(config: &str) -> Vec<&str> {
    config.lines().filter_map(|line| line.strip_prefix('[')?.strip_suffix(']')).collect()
}

/// The sections that declare that they need this one.
fn in_need<'a>(config: &'a str, section: &str) -> Vec<&'a str> {
    let blocks = config.split("\n\n").filter(|block| block.contains(&format!("\n# Needs [{section}].")));
    blocks.filter_map(|block| sections(block).pop()).collect()
}

/// The configuration without a section and without the sections that need it.
fn without_it(config: &str, section: &str) -> String {
    in_need(config, section).into_iter().fold(without(config, section), |rest, other| {
        if sections(&rest).contains(&other) { without_it(&rest, other) } else { rest }
    })
}

/// Processes each item, several at a time.
fn for_each<T: Sync>(items: &[T], work: impl Fn(&T) + Sync) {
    let next = AtomicUsize::new(0);
    let work = || {
        while let Some(item) = items.get(next.fetch_add(1, Ordering::Relaxed)) {
            work(item);
        }
    };
    thread::scope(|scope| {
        (0..thread::available_parallelism().map_or(1, usize::from)).for_each(|_| drop(scope.spawn(work)));
    });
}

/// Removes each section from a configuration that the host accepts whole. `keep` are the sections that this host cannot
/// omit.
fn take_out_each(checkout: &Path, dialect: DialectName, config: &str, keep: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let dictionary = folder.path().join("dict");
    std::fs::write(&dictionary, pinion(&["dict", "--board", "sim", "--dialect", dialect.name()])).unwrap();
    for_each(&sections(config), |section| {
        if ALWAYS.contains(section) || keep.contains(section) {
            return;
        }
        let said = batch(checkout, &dictionary, &without_it(config, section), MOVES);
        assert!(said.is_ok(), "{dialect} without [{section}]: {}", said.unwrap_err());
        if !in_need(config, section).is_empty() {
            let said = batch(checkout, &dictionary, &without(config, section), MOVES);
            assert!(said.is_err(), "{dialect}: {:?} do without [{section}]", in_need(config, section));
        }
    });
    let out = batch(checkout, &dictionary, config, MOVES).unwrap_or_else(|error| panic!("{dialect}: {error}"));
    assert!(out.len() > 1000, "{dialect} wrote only {} bytes", out.len());
}

fn built_in() -> String {
    String::from_utf8(pinion(&["sim", "--print-config"])).unwrap()
}

#[test]
fn klippy_does_without_any_section_of_printer_cfg() {
    let Some(checkout) = checkout("klippy_does_without_any_section_of_printer_cfg") else { return };
    take_out_each(&checkout, DialectName::Master, &built_in(), &[]);
}

#[test]
fn kalico_does_without_any_section_of_printer_cfg() {
    let Some(checkout): Option<PathBuf> = hosts::checkout(DialectName::Kalico) else { return };
    // The firmware of Kalico, and so its dialect, has no angle sensors. A host that looks them up gets them.
    take_out_each(&checkout, DialectName::Kalico, &without(&built_in(), "angle y"), &["virtual_sdcard"]);
}

/// The sections without hardware that a configuration offers, in use: each one's name, its lines, and the section that
/// it replaces.
fn offered(config: &str) -> Vec<(String, String, Option<String>)> {
    let (_, offers) = config.split_once("\n# Sections without hardware.").unwrap();
    let blocks = offers.split("\n\n").filter(|block| block.starts_with("#["));
    let used = |block: &str| block.lines().map(|line| format!("{}\n", line.strip_prefix('#').unwrap())).collect();
    let told = blocks.map(|block| {
        let used: String = used(block);
        let replaced = used.split_once("# Takes the place of [").map(|(_, rest)| rest.split_once(']').unwrap().0);
        (sections(&used)[0].to_owned(), used.clone(), replaced.map(str::to_owned))
    });
    told.collect()
}

/// G-code that needs the offered sections.
const THEIR_MOVES: &str = "G28\nG1 X50 Y50 Z5 F3000\nG2 X70 Y50 I10 J0\nG11\nG10\nRESPOND MSG=hello\nM117 hello\n\
                           SET_SKEW XY=141,141,100\nFORCE_MOVE STEPPER=stepper_x DISTANCE=1 VELOCITY=10\nPAUSE\n\
                           RESUME\nEXCLUDE_OBJECT_DEFINE NAME=PART\nSAVE_VARIABLE VARIABLE=one VALUE=1\n";

/// Enables each offered section alone, and then all compatible ones together.
fn take_in_each(checkout: &Path, dialect: DialectName, config: &str, moves: &str) {
    let folder = tempfile::tempdir().unwrap();
    let dictionary = folder.path().join("dict");
    std::fs::write(&dictionary, pinion(&["dict", "--board", "sim", "--dialect", dialect.name()])).unwrap();
    let offered = offered(config);
    assert!(offered.len() > 14, "{offered:?}");
    for_each(&offered, |(name, section, replaced)| {
        let rest = replaced.as_ref().map_or(config.to_owned(), |replaced| without_it(config, replaced));
        let said = batch(checkout, &dictionary, &format!("{rest}\n{section}"), MOVES);
        assert!(said.is_ok(), "{dialect} with [{name}]: {}", said.unwrap_err());
    });
    let together = offered.iter().filter(|(_, _, replaced)| replaced.is_none());
    let all: String = together.map(|(_, section, _)| format!("\n{section}")).collect();
    let said = batch(checkout, &dictionary, &format!("{config}{all}"), moves);
    assert!(said.is_ok(), "{dialect} with all: {}", said.unwrap_err());
}

#[test]
fn klippy_takes_each_section_without_hardware_that_is_offered() {
    let Some(checkout) = checkout("klippy_takes_each_section_without_hardware_that_is_offered") else { return };
    take_in_each(&checkout, DialectName::Master, &built_in(), THEIR_MOVES);
}

#[test]
fn kalico_takes_each_section_without_hardware_that_is_offered() {
    let Some(checkout): Option<PathBuf> = hosts::checkout(DialectName::Kalico) else { return };
    // Its [firmware_retraction] is not ready yet in batch mode.
    take_in_each(&checkout, DialectName::Kalico, &without(&built_in(), "angle y"), MOVES);
}

/// Makes a host read the printed configuration for each example of the documentation.
fn take_the_examples(checkout: &Path, dialect: DialectName) {
    let built_in = String::from_utf8(pinion(&["sim", "--print-board"])).unwrap();
    let examples: [(&str, &[&str]); 6] = [
        ("Four Z motors", &["stepper_z3", "quad_gantry_level"]),
        ("A delta printer", &["stepper_c", "delta_calibrate", "probe"]),
        ("A CoreXY printer", &["stepper_x", "stepper_y", "bed_mesh"]),
        ("A second extruder", &["extruder1", "dual_carriage"]),
        ("A chamber with a fan", &["temperature_fan exhaust", "heater_fan heat_sink"]),
        ("An RGBW strip", &["led shelf"]),
    ];
    for_each(&examples, |(heading, expected)| {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        std::fs::write(path("board"), example(&built_in, heading)).unwrap();
        let config = String::from_utf8(pinion(&["sim", &path("board"), "--print-config"])).unwrap();
        expected.iter().for_each(|section| assert!(sections(&config).contains(section), "no {section} in {heading}"));
        let board = format!("sim:{}", path("board"));
        let printed = pinion(&["dict", "--board", &board, "--dialect", dialect.name()]);
        std::fs::write(path("dict"), printed).unwrap();
        // Kalico has no angle sensors here.
        let config = match dialect {
            DialectName::Kalico if config.contains("[angle y]") => without(&config, "angle y"),
            _ => config,
        };
        let said = batch(checkout, Path::new(&path("dict")), &config, "G28\nG1 X30 Y20 Z5 F3000\n");
        assert!(said.is_ok(), "{dialect}, {heading}: {}", said.unwrap_err());
    });
}

#[test]
fn klippy_takes_the_examples_of_the_documentation() {
    let Some(checkout) = checkout("klippy_takes_the_examples_of_the_documentation") else { return };
    take_the_examples(&checkout, DialectName::Master);
}

#[test]
fn kalico_takes_the_examples_of_the_documentation() {
    let Some(checkout): Option<PathBuf> = hosts::checkout(DialectName::Kalico) else { return };
    take_the_examples(&checkout, DialectName::Kalico);
}
