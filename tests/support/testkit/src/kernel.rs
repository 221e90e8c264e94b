// SPDX-License-Identifier: GPL-3.0-or-later
//! The boot files of a VM: Debian's own kernel, the modules that the tests use, and the modules of
//! `tests/support/testkit/modules` built for it.
//!
//! Modules fit one exact kernel, so every version comes from apt. Packages are unpacked below the cache, never
//! installed.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;

use super::apt::Apt;
use super::cache::{self, Cache, remove};
use super::initramfs::Archive;
use super::{describe, process, tools};

/// The kernels come from this release of Debian on every computer. The mocks are written for its kernel, and figures of two
/// computers can be compared.
const RELEASE: &str = "bookworm";

/// The kernels that were tested last. Debian offers them for some months after the next ones, which are used when it
/// does so no longer.
const PINNED: &str = "6.1.0-56";

/// Debian's kernels on which Pinion runs.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Flavour {
    /// Debian's default kernel.
    Stock,
    /// PREEMPT_RT.
    Rt,
}

impl Flavour {
    /// The flavors for the tests.
    pub const ALL: [Flavour; 2] = [Flavour::Stock, Flavour::Rt];

    /// The first part of a test's name.
    pub fn name(self) -> &'static str {
        match self {
            Flavour::Stock => "stock",
            Flavour::Rt => "rt",
        }
    }

    /// The end of its packages' names.
    fn suffix(self) -> &'static str {
        match self {
            Flavour::Stock => "amd64",
            Flavour::Rt => "rt-amd64",
        }
    }
}

impl FromStr for Flavour {
    type Err = String;

    fn from_str(name: &str) -> Result<Flavour, String> {
        Flavour::ALL
            .into_iter()
            .find(|flavour| flavour.name() == name)
            .ok_or_else(|| format!("no flavour is called {name}: stock or rt"))
    }
}

/// Loaded in this order, with options. Dependencies come before them.
const MODULES: [(&str, &str); 19] = [
    ("virtio_pci", ""),
    ("9pnet_virtio", ""),
    ("9p", ""),
    ("phram", ""),
    ("gpio-sim", ""),
    ("iio_dummy", ""),
    ("iio_dummy_evgen", ""),
    ("mock_adc", ""),
    ("mock_spi", ""),
    ("i2c-dev", ""),
    ("mock_i2c", ""),
    ("gpio-pca953x", ""),
    ("mock_pwm", ""),
    ("w1_therm", ""),
    ("mock_w1", ""),
    ("vcan", ""),
    ("can-raw", ""),
    // An unfed watchdog writes a message, and the other tests continue.
    ("softdog", "soft_noboot=1"),
    ("i2c-stub", "chip_addr=0x1c"),
];

/// Shows the plan to the guest. The guest loads it later than the others: see `init.sh`.
const PLAN_READER: &str = "qemu_fw_cfg";

/// Its driver asks every two seconds. So only its test loads it, and unloads it.
const FIRMWARE: &str = "mock_firmware";

/// The parts of an image package with these modules.
const IMAGE_PARTS: [&str; 32] = [
    "*/modules.builtin*",
    // The last parts are for the system that `tests/package` boots from a disk.
    "*/drivers/firmware/qemu_fw_cfg.ko",
    "*/drivers/i2c/*",
    "*/drivers/iio/*",
    "*/drivers/mtd/devices/phram.ko",
    "*/drivers/mtd/mtd.ko",
    "*/net/can/*",
    "*/drivers/virtio/*",
    "*/drivers/w1/*",
    "*/drivers/watchdog/*",
    "*/fs/9p/*",
    "*/fs/configfs/*",
    "*/fs/fscache/*",
    "*/fs/netfs/*",
    "*/net/9p/*",
    "./boot/vmlinuz-*",
    "*/crypto/crc32c_generic.ko",
    "*/drivers/block/virtio_blk.ko",
    "*/drivers/char/virtio_console.ko",
    "*/drivers/usb/class/cdc-acm.ko",
    "*/drivers/usb/common/usb-common.ko",
    "*/drivers/usb/core/usbcore.ko",
    "*/drivers/usb/gadget/function/u_serial.ko",
    "*/drivers/usb/gadget/function/usb_f_acm.ko",
    "*/drivers/usb/gadget/libcomposite.ko",
    "*/drivers/usb/gadget/udc/dummy_hcd.ko",
    "*/drivers/usb/gadget/udc/udc-core.ko",
    "*/fs/autofs/*",
    "*/fs/ext4/*",
    "*/fs/jbd2/*",
    "*/fs/mbcache.ko",
    "*/lib/crc*.ko",
];

