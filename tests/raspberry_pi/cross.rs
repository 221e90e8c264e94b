// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion` and the guest's tests, built as `make deb` builds the package for another architecture.

use std::collections::BTreeMap;
use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::debian::Kernel;
use pinion_testkit::cache::Cache;
use pinion_testkit::initramfs::Archive;
use pinion_testkit::process;

const TESTS: &str = "raspberry_pi_guest";

/// The programs' architecture. The kernel is arm64's with both, as in a Raspberry Pi OS of 32 bits.
pub struct Architecture {
    /// Debian's name, and the value of `--arch`.
    pub debian: &'static str,
    /// GNU's name: of the folder of libraries, and the first part of the names of gcc, strip and readelf.
    gnu: &'static str,
    /// The kernel finds it by the name in each program.
    loader: &'static str,
}

pub const ARCHITECTURES: [Architecture; 2] = [
    Architecture { debian: "arm64", gnu: "aarch64-linux-gnu", loader: "ld-linux-aarch64.so.1" },
    Architecture { debian: "armhf", gnu: "arm-linux-gnueabihf", loader: "ld-linux-armhf.so.3" },
];

/// The programs, and the libraries to build against.
pub struct Programs {
    architecture: &'static Architecture,
    libraries: PathBuf,
    /// Each with its name in the guest.
    programs: Vec<(&'static str, PathBuf)>,
}

impl Programs {
    /// Builds them with cargo. Downloads what the cache does not hold yet.
    pub fn build(architecture: &'static Architecture, cache: &Cache) -> Result<Programs, String> {
        let _lock = cache.lock()?;
        eprintln!("building for {}", architecture.debian);
        let libraries = cache.root().join(architecture.debian);
        let mut cargo = Command::new("sh");
        cargo
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["-c", r#"set -e; prepared=$(scripts/cross "$1" "$2"); eval "$prepared"; shift 2; exec "$@""#, "sh"])
            .arg(architecture.debian)
            .arg(&libraries)
            .arg(env::var_os("CARGO").unwrap_or("cargo".into()))
            .args(["build", "--locked", "--bin", "pinion", "--test", TESTS])
            .args(["--message-format", "json", "--target-dir"])
            .arg(Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("raspberry-pi"))
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
                .ok_or_else(|| format!("cargo built no {name} for {}", architecture.debian))
        };
        Ok(Programs { architecture, libraries, programs: vec![program("pinion")?, program(TESTS)?] })
    }

    /// The guest's root folder.
    pub fn initramfs(&self, kernel: &Kernel) -> Result<Archive, String> {
        let Architecture { gnu, loader, .. } = self.architecture;
        let mut archive = Archive::with_busybox(&kernel.busybox())?;
        archive.program("/init", include_bytes!("init.sh"));
        let stripped = tempfile::tempdir().map_err(|error| error.to_string())?;
        let mut libraries = BTreeMap::new();
        for (name, path) in &self.programs {
            let copy = stripped.path().join(name);
            process::run(Command::new(format!("{gnu}-strip")).arg("--strip-debug").arg("-o").arg(&copy).arg(path))?;
            archive.copy(&format!("/bin/{name}"), &copy)?;
            self.find_libraries(path, &mut libraries)?;
        }
        for (name, path) in &libraries {
            let content = fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
            let folder = if name == loader { "/lib".to_owned() } else { format!("/lib/{gnu}") };
            archive.program(&format!("{folder}/{name}"), &content);
        }
        Ok(archive)
    }

    /// Adds the libraries that the program needs, and the libraries that those need. `ldd` would have to run the program.
    fn find_libraries(&self, program: &Path, found: &mut BTreeMap<String, PathBuf>) -> Result<(), String> {
        let gnu = self.architecture.gnu;
        let dynamic = process::output(Command::new(format!("{gnu}-readelf")).args(["-dW"]).arg(program))?;
        // 0x0000000000000001 (NEEDED)  Shared library: [libiio.so.0]
        let needed = dynamic
            .lines()
            .filter(|line| line.contains("(NEEDED)"))
            .filter_map(|line| Some(line.split_once('[')?.1.trim_end_matches(']')));
        for name in needed {
            if found.contains_key(name) {
                continue;
            }
            let path = ["lib", "usr/lib"]
                .map(|folder| self.libraries.join(folder).join(gnu).join(name))
                .into_iter()
                .find(|path| path.exists())
                .ok_or_else(|| format!("{} needs {name}, which is in none of the packages", program.display()))?;
            found.insert(name.to_owned(), path.clone());
            self.find_libraries(&path, found)?;
        }
        Ok(())
    }
}
