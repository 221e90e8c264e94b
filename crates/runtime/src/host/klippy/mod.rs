// SPDX-License-Identifier: GPL-3.0-or-later
//! Facts about a Klipper host, found from outside: its process, the messages that its sources look up, and so the
//! dialect that it speaks.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use pinion_firmware::mcu::{DialectName, Dialects, Feature};
use pinion_linux::foreign;

pub mod command_line;
pub mod process;
pub mod sources;
pub mod terminal;

use sources::{Shape, Sources};

/// Lowest number of our messages that klippy's sources look up. klippy looks up more than 80. A folder with fewer than
/// this is something else.
const SHAPES_MIN: usize = 20;
/// Longest `.git/HEAD` and single reference that is read.
const REF_BYTES_MAX: u64 = 4096;
/// Longest `.git/packed-refs` that is read: a line for each branch and tag, of some 70 bytes.
const PACKED_REFS_BYTES_MAX: u64 = 1 << 20;

/// klippy takes paths that begin like this for pseudo terminals (klippy/mcu.py).
pub const HOST_PATHS: &str = "/tmp/klipper_host_";

/// Whether klippy takes a path for a pseudo terminal. Any process may name a path. One that means more in a command
/// than a name in that folder does not count.
pub fn is_host_path(path: &Path) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "_.-".contains(c);
    path.to_str().and_then(|path| path.strip_prefix(HOST_PATHS)).is_some_and(|name| name.chars().all(is_plain))
}

/// A message that an MCU knows, and the dialects that have it.
struct KnownShape {
    shape: Shape,
    dialects: Dialects,
}

/// Facts about the host that runs from a checkout.
#[derive(Debug)]
pub struct Checkout {
    /// The folder, such as `/home/pi/klipper`.
    pub folder: PathBuf,
    /// The commit that is checked out, if git says so.
    pub commit: Option<String>,
    /// When the newest of its sources was written.
    pub newest: SystemTime,
    /// The first part that could not be read, if any.
    pub unread: Option<String>,
    /// Every message that the host looks up.
    pub shapes: BTreeSet<Shape>,
    /// How each dialect suits the host, in the order of [`DialectName::OF_HOSTS`].
    pub fits: Vec<DialectFit>,
}

/// How a dialect suits a host.
#[derive(Debug)]
pub struct DialectFit {
    /// The dialect.
    pub dialect: DialectName,
    /// Messages in the form that the dialect has.
    pub served: BTreeSet<Shape>,
    /// Messages in a form that the dialect does not have. Another dialect may have it. A host often looks
    /// up several forms of one message, and takes the one that exists.
    pub other: BTreeSet<Shape>,
}

impl Checkout {
    /// Reads the sources in klippy's folder, which holds `klippy.py`. Compares them with the messages of `features`.
    ///
    /// # Errors
    ///
    /// The sources cannot be read, or the folder is not klippy's.
    pub fn read(klippy: &Path, features: &[Feature]) -> io::Result<Checkout> {
        let Sources { shapes, newest, unread, .. } = Sources::read(klippy)?;
        let known = known(features);
        let names: BTreeSet<&str> = known.iter().map(|known| known.shape.name()).collect();
        let ours: BTreeSet<&Shape> = shapes.iter().filter(|shape| names.contains(shape.name())).collect();
        if ours.len() < SHAPES_MIN {
            return Err(io::Error::other(unread.unwrap_or_else(|| "it does not hold klippy's sources".into())));
        }
        let fit = |dialect| {
            let known = known.iter().filter(|known| known.dialects.contains(dialect));
            let known: BTreeSet<&Shape> = known.map(|known| &known.shape).collect();
            let (served, other): (BTreeSet<&Shape>, _) = ours.iter().partition(|shape| known.contains(*shape));
            let owned = |shapes: BTreeSet<&Shape>| shapes.into_iter().cloned().collect();
            DialectFit { dialect, served: owned(served), other: owned(other) }
        };
        let folder = klippy.parent().unwrap_or(klippy).to_owned();
        Ok(Checkout {
            commit: commit(&folder),
            folder,
            newest,
            unread,
            fits: DialectName::OF_HOSTS.into_iter().map(fit).collect(),
            shapes,
        })
    }

    /// The dialect that has most of the messages that the host looks up. Of several it is the newest.
    pub fn best(&self) -> &DialectFit {
        let best = self.fits.iter().rev().min_by_key(|fit| fit.other.len());
        match best {
            Some(fit) => fit,
            None => unreachable!("there is one for each dialect"),
        }
    }