/// Upstream's mocks and drivers, with their includes. A folder means all its files.
const UPSTREAM: [&str; 8] = [
    "kernel/irq/irq_sim.c",
    "drivers/gpio/gpio-pca953x.c",
    "drivers/gpio/gpio-sim.c",
    "drivers/gpio/gpiolib.h",
    "drivers/hwmon/raspberrypi-hwmon.c",
    "drivers/iio/dummy",
    "drivers/iio/industrialio-configfs.c",
    "drivers/iio/industrialio-sw-device.c",
];

/// If a module is made of a source of the same name, that source must be renamed.
const UPSTREAM_RENAMED: [(&str, &str); 3] = [
    ("gpio-pca953x.c", "gpio-pca953x-main.c"),
    ("gpio-sim.c", "gpio-sim-main.c"),
    ("iio_dummy_evgen.c", "iio_dummy_evgen-main.c"),
];

/// A kernel, ready to boot.
pub struct Kernel {
    /// As `uname -r` prints it.
    pub release: String,
    /// The uncompressed kernel.
    pub vmlinux: PathBuf,
    /// Busybox, the modules, and `/tests/modules`, the list in loading order.
    pub initramfs: PathBuf,
}

impl Kernel {
    /// Its folder in the cache.
    pub fn folder(&self) -> &Path {
        self.vmlinux.parent().expect("it is in a folder")
    }

    /// Makes everything that the cache does not contain yet. The caller has its lock.
    pub fn prepare(flavour: Flavour, offers: &Offers, cache: &Cache) -> Result<Kernel, String> {
        let release = offers.release(flavour)?;
        let version = offers.version(&release)?;
        let of_version = cache.root().join(format!("linux-{version}"));
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("modules");
        create(&of_version)?;
        let folder = cache::made(&of_version, &format!("{}-", flavour.name()), key(&sources)?, |folder| {
            eprintln!("building Linux {release}, version {version}");
            build(&offers.apt, &release, &of_version.join("tree"), &sources, folder)?;
            cache::remove_others(cache.root(), "linux-", &of_version)
        })?;
        Ok(Kernel { release, vmlinux: folder.join("vmlinux"), initramfs: folder.join("initramfs") })
    }
}

/// The kernels of Debian 12.
pub struct Offers {
    apt: Apt,
}

impl Offers {
    /// Asks apt for them. The caller has the cache's lock.
    pub fn ask(cache: &Cache) -> Result<Offers, String> {
        Apt::open(&cache.root().join("apt"), "amd64", Some(RELEASE)).map(|apt| Offers { apt })
    }

    /// Debian 12's archives, as a sources.list.
    pub fn sources(&self) -> PathBuf {
        self.apt.sources()
    }

    /// The pinned kernel, or the newest one, as `uname -r` prints it.
    fn release(&self, flavour: Flavour) -> Result<String, String> {
        let pinned = format!("{PINNED}-{}", flavour.suffix());
        if self.version(&pinned).is_ok() {
            return Ok(pinned);
        }
        // It depends on the newest one.
        let newest = Fields::of(&self.apt, &format!("linux-image-{}", flavour.suffix()))?;
        let newest = newest.dependency("linux-image-")?.replace("linux-image-", "");
        eprintln!("Debian offers Linux {pinned} no longer: the tests run on {newest}");
        Ok(newest)
    }

    /// The version of a kernel's package.
    fn version(&self, release: &str) -> Result<String, String> {
        Fields::of(&self.apt, &format!("linux-image-{release}"))?.field("Version").map(str::to_owned)
    }
}

/// apt's names of the packages for one kernel.
struct Packages {
    image: String,
    headers: String,
    headers_common: String,
    kbuild: String,
    source: String,
    compiler: String,
}

