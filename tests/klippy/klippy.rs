// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's Python and its batch mode; configurations for a test.

use std::fs;
use std::path::Path;
use std::process::Command;

use pinion_testkit::simulator;

/// The Python that runs klippy.
pub fn python() -> String {
    std::env::var("KLIPPER_PYTHON").unwrap_or_else(|_| "python3".into())
}

/// Lets klippy move without homing, for tests of other things. During homing klippy is at most 0.1 s ahead of the
/// motion, so a busy computer stops it.
pub const UNHOMED: &str = "\n[force_move]\nenable_force_move: True\n";
/// The initial position of the built-in printer.
pub const WHERE_IT_STANDS: &str = "SET_KINEMATIC_POSITION X=60 Y=45 Z=12";

/// The path of `pinion`, with `pinion-sim` beside it.
pub fn pinion_path() -> &'static Path {
    let pinion = Path::new(env!("CARGO_BIN_EXE_pinion"));
    simulator::beside(pinion);
    pinion
}

/// An example of docs/guide/simulated-printer.md: alone, or appended to the built-in description as the example says.
pub fn example(built_in: &str, heading: &str) -> String {
    const PAGE: &str = include_str!("../../docs/guide/simulated-printer.md");
    let (_, section) = PAGE.split_once(&format!("\n### {heading}\n")).unwrap();
    let (example, _) = section.split_once("\n```toml\n").unwrap().1.split_once("```\n").unwrap();
    if example.starts_with("[delta]") {
        return example.to_owned();
    }
    if example.starts_with("corexy") {
        return format!("{example}{built_in}");
    }
    let rest = match built_in.split_once("[[axis]]\nname = \"z\"\n") {
        Some((before, z)) if example.contains("name = \"z\"\n") => {
            format!("{before}{}", z.split_once("\n\n").unwrap().1)
        }
        _ => built_in.to_owned(),
    };
    format!("{rest}\n{example}")
}

/// The configuration without a section.
pub fn without(config: &str, section: &str) -> String {
    let head = format!("[{section}]\n");
    let (before, after) = config.split_once(&head).unwrap_or_else(|| panic!("no [{section}] in\n{config}"));
    format!("{before}{}", after.split_once("\n\n").map_or("", |(_, after)| after))
}

/// The configuration with an offered section in use, with more keys.
pub fn with(config: &str, section: &str, keys: &str) -> String {
    let head = format!("#[{section}]\n");
    let at = config.find(&head).unwrap_or_else(|| panic!("no #[{section}] in\n{config}"));
    let (before, rest) = config.split_at(at);
    let (lines, after) = rest.split_once("\n\n").unwrap_or((rest, ""));
    let lines: Vec<&str> = lines.lines().map(|line| line.strip_prefix('#').unwrap_or(line)).collect();
    format!("{before}{}\n{keys}\n\n{after}", lines.join("\n"))
}

/// Runs klippy's batch mode with a dictionary, without an MCU. Returns the output, or the reason for a failure.
pub fn batch(checkout: &Path, dictionary: &Path, config: &str, gcode: &str) -> Result<Vec<u8>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("printer.cfg"), config).unwrap();
    fs::write(path("gcode"), gcode).unwrap();
    let ended = Command::new(python())
        .arg(checkout.join("klippy/klippy.py"))
        .arg(path("printer.cfg"))
        .arg("-i")
        .arg(path("gcode"))
        .arg("-o")
        .arg(path("out"))
        .arg("-d")
        .arg(dictionary)
        .arg("-l")
        .arg(path("log"))
        // The home folder for anything that it stores there.
        .env("HOME", folder.path())
        .output()
        .unwrap();
    if ended.status.success() {
        return Ok(fs::read(path("out")).unwrap());
    }
    let log = fs::read_to_string(path("log")).unwrap_or_default();
    Err(format!(
        "{}{}",
        String::from_utf8_lossy(&ended.stderr),
        log.lines().rev().take(8).collect::<Vec<_>>().join("\n")
    ))
}

/// The rest of the line with this start in klippy's answer.
#[track_caller]
pub fn rest<'a>(answer: &'a str, start: &str) -> &'a str {
    let found = answer.lines().find_map(|line| line.trim_start_matches("// ").strip_prefix(start));
    found.unwrap_or_else(|| panic!("no `{start}` in\n{answer}"))
}
