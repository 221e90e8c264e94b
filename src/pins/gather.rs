// SPDX-License-Identifier: GPL-3.0-or-later
//! The wanted part of everything that was found.

use pinion_linux::Inventory;
use pinion_linux::adc::IioDevice;
use pinion_linux::gpio::Chip;
use pinion_linux::pins::{Names, channel_number, line_number, pwm_number};
use pinion_linux::spi::Node;
use pinion_linux::sysfs::{I2cBus, I2cChip, PwmChip, Sysfs};
use pinion_linux::uart::Uart;

use super::{
    AdcChannel, AdcDevice, GpioChip, GpioLine, I2cDevice, I2cEntry, List, PinsArgs, PwmEntry, PwmLine, Reading,
    SerialEntry, SpiDevice, W1Sensor,
};

impl List {
    /// The wanted part of everything that was found. `reading` reads a channel (its driver's name) of a device (its
    /// number). `fast` returns the node of a chip's registers.
    pub(super) fn new(
        inventory: &Inventory,
        sysfs: &Sysfs,
        args: &PinsArgs,
        reading: &dyn Fn(u32, &str) -> Reading,
        fast: &dyn Fn(&Chip) -> Option<String>,
    ) -> List {
        let names = Names::of(inventory);
        let mut list = List {
            gpio: inventory
                .chips
                .iter()
                .map(|chip| GpioChip { fast: fast(chip), ..gpio(chip, inventory, sysfs, &names, args) })
                .collect(),
            adc: vec![],
            pwm: vec![],
            spi: vec![],
            i2c: vec![],
            w1: vec![],
            serial: vec![],
            problems: inventory.problems.iter().map(ToString::to_string).collect(),
        };
        if !args.free {
            list.adc = inventory.adcs.iter().map(|device| adc(device, &names, args, reading)).collect();
            list.pwm = sysfs.pwm.iter().map(|chip| pwm(chip, &names, args)).collect();
            list.spi = inventory.spi.iter().filter_map(|node| spi(*node, args)).collect();
            list.i2c = sysfs.i2c.iter().filter_map(|bus| i2c(bus, args)).collect();
            let sensors = sysfs.thermometers.iter().filter(|serial| wanted(args, [serial.as_str(), "w1", "ds18b20"]));
            list.w1 = sensors.map(|serial| W1Sensor { serial_no: serial.clone() }).collect();
            list.serial = inventory.uarts.iter().filter_map(|uart| serial(uart, args)).collect();
        }
        list.gpio.retain(|chip| !chip.lines.is_empty());
        list.adc.retain(|device| !device.channels.is_empty());
        list.pwm.retain(|chip| !chip.channels.is_empty());
        list
    }
}

/// Whether the filter of the command line is part of any of the names.
fn wanted<'a>(args: &PinsArgs, names: impl IntoIterator<Item = &'a str>) -> bool {
    let Some(filter) = &args.filter else {
        return true;
    };
    let filter = filter.to_lowercase();
    names.into_iter().any(|name| name.to_lowercase().contains(&filter))
}

fn gpio(chip: &Chip, inventory: &Inventory, sysfs: &Sysfs, names: &Names, args: &PinsArgs) -> GpioChip {
    let path = format!("gpiochip{}", chip.number);
    let mut lines = Vec::new();
    for (offset, line) in (0..).zip(&chip.lines) {
        let number = line_number(chip.number, offset);
        let full = format!("{path}/gpio{offset}");
        let numbered = match number {
            // The lines of gpiochip0 have the short names.
            Some(number) if number == offset => format!("gpio{offset}"),
            _ => full.clone(),
        };
        let mut pins = number.map_or_else(Vec::new, |n| names.of_pin(n));
        pins.retain(|name| *name != numbered);
        let mut pins: Vec<String> = pins.into_iter().map(str::to_owned).collect();
        // The numeric name comes second. The first name is the line's own, if it has one.
        pins.insert(pins.len().min(1), numbered);
        pins.extend(inventory.former_names(chip, offset));
        let line = GpioLine {
            line: offset,
            name: line.name.clone(),
            direction: if line.output { "out" } else { "in" },
            held: line.held,
            consumer: line.consumer.clone(),
            device: sysfs.devices.get(&(chip.label.clone(), offset)).cloned(),
            pins,
        };
        let known = [full.as_str(), &chip.label].into_iter().chain(line.name.as_deref());
        let known = known.chain(line.pins.iter().map(String::as_str));
        if wanted(args, known) && (line.is_free() || !args.free) {
            lines.push(line);
        }
    }
    GpioChip {
        chip: path,
        label: chip.label.clone(),
        line_count: chip.lines.len(),
        behind_bus: chip.sleeps,
        fast: None,
        lines,
    }
}

