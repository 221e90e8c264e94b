// SPDX-License-Identifier: GPL-3.0-or-later
//! IIO ADCs, as sysfs shows them.

use std::fs::{self, File};
use std::io::Read;
use std::time::{Duration, Instant};

use nix::errno::Errno;

use crate::mock::adc::{Adcs, Gone, raw};
use crate::sysfs;

/// The kinds of `mock_adc.c`, in the order of their instances.
const ADCS: [&str; 7] =
    ["mock-adc12", "mock-adc8", "mock-adc10", "mock-adc16", "mock-adc-s12", "mock-adc-s16", "mock-adc-plain"];

#[test]
fn a_reading_is_what_was_set() {
    let _adcs = Adcs::new();
    for name in ADCS {
        for channel in 0..8 {
            let value = if name.contains("-s") { -100 } else { 100 } + i32::try_from(channel).unwrap();
            sysfs::write(raw(name, channel), value.to_string());
            assert_eq!(sysfs::read(raw(name, channel)), value.to_string(), "{name}");
        }
    }
}

#[test]
fn the_first_device_is_the_adc_of_12_bits() {
    let _adcs = Adcs::new();
    assert_eq!(sysfs::read("/sys/bus/iio/devices/iio:device0/name"), "mock-adc12");
}

#[test]
fn a_reading_takes_as_long_as_was_set() {
    let _adcs = Adcs::new();
    let delay = "/sys/devices/platform/mock-adc.0/delay_ms";
    sysfs::write(delay, "100");
    let started = Instant::now();
    sysfs::read(raw("mock-adc12", 0));
    let took = started.elapsed();
    sysfs::write(delay, "0");
    assert!(took >= Duration::from_millis(100), "{took:?}");
}

#[test]
fn a_reading_fails_as_was_set() {
    let _adcs = Adcs::new();
    let fail = "/sys/devices/platform/mock-adc.0/fail";
    sysfs::write(fail, (Errno::EIO as i32).to_string());
    let error = fs::read_to_string(raw("mock-adc12", 0)).expect_err("a failure was set");
    sysfs::write(fail, "0");
    assert_eq!(error.raw_os_error(), Some(Errno::EIO as i32));
    sysfs::read(raw("mock-adc12", 0));
}

#[test]
fn an_adc_disappears_under_an_open_file() {
    let _adcs = Adcs::new();
    let path = raw("mock-adc8", 0);
    let mut file = File::open(&path).expect("the channel");
    let gone = Gone::new("mock-adc.1");
    let error = file.read(&mut [0; 8]).expect_err("no such device any more");
    let is_gone = !path.exists();
    drop(gone);
    assert_eq!(error.raw_os_error(), Some(Errno::ENODEV as i32));
    assert!(is_gone);
    sysfs::read(raw("mock-adc8", 0));
}

#[test]
fn upstreams_own_dummy_is_there_too() {
    let folder = "/sys/kernel/config/iio/devices/dummy/lab";
    sysfs::assert_in_guest();
    fs::create_dir(folder).expect("iio_dummy");
    let reading = sysfs::read(raw("lab", 0));
    fs::remove_dir(folder).expect("iio_dummy");
    assert!(reading.parse::<i32>().is_ok(), "{reading}");
}
