// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's configuration, and the MCUs in it that are this computer's.

use std::cell::OnceCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use pinion_printer_config::pins::{Aliases, Pin, section_of};
use pinion_printer_config::{Config, Section, Setting, Trouble};
use pinion_runtime::klippy::HOST_PATHS;

use super::Computer;
use super::instance::instances;
use super::rights::Rights;

/// The usual link to this computer's MCU.
pub const LINK: &str = "/tmp/klipper_host_mcu";

/// A configuration, with the files that it includes.
#[derive(Clone, Debug)]
pub struct Printer {
    /// Its sections.
    pub config: Config,
    /// `[board_pins]`. Without any if klippy refuses them.
    aliases: Aliases,
}

/// A pin in an option.
pub struct Named<'a> {
    /// The section with the option.
    pub section: &'a Section,
    /// The option.
    pub setting: &'a Setting,
    /// The text, as it is written.
    pub text: &'a str,
    /// The MCU, and the name without marks and aliases.
    pub pin: Pin,
}

impl Computer {
    /// Reads a configuration of klippy's kind with the rights of its owner. It may include any file, and an error quotes
    /// the file's line.
    ///
    /// # Errors
    ///
    /// One of the files cannot be read, or klippy would refuse it.
    pub fn config(&self, path: &Path) -> Result<Config, Trouble> {
        // A link is its owner's choice, so its own owner counts.
        let about = self.unfollowed(path).and_then(fs::symlink_metadata);
        let _rights = Rights::of(about.ok().map(|about| (about.uid(), about.gid())))
            .map_err(|error| Trouble::new(error.to_string()).of(path.display()))?;
        Config::read_from(self, path)
    }
}

impl Printer {
    /// Reads a configuration, with the files that it includes.
    ///
    /// # Errors
    ///
    /// One of the files cannot be read, or klippy would refuse it.
    pub fn read(computer: &Computer, path: &Path) -> Result<Printer, Trouble> {
        let config = computer.config(path)?;
        let aliases = Aliases::read(&config).unwrap_or_default();
        Ok(Printer { config, aliases })
    }

