// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices that can be added, and boards: the files in `devices` and `boards`, one for each.
//!
//! To add one, write its file and name it in [`DEVICES`] or [`BOARDS`]. The tests check it.

use serde::Deserialize;

use super::board::KnownBoard;
use crate::cli::computer::Computer;

macro_rules! files {
    ($folder:literal: $($name:literal)*) => {
        [$(($name, include_str!(concat!($folder, "/", $name, ".toml")))),*]
    };
}

/// Each device by its name on the command line, in the order of the list.
const DEVICES: [(&str, &str); 28] = files!("devices":
    "adxl345" "lis2dw" "lis3dh" "mpu9250" "icm20948" "bmi160"
    "bme280" "aht" "sht" "htu21d" "lm75" "ds18b20"
    "max6675" "max31855" "max31856" "max31865" "ads1115" "mcp3208"
    "ws2812" "fan" "relay" "light" "button" "filament" "endstop" "hx711" "tmc2209" "ssd1306");

/// Each board. The first one that fits counts.
const BOARDS: [(&str, &str); 9] = files!("boards":
    "raspberry-pi-3" "raspberry-pi-4" "raspberry-pi-5" "btt-pad7" "btt-cb1" "btt-cb2"
    "orange-pi-3-lts" "orange-pi-zero-2" "radxa-zero-3");

/// A kind of connection.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq, PartialOrd, Ord)]
#[serde(rename_all = "lowercase")]
pub(super) enum Kind {
    /// SPI, with the controller's own chip select.
    Spi,
    /// I2C.
    I2c,
    /// 1-Wire.
    W1,
    /// The data output of an SPI controller, for LEDs.
    Leds,
    /// A hardware PWM channel.
    Pwm,
    /// A serial port.
    Uart,
    /// GPIO lines only.
    Line,
}

impl Kind {
    pub(super) fn name(self) -> &'static str {
        match self {
            Kind::Spi => "SPI",
            Kind::I2c => "I2C",
            Kind::W1 => "1-Wire",
            Kind::Leds => "SPI for LEDs",
            Kind::Pwm => "hardware PWM",
            Kind::Uart => "a serial port",
            Kind::Line => "GPIO lines",
        }
    }
}

/// A device that can be added.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Device {
    /// Its name on the command line, and of its file in `pinion/`.
    #[serde(skip)]
    pub(super) name: &'static str,
    pub(super) title: String,
    /// The most frequent fault.
    pub(super) trap: String,
    /// Its section of printer.cfg.
    pub(super) section: String,
    /// Whether it measures resonances, and so wants a `[resonance_tester]`.
    #[serde(default)]
    pub(super) resonance: bool,
    /// A command that measures something, once the host has restarted.
    pub(super) measure: Option<String>,
    /// The command to type when it works.
    pub(super) next: Vec<String>,
    /// The ways to connect it, the best one first.
    pub(super) way: Vec<Way>,
}

/// A way to connect a device.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Way {
    pub(super) bus: Kind,
    /// SPI mode.
    #[serde(default)]
    pub(super) mode: u8,
    #[serde(default)]
    pub(super) rate_hz: u32,
    /// The I2C addresses that the device can have, the usual one first.
    #[serde(default)]
    pub(super) addresses: Vec<u8>,
    /// The name of the kernel's IIO device, if a driver of the kernel takes the chip.
    pub(super) driver: Option<String>,
    /// Further lines of a Raspberry Pi's config.txt. With a `driver`, all of them.
    #[serde(default)]
    pub(super) config_txt: Vec<String>,
    /// The device's pins, and what each of them is connected to: `3v3`, `5v`, `gnd`, a pin of the bus, or `line`.
    pub(super) wires: Vec<(String, String)>,
    /// The sections of printer.cfg, with `{mcu}`, `{spi_bus}` and so on.
    pub(super) config: String,
    pub(super) check: Option<Check>,
}

/// How the device is asked whether it is there.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub(super) enum Check {
    /// A register holds one of these numbers.
    Id { register: u8, ids: Vec<u8> },
    /// These bits of an SPI chip's answer never change.
    Fixed {
        register: Option<u8>,
        mask: Vec<u8>,
        bits: Vec<u8>,
        #[serde(default)]
        faults: Vec<Fault>,
        detect: Option<Detect>,
    },
    /// An I2C chip without an id answers each of these reads.
    Reads { reads: Vec<Read> },
    /// An I2C chip answers a temperature in 1/256 degrees.
    Temperature { write: Vec<u8>, bytes: usize },
    /// The kernel has found a thermometer.
    W1,
    /// The kernel's driver reads a value in this file that is neither 0 nor the highest one.
    Iio { file: String, highest: u32 },
}

