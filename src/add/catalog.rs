// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices that can be added: the files in `devices`, one for each.
//!
//! To add one, write its file and name it in [`DEVICES`]. The tests check it.

use serde::Deserialize;

use pinion_printer_config::Section;

use pinion_system::board::{Board, Boot, Kind, names, parse};
use pinion_system::files;

/// Each device by its name on the command line, in the order of the list.
const DEVICES: [(&str, &str); 28] = files!("devices":
    "adxl345" "lis2dw" "lis3dh" "mpu9250" "icm20948" "bmi160"
    "bme280" "aht" "sht" "htu21d" "lm75" "ds18b20"
    "max6675" "max31855" "max31856" "max31865" "ads1115" "mcp3208"
    "ws2812" "fan" "relay" "light" "button" "filament" "endstop" "hx711" "tmc2209" "ssd1306");

/// The names of the devices.
pub(super) const NAMES: [&str; DEVICES.len()] = names(&DEVICES);

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
    /// Its section of printer.cfg, without a name.
    section: String,
    /// The usual name behind that. A device without one gets a name only if the user gives it one.
    called: Option<String>,
    /// Whether klippy wants a section without a name before one with a name.
    #[serde(default)]
    pub(super) wants_first: bool,
    /// klippy's module, if it is not called like the section.
    module: Option<String>,
    /// Other names that people look for.
    #[serde(default)]
    also: Vec<String>,
    /// Whether it measures resonances, and so wants a `[resonance_tester]`.
    #[serde(default)]
    pub(super) resonance: bool,
    /// A command that measures something, once the host has restarted.
    pub(super) measure: Option<String>,
    /// The command to type when it works.
    pub(super) next: Vec<String>,
    /// The ways to connect it, the best one first.
    pub(super) way: Vec<Wiring>,
}

/// A way to connect a device.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Wiring {
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
    /// The device's pins, and what each of them is connected to: `3v3`, `5v`, `gnd`, a pin of the bus, `line`, or `up`
    /// for a line that is pulled up.
    pub(super) wires: Vec<(String, String)>,
    /// The sections of printer.cfg, with `{section}`, `{name}`, `{mcu}`, `{spi_bus}` and so on.
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

impl Device {
    /// Its section, if the user calls the device so.
    pub(super) fn section(&self, name: Option<&str>) -> String {
        match name.or(self.called.as_deref()) {
            Some(name) => format!("{} {name}", self.section),
            None => self.section.clone(),
        }
    }

    /// A template with the names put in.
    pub(super) fn named(&self, text: &str, name: Option<&str>) -> String {
        let own = name.or(self.called.as_deref()).unwrap_or(&self.section);
        // klippy's commands find a chip by the last word of its section.
        let chip = name.map_or(String::new(), |name| format!(" CHIP={name}"));
        text.replace("{section}", &self.section(name)).replace("{name}", own).replace("{chip}", &chip)
    }

    /// The name of its file in `pinion/`, without `.cfg`.
    pub(super) fn file(&self, name: Option<&str>) -> String {
        name.map_or_else(|| self.name.to_owned(), |name| format!("{}-{name}", self.name))
    }

    /// klippy's module for it.
    pub(super) fn module(&self) -> &str {
        self.module.as_deref().unwrap_or_else(|| self.section.split(' ').next().unwrap_or_default())
    }

    /// The `sensor_type` that only this device has.
    fn sensor_type(&self) -> Option<&str> {
        let lines = self.way.iter().flat_map(|way| way.config.lines());
        let types = lines.filter_map(|line| line.strip_prefix("sensor_type: "));
        types.into_iter().next().filter(|kind| !kind.contains(' '))
    }

    /// Whether a section of printer.cfg is this chip, whatever its name. Lines and switches have no kind of their own.
    pub(super) fn is_chip_of(&self, section: &Section) -> bool {
        let is_chip = self.way.iter().any(|way| matches!(way.bus, Kind::Spi | Kind::I2c | Kind::W1));
        let is_kind = section.kind() == self.section;
        is_chip
            && is_kind
            && (self.section != "temperature_sensor" || section.text("sensor_type") == self.sensor_type())
            && (self.section != "temperature_sensor" || self.sensor_type().is_some())
    }
}

