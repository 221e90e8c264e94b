// SPDX-License-Identifier: GPL-3.0-or-later
//! A file in place of the registers of a BCM2835. An edge is one store to it, as on a Raspberry Pi. No line changes.
//!
//! Pinion checks each line before it trusts registers. The file says what the kernel says about an output at level 0,
//! because nothing changes it: every line is an output, and its level is 0.

use std::fs;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use nix::mount::{MsFlags, mount, umount};

use super::gpio_sim::GpioSim;
use super::sysfs;

const DEVICES: &str = "/sys/bus/gpio/devices";
const NODE: &str = "/dev/gpiomem";
const BYTES: u64 = 0x1000;
/// Function select registers: six of ten lines each, with 3 bits a line. 1 is an output.
const FUNCTIONS: u64 = 6;
const OUTPUTS: u32 = 0o11_1111_1111;

/// The file, and a device tree that names the chip. Both are removed when this is dropped.
pub struct RegisterFile {
    devices: PathBuf,
}

impl RegisterFile {
    /// Registers for all lines of a simulated chip.
    pub fn of(sim: &GpioSim) -> RegisterFile {
        sysfs::assert_in_guest();
        let file = fs::File::create(NODE).expect("a node");
        file.set_len(BYTES).expect("room");
        for word in 0..FUNCTIONS {
            file.write_all_at(&OUTPUTS.to_ne_bytes(), 4 * word).expect("a register");
        }
        let devices = Path::new("/tmp").join(format!("devices-{}", std::process::id()));
        let tree = devices.join(sim.chip_name()).join("of_node");
        fs::create_dir_all(&tree).expect("a device tree");
        fs::write(tree.join("compatible"), b"brcm,bcm2835-gpio\0").expect("a chip's name");
        let none: Option<&str> = None;
        mount(Some(&devices), DEVICES, none, MsFlags::MS_BIND, none).expect("a mount");
        RegisterFile { devices }
    }
}

impl Drop for RegisterFile {
    fn drop(&mut self) {
        let _ = umount(DEVICES);
        let _ = fs::remove_file(NODE);
        let _ = fs::remove_dir_all(&self.devices);
    }
}
