// SPDX-License-Identifier: GPL-3.0-or-later
//! The folders that hold the files of traces, the names of these files, and which files stay.

use std::env;
use std::fs;
use std::io;
use std::iter;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use pinion_linux::own_folder::OwnFolder;

/// The service's folder.
const SERVICE: &str = "/var/lib/pinion";
/// The end of a file's name.
const SUFFIX: &str = ".trace";
/// Length of the time in a file's name, such as `20261122T142614.321Z`.
const TIME_LEN: usize = 20;
/// The last part of a file's name, before its end, if the host had asked for the stop.
const ASKED: &str = "-asked";
/// Highest number of files that stay for an instance, beside one of a stop that the host asked for.
const KEPT_MAX: usize = 10;
/// The last millisecond with a year of four digits, since 1970.
const UTC_MS_MAX: u64 = 253_402_300_799_999;

/// The folders where traces are kept, the best first. A trace goes into the first one that takes it.
///
/// A service has only `$STATE_DIRECTORY`. Otherwise the first folder is the packaged service's, and the second one is
/// the user's own. Only the service's user may use the first one, so root's own Pinion uses root's own folder.
pub fn folders() -> Vec<PathBuf> {
    let service = env::var("STATE_DIRECTORY").unwrap_or_default();
    let service = service.split(':').map(PathBuf::from).filter(|folder| folder.is_absolute());
    let folders: Vec<PathBuf> = service.collect();
    if folders.is_empty() { iter::once(SERVICE.into()).chain(own()).collect() } else { folders }
}

/// The user's own folder, which may be missing.
fn own() -> Option<PathBuf> {
    Some(user_state()?.join("pinion"))
}

/// Opens a folder for traces. It makes the folder if that is missing. Only systemd or a package makes the service's.
///
/// # Errors
///
/// It cannot be made, or belongs to another user.
pub fn open(folder: &Path) -> io::Result<OwnFolder> {
    if folder == Path::new(SERVICE) { OwnFolder::open(folder) } else { OwnFolder::make(folder) }
}

/// Whether a trace would go into this folder, as far as that is known before.
pub fn is_ours(folder: &Path) -> bool {
    match OwnFolder::open(folder) {
        Ok(_) => true,
        Err(error) => error.kind() == io::ErrorKind::NotFound && folder != Path::new(SERVICE),
    }
}

/// The folder for the state of this user's programs, if there is one (XDG Base Directory Specification).
pub fn user_state() -> Option<PathBuf> {
    let folder = |variable| env::var_os(variable).map(PathBuf::from).filter(|folder: &PathBuf| folder.is_absolute());
    folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")))
}

/// The name of the instance with this link: the file's name without `klipper_host_`.
pub fn name_of(link: &Path) -> String {
    let file = link.file_name().unwrap_or_default().to_string_lossy();
    file.strip_prefix("klipper_host_").unwrap_or(&file).to_owned()
}

/// The name of a new file in this folder, for a trace of this instance that ended then, in milliseconds since 1970
/// (UTC). `is_asked`: the host had asked for the stop.
///
/// The name is `NAME-YYYYMMDDTHHMMSS.mmmZ-NUMBER.trace`. The numbers of a folder go up, so they give the order of its
/// files. The computer's clock may be set in between, or be wrong until the network is up.
pub fn new_name(folder: &Path, name: &str, utc_ms: u64, is_asked: bool) -> String {
    let number = in_folder(folder).map(|file| file.number).max().unwrap_or(0).saturating_add(1);
    file_name(name, utc_ms, number, is_asked)
}

fn file_name(name: &str, utc_ms: u64, number: u64, is_asked: bool) -> String {
    format!("{name}-{}-{number}{}{SUFFIX}", time_text(utc_ms), if is_asked { ASKED } else { "" })
}

/// The time in a file's name. The order of these texts is that of their times.
fn time_text(utc_ms: u64) -> String {
    let ([year, month, day], [hour, minute, second]) = utc(utc_ms);
    let ms = utc_ms.min(UTC_MS_MAX) % 1000;
    format!("{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}.{ms:03}Z")
}

/// A time for people, from milliseconds since 1970.
pub fn utc_text(utc_ms: u64) -> String {
    let ([year, month, day], [hour, minute, second]) = utc(utc_ms);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
}