impl Wiring {
    /// Whether it can be made on this board.
    pub(super) fn fits(&self, board: &Board) -> bool {
        let roles = self.wires.iter().filter(|(_, role)| is_line(role)).count();
        let has_bus = self.bus == Kind::Line || board.bus.contains_key(&self.bus);
        has_bus && board.free.len() >= roles && (self.driver.is_none() || board.boot == Boot::ConfigTxt)
    }
}

/// Whether a wire goes to a line of its own.
pub(super) fn is_line(role: &str) -> bool {
    role.starts_with("line") || role == "up"
}

/// All devices.
pub(super) struct Catalog {
    pub(super) devices: Vec<Device>,
}

/// A name as people write it: `MPU-6500` is `mpu6500`.
fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_ascii_alphanumeric()).collect::<String>().to_ascii_lowercase()
}

impl Catalog {
    /// Reads the files.
    ///
    /// # Errors
    ///
    /// The first file with a mistake. The tests find it before a user does.
    pub(super) fn read() -> Result<Catalog, String> {
        let device = |(name, text): (&'static str, &str)| -> Result<Device, String> {
            Ok(Device { name, ..parse(name, text)? })
        };
        Ok(Catalog { devices: DEVICES.into_iter().map(device).collect::<Result<_, _>>()? })
    }

    /// The device of this name, as people write it.
    ///
    /// # Errors
    ///
    /// One line: there is none, with the nearest name.
    pub(super) fn device(&self, name: &str) -> Result<&Device, String> {
        let wanted = plain(name);
        let names = |device: &Device| -> Vec<String> {
            std::iter::once(device.name.to_owned()).chain(device.also.iter().cloned()).collect()
        };
        if let Some(device) = self.devices.iter().find(|device| names(device).contains(&wanted)) {
            return Ok(device);
        }
        let all = self.devices.iter().flat_map(|device| names(device).into_iter().map(move |name| (name, device.name)));
        let near = all.map(|(name, device)| (strsim::damerau_levenshtein(&name, &wanted), device)).min();
        Err(match near.filter(|(distance, _)| *distance <= 2) {
            Some((_, near)) => format!("there is no device \"{name}\": did you mean {near}?"),
            None => format!("there is no device \"{name}\": pinion add lists them"),
        })
    }

