// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion pins`: the pins and buses of this computer, and how to write them in printer.cfg.

#![forbid(unsafe_code)]

use std::fmt::Write as _;
use std::process::ExitCode;

use clap::Args;

use crate::board::linux::Inventory;
use crate::board::linux::adc::IioDevice;
use crate::board::linux::gpio::{Chip, LineInfo};
use crate::board::linux::pins::{Names, channel_number, line_number};
use crate::board::linux::spi::Node;

use super::{failed, print};

/// Options of `pinion pins`.
#[derive(Args, Clone, Debug, Default)]
pub(super) struct PinsArgs {
    /// Show only GPIO lines that nobody holds
    #[arg(long)]
    pub free: bool,
    /// Show only what has this in a name, in any case (such as gpio17, pinctrl, voltage)
    #[arg(value_name = "NAME")]
    pub filter: Option<String>,
}

/// Prints the list.
pub(super) fn run(args: &PinsArgs) -> ExitCode {
    let inventory = Inventory::scan();
    let list = list(&inventory, args, &|device, id| reading(&inventory, device, id));
    for problem in &inventory.problems {
        log::warn!("{problem}");
    }
    if list.is_empty() {
        return failed(nothing(args));
    }
    print(&list).map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn nothing(args: &PinsArgs) -> String {
    match &args.filter {
        Some(filter) => format!("nothing here has \"{filter}\" in a name: pinion pins lists all"),
        None if args.free => "no GPIO line is free: pinion pins lists who holds them".to_owned(),
        None => "no GPIO chip, ADC or SPI device is to be seen: enable them in the device tree, \
                 or try \"pinion run --board sim\""
            .to_owned(),
    }
}

/// What a channel reads now, as text.
fn reading(inventory: &Inventory, device: u32, id: &str) -> String {
    let Some(reader) = inventory.adc(device, id) else {
        return "gone".to_owned();
    };
    match (reader.read_raw(), reader.read_counts()) {
        (Ok(raw), Ok(scaled)) => format!("{raw} ({scaled} of 4095)"),
        (Err(error), _) => error.to_string(),
        (_, Err(shutdown)) => shutdown.to_string(),
    }
}

/// The whole list. `reading` returns what a channel (its driver's name) of a device (its number) reads.
fn list(inventory: &Inventory, args: &PinsArgs, reading: &dyn Fn(u32, &str) -> String) -> String {
    let names = Names::of(inventory);
    let mut sections: Vec<String> = inventory.chips.iter().map(|chip| chip_section(chip, &names, args)).collect();
    if !args.free {
        let adcs = inventory.adcs.iter();
        sections.extend(adcs.map(|adc| adc_section(adc, &names, args, reading)));
        sections.push(spi_section(&inventory.spi, args));
    }
    sections.retain(|section| !section.is_empty());
    sections.join("\n")
}

/// Whether the filter of the command line is part of any of the names.
fn wanted<'a>(args: &PinsArgs, names: impl IntoIterator<Item = &'a str>) -> bool {
    let Some(filter) = &args.filter else {
        return true;
    };
    let filter = filter.to_lowercase();
    names.into_iter().any(|name| name.to_lowercase().contains(&filter))
}

