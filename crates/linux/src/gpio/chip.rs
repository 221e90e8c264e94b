// SPDX-License-Identifier: GPL-3.0-or-later
//! The GPIO chips of a computer, and the kernel's information about them and their lines.

#![forbid(unsafe_code)]

use std::fs;
use std::path::{Path, PathBuf};

use gpio_cdev::LineDirection;

use super::refusal::{cannot_open, errno};
use super::registers::Places;
use super::{ChipRegisters, FastGpio};
use crate::places::{ASPM_POLICY, DEV, GPIO};
use pinion_firmware::trouble::Trouble;

/// Subsystems whose drivers send messages to their devices and sleep until the answer comes.
const SLEEPING_BUSES: [&str; 7] = ["i2c", "spi", "usb", "hid", "serial", "virtio", "w1"];
/// Labels of chips that are on none of these buses, but whose drivers also sleep. The chip of the Raspberry Pi 3 and 4
/// asks the firmware (drivers/gpio/gpio-raspberrypi-exp.c, `can_sleep`).
const SLEEPING_LABELS: [&str; 1] = ["raspberrypi-exp-gpio"];

/// Labels of the chips with the 40-pin header of a Raspberry Pi: up to the 3, of the 4, and of the 5.
const HEADERS: [&str; 3] = ["pinctrl-bcm2835", "pinctrl-bcm2711", RP1];
const RP1: &str = "pinctrl-rp1";
/// The numbers that kernels have given the header's chip. Only an RP1 was ever number 4. Linux 6.12.96 of Raspberry Pi OS
/// gives it none of them.
const HEADER_NUMBERS: [u32; 2] = [0, 4];

/// A GPIO chip as it was found.
#[derive(Clone, Debug)]
pub struct Chip {
    /// The number of `/dev/gpiochip<n>`.
    pub number: u32,
    /// The driver's label, such as `pinctrl-bcm2835`.
    pub label: String,
    /// Whether calls to it may block, as for an expander.
    pub sleeps: bool,
    /// Its lines by offset.
    pub lines: Vec<LineInfo>,
}

impl Chip {
    /// Whether it has the 40-pin header of a Raspberry Pi.
    pub(crate) fn is_header(&self) -> bool {
        HEADERS.contains(&self.label.as_str())
    }

    /// Whether some kernel gives this chip of the header this number.
    pub(crate) fn may_have_been(&self, number: u32) -> bool {
        number == 0 || self.label == RP1 && HEADER_NUMBERS.contains(&number)
    }

    /// The registers of this chip, mapped as the program would do it.
    ///
    /// # Errors
    ///
    /// Why it has none, or they cannot be used, and what to do.
    pub fn registers(&self, wish: FastGpio) -> Result<ChipRegisters, Trouble> {
        let places = Places { dev: Path::new(DEV), devices: Path::new(GPIO), aspm_policy: Path::new(ASPM_POLICY) };
        ChipRegisters::open(&places, &format!("gpiochip{}", self.number), wish)
    }
}

/// A line as it was found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LineInfo {
    /// The name that the device tree gives the line.
    pub name: Option<String>,
    /// Whether it is an output.
    pub output: bool,
    /// Whether the kernel or a program uses it.
    pub held: bool,
    /// The line's user, if the kernel knows it.
    pub consumer: Option<String>,
}

/// The chips of this computer by number, and why the others cannot be read.
///
/// A node that links to another chip's node (`/dev/gpiochip4` on a Raspberry Pi 5) is left out. Its lines are those of
/// the other chip. Pins with its number still work.
pub(crate) fn scan(dev: &Path, devices: &Path) -> (Vec<Chip>, Vec<Trouble>) {
    let mut chips = Vec::new();
    let mut problems = Vec::new();
    for number in nodes(dev) {
        let path = node(dev, number);
        let chip = match gpio_cdev::Chip::new(&path) {
            Ok(chip) => chip,
            Err(error) => {
                problems.push(cannot_open(&path, errno(&error)));
                continue;
            }
        };
        if chip.name() != format!("gpiochip{number}") {
            continue;
        }
        let lines = chip.lines().map(|line| look_at(&line)).collect();
        let sleeps = may_sleep(devices, chip.name(), chip.label());
        chips.push(Chip { number, label: chip.label().to_owned(), sleeps, lines });
    }
    (chips, problems)
}

/// The numbers of a Raspberry Pi's header that no chip has, and no link in `dev`.
pub(crate) fn vacant(dev: &Path) -> Vec<u32> {
    HEADER_NUMBERS.into_iter().filter(|number| !node(dev, *number).exists()).collect()
}

/// Says that a chip is missing, and lists those that exist.
pub(super) fn missing(path: &Path, chips: &[Chip]) -> Trouble {
    let known: Vec<String> = chips.iter().map(|chip| format!("gpiochip{} ({})", chip.number, chip.label)).collect();
    let known = match known.is_empty() {
        true => "no GPIO chip that can be opened".to_owned(),
        false => known.join(", "),
    };
    Trouble::new(format!("there is no {}: this computer has {known}", path.display()))
        .remedy("write the pin with one of these (pinion pins lists them)")
}

/// The numbers of the chips in `dev`, in ascending order.
pub(super) fn nodes(dev: &Path) -> Vec<u32> {
    let mut numbers: Vec<u32> = fs::read_dir(dev)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.strip_prefix("gpiochip")?.parse().ok())
        .collect();
    numbers.sort_unstable();
    numbers
}

pub(super) fn node(dev: &Path, number: u32) -> PathBuf {
    dev.join(format!("gpiochip{number}"))
}

