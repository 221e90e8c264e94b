// SPDX-License-Identifier: GPL-3.0-or-later
//! PWM through sysfs.

use std::path::{Path, PathBuf};

use crate::mock::pwm::output;
use crate::sysfs;

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
