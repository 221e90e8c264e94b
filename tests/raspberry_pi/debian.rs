// SPDX-License-Identifier: GPL-3.0-or-later
//! Debian's kernel of arm64 with the descriptions of the boards, busybox, and the emulator of a newer Debian.
//!
//! These packages are only unpacked. The computer's dpkg learns nothing of them.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

use super::board::{BOARDS, Board};
use pinion_testkit::apt::{self, Apt};
use pinion_testkit::cache::{self, Cache};
use pinion_testkit::process;

const BUSYBOX: &str = "busybox-static";
/// The package which always depends on the newest kernel.
const KERNEL: &str = "linux-image-arm64";
/// Begins an error of apt.
const NOT_OFFERED: &str = "apt offers not all packages: check the network, and that its sources name a Debian archive";

/// The first Debian whose QEMU has every board: QEMU 9 added the Raspberry Pi 4. Its kernel has device trees of all boards
/// of tools/system/tests/support/boards.rs.
const RELEASE: &str = "trixie";
const EMULATOR_PACKAGE: &str = "qemu-system-arm";

/// QEMU for ARM, unpacked with its libraries.
pub struct Emulator {
    /// The dynamic loader, which is beside the libraries. The computer's own libraries are too old.
    loader: PathBuf,
    folder: PathBuf,
}

impl Emulator {
    /// Downloads what the cache does not hold yet.
    pub fn prepare(cache: &Cache) -> Result<Emulator, String> {
        let _lock = cache.lock()?;
        let root = cache.root().join("emulator");
        let architecture = process::output(Command::new("dpkg").arg("--print-architecture"))?;
        let apt = Apt::open(&root.join("apt"), architecture.trim(), Some(RELEASE))?;
        let packages = Packages::of(&apt, Some(EMULATOR_PACKAGE), Vec::new(), Vec::new())?;
        let folder = packages.unpacked(&apt, &root, &format!("QEMU of Debian {RELEASE}"))?;
        let pattern = folder.join("usr/lib/*/ld-linux*.so.*");
        let mut loaders = glob::glob(&pattern.to_string_lossy()).map_err(|error| error.to_string())?;
        let loader = loaders.find_map(Result::ok).ok_or_else(|| format!("there is no {}", pattern.display()))?;
        Ok(Emulator { loader, folder })
    }

    pub fn command(&self) -> Command {
        let libraries = self.loader.parent().expect("a file has a folder");
        let mut command = Command::new(&self.loader);
        command
            .arg("--library-path")
            .arg(libraries)
            .arg(self.folder.join("usr/bin/qemu-system-aarch64"))
            // Otherwise it tries the modules of the computer's QEMU.
            .env("QEMU_MODULE_DIR", libraries.join("qemu"));
        command
    }
}

/// The kernel of the boards, and busybox.
pub struct Kernel {
    /// As `uname -r` will print it.
    pub release: String,
    folder: PathBuf,
}

impl Kernel {
    /// Downloads what the cache does not hold yet.
    pub fn prepare(cache: &Cache) -> Result<Kernel, String> {
        let _lock = cache.lock()?;
        let root = cache.root().join("arm64-kernel");
        let apt = Apt::open(&root.join("apt"), "arm64", None)?;
        let release = kernel_release(&apt)?;
        // Its modules are large, and all that is needed is built in.
        let parts = BOARDS.iter().map(|board| format!("*/{}", board.device_tree));
        let parts = parts.chain(["./boot/vmlinuz-*".to_owned()]).collect();
        let packages = Packages::of(&apt, None, vec![BUSYBOX.to_owned(), image(&release)], parts)?;
        let folder = packages.unpacked(&apt, &root, &format!("Linux {release} of arm64"))?;
        Ok(Kernel { release, folder })
    }

    pub fn image(&self) -> PathBuf {
        self.folder.join(format!("boot/vmlinuz-{}", self.release))
    }

    pub fn device_tree(&self, board: &Board) -> PathBuf {
        self.folder.join(format!("usr/lib/linux-image-{}", self.release)).join(board.device_tree)
    }

    pub fn busybox(&self) -> PathBuf {
        self.folder.join("bin/busybox")
    }
}

