// SPDX-License-Identifier: GPL-3.0-or-later
//! Checks the form of all pages and their links. Other tests check the content. `tests/package` runs the commands, and
//! `tests/klippy/printer_cfg.rs` gives the configurations to klippy.

use std::fs;
use std::path::{Path, PathBuf};

use pinion_testkit::markdown::{COMMANDS, Page, pages, reason};

/// The allowed kinds of blocks.
const KINDS: [&str; 7] = [COMMANDS, "ini", "toml", "text", "diff", "rust", "yaml"];
/// The pages for developers. Their commands are in indented blocks, and no test runs them.
const FOR_DEVELOPERS: [&str; 2] = ["CONTRIBUTING.md", "docs/develop/"];

/// The lines outside fenced blocks, each with its number, counted from 1.
fn prose(page: &Page) -> Vec<(usize, &str)> {
    let mut fenced = false;
    let mut prose = Vec::new();
    for (number, line) in (1..).zip(page.text.lines()) {
        let is_fence = line.trim_start().starts_with("```");
        if !is_fence && !fenced {
            prose.push((number, line));
        }
        fenced ^= is_fence;
    }
    prose
}

/// The anchor that GitHub and similar sites make from a heading.
fn anchor(heading: &str) -> String {
    let heading = heading.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
    heading.chars().filter(|c| c.is_alphanumeric() || "-_".contains(*c)).collect()
}

#[test]
fn every_block_says_what_it_is() {
    for page in pages() {
        for block in page.blocks() {
            let Page { name, .. } = &page;
            let line = block.line;
            assert!(KINDS.contains(&block.kind.as_str()), "{name}:{line}: a block of {:?}", block.kind);
            assert!(!block.text.trim().is_empty(), "{name}:{line}: an empty block");
            let names_a_file = block.before.contains(".cfg`") || block.before.contains(".conf`");
            assert!(block.kind != "ini" || names_a_file, "{name}:{line}: it does not name its file");
            let reason = block.not_tried.as_deref();
            assert!(reason.is_none() || block.kind == COMMANDS, "{name}:{line}: nobody would try this anyway");
            assert_ne!(reason, Some(""), "{name}:{line}: it does not say why it is not tried");
        }
        let fences = page.text.lines().filter(|line| line.trim_start().starts_with("```")).count();
        assert_eq!(fences, 2 * page.blocks().len(), "{}: a fence is open", page.name);
    }
}

/// A wrong word, or a line between it and the block, would make the test try commands that cannot work.
#[test]
fn what_is_not_tried_is_said_in_the_right_place() {
    for page in pages() {
        let said = page.text.lines().filter(|line| line.starts_with("<!--")).count();
        let understood = page.blocks().iter().filter(|block| block.not_tried.is_some()).count();
        assert_eq!(said, understood, "{}: a comment is not the reason of a block", page.name);
    }
    assert_eq!(reason("<!-- not tried: it takes a Pi -->").as_deref(), Some("it takes a Pi"));
    assert_eq!(reason("<!-- tried -->"), None);
}

#[test]
fn users_find_no_commands_that_nobody_tries() {
    for page in pages().iter().filter(|page| !FOR_DEVELOPERS.iter().any(|place| page.name.starts_with(place))) {
        let mut after_empty = false;
        for (number, line) in prose(page) {
            assert!(!(after_empty && line.starts_with("    ")), "{}:{number}: an indented block: {line}", page.name);
            after_empty = line.trim().is_empty();
        }
    }
}

/// The path of a link's target from the project's folder.
fn resolved(page: &str, target: &str) -> String {
    let mut path: Vec<&str> = page.split('/').collect();
    path.pop();
    for part in target.split('/') {
        if part == ".." {
            assert!(path.pop().is_some(), "{page}: {target} is outside the project");
        } else {
            path.push(part);
        }
    }
    path.join("/")
}

#[test]
fn links_lead_somewhere() {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let pages = pages();
    let mut count = 0;
    for page in &pages {
        for (number, line) in prose(page) {
            let targets = line.split("](").skip(1).filter_map(|rest| rest.split(')').next());
            for target in targets.filter(|target| !target.contains("://")) {
                let (file, heading) = target.split_once('#').unwrap_or((target, ""));
                let path = if file.is_empty() { page.name.clone() } else { resolved(&page.name, file) };
                assert!(project.join(&path).exists(), "{}:{number}: there is no {path}", page.name);
                if !heading.is_empty() {
                    let there = pages.iter().find(|other| other.name == path).map(prose).unwrap_or_default();
                    let found = there.iter().any(|(_, line)| line.starts_with('#') && anchor(line) == heading);
                    assert!(found, "{}:{number}: {path} has no heading #{heading}", page.name);
                }
                count += 1;
            }
        }
    }
    assert!(count > 20, "only {count} links were seen");
}

/// A path from the project's folder, in the pages' form for our files.
fn is_path(text: &str) -> bool {
    let folders = [
        "src/",
        "crates/",
        "tools/",
        "simulator/",
        "tests/",
        "benches/",
        "systemd/",
        "udev/",
        "debian/",
        "docs/guide/",
        "docs/develop/",
    ];
    folders.iter().any(|folder| text.starts_with(folder)) && !text.contains([' ', '*', '<'])
}

#[test]
fn files_that_pages_name_are_there() {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let map = "tests/README.md".to_owned();
    let map = Page { text: fs::read_to_string(project.join(&map)).unwrap(), name: map };
    let mut count = 0;
    for page in pages().iter().chain([&map]) {
        for (number, line) in prose(page) {
            for path in line.split('`').skip(1).step_by(2).filter(|text| is_path(text)) {
                assert!(project.join(path).exists(), "{}:{number}: there is no {path}", page.name);
                count += 1;
            }
        }
    }
    assert!(count > 20, "only {count} paths were seen");
}

/// All Rust sources below a folder, without the indentation of their lines.
fn sources(folder: &Path) -> Vec<String> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let source = |path: PathBuf| match path.extension() {
        _ if path.is_dir() => sources(&path),
        Some(extension) if extension == "rs" => vec![without_indentation(&fs::read_to_string(path).unwrap())],
        _ => Vec::new(),
    };
    paths.flat_map(source).collect()
}

fn without_indentation(text: &str) -> String {
    text.lines().map(|line| format!("{}\n", line.trim())).collect()
}

/// So the Rust compiles, and follows the code.
#[test]
fn rust_on_a_page_is_part_of_a_source() {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let sources: Vec<_> = ["crates", "tests"].iter().flat_map(|folder| sources(&project.join(folder))).collect();
    let mut count = 0;
    for page in pages() {
        for block in page.blocks().iter().filter(|block| block.kind == "rust") {
            let code = without_indentation(&block.text);
            let found = sources.iter().any(|source| source.contains(&code));
            assert!(found, "{}:{}: no source has this code", page.name, block.line);
            count += 1;
        }
    }
    assert!(count > 4, "only {count} blocks were seen");
}

#[test]
fn the_index_leads_to_every_page() {
    let pages = pages();
    let index = pages.iter().find(|page| page.name == "docs/README.md").unwrap();
    assert!(pages[0].text.contains("](docs/README.md)"), "README.md does not lead to the index");
    for page in pages.iter().filter(|page| page.name.matches('/').count() == 2) {
        let link = format!("]({})", &page.name["docs/".len()..]);
        assert!(index.text.contains(&link), "docs/README.md does not lead to {}", page.name);
    }
}
