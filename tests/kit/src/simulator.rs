// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion-sim`. `pinion` starts it from its own folder, and for a test cargo builds only the programs of the
//! test's package.

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use crate::process;

/// Has cargo build the program beside this `pinion`, once for a process. Returns its path.
///
/// # Panics
///
/// cargo failed.
pub fn build_beside(pinion: &Path) -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let program = pinion.with_file_name("pinion-sim");
        let mut cargo = Command::new(env::var_os("CARGO").unwrap_or("cargo".into()));
        cargo.current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
        // As a part of all tests: with this package alone, its libraries would have other features, and be built again.
        cargo.args(["test", "--locked", "--quiet", "--no-run", "--test", "pinion_sim"]);
        // TARGET/[TRIPLE/]PROFILE/pinion
        let folders: Vec<&str> = pinion.ancestors().skip(1).filter_map(|folder| folder.file_name()?.to_str()).collect();
        match folders[0] {
            "debug" => {}
            profile => drop(cargo.args(["--profile", profile])),
        }
        let mut target = pinion.ancestors().nth(2).expect("cargo's folder has folders");
        if folders[1].matches('-').count() >= 2 && folders[1].contains("-linux") {
            cargo.args(["--target", folders[1]]);
            target = target.parent().expect("cargo's folder has folders");
        }
        process::run(cargo.arg("--target-dir").arg(target)).unwrap_or_else(|error| panic!("{error}"));
        assert!(program.exists(), "cargo built no {}", program.display());
        program
    })
}