/// A heading and a table; nothing if there are no rows.
fn section(heading: &str, titles: &[&str], rows: &[Vec<String>]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        let title = titles.get(column).map_or(0, |title| title.chars().count());
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0).max(title)
    };
    let widths: Vec<usize> = (0..titles.len()).map(width).collect();
    let mut text = format!("{heading}\n");
    let titles = titles.iter().map(|title| (*title).to_owned()).collect();
    for row in std::iter::once(&titles).chain(rows) {
        let mut line = String::new();
        for (cell, width) in row.iter().zip(&widths) {
            // Writing to a String does not fail.
            let _ = write!(line, "  {cell:width$}");
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

fn chip_section(chip: &Chip, names: &Names, args: &PinsArgs) -> String {
    let path = format!("gpiochip{}", chip.number);
    let row = |(offset, line): (u32, &LineInfo)| {
        let number = line_number(chip.number, offset);
        let numbered = match number {
            // The lines of gpiochip0 have the short names.
            Some(number) if number == offset => format!("gpio{offset}"),
            _ => format!("{path}/gpio{offset}"),
        };
        let mut named = number.map_or_else(Vec::new, |n| names.of_pin(n));
        named.retain(|name| *name != numbered);
        let full = format!("{path}/gpio{offset}");
        let known = [numbered.as_str(), &full, &chip.label];
        let known = known.into_iter().chain(line.name.as_deref()).chain(named.iter().copied());
        if args.free && line.held || !wanted(args, known) {
            return None;
        }
        // The first name, which is the line's own if it has one, and the numeric one. What the others
        // look like is said in the heading.
        let write = match named.first() {
            Some(name) => format!("{name}, {numbered}"),
            None => numbered,
        };
        Some(vec![
            offset.to_string(),
            cut(line.name.as_deref().unwrap_or("-")),
            if line.output { "out" } else { "in" }.into(),
            cut(holder(line)),
            write,
        ])
    };
    let rows: Vec<Vec<String>> = (0..).zip(&chip.lines).filter_map(row).collect();
    let behind = if chip.sleeps { ", behind a bus: not for steps or other timed edges" } else { "" };
    let heading = format!("{path} {}, {} lines{behind}", chip.label, chip.lines.len());
    section(&heading, &["line", "name", "dir", "held by", "in printer.cfg"], &rows)
}

fn holder(line: &LineInfo) -> &str {
    match &line.consumer {
        _ if !line.held => "free",
        Some(consumer) => consumer,
        None => "the kernel",
    }
}

/// Cuts a text to 20 characters, so that a row fits into 100 columns.
fn cut(text: &str) -> String {
    match text.char_indices().nth(20) {
        Some(_) => text.chars().take(19).chain(['…']).collect(),
        None => text.to_owned(),
    }
}

fn adc_section(adc: &IioDevice, names: &Names, args: &PinsArgs, reading: &dyn Fn(u32, &str) -> String) -> String {
    let mut rows = Vec::new();
    for (position, channel) in adc.channels.iter().enumerate() {
        let number = channel_number(adc.number, position, &channel.id);
        let mut named: Vec<String> =
            number.map_or_else(Vec::new, |n| names.of_pin(n)).into_iter().map(str::to_owned).collect();
        if let (0, Some(n)) = (adc.number, channel.id.strip_prefix("voltage"))
            && n.parse::<u32>().is_ok_and(|n| n < 8)
        {
            named.push(format!("analog{n}"));
        }
        // The name iioN/voltageM is shown only for devices that share their other name.
        if named.len() > 1 {
            named.retain(|name| !name.starts_with(&format!("iio{}/", adc.number)));
        }
        let known = [adc.name.as_str(), &channel.id];
        if !wanted(args, known.into_iter().chain(named.iter().map(String::as_str))) {
            continue;
        }
        rows.push(vec![
            channel.id.clone(),
            channel.format.map_or_else(|| "12 bits assumed".into(), |format| format.to_string()),
            reading(adc.number, &channel.id),
            named.join(", "),
        ]);
    }
    let heading = format!("iio:device{} {}, {} channels", adc.number, adc.name, adc.channels.len());
    section(&heading, &["channel", "resolution", "reads", "in printer.cfg"], &rows)
}

fn spi_section(nodes: &[Node], args: &PinsArgs) -> String {
    let rows: Vec<Vec<String>> = nodes
        .iter()
        .map(Node::to_string)
        .filter(|name| wanted(args, [name.as_str(), "spi"]))
        .map(|name| vec![format!("/dev/{name}"), format!("spi_bus: {name}, or for LEDs pin: {name}")])
        .collect();
    section("SPI", &["device", "in printer.cfg"], &rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::linux::adc::{Channel, Format};

    fn pi() -> Inventory {
        let line = |name: &str, consumer: Option<&str>, held| LineInfo {
            name: Some(name.into()),
            output: consumer.is_some(),
            held,
            consumer: consumer.map(str::to_owned),
        };
        Inventory {
            chips: vec![Chip {
                number: 0,
                label: "pinctrl-bcm2835".into(),
                sleeps: false,
                lines: vec![
                    line("ID_SDA", None, false),
                    line("-", None, false),
                    line("SPI_CE1_N", Some("spi0 CS1"), true),
                ],
            }],
            adcs: vec![IioDevice {
                number: 0,
                name: "ads1115".into(),
                label: None,
                channels: vec![
                    Channel { id: "voltage0".into(), format: Format::new(16, true) },
                    Channel { id: "voltage0-voltage1".into(), format: None },
                ],
            }],
            spi: vec![Node::of(1)],
            ..Inventory::default()
        }
    }

    fn printed(args: &PinsArgs) -> String {
        list(&pi(), args, &|_, _| "1200 (150 of 4095)".into())
    }

    fn filtered(filter: &str) -> String {
        printed(&PinsArgs { free: false, filter: Some(filter.into()) })
    }

    #[test]
    fn everything_is_listed() {
        assert_eq!(
            printed(&PinsArgs::default()),
            "\
gpiochip0 pinctrl-bcm2835, 3 lines
  line  name       dir  held by   in printer.cfg
  0     ID_SDA     in   free      ID_SDA, gpio0
  1     -          in   free      pinctrl-bcm2835/gpio1, gpio1
  2     SPI_CE1_N  out  spi0 CS1  SPI_CE1_N, gpio2

iio:device0 ads1115, 2 channels
  channel            resolution       reads               in printer.cfg
  voltage0           signed 16 bits   1200 (150 of 4095)  ads1115/voltage0, analog0
  voltage0-voltage1  12 bits assumed  1200 (150 of 4095)  ads1115/voltage0-voltage1

SPI
  device          in printer.cfg
  /dev/spidev0.1  spi_bus: spidev0.1, or for LEDs pin: spidev0.1
"
        );
    }

    #[test]
    fn a_chip_behind_a_bus_says_what_it_is_no_good_for() {
        let mut inventory = pi();
        inventory.chips[0].sleeps = true;
        let list = list(&inventory, &PinsArgs::default(), &|_, _| String::new());
        assert!(list.starts_with("gpiochip0 pinctrl-bcm2835, 3 lines, behind a bus: not for steps"), "{list}");
    }

    #[test]
    fn free_lines_only() {
        let free = printed(&PinsArgs { free: true, filter: None });
        assert!(free.contains("ID_SDA") && !free.contains("SPI"), "{free}");
    }

    #[test]
    fn a_filter_finds_any_of_the_names() {
        for filter in ["id_sda", "gpio0", "gpiochip0/gpio0", "bcm2835/gpio0"] {
            let list = filtered(filter);
            assert!(list.contains("ID_SDA") && !list.contains("SPI_CE1"), "{filter}: {list}");
        }
        assert!(filtered("analog0").contains("voltage0"));
        assert!(filtered("spidev0.1").starts_with("SPI"));
        assert_eq!(filtered("nonesuch"), "");
    }
}