    /// All pins, in the order of the sections.
    pub fn pins(&self) -> impl Iterator<Item = Named<'_>> {
        self.config.sections().iter().flat_map(|section| self.pins_of(section))
    }

    /// The pins of a section.
    pub fn pins_of<'a>(&'a self, section: &'a Section) -> impl Iterator<Item = Named<'a>> {
        // `pin_move_time` of a BLTouch is no pin, and a macro's variables are anything.
        let has_pins =
            !["board_pins", "duplicate_pin_override", "gcode_macro", "delayed_gcode"].contains(&section.kind());
        let is_pin = |key: &str| ["pin", "pins"].contains(&key) || key.ends_with("_pin") || key.ends_with("_pins");
        let options = section.settings().iter().filter(move |setting| has_pins && is_pin(&setting.key));
        options.flat_map(|setting| setting.value.split(',').map(move |text| (setting, text))).filter_map(
            move |(setting, text)| {
                let pin = self.aliases.resolve(&Pin::parse(text, true, true).ok()?);
                Some(Named { section, setting, text: text.trim(), pin })
            },
        )
    }

    /// The MCU of a section: that of its pins, or its `i2c_mcu`.
    pub fn mcu_of(&self, section: &Section) -> String {
        let named = ["i2c_mcu", "sensor_mcu"].iter().find_map(|key| section.text(key)).map(str::to_owned);
        named.or_else(|| self.pins_of(section).map(|named| named.pin.chip).next()).unwrap_or_else(|| "mcu".into())
    }

    /// Whether a section is on one of these MCUs of this computer. 1-Wire is always.
    pub fn is_on(&self, section: &Section, own: &BTreeMap<String, PathBuf>) -> bool {
        section.text("serial_no").is_some() || own.contains_key(&self.mcu_of(section))
    }

    /// The `serial` of an MCU. The main one is called `mcu`.
    pub fn serial(&self, mcu: &str) -> Option<&Path> {
        self.config.section(&section_of(mcu))?.text("serial").map(Path::new)
    }

    /// The `serial` of each MCU.
    pub fn serials(&self) -> BTreeSet<PathBuf> {
        self.config.of_kind("mcu").filter_map(|section| section.text("serial")).map(Into::into).collect()
    }

    /// The MCUs that are this computer's own, with their links. Another computer's MCU (`pinion link`) and a simulated
    /// one have links of the same kind. So a link counts if it is the usual one, if a Pinion serves it here, or if the
    /// user has `named` its MCU.
    pub fn own_mcus(&self, computer: &Computer, named: Option<&str>) -> BTreeMap<String, PathBuf> {
        // A file may name many, and the processes are looked at once.
        let found = OnceCell::new();
        let is_served = |link: &str| {
            let instances = || found.get_or_init(|| instances(computer).0);
            link == LINK || link.starts_with(HOST_PATHS) && instances().iter().any(|one| one.serves(Path::new(link)))
        };
        let mcus = self.config.of_kind("mcu").filter_map(|section| {
            let name = section.name.strip_prefix("mcu ").map_or("mcu", str::trim);
            let serial = section
                .text("serial")
                .filter(|serial| named == Some(name) && serial.starts_with(HOST_PATHS) || is_served(serial))?;
            Some((name.to_owned(), PathBuf::from(serial)))
        });
        mcus.collect()
    }

    /// The pins of `[neopixel]` sections.
    fn leds(&self) -> impl Iterator<Item = Named<'_>> {
        self.pins().filter(|named| named.section.kind() == "neopixel")
    }

    /// The pin of each `[neopixel]` section that names an SPI device, such as `host:spidev0.0`.
    pub fn spi_leds(&self) -> BTreeSet<String> {
        let leds = self.leds().filter(|named| named.pin.name.starts_with("spidev"));
        leds.map(|named| named.text.to_owned()).collect()
    }

    /// The pin of each other `[neopixel]` section, with the `serial` of its MCU.
    pub fn line_leds(&self) -> BTreeSet<(PathBuf, String)> {
        let leds = self.leds().filter(|named| !named.pin.name.starts_with("spidev"));
        leds.filter_map(|named| Some((self.serial(&named.pin.chip)?.into(), named.text.to_owned()))).collect()
    }

    /// The serial ports of stepper drivers: the `uart_pin` of a `[tmc...]` section, such as `ttyAMA1`.
    pub fn uarts(&self) -> BTreeSet<String> {
        let is_port = |name: &str| ["tty", "serial"].iter().any(|kind| name.starts_with(kind));
        let ports = self.pins().filter(|named| named.section.kind().starts_with("tmc") && is_port(&named.pin.name));
        ports.map(|named| named.pin.name).collect()
    }

    /// The pins that name a line by the number of its chip, such as `gpio17`, with the `serial` of their MCU.
    pub fn numbered(&self) -> BTreeSet<(PathBuf, String)> {
        let pins = self.pins().filter(|named| line_of(&named.pin.name).is_some());
        pins.filter_map(|named| Some((self.serial(&named.pin.chip)?.into(), named.pin.name))).collect()
    }
}

