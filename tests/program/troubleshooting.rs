// SPDX-License-Identifier: GPL-3.0-or-later
//! docs/guide/troubleshooting.md explains the program's messages: all of them and nothing else.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::process::output;

const PAGE: &str = include_str!("../../docs/guide/troubleshooting.md");
/// The code that makes a line of the log. The search for the host sends its lines to the program's log.
const LOGGING: [&str; 5] = ["error!(", "warn!(", "info!(", ".warn(format!(", ".info(format!("];
/// Stands for the variable parts in a quotation.
const ANYTHING: &str = "...";
/// Fewest letters of a quotation. A shorter one could match any line.
const LETTERS_MIN: usize = 5;

/// The first cells of the tables below this heading, up to the next heading of the same level.
fn first_cells(heading: &str) -> Vec<&'static str> {
    let level = heading.split(' ').next().unwrap_or_default();
    let lines = PAGE.lines().skip_while(|line| *line != heading).skip(1);
    let is_next = |line: &str| {
        let depth = line.chars().take_while(|c| *c == '#').count();
        depth > 0 && depth <= level.len() && line[depth..].starts_with(' ')
    };
    let cells = lines.take_while(|line| !is_next(line)).filter_map(|line| line.strip_prefix('|')?.split('|').next());
    let cells: Vec<&str> = cells.filter(|cell| cell.contains('`')).collect();
    assert!(!cells.is_empty(), "the page has no table below \"{heading}\"");
    cells
}

/// The texts in backquotes.
fn quotations(cell: &'static str) -> impl Iterator<Item = &'static str> {
    cell.split('`').skip(1).step_by(2)
}

/// Whether a text has the fixed parts of a quotation, in order.
fn has(text: &str, quotation: &str) -> bool {
    let mut rest = text;
    quotation.split(ANYTHING).map(str::trim).all(|part| {
        let found = rest.split_once(part);
        rest = found.map_or("", |(_, behind)| behind);
        found.is_some()
    })
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

/// The program's sources without their tests, with each literal in its printed form, and the service's script.
fn sources() -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let rooms = ["crates", "tools", "simulator"].map(|folder| fs::read_dir(root.join(folder)).unwrap());
    let packages = rooms.into_iter().flatten().map(|entry| entry.unwrap().path()).chain([root.to_owned()]);
    let mut all: Vec<PathBuf> = packages.flat_map(|package| files(&package.join("src"))).collect();
    all.push(root.join("systemd/link"));
    let source = |path: PathBuf| {
        let text = fs::read_to_string(&path).unwrap();
        let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
        // A literal continues on the next line after a backslash.
        let mut lines = text.split("\\\n");
        let mut joined = lines.next().unwrap_or_default().to_owned();
        lines.for_each(|line| joined.push_str(line.trim_start()));
        (path.strip_prefix(root).unwrap().display().to_string(), joined.replace("\\\"", "\""))
    };
    all.into_iter().map(source).collect()
}

#[test]
fn each_line_that_the_page_quotes_is_one_of_the_program_s() {
    let sources = sources();
    for cell in first_cells("## Lines of the log") {
        for quotation in quotations(cell) {
            let longest = quotation.split(ANYTHING).map(str::len).max().unwrap_or(0);
            assert!(longest >= LETTERS_MIN, "`{quotation}` says too little");
            // The parts of a line (subject, cause and remedy) may be in different places.
            let is_there = |part: &str| sources.iter().any(|(_, text)| has(text, part));
            assert!(quotation.split(": ").all(is_there), "no source has `{quotation}`");
        }
    }
}

/// The literals in calls of these macros.
fn logged(source: &str, macros: &[&str]) -> Vec<String> {
    let calls = macros.iter().flat_map(|name| source.match_indices(name).map(|(at, _)| &source[at + name.len()..]));
    calls
        .filter_map(|call| {
            let literal = call.trim_start().strip_prefix('"')?;
            let ends = literal
                .match_indices('"')
                .find(|(at, _)| [",", ")", "\n"].iter().any(|c| literal[at + 1..].starts_with(c)));
            Some(literal[..ends?.0].to_owned())
        })
        .collect()
}

/// The parts of a format that are printed unchanged.
fn fixed_parts(format: &str) -> Vec<&str> {
    let mut parts = format.split('{');
    let first = parts.next().into_iter();
    first.chain(parts.filter_map(|part| part.split_once('}').map(|(_, fixed)| fixed))).collect()
}

#[test]
fn each_line_that_the_program_logs_is_on_the_page() {
    let cells = first_cells("## Lines of the log");
    let quotations: Vec<&str> = cells.into_iter().flat_map(quotations).collect();
    for (file, text) in sources() {
        // This file makes the core's lines.
        let macros: &[&str] =
            if file.ends_with("runtime/src/core/responses.rs") { &["format_args!("] } else { &LOGGING };
        for line in logged(&text, macros) {
            let parts = fixed_parts(&line);
            if parts.iter().all(|part| part.chars().filter(|c| c.is_alphabetic()).count() < LETTERS_MIN) {
                // Its text comes from elsewhere.
                continue;
            }
            assert!(
                quotations.iter().any(|quotation| has(&line, quotation)),
                "{file} logs \"{line}\", which is not on the page"
            );
        }
    }
}

#[test]
fn the_page_has_each_shutdown_text_and_no_other() {
    let dictionary: Value = serde_json::from_slice(&output(&["dict", "--board", "sim"]).stdout).unwrap();
    let texts = dictionary["enumerations"]["static_string_id"].as_object().unwrap();
    let texts: BTreeSet<&str> = texts.keys().map(String::as_str).collect();
    let explained: BTreeSet<&str> = first_cells("## Shutdown texts").into_iter().flat_map(quotations).collect();
    let missing: Vec<_> = texts.difference(&explained).collect();
    let unknown: Vec<_> = explained.difference(&texts).collect();
    assert!(
        missing.is_empty() && unknown.is_empty(),
        "the page lacks {missing:?}, and has {unknown:?}, which nobody says"
    );
}