    /// Messages that no dialect has in this form, though it knows their names. The host is newer than all that this
    /// program knows, and these messages will not be served.
    pub fn unknown(&self) -> impl Iterator<Item = &Shape> {
        let everywhere = |shape: &&Shape| self.fits.iter().all(|fit| fit.other.contains(*shape));
        self.best().other.iter().filter(everywhere)
    }
}

/// The messages that have parameters. A message without parameters is only a word in a host's sources.
fn known(features: &[Feature]) -> Vec<KnownShape> {
    let commands = features.iter().flat_map(|feature| feature.commands);
    let commands = commands.map(|command| (command.format, command.dialects));
    let responses = features.iter().flat_map(|feature| feature.responses);
    let responses = responses.map(|form| (form.format, form.dialects));
    commands
        .chain(responses)
        .filter_map(|(format, dialects)| Some(KnownShape { shape: Shape::of(format)?, dialects }))
        .collect()
}

/// The commit of a checkout, from the files that git keeps (gitrepository-layout(5)).
fn commit(folder: &Path) -> Option<String> {
    let git = folder.join(".git");
    let read = |name: &str, bytes_max| String::from_utf8(foreign::read(&git.join(name), bytes_max).ok()?).ok();
    let head = read("HEAD", REF_BYTES_MAX)?;
    let commit = match head.trim().strip_prefix("ref: ") {
        None => head,
        Some(name) if !name.starts_with("refs/") || name.contains("..") => return None,
        Some(name) => read(name, REF_BYTES_MAX).or_else(|| {
            let packed = read("packed-refs", PACKED_REFS_BYTES_MAX)?;
            let line = packed.lines().find(|line| line.split(' ').nth(1) == Some(name))?;
            line.split(' ').next().map(str::to_owned)
        })?,
    };
    let commit = commit.trim();
    let is_commit = commit.len() >= 40 && commit.chars().all(|c| c.is_ascii_hexdigit());
    is_commit.then(|| commit[..9].to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::feature::FEATURES;
    use std::fs;

    /// A checkout that looks these messages up, each in a string of two pieces, and nothing else.
    fn checkout(shapes: impl IntoIterator<Item = String>) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let klippy = folder.path().join("klippy");
        fs::create_dir_all(klippy.join("extras")).unwrap();
        let mut source = String::from("import mcu # of a host\n");
        for shape in shapes {
            let (name, parameters) = shape.split_once(' ').unwrap();
            let parameters: Vec<String> = parameters.split(' ').map(|name| format!("{name}=%u")).collect();
            source += &format!("mcu.lookup_command(\"{name} \"\n    \"{}\")\n", parameters.join(" "));
        }
        fs::write(klippy.join("extras/all.py"), source).unwrap();
        (folder, klippy)
    }

    /// The messages that a dialect's MCUs know.
    fn forms(dialect: DialectName) -> Vec<String> {
        let known = known(FEATURES).into_iter().filter(|known| known.dialects.contains(dialect));
        known.map(|known| known.shape.as_str().to_owned()).collect()
    }

    #[test]
    fn a_host_speaks_the_dialect_that_has_what_it_looks_up() {
        for dialect in DialectName::OF_HOSTS {
            let (_folder, klippy) = checkout(forms(dialect));
            let checkout = Checkout::read(&klippy, FEATURES).unwrap();
            assert_eq!(checkout.best().dialect, dialect);
            assert_eq!(checkout.best().other.len(), 0, "{dialect}");
            assert_eq!(checkout.unknown().count(), 0);
        }
    }

    #[test]
    fn a_host_may_look_up_what_older_mcus_have_too() {
        let older = forms(DialectName::V0_13);
        let (_folder, klippy) = checkout(forms(DialectName::Master).into_iter().chain(older));
        let checkout = Checkout::read(&klippy, FEATURES).unwrap();
        assert_eq!(checkout.best().dialect, DialectName::Master);
        assert!(checkout.best().other.iter().any(|shape| shape.name() == "i2c_write"));
        assert_eq!(checkout.unknown().count(), 0, "another dialect has it");
    }

    #[test]
    fn of_a_newer_host_what_will_not_be_served_is_named() {
        let newer = forms(DialectName::Master).into_iter().map(|shape| match shape.as_str() {
            "query_adxl345 oid rest_ticks" => "query_adxl345 oid rest_ticks range".to_owned(),
            _ => shape,
        });
        let (_folder, klippy) = checkout(newer.chain(["config_new_chip oid bus_oid".to_owned()]));
        let checkout = Checkout::read(&klippy, FEATURES).unwrap();
        assert_eq!(checkout.best().dialect, DialectName::Master);
        let unknown: Vec<&str> = checkout.unknown().map(Shape::as_str).collect();
        assert_eq!(unknown, ["query_adxl345 oid rest_ticks range"]);
    }

    #[test]
    fn another_program_is_no_klippy() {
        let (_folder, klippy) = checkout(["queue_step oid interval count add".to_owned()]);
        let error = Checkout::read(&klippy, FEATURES).unwrap_err();
        assert_eq!(error.to_string(), "it does not hold klippy's sources");
    }

    #[test]
    fn a_path_that_goes_into_a_command_is_a_plain_name() {
        for (path, is) in [
            ("/tmp/klipper_host_mcu", true),
            ("/tmp/klipper_host_b-2.old_one", true),
            ("/tmp/klipper_host_x/../../etc/passwd", false),
            ("/tmp/klipper_host_;reboot", false),
            ("/tmp/klipper_host_$(reboot)", false),
            ("/tmp/klipper_host_a b", false),
            ("/dev/ttyACM0", false),
        ] {
            assert_eq!(is_host_path(Path::new(path)), is, "{path}");
        }
    }

    #[test]
    fn git_knows_the_commit() {
        let folder = tempfile::tempdir().unwrap();
        let git = folder.path().join(".git");
        let put = |path: &str, text: &str| {
            fs::create_dir_all(git.join(path).parent().unwrap()).unwrap();
            fs::write(git.join(path), text).unwrap();
        };
        assert_eq!(commit(folder.path()), None);
        let [first, second, third] = ["a", "b", "c"].map(|digit| digit.repeat(40));
        put("HEAD", &format!("{first}\n"));
        assert_eq!(commit(folder.path()).as_deref(), Some("aaaaaaaaa"));
        put("HEAD", "ref: refs/heads/master\n");
        put("packed-refs", &format!("# pack-refs\n{second} refs/heads/master\n"));
        assert_eq!(commit(folder.path()).as_deref(), Some("bbbbbbbbb"));
        put("refs/heads/master", &format!("{third}\n"));
        assert_eq!(commit(folder.path()).as_deref(), Some("ccccccccc"));
        fs::write(folder.path().join("elsewhere"), &first).unwrap();
        put("HEAD", "ref: refs/../../elsewhere\n");
        assert_eq!(commit(folder.path()), None);
    }

    #[test]
    fn files_of_git_that_are_something_else_are_no_reason_to_hang_or_to_fill_the_memory() {
        use std::os::unix::fs::symlink;
        for file in ["HEAD", "refs/heads/master", "packed-refs"] {
            let folder = tempfile::tempdir().unwrap();
            let git = folder.path().join(".git");
            fs::create_dir_all(git.join("refs/heads")).unwrap();
            fs::write(git.join("HEAD"), "ref: refs/heads/master\n").unwrap();
            let _ = fs::remove_file(git.join(file));
            nix::unistd::mkfifo(&git.join(file), nix::sys::stat::Mode::S_IRWXU).unwrap();
            assert_eq!(commit(folder.path()), None, "{file}: a pipe that nobody writes to");
            fs::remove_file(git.join(file)).unwrap();
            symlink("/dev/zero", git.join(file)).unwrap();
            assert_eq!(commit(folder.path()), None, "{file}: a device without an end");
        }
    }

    /// With checkouts of real hosts in KLIPPER_DIR_V0_11 and so on.
    #[test]
    fn real_hosts_are_distinguished() {
        for dialect in DialectName::OF_HOSTS {
            let variable = format!("KLIPPER_DIR_{}", dialect.name().to_uppercase().replace('.', "_"));
            let Some(folder) = std::env::var_os(&variable) else {
                eprintln!("SKIPPED {dialect}: {variable} is not set");
                continue;
            };
            let checkout = Checkout::read(&Path::new(&folder).join("klippy"), FEATURES).unwrap();
            assert_eq!(checkout.best().dialect, dialect);
            assert_eq!(checkout.unknown().count(), 0, "{dialect}: {:?}", checkout.best().other);
        }
    }
}
