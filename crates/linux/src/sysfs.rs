// SPDX-License-Identifier: GPL-3.0-or-later
//! Information from sysfs and debugfs about pins and buses, for people. The board itself needs none of it.
//!
//! Only root can read debugfs, so its information is missing for others.

#![forbid(unsafe_code)]

use std::collections::HashMap;
use std::path::Path;

use super::attributes::{names, target, text};

/// The result of a search.
#[derive(Debug, Default)]
pub struct Sysfs {
    /// PWM chips by number.
    pub pwm: Vec<PwmChip>,
    /// I2C buses that have a node in /dev, by number.
    pub i2c: Vec<I2cBus>,
    /// DS18B20 sensors on 1-Wire buses, with the kernel's names: `28-0316a4f1ff27`.
    pub thermometers: Vec<String>,
    /// The device that a line's pin is switched to, for example `fe804000.i2c (i2c1)`. The keys are the label of the
    /// line's chip and the line's offset. The GPIO subsystem sees the line as free, but it is in use.
    pub devices: HashMap<(String, u32), String>,
}

/// A PWM chip.
#[derive(Debug, PartialEq, Eq)]
pub struct PwmChip {
    /// The number of `pwmchip<n>`.
    pub number: u32,
    /// The device, such as `fe20c000.pwm`.
    pub device: Option<String>,
    /// By the channel's number.
    pub channels: Vec<PwmChannel>,
}

/// A channel of a PWM chip.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct PwmChannel {
    /// Whether programs can already use it. Pinion exports the others itself.
    pub exported: bool,
    /// The channel's user, if the kernel knows it: a driver's device, or `sysfs` for a program.
    pub consumer: Option<String>,
}

/// An I2C bus.
#[derive(Debug, PartialEq, Eq)]
pub struct I2cBus {
    /// The number of `/dev/i2c-<n>`.
    pub number: u32,
    /// The adapter's name, such as `bcm2835 (i2c@7e804000)`.
    pub adapter: Option<String>,
    /// Chips that the kernel knows of, by address.
    pub chips: Vec<I2cChip>,
}

/// A chip on an I2C bus, known to the kernel.
#[derive(Debug, PartialEq, Eq)]
pub struct I2cChip {
    /// Its address (7 bits).
    pub address: u16,
    /// Its type, such as `ads1115`.
    pub name: String,
    /// The chip's kernel driver. If there is one, no program can use the chip.
    pub driver: Option<String>,
}

impl Sysfs {
    /// Searches below `root`, which is `/`. Missing and unreadable files are left out.
    pub fn scan(root: &Path) -> Sysfs {
        Sysfs {
            pwm: pwm(&root.join("sys/class/pwm"), &root.join("sys/kernel/debug/pwm")),
            i2c: i2c(&root.join("dev"), &root.join("sys/bus/i2c/devices")),
            thermometers: super::w1::scan(&root.join("sys/bus/w1/devices")),
            devices: devices(&root.join("sys/kernel/debug/pinctrl")),
        }
    }
}

fn pwm(class: &Path, debug: &Path) -> Vec<PwmChip> {
    let users = text(debug).map_or_else(HashMap::new, |text| pwm_users(&text));
    let chip = |found: super::pwm::Chip| {
        let super::pwm::Chip { number, device, channels } = found;
        let folder = class.join(format!("pwmchip{number}"));
        let channel = |n: u32| PwmChannel {
            exported: folder.join(format!("pwm{n}")).exists() || class.join(format!("pwm-{number}:{n}")).exists(),
            consumer: device.as_ref().and_then(|device| users.get(&(device.clone(), n))).cloned(),
        };
        let channels = (0..channels).map(channel).collect();
        PwmChip { number, device, channels }
    };
    super::pwm::scan(class).into_iter().map(chip).collect()
}

/// The users of channels by device and number, from a text like this (drivers/pwm/core.c)
///
/// ```text
/// 0: platform/fe20c000.pwm, 2 PWM devices
///  pwm-0   (pwm-fan             ): requested enabled period: 40000 ns duty: 0 ns polarity: normal
///  pwm-1   ((null)              ): period: 0 ns duty: 0 ns polarity: normal
/// ```
fn pwm_users(text: &str) -> HashMap<(String, u32), String> {
    let mut users = HashMap::new();
    let mut device = "";
    for line in text.lines() {
        let channel = line.trim_start().strip_prefix("pwm-").and_then(|rest| rest.split_once('('));
        if let Some((number, rest)) = channel
            && let (Ok(number), Some((user, state))) = (number.trim().parse(), rest.rsplit_once("):"))
        {
            if state.trim_start().starts_with("requested") {
                users.insert((device.to_owned(), number), user.trim().to_owned());
            }
        } else if let Some((chip, _)) = line.split_once(',') {
            device = chip.rsplit('/').next().unwrap_or(chip);
        }
    }
    users
}