fn adc(device: &IioDevice, names: &Names, args: &PinsArgs, reading: &dyn Fn(u32, &str) -> Reading) -> AdcDevice {
    let mut channels = Vec::new();
    for (position, channel) in device.channels.iter().enumerate() {
        let number = channel_number(device.number, position, &channel.id);
        let mut pins: Vec<String> =
            number.map_or_else(Vec::new, |n| names.of_pin(n)).into_iter().map(str::to_owned).collect();
        if let (0, Some(n)) = (device.number, channel.id.strip_prefix("voltage"))
            && n.parse::<u32>().is_ok_and(|n| n < 8)
        {
            pins.push(format!("analog{n}"));
        }
        // The name iioN/voltageM is shown only for devices that share their other name.
        if pins.len() > 1 {
            pins.retain(|name| !name.starts_with(&format!("iio{}/", device.number)));
        }
        let known = [device.name.as_str(), &channel.id];
        if wanted(args, known.into_iter().chain(pins.iter().map(String::as_str))) {
            channels.push(AdcChannel {
                channel: channel.id.clone(),
                resolution: channel.format.map(|format| format.to_string()),
                reading: reading(device.number, &channel.id),
                pins,
            });
        }
    }
    AdcDevice {
        device: format!("iio:device{}", device.number),
        name: device.name.clone(),
        channel_count: device.channels.len(),
        channels,
    }
}

fn pwm(chip: &PwmChip, names: &Names, args: &PinsArgs) -> PwmEntry {
    let name = format!("pwmchip{}", chip.number);
    let mut channels = Vec::new();
    for (channel, found) in (0..).zip(&chip.channels) {
        let full = format!("{name}/pwm{channel}");
        let number = pwm_number(chip.number, channel);
        let mut pins: Vec<String> =
            number.map_or_else(Vec::new, |n| names.of_pin(n)).into_iter().map(str::to_owned).collect();
        pins.extend(number.map(|_| full.clone()));
        if wanted(
            args,
            [full.as_str()].into_iter().chain(chip.device.as_deref()).chain(pins.iter().map(String::as_str)),
        ) {
            channels.push(PwmLine {
                channel,
                exported: found.exported,
                consumer: found.consumer.clone(),
                pin: number.map(|_| full),
                pins,
            });
        }
    }
    PwmEntry { chip: name, device: chip.device.clone(), channels }
}

fn spi(node: Node, args: &PinsArgs) -> Option<SpiDevice> {
    let name = node.to_string();
    wanted(args, [name.as_str(), "spi"]).then(|| SpiDevice { device: format!("/dev/{name}"), spi_bus: name })
}

fn i2c(bus: &I2cBus, args: &PinsArgs) -> Option<I2cEntry> {
    let (device, i2c_bus) = (format!("/dev/i2c-{}", bus.number), format!("i2c.{}", bus.number));
    let names = [device.as_str(), &i2c_bus].into_iter().chain(bus.adapter.as_deref());
    let chip = |I2cChip { address, name, driver }: &I2cChip| I2cDevice {
        address: *address,
        name: name.clone(),
        driver: driver.clone(),
    };
    wanted(args, names.chain(bus.chips.iter().map(|chip| chip.name.as_str()))).then(|| I2cEntry {
        adapter: bus.adapter.clone(),
        chips: bus.chips.iter().map(chip).collect(),
        i2c_bus,
        device,
    })
}

fn serial(uart: &Uart, args: &PinsArgs) -> Option<SerialEntry> {
    let names = [uart.name.as_str(), "serial", "uart"].into_iter().chain(uart.links.iter().map(String::as_str));
    wanted(args, names).then(|| SerialEntry {
        device: format!("/dev/{}", uart.name),
        console: uart.is_console,
        uart_pin: uart.name.clone(),
        links: uart.links.clone(),
    })
}
