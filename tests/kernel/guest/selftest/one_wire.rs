// SPDX-License-Identifier: GPL-3.0-or-later
//! DS18B20 thermometers on the stock w1_therm.

use std::fs;

use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-w1";

fn slave(sensor: usize) -> String {
    format!("/sys/bus/w1/devices/28-00000000100{}/w1_slave", sensor + 1)
}

fn temperature(sensor: usize) -> String {
    sysfs::wait_until("the bus was searched", || fs::exists(slave(sensor)).unwrap_or(false));
    let answer = sysfs::read(slave(sensor));
    assert!(answer.contains("YES"), "{answer}");
    answer.rsplit_once("t=").expect("a temperature").1.to_owned()
}

#[test]
fn each_sensor_measures_its_own_temperature() {
    sysfs::write(format!("{MOCK}/temperature"), "0 85500");
    sysfs::write(format!("{MOCK}/temperature"), "1 -10250");
    assert_eq!(temperature(0), "85500");
    assert_eq!(temperature(1), "-10250");
}

#[test]
fn a_sensor_that_was_taken_away_does_not_answer() {
    temperature(1);
    sysfs::write(format!("{MOCK}/present"), "1 0");
    let answer = fs::read_to_string(slave(1));
    sysfs::write(format!("{MOCK}/present"), "1 1");
    assert!(!answer.is_ok_and(|answer| answer.contains("YES")));
    temperature(1);
}