    /// The device that has this id in this register.
    pub(super) fn with_id(&self, register: u8, id: u8) -> Option<&Device> {
        let has = |way: &Wiring| matches!(&way.check, Some(Check::Id { register: own, ids }) if *own == register && ids.contains(&id));
        self.devices.iter().find(|device| device.way.iter().any(has))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::add::place::Search;
    use crate::boards;
    use crate::tree::Tree;
    use pinion_linux::gpio::Chip;
    use pinion_system::board::{self, Slot};
    use pinion_system::uses::Uses;
    use std::collections::{BTreeMap, BTreeSet};
    use std::fs;
    use std::path::Path;

    #[test]
    fn each_file_is_in_the_catalog_and_the_catalog_can_be_read() {
        let names = |folder: &str| -> BTreeSet<String> {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
            let files = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path());
            files.map(|file| file.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
        };
        assert_eq!(names("src/add/devices"), NAMES.iter().map(|name| (*name).to_owned()).collect());
        assert_eq!(names("tools/system/src/boards"), board::NAMES.iter().map(|name| (*name).to_owned()).collect());
        Catalog::read().unwrap();
        board::all().unwrap();
    }

    /// Mistakes in a file.
    #[test]
    fn the_data_fit_together() {
        let catalog = Catalog::read().unwrap();
        let boards = board::all().unwrap();
        for board in &boards {
            for (kind, bus) in &board.bus {
                assert_ne!(bus.enable.is_empty(), bus.overlays.is_empty(), "{} {kind:?}", board.name);
                assert_eq!(board.boot == Boot::ConfigTxt, bus.overlays.is_empty(), "{} {kind:?}", board.name);
                for pin in bus.all_pins() {
                    assert!((1..=board.pins.len()).contains(&pin), "{} {kind:?} {pin}", board.name);
                    assert!(!["GND", "5 V", "3.3 V", "-"].contains(&board.label(pin)), "{}", board.name);
                }
            }
            for pin in board.free.iter().chain(&board.up) {
                assert!(board.line(*pin).is_some(), "{}: pin {pin}", board.name);
            }
            for pin in board.lines.keys() {
                let label = board.label(pin.parse().unwrap());
                assert!(label.starts_with("GPIO") || label.starts_with('P'), "{}: {label}", board.name);
            }
        }
        for device in &catalog.devices {
            for way in &device.way {
                let own = [device.section(None), device.section(Some("second"))];
                for (name, section) in [None, Some("second")].into_iter().zip(own) {
                    let config = device.named(&way.config, name);
                    let is_head = |line: &str| line == format!("[{section}]");
                    assert!(config.lines().any(is_head), "{}: no {section}: {config}", device.name);
                    assert!(!config.contains("{name}") && !config.contains("{section}"), "{config}");
                }
                assert!(device.trap.len() < 140 && !device.next.is_empty(), "{}: {}", device.name, device.trap.len());
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
                let uses = Uses::find(&Tree::empty().computer(), Some(&boards[1]), None, None);
                let search = Search { board: &boards[1], uses: &uses, own: None, there: None };
                let spot = search.spots(way).remove(0);
                assert_eq!(search.conflict(way, &spot), None, "{}", device.name);
                let wires = search.wires(device, way, &spot, &BTreeMap::new(), None).unwrap();
                let mut signals: Vec<usize> = wires.iter().map(|wire| wire.pin).collect();
                signals.sort_unstable();
                signals.dedup();
                assert_eq!(signals.len(), wires.len(), "{}: two wires on one pin", device.name);
            }
        }
    }

    #[test]
    fn a_name_may_be_written_in_any_way() {
        let catalog = Catalog::read().unwrap();
        for (name, device) in [
            ("ADXL345", "adxl345"),
            ("adxl", "adxl345"),
            ("MPU-6500", "mpu9250"),
            ("mpu6050", "mpu9250"),
            ("neopixel", "ws2812"),
            ("sht31", "sht"),
            ("SI7021", "htu21d"),
            ("aht20", "aht"),
            ("bmp280", "bme280"),
            ("pt100", "max31865"),
            ("lis2dh", "lis3dh"),
        ] {
            assert_eq!(catalog.device(name).unwrap().name, device);
        }
        assert!(catalog.device("adxl354").unwrap_err().contains("did you mean adxl345?"));
        assert!(catalog.device("toaster").unwrap_err().contains("pinion add lists them"));
        // No name means two devices.
        let all = catalog.devices.iter().flat_map(|device| device.also.iter().map(String::as_str).chain([device.name]));
        let all: Vec<&str> = all.collect();
        assert_eq!(all.iter().collect::<BTreeSet<_>>().len(), all.len());
    }

    #[test]
    fn a_board_is_known_by_its_whole_model() {
        let name = |model: &str, system_cfg: &str| {
            let tree = Tree::empty();
            tree.put("proc/device-tree/model", format!("{model}\0"));
            tree.put("boot/system.cfg", system_cfg);
            board::Board::of(&tree.computer(), None).unwrap().map(|board| board.name).unwrap_or_default()
        };
        for (model, board) in [
            ("Raspberry Pi 2 Model B Rev 1.1", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi 3 Model B Plus Rev 1.3", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi Zero 2 W Rev 1.0", "Raspberry Pi 2, 3 or Zero 2"),
            ("Raspberry Pi 400 Rev 1.0", "Raspberry Pi 4"),
            ("Raspberry Pi 4 Model B", "Raspberry Pi 4"),
            ("Raspberry Pi 5 Model B Rev 1.0", "Raspberry Pi 5"),
            ("BigTreeTech CB1", "BigTreeTech CB1 on a board with 40 pins"),
            ("BQ-H616", "BigTreeTech CB1 on a board with 40 pins"),
            ("BigTreeTech CB2", "BigTreeTech CB2 or Pi 2"),
            ("OrangePi Zero3", "Orange Pi Zero 2 or 3"),
            ("OrangePi 3 LTS", "Orange Pi 3 LTS"),
            ("Radxa ZERO 3W", "Radxa ZERO 3"),
            // Its header has other lines.
            ("OrangePi Zero 2W", ""),
            ("OrangePi Zero2W", ""),
            ("OrangePi Zero2 W", ""),
            // Its carrier board decides.
            ("Raspberry Pi Compute Module 4 Rev 1.0", ""),
            ("Pine64", ""),
            ("", ""),
            ("x\u{1b}[2J\nRaspberry Pi 4", ""),
        ] {
            assert_eq!(name(model, ""), board, "{model}");
        }
        assert_eq!(name("BigTreeTech CB1", "BTT_PAD7=\"ON\"  # enables\n"), "BigTreeTech Pad 7 with a CB1");
        assert!(name("BigTreeTech CB1", "#BTT_PAD7=\"ON\"\n").contains("40 pins"));
        let card = Tree::empty();
        let named = board::Board::of(&card.computer(), Some("raspberry-pi-5")).unwrap();
        assert_eq!(named.unwrap().name, "Raspberry Pi 5", "a card has no device tree");
        assert!(
            board::Board::of(&card.computer(), Some("pi5")).unwrap_err().contains("choose one of raspberry-pi-3, ")
        );
    }

    /// On the device trees of boards that people own.
    #[test]
    fn each_line_is_one_of_the_board() {
        let mut known = 0;
        for board in boards::all() {
            let tree = board.tree();
            let Some(own) = board::Board::of(&tree.computer(), None).unwrap() else { continue };
            let chips = board.inventory(&tree).chips;
            let is_there = |line: &str| {
                let is_named =
                    chips.iter().flat_map(|chip| &chip.lines).any(|other| other.name.as_deref() == Some(line));
                let numbered = |chip: &Chip| line.strip_prefix(&format!("{}/gpio", chip.label))?.parse::<usize>().ok();
                is_named || chips.iter().any(|chip| numbered(chip).is_some_and(|number| number < chip.lines.len()))
            };
            // Debian's kernels call GPIO4 GPIO_GCLK, and Pinion knows the number.
            let is_known = |line: &&String| is_there(line) || *line == "GPIO4";
            // Debian 13's kernel has no driver for the header of a Raspberry Pi 5.
            if own.name != "Raspberry Pi 5" || chips.iter().any(|chip| chip.label == "pinctrl-rp1") {
                known += 1;
                let missing: Vec<&String> = own.lines.values().filter(|line| !is_known(line)).collect();
                assert!(missing.is_empty(), "{}: {missing:?}", own.name);
            }
        }
        assert!(known >= 5, "{known}");
    }

    /// The resources of a device that each of these sections takes, on a Raspberry Pi 4.
    #[test]
    fn two_devices_are_not_put_on_the_same_pins() {
        let catalog = Catalog::read().unwrap();
        let boards = board::all().unwrap();
        let board = &boards[1];
        let spot = |device: &str, config: &str| -> Result<String, String> {
            let tree = Tree::empty();
            let head = "[mcu host]\nserial: /tmp/klipper_host_mcu\n";
            tree.put("home/pi/printer_data/config/printer.cfg", format!("{head}{config}"));
            let uses = Uses::find(&tree.computer(), Some(board), None, None);
            let search = Search { board, uses: &uses, own: None, there: None };
            let way = &catalog.device(device).unwrap().way[0];
            let mut why = String::new();
            for spot in search.spots(way) {
                match search.conflict(way, &spot) {
                    None => return Ok(spot.node),
                    Some(conflict) => why = conflict,
                }
            }
            Err(why)
        };
        let spi = |select: u32| format!("[adxl345 x{select}]\ncs_pin: host:None\nspi_bus: spidev0.{select}\n");
        let both = spi(0) + &spi(1);
        assert_eq!(spot("adxl345", "").unwrap(), "spidev0.0");
        assert_eq!(spot("adxl345", &spi(0)).unwrap(), "spidev0.1");
        assert!(spot("adxl345", &both).unwrap_err().starts_with("spidev0.1 is used by [adxl345 x1] ("));
        assert!(spot("adxl345", "[neopixel a]\npin: host:spidev0.0\n").is_err(), "LEDs take every transfer");
        for alone in ["ws2812", "hx711"] {
            assert!(spot(alone, &spi(1)).is_err(), "{alone}");
        }
        let i2c = "[temperature_sensor x]\nsensor_type: BME280\ni2c_mcu: host\ni2c_bus: i2c.1\ni2c_address: 118\n";
        assert_eq!(spot("bme280", i2c).unwrap(), "i2c-1");
        let other = i2c.replace(" x]", " y]").replace("118", "119");
        assert!(spot("bme280", &format!("{i2c}{other}")).unwrap_err().contains("0x76 and 0x77 on i2c-1"));
        let w1 = "[temperature_sensor x]\nsensor_type: DS18B20\nsensor_mcu: host\nserial_no: 28-0316a4f1ff27\n";
        assert!(spot("tmc2209", w1).unwrap_err().starts_with("GPIO4 (pin 7) is used by [temperature_sensor x]"));
        assert!(spot("ds18b20", "[tmc2209 a]\nuart_pin: host:ttyAMA3\n").is_err());
        assert_eq!(spot("ds18b20", w1).unwrap(), "w1_bus_master1", "several thermometers share a wire");
        assert_eq!(spot("relay", &spi(0)).unwrap(), Slot::default().node);
        for (pin, place) in [
            ("gpio17", Ok("spidev0.0")),
            ("gpio8", Ok("spidev0.1")),
            ("GPIO10", Err(())),
            ("pinctrl-bcm2711/gpio10", Err(())),
            ("gpiochip0/gpio10", Err(())),
            // An expander's lines are not the header's.
            ("gpiochip2/gpio8", Ok("spidev0.0")),
            ("gpiochip2/gpio10", Ok("spidev0.0")),
            ("pca9555/gpio10", Ok("spidev0.0")),
        ] {
            let found = spot("adxl345", &format!("[output_pin x]\npin: host:{pin}\n"));
            assert_eq!(found.as_deref().map_err(|_| ()), place, "{pin}: {found:?}");
        }
    }

    /// A section of the user's own is asked at its own address.
    #[test]
    fn the_addresses_of_other_chips_are_not_asked() {
        let catalog = Catalog::read().unwrap();
        let boards = board::all().unwrap();
        let tree = Tree::empty();
        tree.put(
            "home/pi/printer_data/config/printer.cfg",
            "[mcu host]\nserial: /tmp/klipper_host_mcu\n[temperature_sensor room]\nsensor_type: BME280\ni2c_mcu: host\ni2c_bus: i2c.1\ni2c_address: 118\n",
        );
        let uses = Uses::find(&tree.computer(), Some(&boards[1]), None, None);
        let way = &catalog.device("bme280").unwrap().way[0];
        for (there, addresses) in [(None, &[0x77][..]), (Some("temperature_sensor room"), &[0x76, 0x77])] {
            let search = Search { board: &boards[1], uses: &uses, own: None, there: there.map(str::to_owned) };
            assert_eq!(search.addresses(way, &search.spots(way)[0]), addresses);
        }
    }

    #[test]
    fn a_line_is_one_that_nothing_uses() {
        let catalog = Catalog::read().unwrap();
        let boards = board::all().unwrap();
        let board = &boards[1];
        let relay = catalog.device("relay").unwrap();
        let line = |taken: &[&str], wanted: Option<&str>| {
            let tree = Tree::empty();
            let pins = taken.iter().enumerate().map(|(n, pin)| format!("[output_pin x{n}]\npin: host:{pin}\n"));
            let config = format!("[mcu host]\nserial: /tmp/klipper_host_mcu\n{}", pins.collect::<String>());
            tree.put("home/pi/printer_data/config/printer.cfg", config);
            let uses = Uses::find(&tree.computer(), Some(board), None, None);
            let search = Search { board, uses: &uses, own: None, there: None };
            let wires = search.wires(relay, &relay.way[0], &Slot::default(), &BTreeMap::new(), wanted);
            wires.map(|wires| wires.last().unwrap().pin)
        };
        assert_eq!(line(&[], None), Ok(11));
        assert_eq!(line(&["GPIO17", "GPIO27"], None), Ok(15));
        assert_eq!(line(&["gpio17", "pinctrl-bcm2711/gpio27"], None), Ok(15), "klipper_mcu's names");
        assert_eq!(line(&["pca9555/gpio17"], None), Ok(11), "another chip's line");
        assert_eq!(line(&[], Some("40")), Ok(40));
        assert_eq!(line(&[], Some("gpio21")), Ok(40));
        assert_eq!(line(&[], Some("29")), Ok(29), "it is not among the proposed ones, and it is a line");
        for wrong in ["0", "1", "6", "41", "18446744073709551615", "GPIO99", "x"] {
            assert!(
                line(&[], Some(wrong))
                    .unwrap_err()
                    .starts_with("--pin: this pin has no free line: choose one of 11 (GPIO17)"),
                "{wrong}"
            );
        }
        assert!(line(&["GPIO21"], Some("40")).is_err());
        assert_eq!(catalog.with_id(0x0f, 0x33).unwrap().name, "lis3dh");
        assert!(catalog.with_id(0x0f, 0xe5).is_none());
    }
}
