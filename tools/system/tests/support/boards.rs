// SPDX-License-Identifier: GPL-3.0-or-later
//! For tests: boards that people own, as folders of a computer and as what Pinion finds there.
//!
//! Models and names of lines are those of the device trees in Debian 13 (Linux 6.12), in its backports (7.3.4), and in
//! Raspberry Pi OS. The drivers choose labels, numbers of lines, and the order of the chips.
//!
//! With the device trees of Debian 13's kernel in the folder `PINION_DEVICE_TREES`, the tests use these files, and compare
//! the boards here with them. `make test-raspberry-pi` does so.

use std::collections::BTreeMap;
use std::env;
use std::fs;
use std::path::PathBuf;

use pinion_linux::Inventory;
use pinion_linux::gpio::{Chip, LineInfo};

use super::tree::Tree;

/// A GPIO chip of a board.
struct BoardChip {
    number: u32,
    label: &'static str,
    /// Its device below /sys/devices/platform.
    device: &'static str,
    /// Its node in Debian 13's device tree.
    node: &'static str,
    line_count: usize,
    /// The names of its first lines.
    names: Vec<&'static str>,
}

/// A board.
pub struct TestBoard {
    model: &'static str,
    /// Its file in Debian 13's kernel. `None` if the board has another device tree.
    device_tree: Option<&'static str>,
    chips: Vec<BoardChip>,
    /// Links and nodes in /dev besides its chips. A link has its target behind an arrow.
    dev: &'static [&'static str],
    /// Its PWM chips, with their devices and numbers of channels.
    pwm: &'static [(u32, &'static str, u32)],
}

impl TestBoard {
    /// The files by which Linux describes the board.
    pub fn tree(&self) -> Tree {
        let tree = Tree::empty();
        let debian = self.device_tree.and_then(debian_s);
        for (node, properties) in debian.iter().flatten() {
            for (name, value) in properties {
                tree.put(&format!("proc/device-tree{node}/{name}"), value);
            }
        }
        // The firmware of a Raspberry Pi completes its model.
        tree.put("proc/device-tree/model", format!("{}\0", self.model));
        for chip in &self.chips {
            let (number, device) = (chip.number, format!("sys/devices/platform/{}", chip.device));
            tree.put(&format!("dev/gpiochip{number}"), "");
            let names = chip.names.join("\0");
            match &debian {
                Some(nodes) => {
                    let theirs = nodes[chip.node].get("gpio-line-names");
                    let theirs = theirs.map_or_else(String::new, |names| String::from_utf8_lossy(names).into_owned());
                    let [theirs, ours] = [&theirs, &names].map(|names| names.trim_end_matches('\0'));
                    assert_eq!(theirs, ours, "{} of a {}", chip.node, self.model);
                    let node = tree.computer().path(format!("/proc/device-tree{}", chip.node));
                    // Two chips may be banks of one device.
                    if !tree.computer().path(format!("/{device}/of_node")).exists() {
                        tree.link(&format!("{device}/of_node"), node.to_str().unwrap());
                    }
                }
                None if names.is_empty() => {}
                None => tree.put(&format!("{device}/of_node/gpio-line-names"), names + "\0"),
            }
            tree.put(&format!("{device}/gpiochip{number}/dev"), format!("254:{number}\n"));
            let link = format!("sys/bus/gpio/devices/gpiochip{number}");
            tree.link(&link, &format!("../../../devices/platform/{}/gpiochip{number}", chip.device));
        }
        for node in self.dev {
            match node.split_once(" -> ") {
                Some((link, target)) => tree.link(&format!("dev/{link}"), target),
                None => tree.put(&format!("dev/{node}"), ""),
            }
        }
        for (number, device, channels) in self.pwm {
            let chip = format!("sys/class/pwm/pwmchip{number}");
            tree.put(&format!("{chip}/npwm"), format!("{channels}\n"));
            tree.put(&format!("{chip}/export"), "");
            tree.link(&format!("{chip}/device"), &format!("../../../{device}"));
        }
        tree
    }

    /// The chips that Pinion finds there. Only the kernel knows a chip's label and number of lines, so they are not
    /// read.
    pub fn inventory(&self, tree: &Tree) -> Inventory {
        let computer = tree.computer();
        let chip = |chip: &BoardChip| {
            let property =
                computer.path(format!("/sys/bus/gpio/devices/gpiochip{}/../of_node/gpio-line-names", chip.number));
            let names = fs::read_to_string(property).unwrap_or_default();
            let names = names.split('\0').map(|name| (!name.is_empty()).then(|| name.to_owned()));
            let lines = names.chain(std::iter::repeat(None)).take(chip.line_count);
            let lines = lines.map(|name| LineInfo { name, ..LineInfo::default() }).collect();
            Chip { number: chip.number, label: chip.label.into(), sleeps: chip.label == EXPANDER, lines }
        };
        Inventory::around(&computer.path("/"), self.chips.iter().map(chip).collect())
    }
}

