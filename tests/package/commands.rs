// SPDX-License-Identifier: GPL-3.0-or-later
//! The pages' commands for the VM, and the check that tries each page.

use std::fs;
use std::path::Path;

use super::Check;
use pinion_testkit::markdown::{COMMANDS, Page, pages};

/// The start of a check's line that tries a page: `page docs/guide/install.md`.
const WORD: &str = "page ";
/// The page of a check that runs once for each page without another check.
const ANY: &str = "\"$PAGE\"";

/// The pages with commands.
fn with_commands() -> Vec<Page> {
    let has_commands = |page: &Page| page.blocks().iter().any(|block| block.kind == COMMANDS);
    pages().into_iter().filter(has_commands).collect()
}

/// Writes each block of commands into a file in the folder that the VM sees as /share: `pages/README.md/0042.sh`, or
/// `.not-tried`, for the block at line 42.
pub fn share(folder: &Path) -> Result<(), String> {
    for page in with_commands() {
        let folder = folder.join("pages").join(&page.name);
        fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        for block in page.blocks().into_iter().filter(|block| block.kind == COMMANDS) {
            let ending = if block.not_tried.is_some() { "not-tried" } else { "sh" };
            let path = folder.join(format!("{:04}.{ending}", block.line));
            fs::write(&path, block.text).map_err(|error| format!("{}: {error}", path.display()))?;
        }
    }
    Ok(())
}

/// The pages that a check tries.
fn tried(check: &Check) -> impl Iterator<Item = &str> {
    check.script.lines().filter_map(|line| line.strip_prefix(WORD))
}

/// The checks. The check for any page is repeated for each page without another check.
///
/// # Errors
///
/// A page with commands that no check would try.
pub fn each_page(checks: Vec<Check>) -> Result<Vec<Check>, String> {
    let named: Vec<String> = checks.iter().flat_map(tried).map(str::to_owned).collect();
    let mut others = with_commands();
    others.retain(|page| !named.contains(&page.name));
    let (mut all, mut for_any) = (Vec::new(), false);
    for check in checks {
        if !tried(&check).any(|page| page == ANY) {
            all.push(check);
            continue;
        }
        for_any = true;
        all.extend(others.iter().map(|page| Check {
            name: format!("{}-{}", check.name, Path::new(&page.name).file_stem().unwrap_or_default().to_string_lossy()),
            script: check.script.replace(ANY, &page.name),
        }));
    }
    match others.first() {
        Some(page) if !for_any => Err(format!("no check tries the commands of {}", page.name)),
        _ => Ok(all),
    }
}

/// Whether the check tries pages without a block to try. It would only install the package.
pub fn has_nothing_to_try(check: &Check) -> bool {
    let can_be_tried =
        |page: &Page| page.blocks().iter().any(|block| block.kind == COMMANDS && block.not_tried.is_none());
    !pages().iter().any(|page| tried(check).any(|name| name == page.name) && can_be_tried(page))
}

/// A line for each untried block in the pages of this check.
pub fn not_tried(check: &Check) -> Vec<String> {
    let mut lines = Vec::new();
    for page in pages().iter().filter(|page| tried(check).any(|name| name == page.name)) {
        for block in page.blocks() {
            lines.extend(block.not_tried.map(|reason| format!("not tried: {}:{}: {reason}", page.name, block.line)));
        }
    }
    lines
}