/// The year, month and day, and the hour, minute and second.
fn utc(utc_ms: u64) -> ([u64; 3], [u64; 3]) {
    let seconds = utc_ms.min(UTC_MS_MAX) / 1000;
    (date(seconds / 86_400), [seconds / 3600 % 24, seconds / 60 % 60, seconds % 60])
}

/// The year, month and day of a day since 1970-01-01 (`civil_from_days` of howardhinnant.github.io/date_algorithms).
fn date(days: u64) -> [u64; 3] {
    // Years begin in March here, so that the leap day is the last one. An era is 400 years.
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    [era * 400 + year + u64::from(month <= 2), month, day]
}

/// The kept traces of the instance with this name in these folders, the newest first.
pub fn kept(folders: &[PathBuf], name: &str) -> Vec<PathBuf> {
    newest_first(folders, |file| file.name == name)
}

/// The kept traces of all instances in these folders, the newest first.
pub fn all(folders: &[PathBuf]) -> Vec<PathBuf> {
    newest_first(folders, |_| true)
}

/// The files of this instance that are too many. Stops that the host asked for come often, so the last of them stays.
/// They take no place of others.
pub fn surplus(folder: &Path, name: &str) -> Vec<PathBuf> {
    let mut files: Vec<File> = in_folder(folder).filter(|file| file.name == name).collect();
    files.sort_by(|a, b| b.cmp(a));
    let (asked, others): (Vec<File>, Vec<File>) = files.into_iter().partition(|file| file.is_asked);
    asked.into_iter().skip(1).chain(others.into_iter().skip(KEPT_MAX)).map(|file| file.path).collect()
}

/// Within a folder the numbers give the order. Between folders the times do, except times in the future: the clock was
/// wrong then.
fn newest_first(folders: &[PathBuf], is_asked_for: impl Fn(&File) -> bool) -> Vec<PathBuf> {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let now = time_text(now.as_millis() as u64);
    let mut found = Vec::new();
    for folder in folders {
        let mut files: Vec<File> = in_folder(folder).collect();
        files.sort();
        let mut since = String::new();
        for file in files {
            if file.time <= now {
                since = since.max(file.time.clone());
            }
            found.push((since.clone(), file));
        }
    }
    found.sort_by(|a, b| b.cmp(a));
    found.into_iter().map(|(_, file)| file).filter(is_asked_for).map(|file| file.path).collect()
}

/// A file of a trace. Within a folder, their order is that in which they were made.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct File {
    /// Earlier versions wrote files without a number.
    number: u64,
    time: String,
    /// Of the instance.
    name: String,
    is_asked: bool,
    path: PathBuf,
}