/// A read of an I2C chip.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Read {
    /// A register, or a command.
    pub(super) write: Vec<u8>,
    /// How long the command takes. Without it, the answer follows a repeated start.
    #[serde(default)]
    pub(super) wait_ms: u64,
    /// The bits of the answer that are known.
    pub(super) mask: Vec<u8>,
    pub(super) bits: Vec<u8>,
    /// The last byte is a CRC, which begins with this value.
    pub(super) crc: Option<u8>,
}

/// A bit by which a chip reports a fault.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Fault {
    /// The byte of the answer.
    #[serde(default)]
    pub(super) byte: usize,
    pub(super) bit: u8,
    pub(super) meaning: String,
}

/// The detection of faults by an SPI chip that has it off by default.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Detect {
    /// The register that switches it on, and gets its old value back.
    pub(super) register: u8,
    /// The bits that switch it on.
    pub(super) set: u8,
    /// How long it takes.
    pub(super) wait_ms: u64,
    /// The register with the faults.
    pub(super) status: u8,
    pub(super) faults: Vec<Fault>,
}

/// All devices and boards.
pub(super) struct Catalog {
    pub(super) devices: Vec<Device>,
    boards: Vec<KnownBoard>,
}

impl Catalog {
    /// Reads the files.
    ///
    /// # Errors
    ///
    /// The first file with a mistake. The tests find it before a user does.
    pub(super) fn read() -> Result<Catalog, String> {
        fn parsed<T: for<'a> Deserialize<'a>>(name: &str, text: &str) -> Result<T, String> {
            toml::from_str(text).map_err(|error| format!("this is a bug in Pinion: {name}.toml: {error}"))
        }
        let device = |(name, text): (&'static str, &str)| -> Result<Device, String> {
            Ok(Device { name, ..parsed(name, text)? })
        };
        Ok(Catalog {
            devices: DEVICES.into_iter().map(device).collect::<Result<_, _>>()?,
            boards: BOARDS.into_iter().map(|(name, text)| parsed(name, text)).collect::<Result<_, _>>()?,
        })
    }

    /// The device of this name.
    pub(super) fn device(&self, name: &str) -> Option<&Device> {
        self.devices.iter().find(|device| device.name == name)
    }

    /// The board that this computer is.
    pub(super) fn board(&self, computer: &Computer) -> Option<&KnownBoard> {
        let model = model(computer);
        self.boards.iter().find(|board| board.is_here(&model, computer))
    }

    /// The device that has this id in this register.
    pub(super) fn with_id(&self, register: u8, id: u8) -> Option<&Device> {
        let has = |way: &Way| matches!(&way.check, Some(Check::Id { register: own, ids }) if *own == register && ids.contains(&id));
        self.devices.iter().find(|device| device.way.iter().any(has))
    }
}

