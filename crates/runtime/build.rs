// SPDX-License-Identifier: GPL-3.0-or-later
//! Gives the program the state of its sources and the name of its compiler. `pinion --version`, the
//! status and the data dictionary say it.

use std::env;
use std::process::Command;

/// The sources of the program.
const SOURCES: [&str; 4] = ["../../src", "../../crates", "../../Cargo.toml", "../../Cargo.lock"];

/// Where the sources are not a checkout of git, as when a package is built, the builder may say
/// which state they are of.
const GIVEN: &str = "PINION_GIT_STATE";

fn main() {
    println!("cargo::rerun-if-env-changed={GIVEN}");
    for path in SOURCES {
        println!("cargo::rerun-if-changed={path}");
    }
    let state = match env::var(GIVEN) {
        Ok(given) => given,
        Err(_) => checkout().unwrap_or_default(),
    };
    let version = env::var("CARGO_PKG_VERSION").unwrap_or_default();
    match state.trim() {
        "" => println!("cargo::rustc-env=PINION_VERSION={version}"),
        state => println!("cargo::rustc-env=PINION_VERSION={version}-{state}"),
    }
    println!("cargo::rustc-env=PINION_COMPILER={}", compiler().unwrap_or_else(|| "?".into()));
}

/// The compiler's version, such as `1.88.0 (6b00bc388 2025-06-23)`: as Klipper's build, without the compiler's name.
/// The same compiler says the same everywhere, so a build stays reproducible.
fn compiler() -> Option<String> {
    let said = output(Command::new(env::var_os("RUSTC")?).arg("--version"))?;
    let said = said.lines().next()?;
    Some(said.strip_prefix("rustc ").unwrap_or(said).trim().to_owned())
}

/// The commit, such as `g167fa41abcde`, with `-dirty` behind it if what the program is made of was
/// changed since. None without git, or if the sources lie in the checkout of something else.
fn checkout() -> Option<String> {
    // A commit moves the branch, which writes this file.
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"])?;
    if !git(&["ls-files", "build.rs"])?.contains("build.rs") {
        return None;
    }
    println!("cargo::rerun-if-changed={}", log.trim());
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    let changes = git(&[&["status", "--porcelain", "--"][..], &SOURCES[..]].concat())?;
    let dirty = if changes.trim().is_empty() { "" } else { "-dirty" };
    Some(format!("g{}{dirty}", commit.trim()))
}

fn git(args: &[&str]) -> Option<String> {
    output(Command::new("git").args(args))
}

fn output(command: &mut Command) -> Option<String> {
    let output = command.output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}
