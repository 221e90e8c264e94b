// SPDX-License-Identifier: GPL-3.0-or-later
//! The pages of the project, with their fenced blocks. `docs/develop/test-package.md` explains the kinds of blocks.

use std::fs;
use std::path::Path;

/// Commands that a user types. They are tried in the booted system.
pub const COMMANDS: &str = "sh";
/// The line before commands that cannot be tried there.
const NOT_TRIED: &str = "<!-- not tried:";

/// A file of Markdown.
pub struct Page {
    /// Path from the project's folder, for example `docs/guide/install.md`.
    pub name: String,
    /// The whole file.
    pub text: String,
}

/// A fenced block.
pub struct Block {
    /// The text after the fence.
    pub kind: String,
    /// The number of its first line, counted from 1.
    pub line: usize,
    /// The text between the fences.
    pub text: String,
    /// The paragraph before it, which describes it.
    pub before: String,
    /// Why its commands are not tried.
    pub not_tried: Option<String>,
}

/// The pages of the top folder, README.md first, then the pages below docs/ sorted by name.
pub fn pages() -> Vec<Page> {
    let project = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../.."));
    let mut names: Vec<String> = ["README.md", "CONTRIBUTING.md", "SECURITY.md"].map(str::to_owned).into();
    let mut below = Vec::new();
    for folder in ["docs", "docs/develop", "docs/guide"] {
        let files = fs::read_dir(project.join(folder)).expect("a folder of pages");
        let files = files.map(|file| format!("{folder}/{}", file.expect("a file").file_name().to_string_lossy()));
        below.extend(files.filter(|name| name.ends_with(".md")));
    }
    below.sort();
    names.append(&mut below);
    let page = |name: String| Page { text: fs::read_to_string(project.join(&name)).expect("a page"), name };
    names.into_iter().map(page).collect()
}

impl Page {
    /// Its fenced blocks in their order.
    pub fn blocks(&self) -> Vec<Block> {
        let lines: Vec<&str> = self.text.lines().collect();
        let mut blocks = Vec::new();
        let mut at = 0;
        while at < lines.len() {
            let Some(kind) = lines[at].trim_start().strip_prefix("```") else {
                at += 1;
                continue;
            };
            let indent = lines[at].len() - lines[at].trim_start().len();
            let length = lines[at + 1..].iter().take_while(|line| line.trim() != "```").count();
            let text = lines[at + 1..at + 1 + length]
                .iter()
                .map(|line| format!("{}\n", line.get(indent..).unwrap_or_default()))
                .collect();
            let reason = at.checked_sub(1).and_then(|before| reason(lines[before]));
            let before = paragraph(&lines[..at - usize::from(reason.is_some())]);
            blocks.push(Block { kind: kind.to_owned(), line: at + 2, text, before, not_tried: reason });
            at += length + 2;
        }
        blocks
    }
}

/// The reason in a line that marks the next block as not tried.
pub fn reason(line: &str) -> Option<String> {
    Some(line.trim().strip_prefix(NOT_TRIED)?.strip_suffix("-->")?.trim().to_owned())
}

/// The last paragraph of these lines.
fn paragraph(lines: &[&str]) -> String {
    let end = lines.iter().rposition(|line| !line.trim().is_empty()).map_or(0, |last| last + 1);
    let start = lines[..end].iter().rposition(|line| line.trim().is_empty()).map_or(0, |empty| empty + 1);
    lines[start..end].join("\n")
}
