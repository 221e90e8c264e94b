// SPDX-License-Identifier: GPL-3.0-or-later
//! The test program for the guest: cargo's test target `kernel_guest`, with `pinion` itself, other programs to measure,
//! klippy if there is one, and their libraries.

use std::env;
use std::ffi::OsStr;
use std::fs;
use std::hash::{Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;

use super::klippy::Klippy;
use pinion_testkit::initramfs::Archive;
use pinion_testkit::process;

/// Programs of the computer without an equivalent in busybox.
const HOST_PROGRAMS: [&str; 1] = ["/usr/bin/chrt"];

/// An MCU program of the computer that is measured in addition to Pinion.
pub struct OtherProgram {
    pub name: String,
    path: PathBuf,
    arguments: String,
}

impl OtherProgram {
    /// Its path in the guest.
    fn path_inside(&self) -> String {
        format!("/tests/programs/{}", self.name)
    }

    /// The guest's command for it, with words between spaces.
    pub fn command(&self) -> String {
        format!("{} {}", self.path_inside(), self.arguments)
    }
}

impl FromStr for OtherProgram {
    type Err = String;

    fn from_str(text: &str) -> Result<OtherProgram, String> {
        let (name, path) = text.split_once('=').ok_or_else(|| format!("{text} is not NAME=PATH"))?;
        if name.is_empty() || name == "pinion" || !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') {
            return Err(format!("{name:?} is no name for a program: letters, digits and _, and not pinion"));
        }
        let (path, arguments) = path.split_once(' ').unwrap_or((path, ""));
        let path = fs::canonicalize(path).map_err(|error| format!("cannot read {path}: {error}"))?;
        Ok(OtherProgram { name: name.into(), path, arguments: arguments.into() })
    }
}

pub struct GuestProgram<'a> {
    path: PathBuf,
    others: &'a [OtherProgram],
    klippy: Option<Klippy>,
}

impl<'a> GuestProgram<'a> {
    /// Builds it with cargo, in the profile of this harness.
    pub fn build(others: &'a [OtherProgram]) -> Result<GuestProgram<'a>, String> {
        let klippy = Klippy::of_environment()?;
        let mut cargo = Command::new(env::var_os("CARGO").unwrap_or("cargo".into()));
        cargo.current_dir(env!("CARGO_MANIFEST_DIR"));
        cargo.args(["test", "--no-run", "--test", "kernel_guest", "--message-format", "json"]);
        let profile = pinion().parent().and_then(Path::file_name).and_then(OsStr::to_str);
        match profile {
            Some("debug") | None => {}
            Some(profile) => drop(cargo.args(["--profile", profile])),
        }
        let messages = process::output(&mut cargo)?;
        messages
            .lines()
            .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
            .find(|message| message["target"]["name"] == "kernel_guest" && message["executable"].is_string())
            .and_then(|message| message["executable"].as_str().map(PathBuf::from))
            .map(|path| GuestProgram { path, others, klippy })
            .ok_or_else(|| "cargo built no test target `kernel_guest`".into())
    }

    /// Whether the guest has klippy.
    pub fn has_klippy(&self) -> bool {
        self.klippy.is_some()
    }

    /// The names of its tests, in libtest's order.
    pub fn tests(&self) -> Result<Vec<String>, String> {
        let list = process::output(Command::new(&self.path).args(["--list", "--format", "terse"]))?;
        Ok(list.lines().filter_map(|line| line.strip_suffix(": test")).map(str::to_owned).collect())
    }

    /// The second part of the guest's root folder: init, what the computer has, and the libraries of all programs at the
    /// paths of the computer's loader.
    pub fn base(&self) -> Result<Vec<u8>, String> {
        let mut archive = Archive::default();
        archive.program("/init", include_bytes!("init.sh"));
        for program in HOST_PROGRAMS.map(Path::new) {
            let name = program.file_name().unwrap_or_default().to_string_lossy();
            archive.copy(&format!("/bin/{name}"), program)?;
        }
        if let Some(klippy) = &self.klippy {
            klippy.add_to(&mut archive)?;
        }
        for library in self.libraries()? {
            let content = fs::read(&library).map_err(|error| format!("cannot read {library}: {error}"))?;
            archive.program(&library, &content);
        }
        Ok(archive.finish())
    }

    /// The programs under test, and those that are measured, as another archive.
    pub fn programs(&self) -> Result<Vec<u8>, String> {
        let stripped = tempfile::tempdir().map_err(|error| error.to_string())?;
        let mut archive = Archive::default();
        for (name, program) in [("guest", self.path.as_path()), ("pinion", pinion())] {
            let copy = stripped.path().join(name);
            process::run(Command::new("strip").arg("--strip-debug").arg("-o").arg(&copy).arg(program))?;
            archive.copy(&format!("/bin/{name}"), &copy)?;
        }
        for other in self.others {
            archive.copy(&other.path_inside(), &other.path)?;
        }
        Ok(archive.finish())
    }

    /// Changes with everything that makes the base.
    pub fn hash_base(&self, hasher: &mut impl Hasher) -> Result<(), String> {
        for source in [include_str!("klippy.rs"), include_str!("init.sh")] {
            source.hash(hasher);
        }
        let libraries = self.libraries()?;
        let klippy = self.klippy.iter().flat_map(Klippy::files);
        hash_files(HOST_PROGRAMS.iter().map(Path::new).chain(libraries.iter().map(Path::new)).chain(klippy), hasher)
    }

    /// Changes with everything that makes the archive of programs.
    pub fn hash_programs(&self, hasher: &mut impl Hasher) -> Result<(), String> {
        hash_files(self.changing(), hasher)
    }

    fn changing(&self) -> impl Iterator<Item = &Path> {
        [self.path.as_path(), pinion()].into_iter().chain(self.others.iter().map(|other| other.path.as_path()))
    }

    /// The paths that the loader finds, including the loader's own.
    fn libraries(&self) -> Result<Vec<String>, String> {
        let klippy = self.klippy.iter().flat_map(Klippy::programs);
        let mut libraries = Vec::new();
        for program in self.changing().chain(HOST_PROGRAMS.iter().map(Path::new)).chain(klippy) {
            // "name => /path (address)", or "/path (address)" for the loader.
            let list = process::output(Command::new("ldd").arg(program))?;
            let found = list.split_whitespace().filter(|word| word.starts_with('/'));
            libraries.extend(found.map(str::to_owned));
            if let Some(line) = list.lines().find(|line| line.contains("not found")) {
                return Err(format!("{} lacks a library: {line}", program.display()));
            }
        }
        libraries.sort();
        libraries.dedup();
        Ok(libraries)
    }
}

fn pinion() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_pinion"))
}

/// cargo and dpkg replace a file, so no file changes without a change of these values.
fn hash_files<'a>(paths: impl Iterator<Item = &'a Path>, hasher: &mut impl Hasher) -> Result<(), String> {
    include_str!("guest_program.rs").hash(hasher);
    pinion_testkit::initramfs::SOURCE.hash(hasher);
    for path in paths {
        let describe = |error| format!("cannot read {}: {error}", path.display());
        let metadata = fs::metadata(path).map_err(describe)?;
        (path, metadata.len(), metadata.modified().map_err(describe)?).hash(hasher);
    }
    Ok(())
}
