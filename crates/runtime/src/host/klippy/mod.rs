// SPDX-License-Identifier: GPL-3.0-or-later
//! Facts about a Klipper host, found from outside: its process, and the forms of messages that its sources look up.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use pinion_firmware::mcu::{Entry, Feature, Forms, HostForms, Part, entries};
use pinion_linux::foreign;
use pinion_protocol::format;

pub mod command_line;
pub mod process;
pub mod sources;
pub mod terminal;

use sources::{Shape, Sources};

/// Lowest number of our messages that klippy's sources look up. klippy looks up more than 80. A folder with fewer than
/// this is something else.
const SHAPES_MIN: usize = 20;
/// Highest number of missing messages that a line names.
const MISSING_SHOWN: usize = 10;
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
    /// The forms that the host looks up, of those that this program has.
    pub forms: HostForms,
    /// The messages that the host looks up. Other micro-controllers' messages are left out.
    pub shapes: BTreeSet<Shape>,
}

/// A message that a host looks up and does not get.
#[derive(Debug, PartialEq, Eq)]
pub struct Missing<'a> {
    /// The message, in the form that the host looks up.
    pub shape: &'a Shape,
    /// The parts of a printer that do not work without it. Empty if no feature has a message of this name.
    pub serves: &'static str,
}

impl Checkout {
    /// Reads the sources in klippy's folder, which holds `klippy.py`. Compares them with the messages of `features`.
    ///
    /// # Errors
    ///
    /// The sources cannot be read, or the folder is not klippy's.
    pub fn read(klippy: &Path, features: &'static [Feature]) -> io::Result<Checkout> {
        let entries = entries(features);
        let names = |is_message| {
            let names = entries.iter().filter(move |entry| entry.is_message() == is_message).map(|entry| entry.name);
            names.collect::<HashSet<&str>>()
        };
        let (messages, words) = (names(true), names(false));
        let sources = Sources::read(klippy, &|word| words.contains(word))?;
        let Sources { mut shapes, words, newest, unread, .. } = sources;
        if shapes.iter().filter(|shape| messages.contains(shape.name())).count() < SHAPES_MIN {
            return Err(io::Error::other(unread.unwrap_or_else(|| "it does not hold klippy's sources".into())));
        }
        let folder = klippy.parent().unwrap_or(klippy).to_owned();
        if shapes.iter().any(|shape| !messages.contains(shape.name())) {
            // The host's own firmware says which of the unknown messages are Linux's.
            let of_linux = Sources::of_firmware(&folder.join("src"));
            shapes.retain(|shape| messages.contains(shape.name()) || of_linux.contains(shape));
        }
        // A host names an enumeration by a parameter, too.
        let parameters: HashSet<&str> = shapes.iter().flat_map(Shape::parameters).collect();
        let looks_up = |entry: &Entry| match Shape::of(entry.text) {
            Some(shape) if entry.is_message() => shapes.contains(&shape),
            _ => words.contains(entry.name) || parameters.contains(entry.name),
        };
        let forms = HostForms::new(&entries, looks_up);
        Ok(Checkout { commit: commit(&folder), folder, newest, unread, forms, shapes })
    }

