// SPDX-License-Identifier: GPL-3.0-or-later
//! IIO ADCs, as sysfs and libiio show them.

use std::fs::{self, File};
use std::io::Read;
use std::time::{Duration, Instant};

use industrial_io::Context;
use nix::errno::Errno;

use crate::mock::adc::{Gone, raw};
use crate::sysfs;

/// The kinds of `mock_adc.c`, in the order of their instances.
const ADCS: [Adc; 7] = [
    Adc { name: "mock-adc12", bits: 12, is_signed: false, has_scan_type: true },
    Adc { name: "mock-adc8", bits: 8, is_signed: false, has_scan_type: true },
    Adc { name: "mock-adc10", bits: 10, is_signed: false, has_scan_type: true },
    Adc { name: "mock-adc16", bits: 16, is_signed: false, has_scan_type: true },
    Adc { name: "mock-adc-s12", bits: 12, is_signed: true, has_scan_type: true },
    Adc { name: "mock-adc-s16", bits: 16, is_signed: true, has_scan_type: true },
    Adc { name: "mock-adc-plain", bits: 12, is_signed: false, has_scan_type: false },
];

struct Adc {
    name: &'static str,
    bits: u32,
    is_signed: bool,
    has_scan_type: bool,
}

#[test]
fn a_reading_is_what_was_set() {
    for adc in &ADCS {
        for channel in 0..8 {
            let value = if adc.is_signed { -100 } else { 100 } + i32::try_from(channel).unwrap();
            sysfs::write(raw(adc.name, channel), value.to_string());
            assert_eq!(sysfs::read(raw(adc.name, channel)), value.to_string(), "{}", adc.name);
        }
    }
}

#[test]
fn the_first_device_is_the_adc_of_12_bits() {
    assert_eq!(sysfs::read("/sys/bus/iio/devices/iio:device0/name"), "mock-adc12");
}

#[test]
fn libiio_knows_names_channels_and_resolutions() {
    let context = Context::new().expect("libiio");
    for adc in &ADCS {
        let device = context.find_device(adc.name).expect(adc.name);
        assert_eq!(device.num_channels(), 8);
        let channel = device.find_input_channel("voltage3").expect("voltage3");
        sysfs::write(raw(adc.name, 3), "77");
        assert_eq!(channel.attr_read_int("raw").expect("a reading"), 77);
        assert_eq!(channel.is_scan_element(), adc.has_scan_type, "{}", adc.name);
        if adc.has_scan_type {
            let format = channel.data_format();
            assert_eq!((format.bits(), format.is_signed()), (adc.bits, adc.is_signed));
        }
        // Millivolts of one step: 3300 over the range.
        let steps = 1_u32 << (adc.bits - u32::from(adc.is_signed));
        let scale = channel.attr_read_float("scale").expect("a scale");
        assert!((scale * f64::from(steps) - 3300.0).abs() < 0.1, "{}: {scale}", adc.name);
    }
}

#[test]
fn a_reading_takes_as_long_as_was_set() {
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
    let fail = "/sys/devices/platform/mock-adc.0/fail";
    sysfs::write(fail, (Errno::EIO as i32).to_string());
    let error = fs::read_to_string(raw("mock-adc12", 0)).expect_err("a failure was set");
    sysfs::write(fail, "0");
    assert_eq!(error.raw_os_error(), Some(Errno::EIO as i32));
    sysfs::read(raw("mock-adc12", 0));
}

#[test]
fn an_adc_disappears_under_an_open_file() {
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
