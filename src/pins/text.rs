// SPDX-License-Identifier: GPL-3.0-or-later
//! The list as tables.

use std::iter;

use crate::page::{Page, aligned};

use super::{
    AdcChannel, AdcDevice, GpioChip, GpioLine, I2cEntry, List, PwmEntry, PwmLine, SerialEntry, SpiDevice, W1Sensor,
};

impl List {
    pub(super) fn page(&self) -> Page {
        let gpio = self.gpio.iter().map(gpio_section);
        let adc = self.adc.iter().map(adc_section);
        let pwm = self.pwm.iter().map(pwm_section);
        let buses = [spi_section(&self.spi), i2c_section(&self.i2c), w1_section(&self.w1)];
        let sections = gpio.chain(adc).chain(pwm).chain(buses).chain([serial_section(&self.serial)]);
        let mut page = Page::default();
        for section in sections.filter(|section| !section.is_empty()) {
            if !page.is_empty() {
                page.line("");
            }
            page.append(&section);
        }
        page
    }
}

/// A heading and a table. Nothing if there are no rows.
fn section(heading: &str, titles: &[&str], rows: &[Vec<String>]) -> Page {
    let mut page = Page::default();
    if rows.is_empty() {
        return page;
    }
    page.line(heading);
    let titles = titles.iter().map(|title| (*title).to_owned()).collect();
    let rows: Vec<Vec<String>> = iter::once(titles).chain(rows.iter().cloned()).collect();
    aligned(&rows).iter().for_each(|line| page.line(format_args!("  {line}")));
    page
}

/// Cuts a text to 20 characters, so that a row fits into 100 columns.
fn cut(text: &str) -> String {
    match text.char_indices().nth(20) {
        Some(_) => text.chars().take(19).chain(['…']).collect(),
        None => text.to_owned(),
    }
}

fn gpio_section(chip: &GpioChip) -> Page {
    let row = |line: &GpioLine| {
        vec![
            line.line.to_string(),
            cut(line.name.as_deref().unwrap_or("-")),
            line.direction.to_owned(),
            cut(line.used_by()),
            // The heading says what the other names look like.
            line.pins[..line.pins.len().min(2)].join(", "),
        ]
    };
    let rows: Vec<Vec<String>> = chip.lines.iter().map(row).collect();
    let way = match &chip.fast {
        _ if chip.behind_bus => ", behind a bus: not for steps or other timed edges".to_owned(),
        Some(node) => format!(", fast (registers, {node}), for LEDs too"),
        None => String::new(),
    };
    let heading = format!("{} {}, {} lines{way}", chip.chip, chip.label, chip.line_count);
    section(&heading, &["line", "name", "dir", "used by", "in printer.cfg"], &rows)
}

fn adc_section(device: &AdcDevice) -> Page {
    let row = |channel: &AdcChannel| {
        vec![
            channel.channel.clone(),
            channel.resolution.clone().unwrap_or_else(|| "12 bits assumed".into()),
            channel.reading.to_string(),
            channel.pins.join(", "),
        ]
    };
    let rows: Vec<Vec<String>> = device.channels.iter().map(row).collect();
    let heading = format!("{} {}, {} channels", device.device, device.name, device.channel_count);
    section(&heading, &["channel", "resolution", "reads", "in printer.cfg"], &rows)
}

fn pwm_section(chip: &PwmEntry) -> Page {
    let row = |line: &PwmLine| {
        let used_by = match (&line.consumer, line.exported) {
            (Some(consumer), _) if consumer == "sysfs" => "a program",
            (Some(consumer), _) => consumer,
            (None, true) => "exported",
            (None, false) => "free",
        };
        let pin = match line.pins.is_empty() {
            true => "-".to_owned(),
            false => format!("pin: {}, with hardware_pwm: True", line.pins.join(" or ")),
        };
        vec![line.channel.to_string(), cut(used_by), pin]
    };
    let rows: Vec<Vec<String>> = chip.channels.iter().map(row).collect();
    let heading = format!("{}{}", chip.chip, chip.device.as_ref().map_or(String::new(), |device| format!(" {device}")));
    section(&heading, &["channel", "used by", "in printer.cfg"], &rows)
}

fn spi_section(devices: &[SpiDevice]) -> Page {
    let row = |SpiDevice { device, spi_bus }: &SpiDevice| {
        let use_ = format!("spi_bus: {spi_bus}, for LEDs pin: {spi_bus}, for an HX711 dout_pin: {spi_bus}/miso");
        vec![device.clone(), use_]
    };
    section("SPI", &["device", "in printer.cfg"], &devices.iter().map(row).collect::<Vec<_>>())
}

fn i2c_section(buses: &[I2cEntry]) -> Page {
    let row = |bus: &I2cEntry| {
        let taken = bus.chips.iter().filter_map(|chip| {
            let driver = chip.driver.as_ref()?;
            Some(format!("{:#04x} {} by {driver}", chip.address, chip.name))
        });
        let taken: Vec<String> = taken.collect();
        let taken = if taken.is_empty() { "-".to_owned() } else { taken.join(", ") };
        let adapter = cut(bus.adapter.as_deref().unwrap_or("-"));
        vec![bus.device.clone(), adapter, taken, format!("i2c_bus: {}", bus.i2c_bus)]
    };
    let rows: Vec<Vec<String>> = buses.iter().map(row).collect();
    section("I2C", &["device", "adapter", "used by the kernel", "in printer.cfg"], &rows)
}

fn w1_section(sensors: &[W1Sensor]) -> Page {
    let row = |W1Sensor { serial_no }: &W1Sensor| {
        vec![serial_no.clone(), format!("sensor_type: DS18B20, with serial_no: {serial_no}")]
    };
    section("1-Wire", &["sensor", "in printer.cfg"], &sensors.iter().map(row).collect::<Vec<_>>())
}

fn serial_section(ports: &[SerialEntry]) -> Page {
    let row = |port: &SerialEntry| {
        let use_ = match port.console {
            true => "none: the kernel writes its messages there".to_owned(),
            false => {
                let names: Vec<&str> =
                    iter::once(&port.uart_pin).chain(&port.links).map(String::as_str).take(2).collect();
                format!("for TMC drivers uart_pin: {}", names.join(", or "))
            }
        };
        vec![port.device.clone(), use_]
    };
    section("Serial ports", &["device", "in printer.cfg"], &ports.iter().map(row).collect::<Vec<_>>())
}