pub(super) fn look_at(line: &gpio_cdev::Line) -> LineInfo {
    // Without information the line still keeps its place in the list, which is its offset.
    line.info().map_or_else(
        |_| LineInfo::default(),
        |info| LineInfo {
            name: info.name().map(str::to_owned),
            output: info.direction() == LineDirection::Out,
            // Despite its name this flag means "in use", by the kernel or by a program.
            held: info.is_kernel(),
            consumer: info.consumer().map(str::to_owned),
        },
    )
}

/// The number of the chip that `/dev/gpiochip<number>` leads to, if it is a link to another.
pub(crate) fn number_behind(dev: &Path, number: u32) -> Option<u32> {
    let target = fs::read_link(node(dev, number)).ok()?;
    target.file_name()?.to_str()?.strip_prefix("gpiochip")?.parse().ok()
}

/// Whether calls to a chip may block, because its driver talks to it over a bus or asks a firmware. The subsystems of
/// the devices above the chip in `devices` show this. `devices` is `/sys/bus/gpio/devices`.
pub(crate) fn may_sleep(devices: &Path, chip: &str, label: &str) -> bool {
    if SLEEPING_LABELS.contains(&label) {
        return true;
    }
    let Ok(device) = devices.join(chip).canonicalize() else { return false };
    device.ancestors().skip(1).any(|parent| {
        let subsystem = fs::read_link(parent.join("subsystem")).ok();
        let subsystem = subsystem.as_deref().and_then(Path::file_name).and_then(|name| name.to_str());
        subsystem.is_some_and(|name| SLEEPING_BUSES.contains(&name))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    /// A made-up `/sys` with one GPIO chip below devices with these names and subsystems.
    fn sleeps(devices: &[(&str, &str)], label: &str) -> bool {
        let sys = tempfile::tempdir().unwrap();
        let mut device = sys.path().join("devices");
        let mut add = |name: &str, subsystem: &str| {
            device.push(name);
            fs::create_dir_all(&device).unwrap();
            if !subsystem.is_empty() {
                symlink(format!("/sys/bus/{subsystem}"), device.join("subsystem")).unwrap();
            }
        };
        for (name, subsystem) in devices {
            add(name, subsystem);
        }
        add("gpiochip3", "gpio");
        let chips = sys.path().join("bus/gpio/devices");
        fs::create_dir_all(&chips).unwrap();
        symlink(&device, chips.join("gpiochip3")).unwrap();
        assert!(!may_sleep(&chips, "gpiochip4", "another"), "a chip that is not there");
        may_sleep(&chips, "gpiochip3", label)
    }

    #[test]
    fn a_missing_chip_lists_those_that_are_there() {
        let chip = |number, label: &str| Chip { number, label: label.into(), sleeps: false, lines: vec![] };
        let path = Path::new("/dev/gpiochip5");
        assert_eq!(
            missing(path, &[chip(0, "pinctrl-rp1"), chip(10, "gpio-brcmstb@107d508500")]).to_string(),
            "there is no /dev/gpiochip5: this computer has gpiochip0 (pinctrl-rp1), gpiochip10 \
             (gpio-brcmstb@107d508500): write the pin with one of these (pinion pins lists them)"
        );
        assert!(missing(path, &[]).cause.contains("no GPIO chip"));
    }

    #[test]
    fn a_chip_behind_a_bus_may_sleep() {
        let platform = [("platform", ""), ("soc", "platform"), ("fe804000.i2c", "platform")];
        let i2c = [&platform[..], &[("i2c-1", "i2c"), ("1-0020", "i2c")]].concat();
        assert!(sleeps(&i2c, "1-0020"));
        // The GPIO part of a chip with several functions: a platform device below an I2C device.
        assert!(sleeps(&[&i2c[..], &[("da9063-gpio", "platform")]].concat(), "da9063-gpio"));
        let usb = [("pci0000:00", ""), ("0000:00:14.0", "pci"), ("usb1", "usb"), ("1-2", "usb"), ("1-2:1.0", "usb")];
        assert!(sleeps(&[&usb[..], &[("0003:10C4:EA90.0001", "hid")]].concat(), "CP2112 GPIO"));
        assert!(sleeps(
            &[("platform", ""), ("fe204000.spi", "platform"), ("spi0", "spi_master"), ("spi0.0", "spi")],
            ""
        ));
        assert!(sleeps(&[("virtual", ""), ("misc", ""), ("uhid", "misc"), ("0003:04D8:00DD.0001", "hid")], "mcp2221"));
    }

    #[test]
    fn a_chip_of_the_computer_s_own_does_not_sleep() {
        let soc = [("platform", ""), ("soc", "platform"), ("fe200000.gpio", "platform")];
        assert!(!sleeps(&soc, "pinctrl-bcm2711"));
        let rp1 = [
            ("platform", ""),
            ("axi", "platform"),
            ("1000120000.pcie", "platform"),
            ("pci0002:00", ""),
            ("0002:00:00.0", "pci"),
            ("0002:01:00.0", "pci"),
            ("1f000d0000.gpio", "platform"),
        ];
        assert!(!sleeps(&rp1, "pinctrl-rp1"));
    }

    #[test]
    fn a_chip_that_asks_the_firmware_is_known_by_its_label() {
        let device =
            [("platform", ""), ("soc", "platform"), ("soc:firmware", "platform"), ("soc:firmware:gpio", "platform")];
        assert!(sleeps(&device, "raspberrypi-exp-gpio"));
        assert!(!sleeps(&device, "another"));
    }
}