/// The chip that the firmware of a Raspberry Pi drives.
const EXPANDER: &str = "raspberrypi-exp-gpio";

fn named(names: &'static str) -> Vec<&'static str> {
    names.split(' ').collect()
}

/// A Raspberry Pi 4 with Debian.
pub fn pi4() -> TestBoard {
    let names = "ID_SDA ID_SCL SDA1 SCL1 GPIO_GCLK GPIO5 GPIO6 SPI_CE1_N SPI_CE0_N SPI_MISO SPI_MOSI SPI_SCLK GPIO12 \
                 GPIO13 TXD1 RXD1 GPIO16 GPIO17 GPIO18 GPIO19 GPIO20 GPIO21 GPIO22 GPIO23 GPIO24 GPIO25 GPIO26 GPIO27 \
                 RGMII_MDIO RGMIO_MDC CTS0 RTS0 TXD0 RXD0 SD1_CLK SD1_CMD SD1_DATA0 SD1_DATA1 SD1_DATA2 SD1_DATA3 \
                 PWM0_MISO PWM1_MOSI STATUS_LED_G_CLK SPIFLASH_CE_N SDA0 SCL0 RGMII_RXCLK RGMII_RXCTL RGMII_RXD0 \
                 RGMII_RXD1 RGMII_RXD2 RGMII_RXD3 RGMII_TXCLK RGMII_TXCTL RGMII_TXD0 RGMII_TXD1 RGMII_TXD2 RGMII_TXD3";
    TestBoard {
        model: "Raspberry Pi 4 Model B",
        device_tree: Some("broadcom/bcm2711-rpi-4-b.dtb"),
        chips: vec![
            BoardChip {
                number: 0,
                label: "pinctrl-bcm2711",
                device: "soc/fe200000.gpio",
                node: "/soc/gpio@7e200000",
                line_count: 58,
                names: named(names),
            },
            BoardChip {
                number: 1,
                label: EXPANDER,
                device: "soc/soc:firmware/soc:firmware:gpio",
                node: "/soc/firmware/gpio",
                line_count: 8,
                names: named("BT_ON WL_ON PWR_LED_OFF GLOBAL_RESET VDD_SD_IO_SEL CAM_GPIO SD_PWR_ON"),
            },
        ],
        dev: &["i2c-1", "spidev0.0", "spidev0.1"],
        pwm: &[(0, "fe20c000.pwm", 2)],
    }
}

/// A Raspberry Pi Zero 2 with Debian.
pub fn zero2() -> TestBoard {
    let names = "ID_SDA ID_SCL SDA1 SCL1 GPIO_GCLK GPIO5 GPIO6 SPI_CE1_N SPI_CE0_N SPI_MISO SPI_MOSI SPI_SCLK GPIO12 \
                 GPIO13 TXD0 RXD0 GPIO16 GPIO17 GPIO18 GPIO19 GPIO20 GPIO21 GPIO22 GPIO23 GPIO24 GPIO25 GPIO26 GPIO27 \
                 HDMI_HPD_N STATUS_LED_N NC NC NC NC NC NC NC NC NC NC CAM_GPIO0 WL_ON BT_ON WIFI_CLK SDA0 SCL0 \
                 SMPS_SCL SMPS_SDA SD_CLK_R SD_CMD_R SD_DATA0_R SD_DATA1_R SD_DATA2_R SD_DATA3_R";
    TestBoard {
        model: "Raspberry Pi Zero 2 W",
        device_tree: Some("broadcom/bcm2837-rpi-zero-2-w.dtb"),
        chips: vec![BoardChip {
            number: 0,
            label: "pinctrl-bcm2835",
            device: "soc/3f200000.gpio",
            node: "/soc/gpio@7e200000",
            line_count: 54,
            names: named(names),
        }],
        dev: &["i2c-1"],
        pwm: &[(0, "3f20c000.pwm", 2)],
    }
}

/// The chips of a Raspberry Pi 5's processor, in the kernel's order, with these numbers and line counts.
fn brcmstb(chips: &[(u32, &'static str, &'static str, usize)]) -> Vec<BoardChip> {
    let chip = |(number, label, device, line_count): &(u32, &'static str, &'static str, usize)| BoardChip {
        number: *number,
        label,
        device,
        // Only the chip of Debian 13's own kernel is compared. It has two banks of lines.
        node: "/soc@107c000000/gpio@7d517c00",
        line_count: *line_count,
        names: vec![],
    };
    chips.iter().map(chip).collect()
}

fn rp1(number: u32, names: Vec<&'static str>) -> BoardChip {
    BoardChip {
        number,
        label: "pinctrl-rp1",
        device: "axi/1000120000.pcie/pci0002:00/0002:00:00.0/0002:01:00.0/1f000d0000.gpio",
        node: "",
        line_count: 54,
        names,
    }
}

/// A Raspberry Pi 5 with Raspberry Pi OS since July 2026.
pub fn pi5() -> TestBoard {
    let names = "ID_SDA ID_SCL GPIO2 GPIO3 GPIO4 GPIO5 GPIO6 GPIO7 GPIO8 GPIO9 GPIO10 GPIO11 GPIO12 GPIO13 GPIO14 \
                 GPIO15 GPIO16 GPIO17 GPIO18 GPIO19 GPIO20 GPIO21 GPIO22 GPIO23 GPIO24 GPIO25 GPIO26 GPIO27 \
                 PCIE_RP1_WAKE FAN_TACH HOST_SDA HOST_SCL ETH_RST_N - CD0_IO0_MICCLK CD0_IO0_MICDAT0 \
                 RP1_PCIE_CLKREQ_N - CD0_SDA CD0_SCL CD1_SDA CD1_SCL USB_VBUS_EN USB_OC_N RP1_STAT_LED FAN_PWM \
                 CD1_IO0_MICCLK 2712_WAKE CD1_IO1_MICDAT1 EN_MAX_USB_CUR - - - -";
    let mut chips = brcmstb(&[
        (11, "gpio-brcmstb@107d508500", "soc/107d508500.gpio", 32),
        (12, "gpio-brcmstb@107d508520", "soc/107d508500.gpio", 4),
        (13, "gpio-brcmstb@107d517c00", "soc/107d517c00.gpio", 17),
        (14, "gpio-brcmstb@107d517c20", "soc/107d517c00.gpio", 6),
    ]);
    chips.push(rp1(15, named(names)));
    TestBoard {
        model: "Raspberry Pi 5 Model B Rev 1.0",
        device_tree: None,
        chips,
        dev: &["i2c-1", "gpiomem0"],
        pwm: &[(0, "1f00098000.pwm", 4), (1, "107d517a80.pwm", 2)],
    }
}

/// A Raspberry Pi 5 with Debian's backports. Its kernel gives the header's lines no names.
pub fn pi5_debian() -> TestBoard {
    let mut chips = brcmstb(&[
        (0, "gpio-brcmstb@107d508500", "soc@107c000000/107d508500.gpio", 32),
        (1, "gpio-brcmstb@107d508520", "soc@107c000000/107d508500.gpio", 22),
        (2, "gpio-brcmstb@107d517c00", "soc@107c000000/107d517c00.gpio", 17),
        (3, "gpio-brcmstb@107d517c20", "soc@107c000000/107d517c00.gpio", 6),
    ]);
    chips.push(rp1(4, vec![]));
    TestBoard { model: "Raspberry Pi 5 Model B Rev 1.0", device_tree: None, chips, dev: &[], pwm: &[] }
}

/// A Raspberry Pi 5 with Debian 13. Its kernel has no driver for the header.
pub fn pi5_without_header() -> TestBoard {
    let chips = brcmstb(&[
        (0, "gpio-brcmstb@107d517c00", "soc@107c000000/107d517c00.gpio", 17),
        (1, "gpio-brcmstb@107d517c20", "soc@107c000000/107d517c00.gpio", 6),
    ]);
    TestBoard {
        model: "Raspberry Pi 5 Model B Rev 1.0",
        device_tree: Some("broadcom/bcm2712-rpi-5-b.dtb"),
        chips,
        dev: &[],
        pwm: &[],
    }
}

/// A BigTreeTech CB1 (Allwinner H616) with Debian. No line has a name.
pub fn cb1() -> TestBoard {
    let chip =
        |number, label, device, node, line_count| BoardChip { number, label, device, node, line_count, names: vec![] };
    TestBoard {
        model: "BigTreeTech CB1",
        device_tree: Some("allwinner/sun50i-h616-bigtreetech-cb1-manta.dtb"),
        chips: vec![
            chip(0, "300b000.pinctrl", "soc/300b000.pinctrl", "/soc/pinctrl@300b000", 288),
            chip(1, "7022000.pinctrl", "soc/7022000.pinctrl", "/soc/pinctrl@7022000", 32),
        ],
        dev: &["i2c-0", "spidev1.0"],
        pwm: &[],
    }
}

/// A Radxa ZERO 3W (Rockchip RK3566) with Debian. The names of its lines are not for klippy: they have a space.
pub fn rk3566() -> TestBoard {
    let chip = |number, label, device, node, names: &[(usize, &'static str)]| {
        let mut all = vec![""; 32];
        names.iter().for_each(|(line, name)| all[*line] = name);
        BoardChip { number, label, device, node, line_count: 32, names: all }
    };
    let bank_1 = [(0, "pin-03 [GPIO1_A0]"), (1, "pin-05 [GPIO1_A1]"), (4, "pin-37 [GPIO1_A4]")];
    let bank_3 = [
        (1, "pin-11 [GPIO3_A1]"),
        (2, "pin-13 [GPIO3_A2]"),
        (3, "pin-12 [GPIO3_A3]"),
        (4, "pin-35 [GPIO3_A4]"),
        (5, "pin-40 [GPIO3_A5]"),
        (6, "pin-38 [GPIO3_A6]"),
        (7, "pin-36 [GPIO3_A7]"),
        (8, "pin-15 [GPIO3_B0]"),
        (9, "pin-16 [GPIO3_B1]"),
        (10, "pin-18 [GPIO3_B2]"),
        (11, "pin-29 [GPIO3_B3]"),
        (12, "pin-31 [GPIO3_B4]"),
        (17, "pin-22 [GPIO3_C1]"),
        (18, "pin-32 [GPIO3_C2]"),
        (19, "pin-33 [GPIO3_C3]"),
        (20, "pin-07 [GPIO3_C4]"),
    ];
    let bank_4 = [
        (10, "pin-27 [GPIO4_B2]"),
        (11, "pin-28 [GPIO4_B3]"),
        (18, "pin-23 [GPIO4_C2]"),
        (19, "pin-19 [GPIO4_C3]"),
        (21, "pin-21 [GPIO4_C5]"),
        (22, "pin-24 [GPIO4_C6]"),
    ];
    TestBoard {
        model: "Radxa ZERO 3W",
        device_tree: Some("rockchip/rk3566-radxa-zero-3w.dtb"),
        chips: vec![
            chip(
                0,
                "gpio0",
                "pinctrl/fdd60000.gpio",
                "/pinctrl/gpio@fdd60000",
                &[(24, "pin-10 [GPIO0_D0]"), (25, "pin-08 [GPIO0_D1]")],
            ),
            chip(1, "gpio1", "pinctrl/fe740000.gpio", "/pinctrl/gpio@fe740000", &bank_1),
            chip(2, "gpio2", "pinctrl/fe750000.gpio", "/pinctrl/gpio@fe750000", &[]),
            chip(3, "gpio3", "pinctrl/fe760000.gpio", "/pinctrl/gpio@fe760000", &bank_3),
            chip(4, "gpio4", "pinctrl/fe770000.gpio", "/pinctrl/gpio@fe770000", &bank_4),
        ],
        dev: &["i2c-3"],
        pwm: &[(0, "fe700000.pwm", 1)],
    }
}

/// The nodes of a device tree by their paths, with their properties.
type Nodes = BTreeMap<String, BTreeMap<String, Vec<u8>>>;

/// A device tree of Debian's kernel, if the folder with these files is known.
fn debian_s(file: &str) -> Option<Nodes> {
    let file = PathBuf::from(env::var_os("PINION_DEVICE_TREES")?).join(file);
    Some(nodes(&fs::read(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()))))
}

/// Reads a device tree ("Devicetree Specification", chapter 5).
fn nodes(blob: &[u8]) -> Nodes {
    const BEGIN_NODE: usize = 1;
    const END_NODE: usize = 2;
    const PROPERTY: usize = 3;
    const END: usize = 9;
    let number = |at: usize| u32::from_be_bytes(blob[at..at + 4].try_into().unwrap()) as usize;
    let text = |at: usize| {
        let bytes = blob[at..].iter().take_while(|byte| **byte != 0);
        bytes.map(|byte| char::from(*byte)).collect::<String>()
    };
    let (mut at, strings) = (number(8), number(12));
    let (mut path, mut nodes) = (Vec::new(), Nodes::new());
    loop {
        let (token, next) = (number(at), at + 4);
        at = match token {
            BEGIN_NODE => {
                let name = text(next);
                let end = next + name.len() + 1;
                path.push(name);
                nodes.insert(path.join("/"), BTreeMap::new());
                end
            }
            END_NODE => {
                path.pop();
                next
            }
            PROPERTY => {
                let (length, value) = (number(next), next + 8);
                let properties = nodes.get_mut(&path.join("/")).unwrap();
                properties.insert(text(strings + number(next + 4)), blob[value..value + length].to_vec());
                value + length
            }
            END => return nodes,
            _ => next,
        }
        .next_multiple_of(4);
    }
}

/// All of them.
pub fn all() -> Vec<TestBoard> {
    vec![pi4(), zero2(), pi5(), pi5_debian(), pi5_without_header(), cb1(), rk3566()]
}
