// SPDX-License-Identifier: GPL-3.0-or-later
//! Reads klippy's configuration: its pseudo terminals, its LEDs, its drivers on serial ports, and pins by their numbers.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pinion_printer_config::pins::{MAIN, Pin};
use pinion_printer_config::{Config, Section, Trouble};

use crate::cli::computer::Computer;

/// The parts of a configuration that count here.
#[derive(Debug, PartialEq)]
pub(super) struct Printer {
    /// The `serial` of each `[mcu]` section.
    pub(super) serials: BTreeSet<PathBuf>,
    /// The `pin` of each `[neopixel]` section that names an SPI device, such as `host:spidev0.0`.
    pub(super) leds: BTreeSet<String>,
    /// The `pin` of each other `[neopixel]` section, and the `serial` of its MCU.
    pub(super) line_leds: BTreeSet<(PathBuf, String)>,
    /// The `uart_pin` of each `[tmc...]` section that names a serial port, such as `host:ttyAMA1`.
    pub(super) uarts: BTreeSet<String>,
    /// The pins that name a line by the number of its chip, such as `gpio17`, without their MCU and `!`, and the
    /// `serial` of their MCU.
    pub(super) numbered: BTreeSet<(PathBuf, String)>,
}

/// Reads a configuration, with the files that it includes.
///
/// # Errors
///
/// One of the files cannot be read, or klippy would refuse it.
pub(super) fn read(computer: &Computer, config: &Path) -> Result<Printer, Trouble> {
    let config = Config::read_from(computer, config)?;
    let values = |kind: fn(&str) -> bool, key: &'static str| {
        let sections = config.sections().iter().filter(move |section| kind(section.kind()));
        sections.filter_map(move |section| section.text(key)).map(str::to_owned)
    };
    let is_spi = |pin: &String| name_of(pin).starts_with("spidev");
    let is_port = |pin: &String| ["tty", "serial"].iter().any(|kind| name_of(pin).starts_with(kind));
    let leds = || values(|kind| kind == "neopixel", "pin");
    let on_line = |pin: String| Some((serial_of(&config, &pin)?, pin));
    let pins = config.sections().iter().flat_map(pins).filter(|pin| line_of(name_of(pin)).is_some());
    Ok(Printer {
        serials: values(|kind| kind == "mcu", "serial").map(Into::into).collect(),
        leds: leds().filter(is_spi).collect(),
        line_leds: leds().filter(|pin| !is_spi(pin)).filter_map(on_line).collect(),
        uarts: values(|kind| kind.starts_with("tmc"), "uart_pin").filter(is_port).collect(),
        numbered: pins.filter_map(|pin| Some((serial_of(&config, pin)?, name_of(pin).to_owned()))).collect(),
    })
}

/// All pins in a section, as they are written there.
pub(in crate::cli) fn pins(section: &Section) -> impl Iterator<Item = &str> {
    let options = section.settings().iter().filter(|setting| setting.key.contains("pin"));
    options.flat_map(|setting| setting.value.split(','))
}

/// The `serial` of a pin's MCU.
fn serial_of(config: &Config, pin: &str) -> Option<PathBuf> {
    let section = match mcu_of(pin)? {
        mcu if mcu == MAIN => mcu,
        mcu => format!("mcu {mcu}"),
    };
    config.section(&section)?.text("serial").map(Into::into)
}

/// The MCU of a pin.
pub(in crate::cli) fn mcu_of(pin: &str) -> Option<String> {
    Pin::parse(pin, true, true).ok().map(|pin| pin.chip)
}

/// A pin's name without the MCU before it.
pub(in crate::cli) fn name_of(pin: &str) -> &str {
    pin.rsplit(':').next().unwrap_or_default().trim_start_matches(['^', '~', '!', ' ']).trim()
}

/// The chip and the line that a numeric name means: `gpio17` and `gpiochip0/gpio17`.
pub(super) fn line_of(name: &str) -> Option<(u32, u32)> {
    let (chip, line) = name.split_once('/').unwrap_or(("gpiochip0", name));
    Some((chip.strip_prefix("gpiochip")?.parse().ok()?, line.strip_prefix("gpio")?.parse().ok()?))
}

