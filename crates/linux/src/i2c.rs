// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C devices through i2c-dev.

#![forbid(unsafe_code)]

use std::fs;
use std::io;
use std::path::Path;

use linux_embedded_hal::i2cdev::core::{I2CMessage, I2CTransfer};
use linux_embedded_hal::i2cdev::linux::{LinuxI2CDevice, LinuxI2CMessage};

use crate::gpio::not_permitted;
use crate::{LOOK_AT_LOG, sys};
use pinion_firmware::board::{BusDevice, BusError, BusStatus, I2cConfig, Range};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

/// How many buses the C program has names for, from 0 on.
const BUSES: u32 = 15;

/// The numbers of the buses in `dev`, in order.
pub fn scan(dev: &Path) -> Vec<u32> {
    let mut buses: Vec<u32> = fs::read_dir(dev)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.strip_prefix("i2c-")?.parse().ok())
        .collect();
    buses.sort_unstable();
    buses
}

/// The dictionary's enumeration `i2c_bus`: the buses of the C program, and the buses beyond them.
pub fn ranges(buses: &[u32]) -> Vec<Range> {
    let c_program = Range { name: "i2c.0".into(), first: 0, count: BUSES };
    let further = buses.iter().filter(|bus| **bus >= BUSES);
    let further = further.map(|bus| Range { name: format!("i2c.{bus}"), first: *bus, count: 1 });
    [c_program].into_iter().chain(further).collect()
}

/// An open I2C device.
pub struct I2c {
    device: LinuxI2CDevice,
    /// For example `/dev/i2c-1 address 0x48`.
    name: String,
}

impl I2c {
    /// Opens a bus for one address. The clock rate is the driver's own, as with the C program.
    ///
    /// # Errors
    ///
    /// "Unable to open i2c device": the bus or the permission is missing, a kernel driver has the chip, or the adapter
    /// only knows SMBus.
    pub fn open(dev: &Path, config: I2cConfig) -> Result<I2c, Shutdown> {
        let I2cConfig { bus, address, .. } = config;
        let path = dev.join(format!("i2c-{bus}"));
        let name = format!("{} address {address:#04x}", path.display());
        let refused =
            |error: io::Error| Shutdown::because(reason::I2C_OPEN, cannot_open(&path, &name, &error, &scan(dev)));
        let device = LinuxI2CDevice::new(&path, address.into()).map_err(|error| refused(error.into()))?;
        if !sys::is_plain_i2c(&device).map_err(refused)? {
            let cause = format!("{} knows SMBus only, not I2C messages", path.display());
            return Err(Shutdown::because(reason::I2C_OPEN, cause).remedy("choose another i2c_bus"));
        }
        Ok(I2c { device, name })
    }
}

impl BusDevice for I2c {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let lengths = (write.len(), read.len());
        let transferred = match lengths {
            (_, 0) => self.device.transfer(&mut [LinuxI2CMessage::write(write)]),
            (0, _) => self.device.transfer(&mut [LinuxI2CMessage::read(read)]),
            _ => self.device.transfer(&mut [LinuxI2CMessage::write(write), LinuxI2CMessage::read(read)]),
        };
        transferred.map(drop).map_err(|error| failure(&self.name, lengths, &error.into()))
    }
}

/// The meaning of a transfer's error number, from the kernel's Documentation/i2c/fault-codes.rst, and the remedy.
fn failure(name: &str, (written, read): (usize, usize), error: &io::Error) -> BusError {
    const CHECK_CHIP: &str = "check its wiring, its power and i2c_address";
    let (status, trouble) = match error.raw_os_error().unwrap_or_default() {
        libc::ENXIO => (BusStatus::StartNack, Trouble::new("no chip acknowledges the address").remedy(CHECK_CHIP)),
        // Some drivers report a refused address and a refused byte alike: i2c-bcm2835, i2c-designware.
        libc::EREMOTEIO => (BusStatus::Nack, Trouble::new("the chip does not acknowledge").remedy(CHECK_CHIP)),
        libc::ETIMEDOUT | libc::EBUSY => (
            BusStatus::Timeout,
            Trouble::new("the bus is held for too long: a chip or a short pulls SCL or SDA low")
                .remedy("check the wiring, switch the chip's power off and on"),
        ),
        libc::EAGAIN => (
            BusStatus::Timeout,
            Trouble::new("the bus was lost to another master, or to noise")
                .remedy("shorten its wires, lower its rate (on a Raspberry Pi \"dtparam=i2c_arm_baudrate=50000\")"),
        ),
        libc::EINVAL | libc::EOPNOTSUPP => (
            BusStatus::Nack,
            Trouble::new(format!("its adapter refuses a transfer of {written} bytes written and {read} read"))
                .remedy("choose another i2c_bus"),
        ),
        _ => (
            BusStatus::Nack,
            Trouble::new(format!("a transfer of {written} bytes written and {read} read failed: {error}"))
                .remedy("check the wiring, and the kernel's log (dmesg)"),
        ),
    };
    BusError::new(status, trouble).of(name)
}

