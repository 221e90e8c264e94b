// SPDX-License-Identifier: GPL-3.0-or-later
//! The finding of `pinion doctor`: devices in printer.cfg whose bus is not there.

use std::collections::BTreeSet;
use std::path::PathBuf;

use pinion_printer_config::{Section, Setting};

use crate::cli::computer::Computer;
use crate::cli::computer::printer::Printer;
use crate::cli::finding::Finding;

use super::catalog::{Catalog, Device};

/// The finding of `pinion doctor`: the devices of these configurations whose bus is not there, and how to get it.
pub(in crate::cli) fn missing(computer: &Computer, configs: &BTreeSet<PathBuf>) -> Vec<Finding> {
    let Ok(catalog) = Catalog::read() else { return Vec::new() };
    let printers = configs.iter().filter_map(|config| Printer::read(computer, config).ok());
    let finding = |section: &Section| {
        let file = section.settings().iter().find_map(node).filter(|file| !computer.exists(file))?;
        let found = format!("[{}] in printer.cfg needs {file}, which is not there", section.name);
        let is_it = |device: &&Device| {
            device.is_chip_of(section)
                || section.kind() == device.section(None).split(' ').next().unwrap_or_default()
                    && device.name == "ws2812"
        };
        let remedy = match catalog.devices.iter().find(is_it) {
            Some(device) => format!("sudo pinion add {}{}", device.name, computer.root_option()),
            None => "enable its bus: pinion add lists what it knows".into(),
        };
        Some(Finding::error("device", found, remedy))
    };
    let of_printer = |printer: Printer| {
        let own = printer.own_mcus(computer, None);
        let sections = printer.config.sections().iter().filter(|section| printer.is_on(section, &own));
        sections.filter_map(finding).collect::<Vec<_>>()
    };
    printers.flat_map(of_printer).collect()
}

/// The file of a bus or a sensor that an option names.
fn node(setting: &Setting) -> Option<String> {
    let name = setting.value.rsplit(':').next().unwrap_or_default().trim_start_matches(['^', '~', '!', ' ']).trim();
    let is_number = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_digit() || c == '.');
    match (setting.key.as_str(), name.strip_prefix("spidev"), name.strip_prefix("i2c.")) {
        ("spi_bus" | "pin", Some(number), _) if is_number(number) => Some(format!("/dev/{name}")),
        ("i2c_bus", _, Some(number)) if is_number(number) => Some(format!("/dev/i2c-{number}")),
        ("serial_no", ..) if name.chars().all(|c| c.is_ascii_hexdigit() || c == '-') => {
            Some(format!("/sys/bus/w1/devices/{name}"))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::computer::tests::Tree;

    #[test]
    fn a_configured_device_without_its_bus_is_named_with_the_command_that_adds_it() {
        let tree = Tree::new();
        tree.put("home/pi/printer.cfg", "[mcu host]\nserial: /tmp/klipper_host_mcu\n[mcu other]\nserial: /tmp/klipper_host_other\n[adxl345 elsewhere]\ncs_pin: other:None\nspi_bus: spidev1.0\n[adxl345 bed]\ncs_pin: host:None\nspi_bus: spidev0.1\n[temperature_sensor room]\nsensor_type: BME280\ni2c_mcu: host\ni2c_bus: i2c.1\n[lis2dw]\ncs_pin: host:None\nspi_bus: spidev0.0\n[tmc5160 stepper_x]\nspi_bus: spi1\n[temperature_sensor out]\nsensor_type: DS18B20\nserial_no: 28-0316a4f1ff27\n[neopixel strip]\npin: host:spidev9.0\n[sx1509 x]\ni2c_mcu: host\ni2c_bus: i2c.7\n");
        tree.put("dev/spidev0.0", "");
        let found = missing(&tree.computer(), &[PathBuf::from("/home/pi/printer.cfg"), "/none".into()].into());
        let remedies: Vec<(String, String)> = found
            .iter()
            .map(|finding| {
                let found = finding.trouble.found();
                let remedy: String = finding.trouble.remedy.clone().unwrap_or_default().into();
                let root = tree.computer().root_option();
                (found.split(']').next().unwrap().to_owned(), remedy.replace(&root, ""))
            })
            .collect();
        let expected = [
            ("[adxl345 bed", "sudo pinion add adxl345"),
            ("[temperature_sensor room", "sudo pinion add bme280"),
            ("[temperature_sensor out", "sudo pinion add ds18b20"),
            ("[neopixel strip", "sudo pinion add ws2812"),
            ("[sx1509 x", "enable its bus: pinion add lists what it knows"),
        ];
        assert_eq!(remedies, expected.map(|(found, remedy)| (found.to_owned(), remedy.to_owned())));
    }
}
