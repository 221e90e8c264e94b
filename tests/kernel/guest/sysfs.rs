// SPDX-License-Identifier: GPL-3.0-or-later
//! Files of the kernel: sysfs, configfs and tracefs. A test ends with the file's name if a file cannot be read or
//! written.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_gettime};

/// An idle guest's time passes at once, and a look costs an emulated processor much. No multiple of a PWM's cycle.
pub const POLL_INTERVAL: Duration = Duration::from_millis(13);

/// Tests write to any hardware that they find. That is allowed in the guest only.
pub fn assert_in_guest() {
    assert!(
        Path::new("/run/pinion-tests").exists(),
        "this runs in the VM of tests/kernel only: cargo test --test kernel"
    );
}

/// The content without the newline at its end.
pub fn read(path: impl AsRef<Path>) -> String {
    let path = path.as_ref();
    let content = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    content.trim_end().to_owned()
}

pub fn write(path: impl AsRef<Path>, value: impl AsRef<str>) {
    let (path, value) = (path.as_ref(), value.as_ref());
    try_write(path, value).unwrap_or_else(|error| panic!("writing {value:?} to {}: {error}", path.display()));
}

/// A write that may fail.
pub fn try_write(path: impl AsRef<Path>, value: impl AsRef<str>) -> io::Result<()> {
    assert_in_guest();
    fs::write(path, value.as_ref())
}

/// A setting of a mock. It is undone when this is dropped, so the next test finds the former value even if this test
/// fails.
pub struct Setting {
    path: PathBuf,
    before: &'static str,
}

/// Writes `value` now, and `before` at the end.
pub fn set(path: impl Into<PathBuf>, value: impl AsRef<str>, before: &'static str) -> Setting {
    let path = path.into();
    write(&path, value);
    Setting { path, before }
}

impl Drop for Setting {
    fn drop(&mut self) {
        // Not through helpers that panic: the test may be panicking already.
        let _ = fs::write(&self.path, self.before);
    }
}

/// The folder's entry with `value` in its file `name`. Devices are numbered in the order in which they came.
pub fn entry_with(folder: &str, name: &str, value: &str) -> PathBuf {
    fs::read_dir(folder)
        .unwrap_or_else(|error| panic!("{folder}: {error}"))
        .map(|entry| entry.expect("a readable folder").path())
        .find(|path| fs::read_to_string(path.join(name)).is_ok_and(|it| it.trim_end() == value))
        .unwrap_or_else(|| panic!("nothing in {folder} has {value:?} in its {name}"))
}

/// CLOCK_MONOTONIC, which traces and Pinion's log have, too.
pub fn monotonic() -> Duration {
    clock_gettime(ClockId::CLOCK_MONOTONIC).expect("every kernel has this clock").into()
}

/// Waits for the result of another thread or process.
pub fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(10);
    while !condition() {
        assert!(Instant::now() < deadline, "waited in vain until {what}");
        thread::sleep(POLL_INTERVAL);
    }
}
