// SPDX-License-Identifier: GPL-3.0-or-later
//! Debian's arm64: libraries to build against, busybox, and the kernel with the
//! description of the Raspberry Pi 3.
//!
//! The computer's dpkg learns nothing of arm64. It only gets the compilers and the emulator, which are ordinary packages.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

use pinion_testkit::apt::{self, Apt};
use pinion_testkit::cache::Cache;
use pinion_testkit::{process, tools};

/// Rust's compiler as Debian has it: rustup's has no standard library that goes
/// with Debian's for arm64.
pub const RUSTC: &str = "/usr/bin/rustc";
const RUSTC_PACKAGE: &str = "rustc-web";
/// Cross gcc, strip and readelf begin with it.
pub const TOOL_PREFIX: &str = "aarch64-linux-gnu-";
pub const EMULATOR: &str = "qemu-system-aarch64";

/// What the host gets.
const TOOLS: [&str; 4] = ["qemu-system-arm", "gcc-aarch64-linux-gnu", "libc6-dev-arm64-cross", RUSTC_PACKAGE];
/// What pinion links to; unpacked with all that it depends on.
const LIBRARY: &str = "libiio-dev";
/// Unpacked alone.
const STANDARD_LIBRARY: &str = "libstd-rust-web-dev";
const BUSYBOX: &str = "busybox-static";
/// The package which always depends on the newest kernel.
const KERNEL: &str = "linux-image-arm64";
const DEVICE_TREE: &str = "broadcom/bcm2837-rpi-3-b.dtb";

/// The unpacked packages.
pub struct Sysroot {
    /// As `uname -r` will print it.
    pub release: String,
    folder: PathBuf,
}

impl Sysroot {
    /// Downloads what the cache does not hold yet.
    pub fn prepare(cache: &Cache) -> Result<Sysroot, String> {
        install_tools()?;
        let _lock = cache.lock()?;
        let root = cache.root().join("arm64");
        let apt = Apt::open(&root.join("apt"), "arm64", None)?;
        let release = kernel_release(&apt)?;
        let packages = Packages::of(&apt, &release)?;
        let folder = root.join(format!("sysroot-{:016x}", packages.key()));
        if !folder.exists() {
            eprintln!("fetching {} packages of Debian's arm64, with Linux {release}", packages.files.len());
            remove_others(&root, &folder)?;
            let partial = folder.with_extension("partial");
            packages.unpack(&apt, &partial)?;
            fs::rename(&partial, &folder).map_err(|error| describe("rename", &partial, &error))?;
        }
        Ok(Sysroot { release, folder })
    }

    pub fn path(&self) -> &Path {
        &self.folder
    }

    pub fn kernel(&self) -> PathBuf {
        self.folder.join(format!("boot/vmlinuz-{}", self.release))
    }

    pub fn device_tree(&self) -> PathBuf {
        self.folder.join(format!("usr/lib/linux-image-{}", self.release)).join(DEVICE_TREE)
    }

    pub fn busybox(&self) -> PathBuf {
        self.folder.join("bin/busybox")
    }

    /// Where its libraries are.
    pub fn library_folders(&self) -> [PathBuf; 2] {
        ["lib/aarch64-linux-gnu", "usr/lib/aarch64-linux-gnu"].map(|folder| self.folder.join(folder))
    }
}

/// Adds to the host what it lacks.
fn install_tools() -> Result<(), String> {
    let missing: Vec<&str> = TOOLS.into_iter().filter(|package| installed_version(package).is_err()).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let packages = missing.join(" ");
    if !nix::unistd::geteuid().is_root() {
        return Err(format!("this suite needs: sudo apt-get install --no-install-recommends {packages}"));
    }
    eprintln!("installing {packages}");
    tools::update_package_lists()?;
    process::run(
        Command::new("apt-get")
            .args(["install", "-qq", "-y", "--no-install-recommends"])
            // Rather not at all than instead of another Rust.
            .args(["--no-remove", "-o", "DPkg::Lock::Timeout=120"])
            .args(missing)
            .env("DEBIAN_FRONTEND", "noninteractive"),
    )
    .map_err(|cause| format!("this suite needs the packages {packages}: {cause}"))
}

fn installed_version(package: &str) -> Result<String, String> {
    let state =
        process::output(Command::new("dpkg-query").args(["-W", "-f", "${db:Status-Status} ${Version}", package]))?;
    match state.split_once(' ') {
        Some(("installed", version)) => Ok(version.to_owned()),
        _ => Err(format!("{package} is not installed")),
    }
}

