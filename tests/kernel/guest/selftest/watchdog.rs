// SPDX-License-Identifier: GPL-3.0-or-later
//! The watchdog device.

use std::fs::File;
use std::io::Write;

use crate::sysfs;

#[test]
fn it_is_fed_and_closed() {
    assert_eq!(sysfs::read("/sys/class/watchdog/watchdog0/identity"), "Software Watchdog");
    sysfs::assert_in_guest();
    let mut watchdog = File::create("/dev/watchdog").expect("the watchdog");
    watchdog.write_all(b".").expect("feeding");
    // This letter stops it when it is closed.
    watchdog.write_all(b"V").expect("closing");
}
