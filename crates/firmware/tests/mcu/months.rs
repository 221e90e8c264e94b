// SPDX-License-Identifier: GPL-3.0-or-later
//! Each month's host gets the forms, constants and enumerations of its own linux firmware.

use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Forms, HostForms, entries};
use pinion_testbench::months::hosts;

/// Messages that some or all hosts await by their name alone, or never look up.
const UNNAMED: [&str; 12] = [
    "adxl345_data",
    "analog_in_state",
    "buttons_state",
    "clock",
    "ds18b20_result",
    "lis2dw_data",
    "mpu9250_data",
    "sensor_bulk_data",
    "set_pca9685_out",
    "set_pwm_out",
    "spi_angle_data",
    "thermocouple_result",
];

#[test]
fn each_month_s_host_gets_what_its_own_firmware_has() {
    let hosts = hosts();
    assert!(hosts.len() >= 76, "{}", hosts.len());
    for host in hosts {
        let looks_up = HostForms::new(&entries(FEATURES), |entry| host.has(entry) && !UNNAMED.contains(&entry.name));
        let extra = host.check(Forms::Host(looks_up));
        assert!(extra.is_empty(), "{} {} gets {extra:?}", host.repository, host.name);
    }
}
