// SPDX-License-Identifier: GPL-3.0-or-later
//! The folders that hold the files of traces, and the names of these files.

#![forbid(unsafe_code)]

use std::env;
use std::fs::{self, DirBuilder};
use std::io;
use std::iter;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

/// The service's folder.
const SERVICE: &str = "/var/lib/pinion";
/// The end of a file's name.
const SUFFIX: &str = ".trace";
/// Length of the time in a file's name, such as `20261122T142614.321Z`.
const TIME_LEN: usize = 20;
/// The clock may stand still for a moment, or be set back by this much.
const SET_BACK_MS: u64 = 10_000;
/// The last millisecond with a year of four digits, since 1970.
const UTC_MS_MAX: u64 = 253_402_300_799_999;

/// The folders where traces are kept, the best first. A trace goes into the first one that takes it.
///
/// A service has only `$STATE_DIRECTORY`. Otherwise the first folder is the packaged service's, and the second one is
/// the user's own.
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

/// Makes a folder for traces, if it is missing. Only systemd or a package makes the service's folder.
///
/// # Errors
///
/// It cannot be made.
pub fn make(folder: &Path) -> io::Result<()> {
    if folder == Path::new(SERVICE) {
        return Ok(());
    }
    DirBuilder::new().recursive(true).mode(0o755).create(folder)
}

/// The folder for the state of this user's programs, if there is one (XDG Base Directory Specification).
pub(crate) fn user_state() -> Option<PathBuf> {
    let folder = |variable| env::var_os(variable).map(PathBuf::from).filter(|folder: &PathBuf| folder.is_absolute());
    folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")))
}

/// The name of the instance with this link: the file's name without `klipper_host_`.
pub fn name_of(link: &Path) -> String {
    let file = link.file_name().unwrap_or_default().to_string_lossy();
    file.strip_prefix("klipper_host_").unwrap_or(&file).to_owned()
}

/// The file's name for a trace of this instance that ended then, in milliseconds since 1970 (UTC). It is
/// `NAME-YYYYMMDDTHHMMSS.mmmZ.trace`.
pub fn file_name(name: &str, utc_ms: u64) -> String {
    let ([year, month, day], [hour, minute, second]) = utc(utc_ms);
    let ms = utc_ms.min(UTC_MS_MAX) % 1000;
    format!("{name}-{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}.{ms:03}Z{SUFFIX}")
}

/// The path of a new file in this folder. Its time may be a little later, so that it is the newest.
pub fn new_file(folder: &Path, name: &str, utc_ms: u64) -> PathBuf {
    let newest = kept(folder, name).into_iter().next();
    let path = |utc_ms| folder.join(file_name(name, utc_ms));
    let mut later = (utc_ms..utc_ms.saturating_add(SET_BACK_MS)).map(path);
    later.find(|path| newest.as_ref().is_none_or(|newest| path > newest)).unwrap_or_else(|| path(utc_ms))
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

/// The kept traces of the instance with this name, the newest first.
pub fn kept(folder: &Path, name: &str) -> Vec<PathBuf> {
    newest_first(in_folder(folder).filter(|(_, its, _)| its == name))
}

/// The kept traces of all instances in these folders, the newest first.
pub fn all(folders: &[PathBuf]) -> Vec<PathBuf> {
    newest_first(folders.iter().flat_map(|folder| in_folder(folder)))
}

fn newest_first(files: impl Iterator<Item = (String, String, PathBuf)>) -> Vec<PathBuf> {
    let mut files: Vec<_> = files.collect();
    files.sort_by(|a, b| b.cmp(a));
    files.into_iter().map(|(_, _, path)| path).collect()
}

/// The traces in a folder: their times, the names of their instances, their paths.
fn in_folder(folder: &Path) -> impl Iterator<Item = (String, String, PathBuf)> + use<> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| {
        let file = entry.file_name();
        let stem = file.to_str()?.strip_suffix(SUFFIX)?;
        let (name, time) = stem.split_at_checked(stem.len().checked_sub(TIME_LEN)?)?;
        let name = name.strip_suffix('-')?;
        let fits = |(at, byte): (usize, u8)| match at {
            8 => byte == b'T',
            15 => byte == b'.',
            19 => byte == b'Z',
            _ => byte.is_ascii_digit(),
        };
        time.bytes().enumerate().all(fits).then(|| (time.to_owned(), name.to_owned(), entry.path()))
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
            assert_eq!(file_name("mcu", utc_ms), format!("mcu-{time}.trace"));
        }
        assert_eq!(utc_text(1_795_357_574_321), "2026-11-22 14:26:14 UTC");
        for (link, name) in [("/tmp/klipper_host_mcu", "mcu"), ("/run/pinion/b", "b"), ("/", "")] {
            assert_eq!(name_of(Path::new(link)), name);
        }
    }

    #[test]
    fn the_newest_of_an_instance_come_first_and_other_files_are_not_traces() {
        let folder = tempfile::tempdir().unwrap();
        // The last two are in the same second.
        let times = [1_795_357_574_321, 951_782_400_000, 1_795_357_574_999];
        for (name, utc_ms) in times.iter().flat_map(|at| [("mcu", at), ("mcu-2", at), ("", at)]) {
            fs::write(folder.path().join(file_name(name, *utc_ms)), "").unwrap();
        }
        for other in [
            "mcu.trace",
            "mcu-20261122T142614.321Z.trace.1",
            "mcu-2026112T142614.321ZZ.trace",
            "mcu-20261122T142614Z.trace",
            "ä-0261122T142614.321Z.trace",
        ] {
            fs::write(folder.path().join(other), "").unwrap();
        }
        for name in ["mcu", "mcu-2", ""] {
            let newest = ["20261122T142614.999Z", "20261122T142614.321Z", "20000229T000000.000Z"];
            let newest = newest.map(|time| folder.path().join(format!("{name}-{time}.trace")));
            assert_eq!(kept(folder.path(), name), newest);
        }
        assert!(kept(folder.path(), "other").is_empty());
        let newest = all(&[folder.path().join("missing"), folder.path().to_owned()]);
        assert_eq!(newest.len(), 9);
        assert!(newest[..3].iter().all(|path| path.to_string_lossy().ends_with("20261122T142614.999Z.trace")));
        assert!(kept(&folder.path().join("missing"), "mcu").is_empty());
    }
}