/// The chip and the line that a numeric name means: `gpio17` and `gpiochip0/gpio17`.
pub fn line_of(name: &str) -> Option<(u32, u32)> {
    let (chip, line) = name.split_once('/').unwrap_or(("gpiochip0", name));
    Some((chip.strip_prefix("gpiochip")?.parse().ok()?, line.strip_prefix("gpio")?.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    const CONFIG: &str = "/home/pi/config/printer.cfg";

    fn serials(tree: &Tree) -> Option<Vec<String>> {
        let printer = Printer::read(&tree.computer(), Path::new(CONFIG)).ok()?;
        Some(printer.serials().iter().map(|path| path.display().to_string()).collect())
    }

    #[test]
    fn leds_on_spi_buses() {
        let tree = Tree::empty();
        let leds = |text: &str| {
            tree.put("home/pi/config/printer.cfg", text);
            Printer::read(&tree.computer(), Path::new(CONFIG)).unwrap().spi_leds().into_iter().collect::<Vec<_>>()
        };
        let strip =
            "[neopixel strip]\npin: host:spidev0.0 # MOSI\n[neopixel other]\npin: PA1\n[dotstar x]\npin: spidev1.0\n";
        assert_eq!(leds(strip), ["host:spidev0.0"]);
        assert_eq!(leds(&format!("{strip}[neopixel strip]\npin = host: spidev0.1\n")), ["host: spidev0.1"]);
        assert!(leds("[mcu host]\npin: spidev0.0\n#[neopixel a]\n#pin: spidev0.0\n").is_empty());
    }

    #[test]
    fn leds_on_lines() {
        let tree = Tree::empty();
        let text = "[mcu]\nserial: /dev/board\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[neopixel a]\npin: host:spidev0.0\n[neopixel b]\npin: host: gpio18\n[neopixel c]\npin: !PA1\n[neopixel d]\npin: no:PA2\n";
        tree.put("home/pi/config/printer.cfg", text);
        let leds = Printer::read(&tree.computer(), Path::new(CONFIG)).unwrap().line_leds();
        let expected = [("/dev/board", "!PA1"), ("/tmp/klipper_host_mcu", "host: gpio18")];
        assert_eq!(leds, expected.map(|(serial, pin)| (serial.into(), pin.into())).into());
    }

    #[test]
    fn drivers_on_serial_ports() {
        let tree = Tree::empty();
        let text = "[tmc2209 stepper_x]\nuart_pin: ^host:ttyAMA1\n[tmc2209 stepper_y]\nuart_pin: ^host:ttyAMA1\n[tmc2208 extruder]\nuart_pin: host: serial0 # a link\n[tmc2209 stepper_z]\nuart_pin: PC11\n";
        tree.put("home/pi/config/printer.cfg", text);
        let uarts = Printer::read(&tree.computer(), Path::new(CONFIG)).unwrap().uarts();
        assert_eq!(uarts.into_iter().collect::<Vec<_>>(), ["serial0", "ttyAMA1"]);
    }

    #[test]
    fn pins_by_the_number_of_their_chip() {
        let tree = Tree::empty();
        let text = "[mcu]\nserial: /dev/board\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[stepper_x]\nstep_pin: host:gpio5\ndir_pin: !host:gpiochip4/gpio6\nenable_pin: PA1\nendstop_pin: ^ !host: gpio7\n[multi_pin a]\npins: host:gpio8, host:GPIO9\n[output_pin b]\npin: gpio10\n[output_pin c]\npin: host:gpio11\n[output_pin c]\npin: host:spidev0.0\n[gcode_macro d]\ngcode:\n  PIN_pin=host:gpio12\n[e]\npin: no:gpio13\n";
        tree.put("home/pi/config/printer.cfg", text);
        let pins = Printer::read(&tree.computer(), Path::new(CONFIG)).unwrap().numbered();
        let host = ["gpio5", "gpio7", "gpio8", "gpiochip4/gpio6"].map(|pin| ("/tmp/klipper_host_mcu", pin));
        let expected = [("/dev/board", "gpio10")].into_iter().chain(host);
        assert_eq!(pins, expected.map(|(serial, pin)| (serial.into(), pin.into())).collect());
        assert_eq!([line_of("gpio17"), line_of("gpiochip15/gpio3")], [Some((0, 17)), Some((15, 3))]);
        assert_eq!([line_of("GPIO17"), line_of("pinctrl-rp1/gpio17"), line_of("gpiochip0")], [None; 3]);
    }

    #[test]
    fn each_micro_controller_s_serial_counts_as_it_was_said_last() {
        let tree = Tree::empty();
        assert_eq!(serials(&tree), None);
        tree.put("home/pi/config/printer.cfg", "[printer]\nserial: /no\n[mcu]\nserial: /dev/serial/by-id/x # a board\n#[mcu no]\n#serial: /no\n; [mcu no]\n;serial: /no\n[mcu host]\nserial=/tmp/klipper_host_mcu ; the Pi\n[mcu odd]\nserial: /tmp/a;b\n[include parts/*.cfg]\n[mcu last]\nrestart_method: command\n");
        assert_eq!(serials(&tree).unwrap(), ["/dev/serial/by-id/x", "/tmp/a;b", "/tmp/klipper_host_mcu"]);
        tree.put("home/pi/config/parts/b.cfg", "[mcu host]\nserial: /tmp/klipper_host_b\n");
        tree.put("home/pi/config/parts/a.cfg", "[mcu host]\nserial: /tmp/klipper_host_a\n[include ../up.cfg]\n");
        tree.put("home/pi/config/parts/.hidden.cfg", "[mcu hidden]\nserial: /no\n");
        tree.put("home/pi/config/up.cfg", "[mcu]\nserial: /tmp/klipper_host_up\n");
        assert_eq!(serials(&tree).unwrap(), ["/tmp/a;b", "/tmp/klipper_host_b", "/tmp/klipper_host_up"]);
        // The link has the path of the computer itself.
        tree.link("home/pi/config/parts/c.cfg", "/usr/share/c.cfg");
        assert_eq!(serials(&tree), None, "it leads nowhere");
        tree.put("usr/share/c.cfg", "[mcu c]\nserial: /tmp/klipper_host_c\n");
        assert_eq!(serials(&tree).unwrap().len(), 4);
    }

    #[test]
    fn files_that_include_each_other_are_not_read_for_ever() {
        let tree = Tree::empty();
        tree.put("home/pi/config/printer.cfg", "[include a.cfg]\n");
        tree.put("home/pi/config/a.cfg", "[include *.cfg]\n");
        assert_eq!(serials(&tree), None);
    }
}