impl Packages {
    fn of(apt: &Apt, release: &str) -> Result<Packages, String> {
        let headers = format!("linux-headers-{release}");
        let fields = Fields::of(apt, &headers)?;
        let kbuild = fields.dependency("linux-kbuild-")?;
        // linux-compiler-gcc-12-x86 means gcc-12.
        let compiler = fields.dependency("linux-compiler-")?;
        let compiler = compiler.trim_start_matches("linux-compiler-").trim_end_matches("-x86");
        Ok(Packages {
            image: format!("linux-image-{release}"),
            headers_common: fields.dependency("linux-headers-")?,
            source: kbuild.replace("linux-kbuild-", "linux-source-"),
            compiler: compiler.to_owned(),
            headers,
            kbuild,
        })
    }
}

/// apt's fields of a package.
struct Fields(String);

impl Fields {
    fn of(apt: &Apt, package: &str) -> Result<Fields, String> {
        let mut show = apt.command("apt-cache");
        show.args(["show", "--no-all-versions", package]);
        process::output(&mut show).map(Fields).map_err(|cause| format!("apt offers no {package}: {cause}"))
    }

    fn field(&self, name: &str) -> Result<&str, String> {
        self.0
            .lines()
            .find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
            .ok_or_else(|| format!("apt says nothing of {name} in:\n{}", self.0))
    }

    fn dependency(&self, prefix: &str) -> Result<String, String> {
        self.field("Depends")?
            .split(", ")
            .filter_map(|dependency| dependency.split(' ').next())
            .find(|name| name.starts_with(prefix))
            .map(str::to_owned)
            .ok_or_else(|| {
                format!("no {prefix}*, which the tests know from Debian 12, among the dependencies of:\n{}", self.0)
            })
    }
}

/// Changes with everything that makes a prepared kernel, except its version.
fn key(sources: &Path) -> Result<u64, String> {
    let mut hasher = DefaultHasher::new();
    include_str!("kernel.rs").hash(&mut hasher);
    super::initramfs::SOURCE.hash(&mut hasher);
    include_str!("start.sh").hash(&mut hasher);
    for path in files(sources)? {
        path.file_name().hash(&mut hasher);
        read(&path)?.hash(&mut hasher);
    }
    Ok(hasher.finish())
}

fn build(apt: &Apt, release: &str, tree: &Path, sources: &Path, folder: &Path) -> Result<(), String> {
    let packages = Packages::of(apt, release)?;
    tools::install(&[(&packages.compiler, &packages.compiler)])?;
    unpack(apt, &packages, tree)?;

    create(folder)?;
    // The kernel's makefiles refuse a path with a space or a colon.
    let elsewhere = match path_str(tree)?.contains([' ', ':']) {
        true => {
            Some(tempfile::tempdir_in("/var/tmp").map_err(|error| describe("write", Path::new("/var/tmp"), &error))?)
        }
        false => None,
    };
    let (headers, modules) = match &elsewhere {
        Some(elsewhere) => {
            process::run(Command::new("cp").arg("-a").arg(tree.join("usr")).arg(elsewhere.path()))?;
            (elsewhere.path().join("usr/src"), elsewhere.path().join("modules"))
        }
        None => (tree.join("usr/src"), folder.join("modules")),
    };
    copy_files(sources, &modules)?;
    copy_files(&tree.join("upstream"), &modules.join("upstream"))?;
    process::run(
        Command::new("make")
            .arg("-C")
            .arg(headers.join(&packages.headers))
            // The Makefile that the headers include has an absolute path of the computer.
            .arg("-f")
            .arg(headers.join(&packages.headers_common).join("Makefile"))
            .arg(format!("M={}", modules.display()))
            .args(["-s", "-j2", "modules"]),
    )?;

    let image = tree.join("lib/modules").join(release);
    archive_modules(&image, &modules, tree, &folder.join("initramfs"))?;
    let vmlinuz = tree.join(format!("boot/vmlinuz-{release}"));
    extract_vmlinux(&vmlinuz, &folder.join("vmlinux"))?;
    remove(&modules)
}