/// For `fuzz/`: files of klippy that include each other. A byte 0 separates them.
#[cfg(fuzzing)]
#[allow(clippy::expect_used)]
pub fn printer_cfg(bytes: &[u8]) {
    let folder = std::env::temp_dir().join(format!("pinion-fuzz-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let names = ["printer.cfg", "a.cfg", "b.cfg", "c.txt", "d", "e.cfg"];
    for (text, name) in bytes.split(|byte| *byte == 0).zip(names) {
        std::fs::write(folder.join(name), text).expect("a file");
    }
    if let Ok(printer) = read(&Computer::at(&folder), Path::new("/printer.cfg")) {
        assert!(printer.leds.iter().all(|pin| pin.contains("spidev")));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::computer::tests::Tree;

    const CONFIG: &str = "/home/pi/config/printer.cfg";

    fn serials(tree: &Tree) -> Option<Vec<String>> {
        let printer = read(&tree.computer(), Path::new(CONFIG)).ok()?;
        Some(printer.serials.iter().map(|path| path.display().to_string()).collect())
    }

    #[test]
    fn leds_on_spi_buses() {
        let tree = Tree::new();
        let leds = |text: &str| {
            tree.put("home/pi/config/printer.cfg", text);
            read(&tree.computer(), Path::new(CONFIG)).unwrap().leds.into_iter().collect::<Vec<_>>()
        };
        let strip =
            "[neopixel strip]\npin: host:spidev0.0 # MOSI\n[neopixel other]\npin: PA1\n[dotstar x]\npin: spidev1.0\n";
        assert_eq!(leds(strip), ["host:spidev0.0"]);
        assert_eq!(leds(&format!("{strip}[neopixel strip]\npin = host: spidev0.1\n")), ["host: spidev0.1"]);
        assert!(leds("[mcu host]\npin: spidev0.0\n#[neopixel a]\n#pin: spidev0.0\n").is_empty());
    }

    #[test]
    fn leds_on_lines() {
        let tree = Tree::new();
        let text = "[mcu]\nserial: /dev/board\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[neopixel a]\npin: host:spidev0.0\n[neopixel b]\npin: host: gpio18\n[neopixel c]\npin: !PA1\n[neopixel d]\npin: no:PA2\n";
        tree.put("home/pi/config/printer.cfg", text);
        let leds = read(&tree.computer(), Path::new(CONFIG)).unwrap().line_leds;
        let expected = [("/dev/board", "!PA1"), ("/tmp/klipper_host_mcu", "host: gpio18")];
        assert_eq!(leds, expected.map(|(serial, pin)| (serial.into(), pin.into())).into());
    }

    #[test]
    fn drivers_on_serial_ports() {
        let tree = Tree::new();
        let text = "[tmc2209 stepper_x]\nuart_pin: ^host:ttyAMA1\n[tmc2209 stepper_y]\nuart_pin: ^host:ttyAMA1\n[tmc2208 extruder]\nuart_pin: host: serial0 # a link\n[tmc2209 stepper_z]\nuart_pin: PC11\n";
        tree.put("home/pi/config/printer.cfg", text);
        let uarts = read(&tree.computer(), Path::new(CONFIG)).unwrap().uarts;
        assert_eq!(uarts.iter().map(|pin| name_of(pin)).collect::<Vec<_>>(), ["ttyAMA1", "serial0"]);
    }

    #[test]
    fn pins_by_the_number_of_their_chip() {
        let tree = Tree::new();
        let text = "[mcu]\nserial: /dev/board\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[stepper_x]\nstep_pin: host:gpio5\ndir_pin: !host:gpiochip4/gpio6\nenable_pin: PA1\nendstop_pin: ^ !host: gpio7\n[multi_pin a]\npins: host:gpio8, host:GPIO9\n[output_pin b]\npin: gpio10\n[output_pin c]\npin: host:gpio11\n[output_pin c]\npin: host:spidev0.0\n[gcode_macro d]\ngcode:\n  PIN_pin=host:gpio12\n[e]\npin: no:gpio13\n";
        tree.put("home/pi/config/printer.cfg", text);
        let pins = read(&tree.computer(), Path::new(CONFIG)).unwrap().numbered;
        let host = ["gpio5", "gpio7", "gpio8", "gpiochip4/gpio6"].map(|pin| ("/tmp/klipper_host_mcu", pin));
        let expected = [("/dev/board", "gpio10")].into_iter().chain(host);
        assert_eq!(pins, expected.map(|(serial, pin)| (serial.into(), pin.into())).collect());
        assert_eq!([line_of("gpio17"), line_of("gpiochip15/gpio3")], [Some((0, 17)), Some((15, 3))]);
        assert_eq!([line_of("GPIO17"), line_of("pinctrl-rp1/gpio17"), line_of("gpiochip0")], [None; 3]);
    }

    #[test]
    fn each_micro_controller_s_serial_counts_as_it_was_said_last() {
        let tree = Tree::new();
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
        let tree = Tree::new();
        tree.put("home/pi/config/printer.cfg", "[include a.cfg]\n");
        tree.put("home/pi/config/a.cfg", "[include *.cfg]\n");
        assert_eq!(serials(&tree), None);
    }
}
