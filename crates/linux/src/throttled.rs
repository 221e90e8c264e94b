// SPDX-License-Identifier: GPL-3.0-or-later
//! The report of a Raspberry Pi's firmware on its power and its temperature
//! (<https://www.raspberrypi.com/documentation/computers/os.html#get_throttled>).

#![forbid(unsafe_code)]

/// The pattern of the file with the firmware's bits.
pub const FILES: &str = "/sys/devices/platform/*/*firmware/get_throttled";
/// The voltage is too low.
pub const UNDERVOLTAGE: u32 = 1 << 0;
/// The processors are throttled, or at their temperature limit.
pub const HOT: u32 = 1 << 2 | 1 << 3;

/// The bits, from the file or from vcgencmd.
pub fn bits(text: &str) -> Option<u32> {
    u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()
}
