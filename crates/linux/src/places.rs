// SPDX-License-Identifier: GPL-3.0-or-later
//! Folders and files in which the kernel shows its devices.

#![forbid(unsafe_code)]

pub(crate) const DEV: &str = "/dev";
pub(crate) const GPIO: &str = "/sys/bus/gpio/devices";
/// The kernel's policy for the sleep of PCIe links.
pub(crate) const ASPM_POLICY: &str = "/sys/module/pcie_aspm/parameters/policy";
pub(crate) const PWM: &str = "/sys/class/pwm";
pub(crate) const IIO: &str = "/sys/bus/iio/devices";
pub(crate) const TTY: &str = "/sys/class/tty";
pub(crate) const SPI_MASTERS: &str = "/sys/class/spi_master";
pub(crate) const W1: &str = "/sys/bus/w1/devices";
