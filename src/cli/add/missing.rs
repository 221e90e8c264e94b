// SPDX-License-Identifier: GPL-3.0-or-later
//! The finding of `pinion doctor`: devices in printer.cfg whose bus is not there.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::cli::computer::Computer;
use crate::cli::finding::Finding;

use super::catalog::{Catalog, Device};
use super::printer::Printer;

/// The finding of `pinion doctor`: the devices of these configurations whose bus is not there, and how to get it.
pub(in crate::cli) fn missing(computer: &Computer, configs: &BTreeSet<PathBuf>) -> Vec<Finding> {
    let Ok(catalog) = Catalog::read() else { return Vec::new() };
    let printers = configs.iter().filter_map(|config| Printer::read(computer, config).ok());
    let finding = |printer: Printer| -> Vec<Finding> {
        let of = |(section, sensor, file): (&str, Option<&str>, String)| {
            let found = format!("[{section}] in printer.cfg needs {file}, which is not there");
            let kind = section.split(' ').next().unwrap_or_default();
            let is_it = |device: &&Device| match sensor {
                Some(sensor) => device.way.iter().any(|way| way.config.contains(&format!("sensor_type: {sensor}\n"))),
                None => device.section.split(' ').next() == Some(kind),
            };
            match catalog.devices.iter().find(is_it) {
                Some(device) => Finding::error("device", found, format!("sudo pinion add {}", device.name)),
                None => Finding::error("device", found, "enable its bus: pinion add lists what it knows"),
            }
        };
        printer.absent(computer).into_iter().map(of).collect()
    };
    printers.flat_map(finding).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::computer::tests::Tree;

    #[test]
    fn a_configured_device_without_its_bus_is_named_with_the_command_that_adds_it() {
        let tree = Tree::new();
        tree.put("home/pi/printer.cfg", "[adxl345 bed]\ncs_pin: host:None\nspi_bus: spidev0.1\n[temperature_sensor room]\nsensor_type: BME280\ni2c_bus: i2c.1\n[lis2dw]\nspi_bus: spidev0.0\n[tmc5160 stepper_x]\nspi_bus: spi1\n[temperature_sensor out]\nsensor_type: DS18B20\nserial_no: 28-0316a4f1ff27\n[neopixel strip]\npin: host:spidev9.0\n[sx1509 x]\ni2c_bus: i2c.7\n");
        tree.put("dev/spidev0.0", "");
        let found = missing(&tree.computer(), &[PathBuf::from("/home/pi/printer.cfg"), "/none".into()].into());
        let remedies: Vec<(String, String)> = found
            .iter()
            .map(|finding| {
                let found = finding.trouble.found();
                (found.split(']').next().unwrap().to_owned(), finding.trouble.remedy.clone().unwrap_or_default().into())
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
