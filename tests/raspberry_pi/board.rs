// SPDX-License-Identifier: GPL-3.0-or-later
//! The boards that the emulator has.

use super::gpio::Registers;

/// A board, and what the tests expect of it.
pub struct Board {
    /// For people.
    pub name: &'static str,
    /// The emulator's name, and the value of `--board`.
    pub machine: &'static str,
    /// Its file in Debian's package of the kernel.
    pub device_tree: &'static str,
    /// Of the console. The emulated port takes the high byte of the divisor for its interrupt enable register. Bit 1 there
    /// would be an interrupt without end.
    pub baud: u32,
    /// More words for the kernel's command line.
    pub command_line: &'static str,
    /// Of the GPIO chip.
    pub registers: Registers,
    /// The kernel's label of the GPIO chip.
    pub chip: &'static str,
    /// The kernel's number of lines of that chip.
    pub lines: u32,
}

pub const BOARDS: [Board; 2] = [
    Board {
        name: "Raspberry Pi 3",
        machine: "raspi3b",
        device_tree: "broadcom/bcm2837-rpi-3-b.dtb",
        baud: 115_200,
        command_line: "",
        registers: Registers(0x3f20_0000),
        chip: "pinctrl-bcm2835",
        lines: 54,
    },
    Board {
        name: "Raspberry Pi 4",
        machine: "raspi4b",
        device_tree: "broadcom/bcm2711-rpi-4-b.dtb",
        baud: 230_400,
        // The emulated board has no HDMI. Its drivers would read registers that are not there, and stop the kernel.
        command_line: "initcall_blacklist=brcmstb_l2_driver_init,brcmstb_i2c_driver_init,clk_dvp_driver_init",
        registers: Registers(0xfe20_0000),
        chip: "pinctrl-bcm2711",
        lines: 58,
    },
];