/// The release of its newest kernel, as `uname -r` prints it.
fn kernel_release(apt: &Apt) -> Result<String, String> {
    let mut show = apt.command("apt-cache");
    let shown = process::output(show.args(["show", "--no-all-versions", KERNEL])).map_err(|cause| {
        format!(
            "apt offers no {KERNEL} for arm64: is there a network, and one of Debian's archives among apt's sources? \
             {cause}"
        )
    })?;
    shown
        .lines()
        .find_map(|line| line.strip_prefix("Depends: linux-image-")?.split(' ').next())
        .map(str::to_owned)
        .ok_or_else(|| format!("{KERNEL} depends on no kernel that this suite knows:\n{shown}"))
}

/// What is unpacked.
struct Packages {
    alone: Vec<String>,
    /// Their files' names; they contain the versions.
    files: Vec<String>,
}

impl Packages {
    fn of(apt: &Apt, release: &str) -> Result<Packages, String> {
        let version = installed_version(RUSTC_PACKAGE)?;
        let alone = vec![format!("{STANDARD_LIBRARY}={version}"), BUSYBOX.to_owned(), format!("linux-image-{release}")];
        let print = |arguments: &[&str], packages: &[String]| -> Result<Vec<String>, String> {
            let mut command = apt.command("apt-get");
            command.args(arguments).args(["-qq", "--print-uris"]).args(packages);
            // 'URI' file size hash
            let list = process::output(&mut command)?;
            Ok(list.lines().filter_map(|line| line.split(' ').nth(1)).map(str::to_owned).collect())
        };
        let mut files = print(&["install"], &[LIBRARY.to_owned()])?;
        files.extend(print(&["download"], &alone).map_err(|cause| {
            format!(
                "apt offers no standard library for {RUSTC_PACKAGE} {version}; \
                 sudo apt-get update && sudo apt-get install {RUSTC_PACKAGE} may help: {cause}"
            )
        })?);
        files.sort();
        Ok(Packages { alone, files })
    }

    /// Changes with everything that is unpacked.
    fn key(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        include_str!("debian.rs").hash(&mut hasher);
        self.files.hash(&mut hasher);
        hasher.finish()
    }

    fn unpack(&self, apt: &Apt, folder: &Path) -> Result<(), String> {
        let archives = folder.with_extension("archives");
        for path in [folder, &archives] {
            remove(path)?;
            fs::create_dir_all(path).map_err(|error| describe("create", path, &error))?;
        }
        process::run(
            apt.command("apt-get")
                .args(["install", "-qq", "-y", "--download-only", "-o"])
                .arg(apt::option("Dir::Cache::archives", &archives))
                .arg(LIBRARY),
        )?;
        process::run(apt.command("apt-get").args(["download", "-qq"]).args(&self.alone).current_dir(&archives))?;
        for file in &self.files {
            let archive = archives.join(file);
            // Of the kernel only what boots: its modules are large and all that is
            // needed is built in.
            let parts: &[&str] = match file.starts_with("linux-image-") {
                true => &["./boot/vmlinuz-*", "*/bcm2837-rpi-3-b.dtb"],
                false => &["./*"],
            };
            let words = [archive.to_str(), folder.to_str()];
            let mut words: Vec<&str> = words.into_iter().map(|word| word.expect("it was UTF-8 before")).collect();
            words.extend(parts);
            process::pipeline(
                r#"archive=$1 tree=$2; shift 2
                   dpkg-deb --fsys-tarfile "$archive" | tar -x -C "$tree" --wildcards "$@""#,
                &words,
            )?;
        }
        remove(&archives)
    }
}

/// Removes what earlier versions left.
fn remove_others(root: &Path, keep: &Path) -> Result<(), String> {
    let entries = fs::read_dir(root).map_err(|error| describe("read", root, &error))?;
    for entry in entries {
        let entry = entry.map_err(|error| describe("read", root, &error))?;
        if entry.path() != keep && entry.file_name().to_string_lossy().starts_with("sysroot-") {
            remove(&entry.path())?;
        }
    }
    Ok(())
}

fn remove(folder: &Path) -> Result<(), String> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(describe("remove", folder, &error)),
        _ => Ok(()),
    }
}

fn describe(action: &str, path: &Path, error: &std::io::Error) -> String {
    format!("cannot {action} {}: {error}", path.display())
}
