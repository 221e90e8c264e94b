// SPDX-License-Identifier: GPL-3.0-or-later
//! PWM: `mock_pwm.c`.

use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-pwm";

/// The channel's line with the state of its output, without the count of writes.
pub fn output(channel: usize) -> String {
    let outputs = sysfs::read(format!("{MOCK}/outputs"));
    let line = outputs.lines().nth(channel).expect("a channel");
    line.rsplit_once(' ').expect("a count").0.to_owned()
}

/// Forgets the history of the outputs.
pub fn forget() {
    sysfs::write(format!("{MOCK}/history"), "0");
}

/// The changes of the channel since then: period and duty cycle in ns, and whether it is enabled.
pub fn history(channel: u64) -> Vec<(u64, u64, bool)> {
    let changes = sysfs::read(format!("{MOCK}/history"));
    let numbers = |line: &str| line.split(' ').map(|word| word.parse().expect("a number")).collect::<Vec<u64>>();
    let of = |change: Vec<u64>| (change[0] == channel).then(|| (change[1], change[2], change[3] == 1));
    changes.lines().filter_map(|line| of(numbers(line))).collect()
}
