// SPDX-License-Identifier: GPL-3.0-or-later
//! The finding of `pinion doctor`: devices in printer.cfg whose bus is not there.

use pinion_system::Computer;
use pinion_system::finding::Finding;
use pinion_system::uses::{Resource, Use, Uses};

use super::catalog::{Catalog, Device};

/// The finding of `pinion doctor`: the devices whose bus is not there, and how to get it.
pub(crate) fn missing(computer: &Computer, uses: &Uses) -> Vec<Finding> {
    let Ok(catalog) = Catalog::read() else { return Vec::new() };
    let finding = |one: &Use| {
        let section = uses.section(one)?;
        let file = match &one.what {
            Resource::Select(bus, select) => format!("/dev/spidev{bus}.{select}"),
            Resource::Controller(bus) => format!("/dev/spidev{bus}.0"),
            Resource::I2c(bus, _) => format!("/dev/i2c-{bus}"),
            Resource::Sensor(serial) => format!("/sys/bus/w1/devices/{}", serial.replace('/', "")),
            _ => return None,
        };
        if computer.exists(&file) {
            return None;
        }
        let found = format!("[{}] in printer.cfg needs {file}, which does not exist", section.name);
        let is_it =
            |device: &&Device| device.is_chip_of(section) || section.kind() == "neopixel" && device.name == "ws2812";
        let remedy = match catalog.devices.iter().find(is_it) {
            Some(device) => format!("sudo pinion add {}{}", device.name, computer.root_option()),
            None => "enable its bus: pinion add lists what it knows".into(),
        };
        Some(Finding::error("device", found, remedy))
    };
    uses.all.iter().filter_map(finding).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    #[test]
    fn a_configured_device_without_its_bus_is_named_with_the_command_that_adds_it() {
        let tree = Tree::empty();
        tree.put("home/pi/printer.cfg", "[mcu host]\nserial: /tmp/klipper_host_mcu\n[mcu other]\nserial: /tmp/klipper_host_other\n[adxl345 elsewhere]\ncs_pin: other:None\nspi_bus: spidev1.0\n[adxl345 bed]\ncs_pin: host:None\nspi_bus: spidev0.1\n[temperature_sensor room]\nsensor_type: BME280\ni2c_mcu: host\ni2c_bus: i2c.1\n[lis2dw]\ncs_pin: host:None\nspi_bus: spidev0.0\n[tmc5160 stepper_x]\nspi_bus: spi1\n[temperature_sensor out]\nsensor_type: DS18B20\nserial_no: 28-0316a4f1ff27\n[neopixel strip]\npin: host:spidev9.0\n[sx1509 x]\ni2c_mcu: host\ni2c_bus: i2c.7\n");
        tree.put("dev/spidev0.0", "");
        let found = missing(&tree.computer(), &Uses::find(&tree.computer(), None, None, None));
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