    /// The messages that the host looks up and does not get if its MCU has these forms. A message with another way is
    /// left out: the host looks up several forms and gets one, or it looks up the message that replaces this one.
    pub fn missing(&self, forms: &Forms, features: &'static [Feature]) -> Vec<Missing<'_>> {
        let entries = entries(features);
        let parts = forms.parts(&entries);
        let served = entries.iter().zip(parts).filter(|(_, part)| *part != Part::Left);
        let served: BTreeSet<Shape> = served.filter_map(|(entry, _)| Shape::of(entry.text)).collect();
        let gets = |shape: &&Shape| served.contains(*shape);
        let names: HashSet<&str> = self.shapes.iter().filter(gets).map(Shape::name).collect();
        let messages = entries.iter().filter(|entry| entry.is_message());
        let known: HashMap<&str, &Entry> = messages.map(|entry| (entry.name, entry)).collect();
        let is_replaced = |name: &str| {
            let newer = known.get(name).and_then(|entry| entry.replaced_by());
            newer.is_some_and(|format| names.contains(format::name(format)))
        };
        let without = self.shapes.iter().filter(|shape| !names.contains(shape.name()) && !is_replaced(shape.name()));
        let serves = |shape: &Shape| known.get(shape.name()).map_or("", |entry| features[entry.feature].serves);
        without.map(|shape| Missing { shape, serves: serves(shape) }).collect()
    }
}

/// The parts of a printer that do not work without these messages, for people. Empty if nobody knows.
pub fn parts_without(missing: &[Missing<'_>]) -> String {
    let parts: BTreeSet<&str> = missing.iter().map(|missing| missing.serves).filter(|part| !part.is_empty()).collect();
    parts.into_iter().collect::<Vec<_>>().join("; ")
}

/// These messages, for a line of text.
pub fn names(missing: &[Missing<'_>]) -> String {
    let shown: Vec<&str> = missing.iter().take(MISSING_SHOWN).map(|missing| missing.shape.as_str()).collect();
    let more = missing.len() - shown.len();
    let more = if more == 0 { String::new() } else { format!("; and {more} more") };
    format!("{}{more}", shown.join("; "))
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
    use pinion_firmware::mcu::DialectName;
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

    /// The messages with parameters that a dialect's MCUs know.
    fn forms(dialect: DialectName) -> Vec<String> {
        let entries = entries(FEATURES);
        let parts = Forms::from(dialect).parts(&entries);
        let served = entries.iter().zip(parts).filter(|(entry, part)| entry.is_message() && *part == Part::Needed);
        served.filter_map(|(entry, _)| Some(Shape::of(entry.text)?.as_str().to_owned())).collect()
    }

    fn missing(checkout: &Checkout) -> Vec<(&str, &str)> {
        let missing = checkout.missing(&Forms::Host(checkout.forms.clone()), FEATURES);
        missing.iter().map(|missing| (missing.shape.as_str(), missing.serves)).collect()
    }

    /// The parameters of the messages that a host gets, by name.
    fn served(checkout: &Checkout, name: &str) -> Vec<Shape> {
        let entries = entries(FEATURES);
        let parts = Forms::Host(checkout.forms.clone()).parts(&entries);
        let needed = entries.iter().zip(parts).filter(|(entry, part)| entry.name == name && *part == Part::Needed);
        needed.filter_map(|(entry, _)| Shape::of(entry.text)).collect()
    }

    #[test]
    fn a_host_gets_what_it_looks_up() {
        for dialect in DialectName::OF_HOSTS {
            let (_folder, klippy) = checkout(forms(dialect));
            let checkout = Checkout::read(&klippy, FEATURES).unwrap();
            assert_eq!(missing(&checkout), [], "{dialect}");
            for form in forms(dialect) {
                let name = form.split(' ').next().unwrap();
                let served = served(&checkout, name);
                assert!(served.iter().any(|shape| shape.as_str() == form), "{dialect}: {form} {served:?}");
            }
        }
    }

    #[test]
    fn of_several_forms_a_host_gets_the_newest_and_no_message_that_it_prefers_to_a_newer_one() {
        let older = forms(DialectName::V0_13);
        let (_folder, klippy) = checkout(forms(DialectName::Master).into_iter().chain(older));
        let checkout = Checkout::read(&klippy, FEATURES).unwrap();
        assert_eq!(missing(&checkout), []);
        let [query] = &served(&checkout, "query_analog_in")[..] else { panic!() };
        assert!(query.parameters().any(|name| name == "bytes_per_report"), "{query:?}");
        assert_eq!(served(&checkout, "i2c_transfer").len(), 1);
        // klippy uses it if it exists.
        assert_eq!(served(&checkout, "i2c_read"), []);
    }

    #[test]
    fn of_a_newer_host_what_it_does_not_get_is_named() {
        let newer = forms(DialectName::Master).into_iter().map(|shape| match shape.as_str() {
            "query_adxl345 oid rest_ticks" => "query_adxl345 oid rest_ticks range".to_owned(),
            _ => shape,
        });
        let others = ["config_new_chip oid bus_oid", "beacon_stream en"].map(str::to_owned);
        let (folder, klippy) = checkout(newer.chain(others));
        let read = || Checkout::read(&klippy, FEATURES).unwrap();
        let of_adxl345 = ("query_adxl345 oid rest_ticks range", "ADXL345 accelerometers");
        assert_eq!(missing(&read()), [of_adxl345], "other names are other micro-controllers'");
        // The host's own firmware for Linux has a message that Pinion does not know.
        let src = folder.path().join("src");
        fs::create_dir_all(src.join("stm32")).unwrap();
        let declared = |format: &str| format!("// It's C\nDECL_COMMAND(command_x,\n  \"{format}\");\n");
        fs::write(src.join("new_chip.c"), declared("config_new_chip oid=%c\"\n \" bus_oid=%c")).unwrap();
        fs::write(src.join("stm32/beacon.c"), declared("beacon_stream en=%c")).unwrap();
        let checkout = read();
        assert_eq!(missing(&checkout), [("config_new_chip oid bus_oid", ""), of_adxl345]);
        let missing = checkout.missing(&Forms::Host(checkout.forms.clone()), FEATURES);
        assert_eq!(names(&missing), "config_new_chip oid bus_oid; query_adxl345 oid rest_ticks range");
        assert_eq!(parts_without(&missing), "ADXL345 accelerometers");
    }

    #[test]
    fn a_hostile_checkout_has_no_more_forms_than_there_is_room_for() {
        let ours = forms(DialectName::Master);
        let many = (0..20_000).map(|n| format!("query_adxl345 oid rest_ticks hostile_{n}"));
        let long = format!("config_adxl345 {}", "oid ".repeat(500));
        let names_of_others = (0..20_000).map(|n| format!("hostile_{n} oid"));
        for hostile in [many.collect::<Vec<_>>(), names_of_others.collect(), vec![long.trim().to_owned()]] {
            let (folder, klippy) = checkout(ours.iter().cloned());
            let (_other, more) = checkout(hostile);
            fs::copy(more.join("extras/all.py"), klippy.join("extras/hostile.py")).unwrap();
            fs::create_dir(folder.path().join("src")).unwrap();
            fs::copy(more.join("extras/all.py"), folder.path().join("src/hostile.c")).unwrap();
            let Ok(checkout) = Checkout::read(&klippy, FEATURES) else { continue };
            assert!(checkout.shapes.len() <= 10_000 && checkout.shapes.iter().all(|shape| shape.as_str().len() < 1000));
            let missing = checkout.missing(&Forms::Host(checkout.forms.clone()), FEATURES);
            assert!(names(&missing).len() < 11_000, "a line of the log");
            assert!(checkout.forms.places().count() <= entries(FEATURES).len());
        }
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

    /// With checkouts of real hosts in the folder KLIPPER_MONTHS. Their folders' names end with a date and a commit of
    /// `tests/dictionaries/months.json`.
    #[test]
    fn a_real_host_of_any_month_gets_what_its_own_firmware_has() {
        let Some(folder) = std::env::var_os("KLIPPER_MONTHS") else {
            eprintln!("SKIPPED: KLIPPER_MONTHS is not set");
            return;
        };
        let folders: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        let mut tried = 0;
        for host in pinion_testbench::months::hosts() {
            let is_it = |folder: &&PathBuf| folder.to_str().is_some_and(|folder| folder.ends_with(&host.name));
            let Some(folder) = folders.iter().find(is_it) else { continue };
            let checkout = Checkout::read(&folder.join("klippy"), FEATURES).unwrap();
            assert_eq!(missing(&checkout), [], "{folder:?}");
            let extra = host.check(Forms::Host(checkout.forms.clone()));
            // Kalico looks up angle sensors, which its firmware for Linux does not have.
            assert!(extra.iter().all(|entry| entry == "enumeration spi_angle_type"), "{folder:?}: {extra:?}");
            tried += 1;
        }
        eprintln!("{tried} hosts tried");
        assert!(tried > 0, "no folder ends with the date and commit of a month");
    }
}