fn cannot_open(path: &Path, name: &str, error: &io::Error, buses: &[u32]) -> Trouble {
    match error.raw_os_error().unwrap_or_default() {
        libc::ENOENT => {
            let known: Vec<String> = buses.iter().map(|bus| format!("i2c.{bus}")).collect();
            let known = match known.is_empty() {
                true => "this computer has no I2C bus".to_owned(),
                false => format!("this computer has {}", known.join(", ")),
            };
            Trouble::new(format!("there is no {}: {known}", path.display())).remedy(
                "enable the bus (on a Raspberry Pi \"dtparam=i2c_arm=on\" in config.txt, and \"sudo modprobe \
                 i2c-dev\"), or change i2c_bus",
            )
        }
        code @ (libc::EACCES | libc::EPERM) => not_permitted(path, code),
        libc::EBUSY => Trouble::new(format!("{name} is in use by a driver of the kernel"))
            .remedy("remove its overlay from the device tree, or choose another chip"),
        _ => Trouble::new(format!("{name} cannot be opened: {error}")).remedy(LOOK_AT_LOG),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: I2cConfig = I2cConfig { bus: 1, address: 0x48, rate_hz: 100_000 };

    #[test]
    fn buses_beyond_the_c_program_s_are_published() {
        let dev = tempfile::tempdir().unwrap();
        for name in ["i2c-1", "i2c-22", "i2c-x", "i2c", "spidev0.0"] {
            fs::write(dev.path().join(name), "").unwrap();
        }
        let buses = scan(dev.path());
        assert_eq!(buses, [1, 22]);
        let range = |name: &str, first, count| Range { name: name.into(), first, count };
        assert_eq!(ranges(&buses), [range("i2c.0", 0, 15), range("i2c.22", 22, 1)]);
    }

    #[test]
    fn a_bus_that_is_not_there_or_none_at_all() {
        let dev = tempfile::tempdir().unwrap();
        fs::write(dev.path().join("i2c-20"), "").unwrap();
        let error = I2c::open(dev.path(), CONFIG).err().unwrap();
        assert_eq!(error.reason, reason::I2C_OPEN);
        assert!(error.to_string().contains("this computer has i2c.20: enable the bus"), "{error}");
        fs::write(dev.path().join("i2c-1"), "").unwrap();
        let error = I2c::open(dev.path(), CONFIG).err().unwrap();
        assert!(error.to_string().contains("i2c-1 address 0x48 cannot be opened: "), "{error}");
    }

    #[test]
    fn faults_have_their_status_and_a_remedy() {
        for (code, status, remedy) in [
            (libc::ENXIO, BusStatus::StartNack, "check its wiring"),
            (libc::EREMOTEIO, BusStatus::Nack, "check its wiring"),
            (libc::ETIMEDOUT, BusStatus::Timeout, "power off and on"),
            (libc::EBUSY, BusStatus::Timeout, "power off and on"),
            (libc::EAGAIN, BusStatus::Timeout, "shorten its wires"),
            (libc::EOPNOTSUPP, BusStatus::Nack, "2 bytes written and 200 read: choose another"),
            (libc::EIO, BusStatus::Nack, "(dmesg)"),
        ] {
            let error = failure("/dev/i2c-1 address 0x48", (2, 200), &io::Error::from_raw_os_error(code));
            assert_eq!(error.status, status, "{code}");
            let said = error.trouble.to_string();
            assert!(said.starts_with("/dev/i2c-1 address 0x48: ") && said.contains(remedy), "{said}");
        }
    }

    #[test]
    fn a_chip_that_the_kernel_has_and_a_bus_that_is_not_permitted() {
        let text = |code| {
            let error = io::Error::from_raw_os_error(code);
            cannot_open(Path::new("/dev/i2c-1"), "/dev/i2c-1 address 0x48", &error, &[]).to_string()
        };
        assert!(text(libc::EBUSY).contains("in use by a driver of the kernel: remove"));
        assert!(text(libc::EACCES).contains("may not open /dev/i2c-1"));
        assert!(text(libc::ENOENT).contains("no I2C bus: enable"));
    }
}
