// SPDX-License-Identifier: GPL-3.0-or-later
//! PWM through sysfs.

use std::path::{Path, PathBuf};

use super::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-pwm";

/// The channel's line of what the pins would do, without the count of writes.
pub fn output(channel: usize) -> String {
    let outputs = sysfs::read(format!("{MOCK}/outputs"));
    let line = outputs.lines().nth(channel).expect("a channel");
    line.rsplit_once(' ').expect("a count").0.to_owned()
}

/// Forgets what the outputs did.
pub fn forget() {
    sysfs::write(format!("{MOCK}/history"), "0");
}

/// What the channel did since then: period and duty cycle in ns, and whether it is enabled.
pub fn history(channel: u64) -> Vec<(u64, u64, bool)> {
    let changes = sysfs::read(format!("{MOCK}/history"));
    let numbers = |line: &str| line.split(' ').map(|word| word.parse().expect("a number")).collect::<Vec<u64>>();
    let of = |change: Vec<u64>| (change[0] == channel).then(|| (change[1], change[2], change[3] == 1));
    changes.lines().filter_map(|line| of(numbers(line))).collect()
}

fn chip() -> PathBuf {
    let chip = Path::new("/sys/class/pwm/pwmchip0");
    assert_eq!(sysfs::read(chip.join("npwm")), "8");
    chip.to_owned()
}

#[test]
fn an_exported_channel_drives_its_output() {
    let chip = chip();
    sysfs::write(chip.join("export"), "2");
    let channel = chip.join("pwm2");
    sysfs::write(channel.join("period"), "1000000");
    sysfs::write(channel.join("duty_cycle"), "250000");
    sysfs::write(channel.join("enable"), "1");
    assert_eq!(output(2), "2 1000000 250000 1");
    sysfs::write(channel.join("enable"), "0");
    assert_eq!(output(2), "2 1000000 250000 0");
    sysfs::write(chip.join("unexport"), "2");
    assert!(!channel.exists());
}

#[test]
fn a_channel_is_exported_once() {
    let chip = chip();
    sysfs::write(chip.join("export"), "3");
    assert!(sysfs::try_write(chip.join("export"), "3").is_err());
    assert!(sysfs::try_write(chip.join("export"), "8").is_err(), "there are eight channels");
    sysfs::write(chip.join("unexport"), "3");
}
