// SPDX-License-Identifier: GPL-3.0-or-later
//! The cache lines that an edge uses, counted by a plugin of the emulator: see `cache_lines.c`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::vm;
use pinion_testkit::process;

/// Tests whose edges are counted. Each has its own VM.
pub const TESTS: &str = "figures::cache_lines";

const SOURCE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/kernel/cache_lines.c");
/// Fewer edges are no figure.
const EDGES_MIN: usize = 100;
const OF: &str = "Cache lines of 64 bytes from wake-up to edge: p50 / max";
/// In the order of the plugin's numbers.
const CASES: [&str; 5] = [
    "instructions of the kernel",
    "data of the kernel",
    "instructions of programs",
    "data of programs",
    "of all, first used by the system call that writes the edge",
];
/// The last case is a part of the others.
const PARTS: usize = 4;

/// The plugin and its counts.
pub struct CacheLines {
    plugin: PathBuf,
    counts: PathBuf,
}

impl CacheLines {
    /// The plugin for a VM with these tests, if they need it. It is made in the folder.
    pub fn of(tests: &[String], folder: &Path) -> Result<Option<CacheLines>, String> {
        if !tests.iter().any(|test| test.starts_with(TESTS)) {
            return Ok(None);
        }
        let (plugin, counts) = (folder.join("cache_lines.so"), folder.join("cache_lines"));
        let version = if emulator_version()? < 9 { 1 } else { 2 };
        let mut compiler = Command::new("cc");
        compiler.args(["-O2", "-shared", "-fPIC", &format!("-DVERSION={version}"), SOURCE, "-o"]).arg(&plugin);
        process::run(&mut compiler)?;
        Ok(Some(CacheLines { plugin, counts }))
    }

    /// The value of the emulator's option `-plugin`.
    pub fn option(&self) -> String {
        format!("file={},into={}", self.plugin.display(), self.counts.display())
    }

    /// The figures as lines for the table.
    pub fn figures(&self) -> Result<String, String> {
        let text = fs::read_to_string(&self.counts).map_err(|error| format!("the plugin left no counts: {error}"))?;
        let edges: Vec<Vec<u32>> =
            text.lines().map(|line| line.split(' ').filter_map(|count| count.parse().ok()).collect()).collect();
        if edges.len() < EDGES_MIN {
            return Err(format!("the plugin saw {} edges, not {EDGES_MIN} or more", edges.len()));
        }
        let figure = |case: &str, mut counts: Vec<u32>| {
            counts.sort_unstable();
            format!("figure\t{OF}\t{case}\t{} / {}\n", counts[counts.len() / 2], counts[counts.len() - 1])
        };
        let each = CASES.iter().enumerate().map(|(n, case)| figure(case, edges.iter().map(|edge| edge[n]).collect()));
        let all = figure("all", edges.iter().map(|edge| edge[..PARTS].iter().sum()).collect());
        Ok(each.chain([all]).collect())
    }
}

/// The first number of the emulator's version.
fn emulator_version() -> Result<u32, String> {
    let text = process::output(Command::new(vm::EMULATOR).arg("--version"))?;
    let version = text.split("version ").nth(1).and_then(|rest| rest.split('.').next());
    version.and_then(|number| number.parse().ok()).ok_or_else(|| format!("{} has no version: {text}", vm::EMULATOR))
}
