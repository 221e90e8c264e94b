// SPDX-License-Identifier: GPL-3.0-or-later
//! Asks the device, before anything is written to printer.cfg.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pinion_printer_config::Section;
use serde_json::json;

use crate::quietly;
use pinion_system::board::{Board, Kind, Slot};
use pinion_system::{Access, Computer};

use super::catalog::Check;
use super::command;
use super::printer::Target;
use super::probe::{self, Answer};
use super::work::Work;

/// How often a chip's driver is asked for a value.
const SAMPLES: usize = 8;

impl Work<'_> {
    /// Asks the device. Returns its I2C address.
    pub(super) fn check(&mut self, printer: Option<&Target>) -> Result<Option<u8>, String> {
        let node = self.node().to_owned();
        let mut checks = Vec::new();
        let path = format!("/dev/{node}");
        // Lines have no node of their own.
        if self.way.bus != Kind::Line
            && let Ok(about) = std::fs::metadata(self.computer.path(&path))
        {
            checks.push(format!("{path} is there"));
            if let Some(user) = self.computer.user("pinion")
                && !user.may(Access::READ_WRITE, &about)
            {
                checks.push(format!("Pinion's user may not open {path}: sudo pinion doctor says why"));
            }
        }
        checks.extend(strays(self.computer, self.board, &self.spot));
        let addresses = self.search.addresses(self.way, &self.spot);
        let asked = match (&self.way.check, self.way.driver.is_some()) {
            (Some(Check::W1), _) => match self.thermometer(printer) {
                Some(serial) => Ok(Answer { text: format!("the thermometer {serial} answers"), address: None }),
                None => {
                    Err("no DS18B20 answers: check its wires and the resistor of 4.7 kOhm from data to 3.3 V".into())
                }
            },
            (Some(Check::Iio { file, highest }), _) => self.sample(file, *highest),
            (Some(_), false) => match probe::Live::of(&node) {
                Some(mut live) => quietly(|| probe::ask(self.catalog, self.way, &addresses, &mut live)),
                None => Err(format!("{node} is not a bus")),
            },
            _ => Ok(Answer { text: "it cannot be asked: try it out".into(), address: None }),
        };
        checks.push(match &asked {
            Ok(answer) => format!("{}: {}", self.device.name, answer.text),
            Err(why) => format!("{}: {why}", self.device.name),
        });
        self.report.set("checks", json!(checks));
        checks.iter().for_each(|line| self.report.line(line));
        self.report.show()?;
        match asked {
            Ok(answer) => Ok(answer.address),
            Err(why) => Err(format!("{}: {why}: then run \"{}\" again", self.device.name, command(self.args, false))),
        }
    }

    /// Reads a value of the chip by its driver, which does not know whether the chip is there.
    fn sample(&self, file: &str, highest: u32) -> Result<Answer, String> {
        let folder = self.iio().ok_or("the chip's driver is gone: reboot")?;
        let path = self.computer.name(&folder.join(file));
        let read = |_| self.computer.text(&path)?.parse().ok();
        let values: Option<Vec<u32>> = (0..SAMPLES).map(read).collect();
        let values = values.ok_or_else(|| format!("{file} cannot be read"))?;
        judge(file, &values, highest).map(|text| Answer { text, address: None })
    }

    /// The folder of the device of the chip's driver.
    pub(super) fn iio(&self) -> Option<PathBuf> {
        let driver = self.way.driver.as_deref();
        let names = self.computer.matching("/sys/bus/iio/devices/iio:device*/name");
        let name = names.iter().find(|name| self.computer.text(self.computer.name(name)).as_deref() == driver)?;
        name.parent().map(Path::to_owned)
    }

    /// A thermometer that printer.cfg does not have yet.
    pub(super) fn thermometer(&self, printer: Option<&Target>) -> Option<String> {
        let own = printer.map(|printer| printer.file(&self.device.file(self.name())));
        let others = printer.zip(own.as_deref()).map(|(printer, own)| printer.others(own));
        // A section that is there already keeps its thermometer.
        let is_other = |section: &&Section| self.search.there.as_ref() != Some(&section.name);
        let known: BTreeSet<&str> =
            others.into_iter().flatten().filter(is_other).filter_map(|section| section.text("serial_no")).collect();
        let found = self.computer.matching("/sys/bus/w1/devices/28-*");
        let names = found.iter().filter_map(|path| path.file_name()?.to_str());
        let is_serial = |name: &&str| name.chars().all(|c| c.is_ascii_hexdigit() || c == '-');
        names.filter(is_serial).find(|name| !known.contains(name)).map(str::to_owned)
    }
}