/// The device tree's model.
pub(super) fn model(computer: &Computer) -> String {
    computer.text("/proc/device-tree/model").unwrap_or_default().trim_end_matches('\0').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::add::board::{Boot, Spot};
    use crate::cli::boards;
    use crate::cli::computer::tests::Tree;
    use pinion_linux::gpio::Chip;
    use std::collections::BTreeSet;
    use std::fs;
    use std::path::Path;

    #[test]
    fn each_file_is_in_the_catalog_and_the_catalog_can_be_read() {
        let names = |folder: &str| -> BTreeSet<String> {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/cli/add").join(folder);
            let files = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path());
            files.map(|file| file.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
        };
        assert_eq!(names("devices"), DEVICES.iter().map(|(name, _)| (*name).to_owned()).collect());
        assert_eq!(names("boards"), BOARDS.iter().map(|(name, _)| (*name).to_owned()).collect());
        Catalog::read().unwrap();
    }

    /// Mistakes in a file.
    #[test]
    fn the_data_fit_together() {
        let catalog = Catalog::read().unwrap();
        for board in &catalog.boards {
            for (kind, bus) in &board.bus {
                assert_ne!(bus.enable.is_empty(), bus.overlays.is_empty(), "{} {kind:?}", board.name);
                assert_eq!(board.boot == Boot::ConfigTxt, bus.overlays.is_empty(), "{} {kind:?}", board.name);
                for pin in bus.pins.values() {
                    assert!((1..=board.pins.len()).contains(pin), "{} {kind:?} {pin}", board.name);
                    assert!(!["GND", "5 V", "3.3 V", "-"].contains(&board.pins[pin - 1].as_str()), "{}", board.name);
                }
            }
            for pin in &board.free {
                assert!(board.line(*pin).is_some(), "{}: pin {pin}", board.name);
            }
            for pin in board.lines.keys() {
                let label = &board.pins[pin.parse::<usize>().unwrap() - 1];
                assert!(label.starts_with("GPIO") || label.starts_with('P'), "{}: {label}", board.name);
            }
        }
        for device in &catalog.devices {
            let first = device.way[0].config.trim_start().lines().next().unwrap();
            assert!(first.starts_with('['), "{}", device.name);
            for way in &device.way {
                let section = format!("[{}]", device.section);
                assert!(way.config.lines().any(|line| line == section), "{}: no {section}", device.name);
                assert!(device.trap.len() < 140 && !device.next.is_empty(), "{}", device.name);
                assert_eq!(way.bus == Kind::I2c, !way.addresses.is_empty(), "{}", device.name);
                let is_asked = way.bus == Kind::Spi && way.check.is_some() && way.driver.is_none();
                assert!(!is_asked || way.rate_hz >= 100_000, "{}", device.name);
                let fits = |mask: &[u8], bits: &[u8]| {
                    mask.len() == bits.len() && mask.iter().zip(bits).all(|(mask, bits)| bits & !mask == 0)
                };
                match &way.check {
                    Some(Check::Fixed { mask, bits, faults, .. }) => {
                        let has_byte = faults.iter().all(|fault| fault.byte < mask.len());
                        assert!(fits(mask, bits) && has_byte, "{}", device.name);
                    }
                    Some(Check::Reads { reads }) => {
                        assert!(reads.iter().all(|read| fits(&read.mask, &read.bits)), "{}", device.name);
                    }
                    _ => {}
                }
                // Every device can be added to a Raspberry Pi 4.
                let wires = catalog.boards[1]
                    .wires(
                        way,
                        &catalog.boards[1].spot(way, &|_, _| None, &BTreeSet::new()).unwrap(),
                        &BTreeSet::new(),
                        None,
                    )
                    .unwrap();
                let mut signals: Vec<usize> = wires.iter().map(|wire| wire.pin).collect();
                signals.sort_unstable();
                signals.dedup();
                assert_eq!(signals.len(), wires.len(), "{}: two wires on one pin", device.name);
            }
        }
    }

    #[test]
    fn a_board_is_known_by_its_model() {
        let catalog = Catalog::read().unwrap();
        let name = |model: &str, system_cfg: &str| {
            let tree = Tree::new();
            tree.put("proc/device-tree/model", format!("{model}\0"));
            tree.put("boot/system.cfg", system_cfg);
            catalog.board(&tree.computer()).map(|board| board.name.clone()).unwrap_or_default()
        };
        for (model, board) in [
            ("Raspberry Pi 2 Model B Rev 1.1", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi 3 Model B Plus Rev 1.3", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi Zero 2 W Rev 1.0", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi 400 Rev 1.0", "Raspberry Pi 4"),
            ("Raspberry Pi 5 Model B Rev 1.0", "Raspberry Pi 5"),
            ("BigTreeTech CB1", "BigTreeTech CB1 on a board with 40 pins"),
            ("BigTreeTech CB2", "BigTreeTech CB2 or Pi 2"),
            ("OrangePi Zero3", "Orange Pi Zero 2 or 3"),
            ("OrangePi 3 LTS", "Orange Pi 3 LTS"),
            ("Radxa ZERO 3W", "Radxa ZERO 3"),
            ("Pine64", ""),
            ("", ""),
            ("x\u{1b}[2J\nRaspberry Pi 4", ""),
        ] {
            assert_eq!(name(model, ""), board);
        }
        assert_eq!(name("BigTreeTech CB1", "BTT_PAD7=\"ON\"  # enables\n"), "BigTreeTech Pad 7 with a CB1");
        assert!(name("BigTreeTech CB1", "#BTT_PAD7=\"ON\"\n").contains("40 pins"));
    }

    /// On the device trees of boards that people own.
    #[test]
    fn each_line_is_one_of_the_board() {
        let catalog = Catalog::read().unwrap();
        let mut known = 0;
        for board in boards::all() {
            let tree = board.tree();
            let Some(own) = catalog.board(&tree.computer()) else { continue };
            let chips = board.inventory(&tree).chips;
            let is_there = |line: &str| {
                let is_named =
                    chips.iter().flat_map(|chip| &chip.lines).any(|other| other.name.as_deref() == Some(line));
                let numbered = |chip: &Chip| line.strip_prefix(&format!("{}/gpio", chip.label))?.parse::<usize>().ok();
                is_named || chips.iter().any(|chip| numbered(chip).is_some_and(|number| number < chip.lines.len()))
            };
            // Debian 13's kernel has no driver for the header of a Raspberry Pi 5.
            if own.name != "Raspberry Pi 5" || chips.iter().any(|chip| chip.label == "pinctrl-rp1") {
                known += 1;
                let missing: Vec<&String> = own.lines.values().filter(|line| !is_there(line)).collect();
                assert!(missing.is_empty(), "{}: {missing:?}", own.name);
            }
        }
        assert!(known >= 5, "{known}");
    }

    #[test]
    fn two_devices_are_not_put_on_the_same_pins() {
        let catalog = Catalog::read().unwrap();
        let board = &catalog.boards[1];
        let spot = |device: &str, used: &[&str]| {
            let used: Vec<String> = used.iter().map(|node| (*node).to_owned()).collect();
            let uses = move |_: Kind, node: &str| used.contains(&node.to_owned()).then(|| "x".to_owned());
            board.spot(&catalog.device(device).unwrap().way[0], &uses, &BTreeSet::new()).map(|spot| spot.node)
        };
        assert_eq!(spot("adxl345", &[]).unwrap(), "spidev0.0");
        assert_eq!(spot("adxl345", &["spidev0.0"]).unwrap(), "spidev0.1");
        assert!(
            spot("adxl345", &["spidev0.0", "spidev0.1"]).unwrap_err().starts_with("[x] in printer.cfg uses spidev0.")
        );
        let uses_leds = |_: Kind, node: &str| (node == "spidev0.0").then(|| "neopixel a".to_owned());
        assert!(board.spot(&catalog.device("adxl345").unwrap().way[0], &uses_leds, &BTreeSet::new()).is_err());
        for alone in ["ws2812", "hx711"] {
            assert!(spot(alone, &["spidev0.1"]).is_err(), "{alone}");
        }
        assert_eq!(spot("bme280", &["i2c-1"]).unwrap(), "i2c-1");
        assert!(spot("tmc2209", &["w1_bus_master1"]).unwrap_err().contains("w1_bus_master1"), "both have pin 7");
        assert!(spot("ds18b20", &["ttyAMA3"]).is_err());
        assert_eq!(spot("relay", &["spidev0.0"]).unwrap(), "");
    }

    #[test]
    fn a_bus_does_not_take_a_pin_that_printer_cfg_uses() {
        let catalog = Catalog::read().unwrap();
        let (board, way) = (&catalog.boards[1], &catalog.device("adxl345").unwrap().way[0]);
        let spot = board.spot(way, &|_, _| None, &BTreeSet::new()).unwrap();
        let wires = |taken: &str| board.wires(way, &spot, &[taken.to_owned()].into(), None);
        assert!(wires("gpio17").is_ok());
        assert!(wires("gpio10").unwrap_err().starts_with("printer.cfg uses GPIO10 (pin 19)"));
        assert!(wires("GPIO8").unwrap_err().contains("the bus needs it"));
        let node = |line: &str| board.spot(way, &|_, _| None, &[line.to_owned()].into()).map(|spot| spot.node);
        assert_eq!(node("gpio17").unwrap(), "spidev0.0");
        assert_eq!(node("gpio8").unwrap(), "spidev0.1", "the other chip select");
        assert!(node("gpio10").unwrap_err().starts_with("printer.cfg uses GPIO10 (pin 19)"));
    }

    #[test]
    fn a_line_is_one_that_nothing_uses() {
        let catalog = Catalog::read().unwrap();
        let (board, way) = (&catalog.boards[1], &catalog.device("relay").unwrap().way[0]);
        let line = |taken: &[&str], wanted| {
            let taken = taken.iter().map(|line| (*line).to_owned()).collect();
            board.wires(way, &Spot::default(), &taken, wanted).map(|wires| wires.last().unwrap().pin)
        };
        assert_eq!(line(&[], None), Ok(11));
        assert_eq!(line(&["GPIO17", "GPIO27"], None), Ok(15));
        assert_eq!(line(&["gpio17", "pinctrl-bcm2711/gpio27"], None), Ok(15), "klipper_mcu's names");
        assert_eq!(line(&["pca9555/gpio17"], None), Ok(11), "another chip's line");
        assert_eq!(line(&[], Some(40)), Ok(40));
        assert_eq!(line(&[], Some(29)), Ok(29), "it is not among the proposed ones, and it is a line");
        for wrong in [0, 1, 6, 41, usize::MAX] {
            assert!(line(&[], Some(wrong)).unwrap_err().starts_with("--pin: "), "{wrong}");
        }
        assert!(line(&["GPIO21"], Some(40)).is_err());
        assert_eq!(catalog.with_id(0x0f, 0x33).unwrap().name, "lis3dh");
        assert!(catalog.with_id(0x0f, 0xe5).is_none());
    }
}
