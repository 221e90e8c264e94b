// SPDX-License-Identifier: GPL-3.0-or-later
//! The I2C adapter: `mock_i2c.c`.

use std::path::{Path, PathBuf};

use crate::sysfs;

/// The node of the mocked bus.
pub fn bus() -> PathBuf {
    let entry = sysfs::entry_with("/sys/class/i2c-dev", "name", "mock-i2c");
    Path::new("/dev").join(entry.file_name().expect("a named entry"))
}