/// Downloads and unpacks the parts that the tree lacks. Flavors share most parts.
fn unpack(apt: &Apt, packages: &Packages, tree: &Path) -> Result<(), String> {
    let stamps = tree.join("unpacked");
    let archives = tree.join("archives");
    create(&stamps)?;
    create(&archives)?;
    let all = [
        (&packages.image, &IMAGE_PARTS[..]),
        (&packages.headers, &["./usr/*"]),
        (&packages.headers_common, &["./usr/*"]),
        (&packages.kbuild, &["./usr/*"]),
        (&packages.source, &["./usr/src/*"]),
        (&"busybox-static".to_owned(), &["./bin/busybox"]),
    ];
    // A stamp lists the unpacked parts.
    let stamp_of = |package: &String, parts: &[&str]| match *package == packages.source {
        true => UPSTREAM.join(" "),
        false => parts.join(" "),
    };
    let is_missing = |(package, parts): &(&String, &[&str])| {
        !fs::read_to_string(stamps.join(package)).is_ok_and(|stamp| stamp == stamp_of(package, parts))
    };
    let missing: Vec<_> = all.into_iter().filter(is_missing).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let download = || {
        process::run(
            apt.command("apt-get")
                .args(["download", "-qq"])
                .args(missing.iter().map(|(package, _)| package))
                .current_dir(&archives),
        )
    };
    // The archives drop a version soon after a newer one is published.
    download().or_else(|_| apt.update().and_then(|()| download()))?;

    for (package, parts) in missing {
        let archive = files(&archives)?
            .into_iter()
            .find(|path| file_name(path).starts_with(&format!("{package}_")))
            .ok_or_else(|| format!("apt-get download left no archive of {package}"))?;
        let mut words = vec![path_str(&archive)?, path_str(tree)?];
        words.extend(parts.iter());
        process::pipeline(
            r#"archive=$1 tree=$2; shift 2
               dpkg-deb --fsys-tarfile "$archive" | tar -x -C "$tree" --wildcards "$@""#,
            &words,
        )?;
        if *package == packages.source {
            unpack_upstream(&packages.source, tree)?;
        }
        fs::write(stamps.join(package), stamp_of(package, parts))
            .map_err(|error| describe("write", &stamps.join(package), &error))?;
        remove(&archive)?;
    }
    Ok(())
}

/// A few files of the kernel's sources, in `upstream`.
fn unpack_upstream(package: &str, tree: &Path) -> Result<(), String> {
    let tarball = tree.join(format!("usr/src/{package}.tar.xz"));
    let upstream = tree.join("upstream");
    create(&upstream)?;
    let members = UPSTREAM.map(|path| format!("{package}/{path}"));
    let mut words = vec![path_str(&tarball)?, path_str(&upstream)?];
    words.extend(members.iter().map(String::as_str));
    // tar stops after the last member, and so does xz, by a signal. So this is not a pipeline.
    process::pipeline(
        r#"tarball=$1 upstream=$2; shift 2
           tar -x -f <(xz -dc -T0 "$tarball") -C "$upstream" \
               --occurrence=1 --transform 's,.*/,,' "$@""#,
        &words,
    )?;
    for (from, to) in UPSTREAM_RENAMED {
        fs::rename(upstream.join(from), upstream.join(to))
            .map_err(|error| describe("rename", &upstream.join(from), &error))?;
    }
    remove(&tarball)
}

/// The plain ELF boots by PVH. So the emulated processor does not have to unpack it.
fn extract_vmlinux(vmlinuz: &Path, vmlinux: &Path) -> Result<(), String> {
    const XZ_MAGIC: &[u8] = b"\xfd7zXZ\0";
    let image = read(vmlinuz)?;
    let start = image
        .windows(XZ_MAGIC.len())
        .position(|window| window == XZ_MAGIC)
        .ok_or_else(|| format!("{} is not packed by xz", vmlinuz.display()))?;
    let packed = vmlinux.with_extension("xz");
    fs::write(&packed, &image[start..]).map_err(|error| describe("write", &packed, &error))?;
    // The data after the packed kernel in the image makes xz fail at the end.
    process::pipeline(
        r#"xz -dc --single-stream "$1" >"$2" 2>/dev/null || true; strip "$2""#,
        &[path_str(&packed)?, path_str(vmlinux)?],
    )?;
    remove(&packed)
}

