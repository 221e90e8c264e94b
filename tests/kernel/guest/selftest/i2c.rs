// SPDX-License-Identifier: GPL-3.0-or-later
//! i2c-dev on the mocked adapter.

use std::time::{Duration, Instant};

use nix::errno::Errno;

use crate::mock::i2c::bus;
use crate::{sysfs, uapi};

const MOCK: &str = "/sys/devices/platform/mock-i2c";
const CHIP: u16 = 0x50;

#[test]
fn a_register_holds_what_was_written() {
    sysfs::write(format!("{MOCK}/sent"), "0");
    assert_eq!(uapi::i2c_transfer(&bus(), CHIP, &[0x10, 0xaa, 0x55], 0), Ok(vec![]));
    assert_eq!(uapi::i2c_transfer(&bus(), CHIP, &[0x10], 2), Ok(vec![0xaa, 0x55]));
    assert_eq!(uapi::i2c_transfer(&bus(), CHIP + 1, &[0x10], 2), Ok(vec![0, 0]));
    assert_eq!(sysfs::read(format!("{MOCK}/sent")), "50 10 aa 55\n50 10\n51 10");
}

#[test]
fn an_address_without_a_chip_does_not_acknowledge() {
    assert_eq!(uapi::i2c_transfer(&bus(), 0x20, &[0], 0), Err(Errno::ENXIO));
}

#[test]
fn a_transfer_fails_as_was_set() {
    let transfer = || uapi::i2c_transfer(&bus(), CHIP + 2, &[0], 1);
    sysfs::write(format!("{MOCK}/fail"), format!("{} 1", Errno::ETIMEDOUT as i32));
    assert_eq!(transfer(), Err(Errno::ETIMEDOUT));
    assert_eq!(transfer(), Ok(vec![0]));
}

#[test]
fn a_transfer_takes_as_long_as_was_set() {
    let started = Instant::now();
    sysfs::write(format!("{MOCK}/delay_ms"), "50");
    let result = uapi::i2c_transfer(&bus(), CHIP + 2, &[0], 1);
    sysfs::write(format!("{MOCK}/delay_ms"), "0");
    assert_eq!(result, Ok(vec![0]));
    assert!(started.elapsed() >= Duration::from_millis(50));
}