/// Downloads the device trees of a newer kernel, unless the cache holds them. Returns their folder.
pub fn device_trees(cache: &Cache) -> Result<PathBuf, String> {
    let _lock = cache.lock()?;
    let root = cache.root().join("device-trees");
    let apt = Apt::open(&root.join("apt"), "arm64", Some(RELEASE))?;
    let release = kernel_release(&apt)?;
    let packages = Packages::of(&apt, None, vec![image(&release)], vec!["*.dtb".to_owned()])?;
    let folder = packages.unpacked(&apt, &root, &format!("the device trees of Linux {release}"))?;
    Ok(folder.join(format!("usr/lib/linux-image-{release}")))
}

/// The package of a kernel.
fn image(release: &str) -> String {
    format!("linux-image-{release}")
}

/// The release of its newest kernel, as `uname -r` prints it.
fn kernel_release(apt: &Apt) -> Result<String, String> {
    let mut show = apt.command("apt-cache");
    let shown = process::output(show.args(["show", "--no-all-versions", KERNEL]))
        .map_err(|cause| format!("{NOT_OFFERED}: {cause}"))?;
    shown
        .lines()
        .find_map(|line| line.strip_prefix("Depends: linux-image-")?.split(' ').next())
        .map(str::to_owned)
        .ok_or_else(|| format!("{KERNEL} depends on no kernel that this suite knows:\n{shown}"))
}

/// Packages to unpack.
struct Packages {
    /// Unpacked with all that it depends on.
    whole: Option<&'static str>,
    alone: Vec<String>,
    /// The files that are unpacked of a kernel.
    parts_of_kernel: Vec<String>,
    /// The archives' names; they contain the versions.
    files: Vec<String>,
}

impl Packages {
    fn of(
        apt: &Apt,
        whole: Option<&'static str>,
        alone: Vec<String>,
        parts_of_kernel: Vec<String>,
    ) -> Result<Packages, String> {
        let print = |action: &str, packages: &[String]| -> Result<Vec<String>, String> {
            let mut command = apt.command("apt-get");
            command.args([action, "-qq", "--print-uris"]).args(packages);
            // 'URI' file size hash
            let list = process::output(&mut command)?;
            Ok(list.lines().filter_map(|line| line.split(' ').nth(1)).map(str::to_owned).collect())
        };
        let mut files = Vec::new();
        for (action, packages) in [("install", whole.map(str::to_owned).as_slice()), ("download", &alone)] {
            if !packages.is_empty() {
                files.extend(print(action, packages).map_err(|cause| format!("{NOT_OFFERED}: {cause}"))?);
            }
        }
        files.sort();
        Ok(Packages { whole, alone, parts_of_kernel, files })
    }

    /// Changes with everything that is unpacked.
    fn key(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        include_str!("debian.rs").hash(&mut hasher);
        self.parts_of_kernel.hash(&mut hasher);
        self.files.hash(&mut hasher);
        hasher.finish()
    }

    /// The folder below `root` where they are unpacked, downloaded if necessary.
    fn unpacked(&self, apt: &Apt, root: &Path, what: &str) -> Result<PathBuf, String> {
        cache::made(root, "sysroot-", self.key(), |folder| {
            eprintln!("fetching {what}, {} packages", self.files.len());
            self.unpack(apt, folder)
        })
    }

    fn unpack(&self, apt: &Apt, folder: &Path) -> Result<(), String> {
        let archives = folder.with_extension("archives");
        for path in [folder, &archives] {
            fs::create_dir(path).map_err(|error| format!("cannot create {}: {error}", path.display()))?;
        }
        if let Some(whole) = self.whole {
            process::run(
                apt.command("apt-get")
                    .args(["install", "-qq", "-y", "--download-only", "-o"])
                    .arg(apt::option("Dir::Cache::archives", &archives))
                    .arg(whole),
            )?;
        }
        if !self.alone.is_empty() {
            process::run(apt.command("apt-get").args(["download", "-qq"]).args(&self.alone).current_dir(&archives))?;
        }
        for file in &self.files {
            let archive = archives.join(file);
            let parts = match file.starts_with("linux-image-") {
                true => self.parts_of_kernel.clone(),
                false => vec!["./*".to_owned()],
            };
            let words = [archive.to_str(), folder.to_str()];
            let mut words: Vec<&str> = words.into_iter().map(|word| word.expect("it was UTF-8 before")).collect();
            words.extend(parts.iter().map(String::as_str));
            process::pipeline(
                r#"archive=$1 tree=$2; shift 2
                   dpkg-deb --fsys-tarfile "$archive" | tar -x -C "$tree" --wildcards "$@""#,
                &words,
            )?;
        }
        cache::remove(&archives)
    }
}