/// The traces in a folder.
fn in_folder(folder: &Path) -> impl Iterator<Item = File> + use<> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| {
        let file = entry.file_name();
        let stem = file.to_str()?.strip_suffix(SUFFIX)?;
        let (stem, is_asked) = stem.strip_suffix(ASKED).map_or((stem, false), |stem| (stem, true));
        let number = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit()).then(|| text.parse().ok())?;
        let numbered = stem.rsplit_once('-').and_then(|(stem, text)| Some((stem, number(text)?)));
        let (stem, number) = numbered.unwrap_or((stem, 0));
        let (name, time) = stem.split_at_checked(stem.len().checked_sub(TIME_LEN)?)?;
        let name = name.strip_suffix('-')?;
        let fits = |(at, byte): (usize, u8)| match at {
            8 => byte == b'T',
            15 => byte == b'.',
            19 => byte == b'Z',
            _ => byte.is_ascii_digit(),
        };
        let is_trace = time.bytes().enumerate().all(fits);
        is_trace.then(|| File { number, time: time.to_owned(), name: name.to_owned(), is_asked, path: entry.path() })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_the_names_of_its_instance_and_of_its_time() {
        for (utc_ms, time) in [
            (0, "19700101T000000.000Z"),
            (951_782_399_999, "20000228T235959.999Z"),
            (951_782_400_000, "20000229T000000.000Z"),
            (951_868_800_000, "20000301T000000.000Z"),
            (1_795_357_574_321, "20261122T142614.321Z"),
            (4_107_542_399_000, "21000228T235959.000Z"),
            (4_107_542_400_000, "21000301T000000.000Z"),
            (u64::MAX, "99991231T235959.999Z"),
        ] {
            assert_eq!(file_name("mcu", utc_ms, 7, false), format!("mcu-{time}-7.trace"));
            assert_eq!(file_name("mcu", utc_ms, 8, true), format!("mcu-{time}-8-asked.trace"));
        }
        assert_eq!(utc_text(1_795_357_574_321), "2026-11-22 14:26:14 UTC");
        for (link, name) in [("/tmp/klipper_host_mcu", "mcu"), ("/run/pinion/b", "b"), ("/", "")] {
            assert_eq!(name_of(Path::new(link)), name);
        }
    }

    /// The names of the files at these paths.
    fn names(paths: Vec<PathBuf>) -> Vec<String> {
        paths.iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect()
    }

    fn put(folder: &Path, names: &[&str]) {
        names.iter().for_each(|name| fs::write(folder.join(name), "").unwrap());
    }

    #[test]
    fn the_newest_of_an_instance_come_first_and_other_files_are_not_traces() {
        let folder = tempfile::tempdir().unwrap();
        // The first one is an earlier version's, and the third one was asked for.
        let ends = ["20000229T000000.000Z", "20000229T000000.000Z-9", "19991122T142614.321Z-10-asked"];
        let put_for = |name: &str| ends.map(|end| format!("{name}-{end}.trace"));
        for name in ["mcu", "mcu-2", ""] {
            put(folder.path(), &put_for(name).each_ref().map(String::as_str));
        }
        let others = [
            "mcu.trace",
            "mcu-20261122T142614.321Z.trace.1",
            "mcu-2026112T142614.321ZZ.trace",
            "mcu-20261122T142614Z.trace",
            "mcu-20261122T142614.321Z-+1.trace",
            "mcu-20261122T142614.321Z-99999999999999999999.trace",
            "mcu-20261122T142614.321Z-asked-3.trace",
            "ä-0261122T142614.321Z.trace",
        ];
        put(folder.path(), &others);
        let folders = [folder.path().join("missing"), folder.path().to_owned()];
        for name in ["mcu", "mcu-2", ""] {
            let mut newest = put_for(name);
            newest.reverse();
            assert_eq!(names(kept(&folders, name)), newest);
        }
        assert!(kept(&folders, "other").is_empty() && kept(&folders[..1], "mcu").is_empty());
        let newest = names(all(&folders));
        assert_eq!(newest.len(), 9);
        assert!(newest[..3].iter().all(|name| name.ends_with("-10-asked.trace")), "{newest:?}");
        assert!(new_name(folder.path(), "b", 0, false).starts_with("b-19700101T000000.000Z-11."));
    }

    /// The service's folder and the user's own have numbers of their own.
    #[test]
    fn a_time_in_the_future_makes_no_file_the_newest() {
        let (one, two) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let folders = [one.path().to_owned(), two.path().to_owned()];
        let future = "mcu-99981122T142614.321Z-3.trace";
        let [first, second, third] = [
            "mcu-20200101T000000.000Z-2.trace",
            "mcu-20210101T000000.000Z-1.trace",
            "mcu-20220101T000000.000Z-4.trace",
        ];
        put(one.path(), &[future, first]);
        put(two.path(), &[second]);
        assert_eq!(names(all(&folders)), [second, future, first]);
        put(one.path(), &[third]);
        assert_eq!(names(all(&folders)), [third, second, future, first]);
        // The clock was set back, but a later file is later.
        put(one.path(), &["mcu-20210601T000000.000Z-5.trace"]);
        assert_eq!(names(all(&folders)), ["mcu-20210601T000000.000Z-5.trace", third, second, future, first]);
    }

    #[test]
    fn stops_that_the_host_asked_for_take_no_place_of_others() {
        let folder = tempfile::tempdir().unwrap();
        let all: Vec<String> = (1..=30).map(|number| file_name("mcu", 0, number, number > 12)).collect();
        put(folder.path(), &all.iter().map(String::as_str).collect::<Vec<_>>());
        put(folder.path(), &["b-20200101T000000.000Z-1.trace"]);
        let surplus = names(surplus(folder.path(), "mcu"));
        let stays: Vec<&String> = all.iter().filter(|name| !surplus.contains(name)).collect();
        assert_eq!(stays, all[2..12].iter().chain(&all[29..]).collect::<Vec<_>>());
        assert_eq!(surplus.len(), 30 - 11);
    }
}