/// The meaning of the values that a chip's driver has read.
fn judge(file: &str, values: &[u32], highest: u32) -> Result<String, String> {
    let least = values.iter().copied().min().unwrap_or_default();
    let most = values.iter().copied().max().unwrap_or_default();
    // A thermistor's voltage hardly changes between two reads, and a loose data wire is noise.
    match (least, most) {
        (_, 0) => Err(format!("{file} is 0: no power, DOUT is not connected, or the input touches ground")),
        _ if least >= highest => {
            Err(format!("{file} is {most}, the highest value: no ground, or nothing is connected at the input"))
        }
        _ if most - least > highest / 8 => Err(format!("{file} changes from {least} to {most}: a wire is loose")),
        _ => Ok(format!("{file} is {most} of {highest}")),
    }
}

/// The pins of the bus that are GPIO lines now: another program has switched them. A Raspberry Pi shows this to root.
fn strays(computer: &Computer, board: &Board, spot: &Slot) -> Vec<String> {
    let controllers = computer.matching("/sys/kernel/debug/pinctrl/*-pinctrl-*/pins");
    let is_header = |path: &&PathBuf| {
        let name = path.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
        ["bcm2835", "bcm2711", "rp1"].iter().any(|chip| name.ends_with(chip))
    };
    let text = controllers.iter().find(is_header).and_then(|path| computer.text(computer.name(path)));
    let text = text.unwrap_or_default();
    // The driver selects a chip by a line, and 1-Wire is bits on a line.
    let pins = spot.pins.iter().filter(|(role, _)| !["cs", "data"].contains(&role.as_str()));
    let stray = |(_, pin): (&String, &usize)| {
        let label = board.pins.get(pin - 1)?;
        let line: u32 = label.strip_prefix("GPIO")?.split(' ').next()?.parse().ok()?;
        // For example "pin 10 (gpio10) function gpio_out in hi; irq 0 (none)".
        let is_it = |text: &&str| text.starts_with(&format!("pin {line} ("));
        let function = text.lines().find(is_it)?.split_once(" function ")?.1.split(' ').next()?;
        function.starts_with("gpio").then(|| {
            format!(
                "pin {pin} ({label}) is a GPIO line now: another program has switched it: end that program, or reboot"
            )
        })
    };
    pins.filter_map(stray).collect()
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::tree::Tree;

    #[test]
    fn an_adc_that_is_not_there_is_known_by_its_values() {
        assert_eq!(judge("x", &[2000, 2040, 1990], 4095).unwrap(), "x is 2040 of 4095");
        assert_eq!(judge("x", &[0, 3], 4095).unwrap(), "x is 3 of 4095", "a cold thermistor");
        for (values, words) in [
            (&[0, 0][..], "x is 0: no power"),
            (&[4095, 4095], "x is 4095, the highest value"),
            (&[1000, 3000, 4095], "x changes from 1000 to 4095: a wire is loose"),
        ] {
            assert!(judge("x", values, 4095).unwrap_err().starts_with(words), "{values:?}");
        }
    }

    #[test]
    fn a_pin_of_the_bus_that_another_program_has_switched_is_named() {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B");
        // Pin controllers of other chips have pins of the same numbers.
        tree.put("sys/kernel/debug/pinctrl/107d504100.pinctrl-pinctrl-bcm2712/pins", "pin 11 (gpio11) function gpio\n");
        let pins = "registered pins: 58\n\
                    pin 8 (gpio8) function gpio_out in hi; irq 0 (none)\n\
                    pin 9 (gpio9) function alt0 in lo; irq 0 (none)\n\
                    pin 10 (gpio10) function gpio_in in lo; irq 0 (none)\n\
                    pin 11 (gpio11) function alt0 in lo; irq 0 (none)\n";
        tree.put("sys/kernel/debug/pinctrl/fe200000.gpio-pinctrl-bcm2711/pins", pins);
        let computer = tree.computer();
        let board = Board::of(&computer, None).unwrap().unwrap();
        let spot = board.bus[&Kind::Spi].spots().next().unwrap();
        let found = strays(&computer, &board, &spot);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].starts_with("pin 19 (GPIO10 MOSI) is a GPIO line now"), "{found:?}");
    }
}