fn i2c(dev: &Path, devices: &Path) -> Vec<I2cBus> {
    let known = names(devices);
    let bus = |number: u32| {
        // For example 1-0048. Addresses of 10 bits have an `a` in front.
        let chip = |name: &String| {
            let address = name.strip_prefix(&format!("{number}-"))?;
            let folder = devices.join(name);
            Some(I2cChip {
                address: u16::from_str_radix(address, 16).ok()?,
                name: text(&folder.join("name")).unwrap_or_default(),
                driver: target(&folder.join("driver")),
            })
        };
        let adapter = text(&devices.join(format!("i2c-{number}/name")));
        I2cBus { number, adapter, chips: known.iter().filter_map(chip).collect() }
    };
    super::i2c::scan(dev).into_iter().map(bus).collect()
}

/// The devices that the pin controllers have switched lines to.
fn devices(pinctrl: &Path) -> HashMap<(String, u32), String> {
    let mut devices = HashMap::new();
    for controller in names(pinctrl) {
        let folder = pinctrl.join(controller);
        let (Some(ranges), Some(pins)) = (text(&folder.join("gpio-ranges")), text(&folder.join("pinmux-pins"))) else {
            continue;
        };
        let ranges = gpio_ranges(&ranges);
        for (pin, device) in pins.lines().filter_map(muxed_pin) {
            let range = ranges.iter().find(|range| (range.first_pin..=range.last_pin).contains(&pin));
            if let Some(range) = range {
                let line = range.first_line + pin - range.first_pin;
                devices.insert((range.label.clone(), line), device);
            }
        }
    }
    devices
}

/// Lines of a chip that are pins of a controller.
#[derive(Debug, PartialEq, Eq)]
struct GpioRange {
    label: String,
    first_line: u32,
    first_pin: u32,
    last_pin: u32,
}

/// Reads lines like `0: pinctrl-bcm2711 GPIOS [512 - 569] PINS [0 - 57]` (drivers/pinctrl/core.c). The numbers of a
/// chip's lines begin anywhere. So the lowest number is taken for the first line.
fn gpio_ranges(text: &str) -> Vec<GpioRange> {
    let pair = |text: &str| {
        let (first, last) = text.split_once('[')?.1.split_once(']')?.0.split_once(" - ")?;
        Some((first.parse::<u32>().ok()?, last.parse::<u32>().ok()?))
    };
    let range = |line: &str| {
        let (label, rest) = line.split_once(": ")?.1.split_once(" GPIOS ")?;
        let (lines, pins) = rest.split_once(" PINS ")?;
        let ((first_line, _), (first_pin, last_pin)) = (pair(lines)?, pair(pins)?);
        Some(GpioRange { label: label.to_owned(), first_line, first_pin, last_pin })
    };
    let mut ranges: Vec<GpioRange> = text.lines().filter_map(range).collect();
    let mut lowest: HashMap<String, u32> = HashMap::new();
    for range in &ranges {
        let first = lowest.entry(range.label.clone()).or_insert(range.first_line);
        *first = range.first_line.min(*first);
    }
    for range in &mut ranges {
        range.first_line -= lowest[&range.label];
    }
    ranges
}

