// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion` and the guest's tests, built for arm64.

use std::collections::BTreeMap;
use std::env;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::debian::{RUSTC, Sysroot, TOOL_PREFIX};
use pinion_testkit::initramfs::Archive;
use pinion_testkit::process;

const TARGET: &str = "aarch64-unknown-linux-gnu";
const TESTS: &str = "raspberry_pi_guest";
/// The kernel finds it by the name in each program.
const LOADER: &str = "ld-linux-aarch64.so.1";

/// The programs, each with its name in the guest.
pub struct Programs(Vec<(&'static str, PathBuf)>);

impl Programs {
    /// Builds them with cargo in a separate target folder, because this rustc differs from the usual one.
    pub fn build(sysroot: &Sysroot) -> Result<Programs, String> {
        eprintln!("building for arm64");
        let mut cargo = Command::new(env::var_os("CARGO").unwrap_or("cargo".into()));
        cargo
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["build", "--locked", "--target", TARGET, "--bin", "pinion", "--test", TESTS])
            .args(["--message-format", "json", "--target-dir"])
            .arg(Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("raspberry-pi"))
            .env("RUSTC", RUSTC)
            .env("CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER", format!("{TOOL_PREFIX}gcc"))
            .env("CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUSTFLAGS", flags(sysroot))
            // cargo has set it for this program, to libraries of the other rustc.
            .env_remove("LD_LIBRARY_PATH")
            .env_remove("RUSTC_WRAPPER")
            .env_remove("RUSTFLAGS");
        let messages = process::output(&mut cargo)?;
        let executables: Vec<serde_json::Value> = messages
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .filter(|message: &serde_json::Value| message["executable"].is_string())
            .collect();
        let program = |name: &'static str| {
            executables
                .iter()
                .find(|message| message["target"]["name"] == name)
                .and_then(|message| message["executable"].as_str())
                .map(|path| (name, PathBuf::from(path)))
                .ok_or_else(|| format!("cargo built no {name} for arm64"))
        };
        Ok(Programs(vec![program("pinion")?, program(TESTS)?]))
    }

    /// The guest's root folder.
    pub fn initramfs(&self, sysroot: &Sysroot) -> Result<Archive, String> {
        let mut archive = Archive::with_busybox(&sysroot.busybox())?;
        archive.program("/init", include_bytes!("init.sh"));
        let stripped = tempfile::tempdir().map_err(|error| error.to_string())?;
        let mut libraries = BTreeMap::new();
        for (name, path) in &self.0 {
            let copy = stripped.path().join(name);
            process::run(
                Command::new(format!("{TOOL_PREFIX}strip")).arg("--strip-debug").arg("-o").arg(&copy).arg(path),
            )?;
            archive.copy(&format!("/bin/{name}"), &copy)?;
            find_libraries(path, sysroot, &mut libraries)?;
        }
        for (name, path) in &libraries {
            let content = fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
            let folder = if name == LOADER { "/lib" } else { "/lib/aarch64-linux-gnu" };
            archive.program(&format!("{folder}/{name}"), &content);
        }
        Ok(archive)
    }
}

/// The standard library and the other libraries come from the sysroot. The C library for linking comes with the cross
/// compiler.
fn flags(sysroot: &Sysroot) -> OsString {
    let mut flags = OsString::from("--sysroot=");
    flags.push(sysroot.path().join("usr"));
    for folder in sysroot.library_folders() {
        flags.push(" -Lnative=");
        flags.push(&folder);
        flags.push(" -Clink-arg=-Wl,-rpath-link,");
        flags.push(&folder);
    }
    flags
}

/// Adds the libraries that the program needs, and the libraries that those need. `ldd` would have to run the program.
fn find_libraries(program: &Path, sysroot: &Sysroot, found: &mut BTreeMap<String, PathBuf>) -> Result<(), String> {
    let dynamic = process::output(Command::new(format!("{TOOL_PREFIX}readelf")).args(["-dW"]).arg(program))?;
    // 0x0000000000000001 (NEEDED)  Shared library: [libiio.so.0]
    let needed = dynamic
        .lines()
        .filter(|line| line.contains("(NEEDED)"))
        .filter_map(|line| Some(line.split_once('[')?.1.trim_end_matches(']')));
    for name in needed {
        if found.contains_key(name) {
            continue;
        }
        let path = sysroot
            .library_folders()
            .into_iter()
            .map(|folder| folder.join(name))
            .find(|path| path.exists())
            .ok_or_else(|| format!("{} needs {name}, which is in none of the packages", program.display()))?;
        found.insert(name.to_owned(), path.clone());
        find_libraries(&path, sysroot, found)?;
    }
    Ok(())
}
