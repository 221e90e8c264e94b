// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion-sim`. `pinion` starts it from its own folder.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::SystemTime;

/// A cargo command that tests several programs builds both of them. For `--test program` alone, cargo builds only the
/// programs of that test's package.
const REMEDY: &str = "run cargo test --locked --no-run --test pinion_sim";

/// Returns the program's path, beside this `pinion`.
///
/// # Panics
///
/// cargo has not built it since its sources have changed.
pub fn beside(pinion: &Path) -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let program = pinion.with_file_name("pinion-sim");
        let built = changed(&program).unwrap_or_else(|| panic!("there is no {}: {REMEDY}", program.display()));
        let tree = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
        let inside = |folder| fs::read_dir(tree.join(folder)).expect("the tree is complete").flatten();
        let packages = ["crates", "tools", "simulator"].into_iter().flat_map(inside).map(|entry| entry.path());
        let newest = packages.chain([tree.clone()]).filter_map(|package| newest(&package.join("src"))).max();
        if let Some((changed, file)) = newest.filter(|(changed, _)| *changed > built) {
            let age = changed.duration_since(built).unwrap_or_default();
            panic!("{} is {} s older than {}: {REMEDY}", program.display(), age.as_secs(), file.display());
        }
        program
    })
}

/// When the file was changed.
fn changed(file: &Path) -> Option<SystemTime> {
    fs::metadata(file).and_then(|about| about.modified()).ok()
}

/// The last changed file of a folder. No program is built from unit tests.
fn newest(folder: &Path) -> Option<(SystemTime, PathBuf)> {
    let is_of_program = |path: &PathBuf| path.file_stem().is_none_or(|name| name != "tests");
    let of = |path: PathBuf| if path.is_dir() { newest(&path) } else { changed(&path).map(|time| (time, path)) };
    fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path()).filter(is_of_program).filter_map(of).max()
}
