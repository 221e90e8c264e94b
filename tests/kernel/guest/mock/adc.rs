// SPDX-License-Identifier: GPL-3.0-or-later
//! ADCs: `mock_adc.c`.

use std::fs;
use std::path::PathBuf;

use crate::sysfs;

const DRIVER: &str = "/sys/bus/platform/drivers/mock-adc";

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