fn archive_modules(image: &Path, ours: &Path, tree: &Path, to: &Path) -> Result<(), String> {
    let built_in = fs::read_to_string(image.join("modules.builtin"))
        .map_err(|error| describe("read", &image.join("modules.builtin"), &error))?;
    let built_in = built_in.lines().map(|line| module_name(Path::new(line))).collect();
    let mut loader = Loader { paths: Vec::new(), built_in, order: Vec::new() };
    // Our modules come first, so they take precedence over a module of the same name.
    find_modules(ours, &mut loader.paths)?;
    find_modules(image, &mut loader.paths)?;
    for (module, options) in MODULES {
        loader.load(&module.replace('-', "_"), options)?;
    }

    let mut archive = Archive::with_busybox(&tree.join("bin/busybox"))?;
    for (module, inside) in [(PLAN_READER, "/tests/plan.ko"), (FIRMWARE, "/tests/firmware.ko")] {
        let path = loader.find(module)?;
        process::run(Command::new("strip").arg("--strip-debug").arg(&path))?;
        archive.copy(inside, &path)?;
    }
    let mut list = String::new();
    for (path, options) in &loader.order {
        let inside = format!("/tests/modules.d/{}", file_name(path));
        process::run(Command::new("strip").arg("--strip-debug").arg(path))?;
        archive.copy(&inside, path)?;
        list += &format!("{inside} {options}\n");
    }
    archive.file("/tests/modules", list.as_bytes());
    fs::write(to, archive.finish()).map_err(|error| describe("write", to, &error))
}

/// Finds an order in which modules can be loaded.
struct Loader {
    paths: Vec<PathBuf>,
    built_in: Vec<String>,
    order: Vec<(PathBuf, &'static str)>,
}

impl Loader {
    fn load(&mut self, module: &str, options: &'static str) -> Result<(), String> {
        let is_loaded = |(path, _): &(PathBuf, _)| module_name(path) == module;
        if self.order.iter().any(is_loaded) || self.built_in.iter().any(|name| name == module) {
            return Ok(());
        }
        let path = self.find(module)?;
        for dependency in dependencies(&path)? {
            self.load(&dependency, "")?;
        }
        self.order.push((path, options));
        Ok(())
    }

    fn find(&self, module: &str) -> Result<PathBuf, String> {
        self.paths
            .iter()
            .find(|path| module_name(path) == module)
            .cloned()
            .ok_or_else(|| format!("the kernel has no module {module} among {IMAGE_PARTS:?}"))
    }
}

/// A module's own list, because packages contain no modules.dep.
fn dependencies(module: &Path) -> Result<Vec<String>, String> {
    const KEY: &[u8] = b"\0depends=";
    let content = read(module)?;
    let Some(at) = content.windows(KEY.len()).position(|window| window == KEY) else {
        return Ok(Vec::new());
    };
    let value = &content[at + KEY.len()..];
    let end = value.iter().position(|&byte| byte == 0).unwrap_or(value.len());
    Ok(String::from_utf8_lossy(&value[..end])
        .split(',')
        .filter(|name| !name.is_empty())
        .map(|name| name.replace('-', "_"))
        .collect())
}

fn find_modules(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), String> {
    for path in entries(folder)? {
        if path.is_dir() {
            find_modules(&path, found)?;
        } else if path.extension().is_some_and(|extension| extension == "ko") {
            found.push(path);
        }
    }
    Ok(())
}

/// The kernel's form of the name: without its path, and with underscores.
fn module_name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().replace('-', "_")
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let list = || -> io::Result<Vec<PathBuf>> { fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect() };
    let mut paths = list().map_err(|error| describe("read", folder, &error))?;
    paths.sort();
    Ok(paths)
}

fn files(folder: &Path) -> Result<Vec<PathBuf>, String> {
    Ok(entries(folder)?.into_iter().filter(|path| path.is_file()).collect())
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn path_str(path: &Path) -> Result<&str, String> {
    path.to_str().ok_or_else(|| format!("{} is not UTF-8", path.display()))
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    fs::read(path).map_err(|error| describe("read", path, &error))
}

fn create(folder: &Path) -> Result<(), String> {
    fs::create_dir_all(folder).map_err(|error| describe("create", folder, &error))
}

fn copy_files(from: &Path, to: &Path) -> Result<(), String> {
    create(to)?;
    for path in files(from)? {
        fs::copy(&path, to.join(file_name(&path))).map_err(|error| describe("copy", &path, &error))?;
    }
    Ok(())
}
