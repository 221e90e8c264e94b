// SPDX-License-Identifier: GPL-3.0-or-later
//! ADCs: `mock_adc.c`.

use std::fs;
use std::path::{Path, PathBuf};

use crate::sysfs;

const DRIVER: &str = "/sys/bus/platform/drivers/mock-adc";
const INSTANCES: [&str; 7] =
    ["mock-adc.0", "mock-adc.1", "mock-adc.2", "mock-adc.3", "mock-adc.4", "mock-adc.5", "mock-adc.6"];

/// All mocks, until this is dropped. Most tests do without: each program looks at all channels of all ADCs.
pub struct Adcs(());

impl Adcs {
    pub fn new() -> Adcs {
        // A killed test leaves its ADCs to the next tests.
        for instance in INSTANCES.iter().filter(|instance| !Path::new(DRIVER).join(instance).exists()) {
            sysfs::write(format!("{DRIVER}/bind"), instance);
        }
        Adcs(())
    }
}

impl Drop for Adcs {
    fn drop(&mut self) {
        for instance in INSTANCES {
            let _ = fs::write(format!("{DRIVER}/unbind"), instance);
        }
    }
}

pub fn device(name: &str) -> PathBuf {
    sysfs::entry_with("/sys/bus/iio/devices", "name", name)
}

pub fn raw(name: &str, channel: u32) -> PathBuf {
    device(name).join(format!("in_voltage{channel}_raw"))
}

/// An ADC that is removed while it is in use, until this is dropped.
pub struct Gone(&'static str);

impl Gone {
    /// `instance` as in `mock-adc.1`.
    pub fn new(instance: &'static str) -> Gone {
        sysfs::write(format!("{DRIVER}/unbind"), instance);
        Gone(instance)
    }
}

impl Drop for Gone {
    fn drop(&mut self) {
        let _ = fs::write(format!("{DRIVER}/bind"), self.0);
    }
}