/// The number of a pin that a device has, and the device with its function, from a line like these
/// (drivers/pinctrl/pinmux.c)
///
/// ```text
/// pin 2 (gpio2): fe804000.i2c (GPIO UNCLAIMED) function i2c1 group gpio2
/// pin 3 (gpio3): device fe804000.i2c function i2c1 group gpio3
/// pin 4 (gpio4): (MUX UNCLAIMED) pinctrl-bcm2711:516
/// ```
fn muxed_pin(line: &str) -> Option<(u32, String)> {
    let (number, rest) = line.strip_prefix("pin ")?.split_once(" (")?;
    let rest = rest.split_once("): ")?.1;
    let rest = rest.strip_prefix("device ").unwrap_or(rest);
    let owner = rest.split_whitespace().next()?;
    // A hog is a setup by the controller itself, without a device that asked for it.
    if owner.starts_with('(') || ["GPIO", "UNCLAIMED"].contains(&owner) || rest.contains("(HOG)") {
        return None;
    }
    let function = rest.split_once(" function ").and_then(|(_, rest)| rest.split_whitespace().next());
    let device = function.map_or_else(|| owner.to_owned(), |function| format!("{owner} ({function})"));
    Some((number.parse().ok()?, device))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;
    use tempfile::TempDir;

    fn root() -> TempDir {
        tempfile::tempdir().unwrap()
    }

    fn put(root: &TempDir, path: &str, text: &str) {
        let path = root.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn nothing_is_there() {
        let found = Sysfs::scan(root().path());
        assert!(
            found.pwm.is_empty() && found.i2c.is_empty() && found.thermometers.is_empty() && found.devices.is_empty()
        );
    }

    #[test]
    fn pwm_chips_with_their_channels_and_who_has_them() {
        let root = root();
        put(&root, "sys/class/pwm/pwmchip0/npwm", "2\n");
        put(&root, "sys/class/pwm/pwmchip0/pwm1/period", "0\n");
        put(&root, "sys/class/pwm/pwmchip10/npwm", "no number");
        put(&root, "sys/class/pwm/pwmchip2/npwm", "1\n");
        symlink("../../../fe20c000.pwm", root.path().join("sys/class/pwm/pwmchip0/device")).unwrap();
        put(
            &root,
            "sys/kernel/debug/pwm",
            "0: platform/fe20c800.pwm, 1 PWM device\n pwm-0   (other               ): requested\n\n\
             1: platform/fe20c000.pwm, 2 PWM devices\n\
             \x20pwm-0   ((null)              ): period: 0 ns duty: 0 ns polarity: normal\n\
             \x20pwm-1   (sysfs               ): requested enabled period: 40000 ns\n",
        );
        let chips = Sysfs::scan(root.path()).pwm;
        let channel = |exported, consumer: Option<&str>| PwmChannel { exported, consumer: consumer.map(str::to_owned) };
        assert_eq!(
            chips,
            [
                PwmChip {
                    number: 0,
                    device: Some("fe20c000.pwm".into()),
                    channels: vec![channel(false, None), channel(true, Some("sysfs"))]
                },
                PwmChip { number: 2, device: None, channels: vec![channel(false, None)] },
                PwmChip { number: 10, device: None, channels: vec![] },
            ]
        );
    }

    #[test]
    fn i2c_buses_with_the_chips_that_the_kernel_has() {
        let root = root();
        put(&root, "dev/i2c-1", "");
        put(&root, "sys/bus/i2c/devices/i2c-1/name", "bcm2835 (i2c@7e804000)\n");
        put(&root, "sys/bus/i2c/devices/1-0048/name", "ads1115\n");
        put(&root, "sys/bus/i2c/devices/1-0068/name", "ds3231\n");
        put(&root, "sys/bus/i2c/devices/11-0068/name", "of another bus\n");
        symlink("../../../../bus/i2c/drivers/ads1015", root.path().join("sys/bus/i2c/devices/1-0048/driver")).unwrap();
        let chip = |address, name: &str, driver: Option<&str>| I2cChip {
            address,
            name: name.into(),
            driver: driver.map(str::to_owned),
        };
        assert_eq!(
            Sysfs::scan(root.path()).i2c,
            [I2cBus {
                number: 1,
                adapter: Some("bcm2835 (i2c@7e804000)".into()),
                chips: vec![chip(0x48, "ads1115", Some("ads1015")), chip(0x68, "ds3231", None)],
            }]
        );
    }

    #[test]
    fn thermometers_of_the_family_alone() {
        let root = root();
        for name in ["28-0316a4f1ff27", "w1_bus_master1", "28-0000", "05-1"] {
            put(&root, &format!("sys/bus/w1/devices/{name}/name"), "");
        }
        assert_eq!(Sysfs::scan(root.path()).thermometers, ["28-0000", "28-0316a4f1ff27"]);
    }

    #[test]
    fn lines_that_a_device_has_though_the_gpio_subsystem_calls_them_free() {
        let root = root();
        let folder = "sys/kernel/debug/pinctrl/fe200000.gpio-pinctrl-bcm2711";
        put(
            &root,
            &format!("{folder}/gpio-ranges"),
            "GPIO ranges handled:\n0: pinctrl-bcm2711 GPIOS [532 - 569] PINS [20 - 57]\n\
             1: pinctrl-bcm2711 GPIOS [512 - 531] PINS [0 - 19]\n",
        );
        put(
            &root,
            &format!("{folder}/pinmux-pins"),
            "Pinmux settings per pin\nFormat: pin (name): mux_owner gpio_owner hog?\n\
             pin 0 (gpio0): (MUX UNCLAIMED) (GPIO UNCLAIMED)\n\
             pin 2 (gpio2): fe804000.i2c (GPIO UNCLAIMED) function i2c1 group gpio2\n\
             pin 4 (gpio4): (MUX UNCLAIMED) pinctrl-bcm2711:516\n\
             pin 5 (gpio5): fe200000.gpio (GPIO UNCLAIMED) (HOG) function gpio_in group gpio5\n\
             pin 22 (gpio22): device fe204000.spi function spi0 group gpio22\n\
             pin 23 (gpio23): GPIO pinctrl-bcm2711:535\npin 24 (gpio24): UNCLAIMED\n",
        );
        let expected = [(2, "fe804000.i2c (i2c1)"), (22, "fe204000.spi (spi0)")];
        let expected = expected.map(|(line, device)| (("pinctrl-bcm2711".to_owned(), line), device.to_owned()));
        assert_eq!(Sysfs::scan(root.path()).devices, HashMap::from(expected));
    }
}
