// SPDX-License-Identifier: GPL-3.0-or-later
//! The devices of this computer, as a search finds them.

#![forbid(unsafe_code)]

use std::path::Path;

use industrial_io::Context;

use pinion_firmware::trouble::Trouble;

use crate::places::{DEV, GPIO, IIO, PWM, TTY};
use crate::{adc, gpio, i2c, pwm, spi, uart};

/// The devices of this computer.
#[derive(Debug, Default)]
pub struct Inventory {
    /// GPIO chips.
    pub chips: Vec<gpio::Chip>,
    /// Numbers that a Raspberry Pi's header has had, and that no chip has now.
    pub vacant: Vec<u32>,
    /// ADCs.
    pub adcs: Vec<adc::IioDevice>,
    /// PWM chips.
    pub pwm: Vec<pwm::Chip>,
    /// SPI device nodes.
    pub spi: Vec<spi::Node>,
    /// Numbers of I2C buses.
    pub i2c: Vec<u32>,
    /// Serial ports.
    pub uarts: Vec<uart::Uart>,
    /// Each thing that exists but cannot be used.
    pub problems: Vec<Trouble>,
    /// libiio's view of this computer. `None` without IIO devices.
    pub context: Option<Context>,
}

impl Inventory {
    /// Looks for chips, ADCs and buses. A computer without any of them is no error.
    pub fn scan() -> Inventory {
        let (chips, problems) = gpio::scan(Path::new(DEV), Path::new(GPIO));
        let mut inventory = Inventory { problems, ..Inventory::around(Path::new("/"), chips) };
        match adc::context(Path::new(IIO)) {
            Ok(context) => {
                inventory.adcs = context.as_ref().map(adc::scan).unwrap_or_default();
                inventory.context = context;
            }
            Err(problem) => inventory.problems.push(problem),
        }
        inventory
    }

    /// These chips, and everything else from the files below `root`. ADCs are not among it.
    pub fn around(root: &Path, chips: Vec<gpio::Chip>) -> Inventory {
        let below = |path: &str| root.join(path.trim_start_matches('/'));
        let (dev, pwm, tty) = (below(DEV), below(PWM), below(TTY));
        Inventory {
            chips,
            vacant: gpio::vacant(&dev),
            pwm: pwm::scan(&pwm),
            spi: spi::scan(&dev),
            i2c: i2c::scan(&dev),
            uarts: uart::scan(&dev, &tty),
            ..Inventory::default()
        }
    }

    /// Opens the channel that the driver of `iio:device<device>` calls `id`, if it exists.
    pub fn adc(&self, device: u32, id: &str) -> Option<adc::ChannelReader> {
        adc::ChannelReader::open(self.context.as_ref()?, device, id)
    }

    /// The chip with the 40-pin header of a Raspberry Pi.
    pub fn header(&self) -> Option<&gpio::Chip> {
        let mut headers = self.chips.iter().filter(|chip| chip.is_header());
        headers.next().filter(|_| headers.next().is_none())
    }

    /// The header's chip, if `/dev/gpiochip<number>` is missing and some kernel gives the header this number. A pin with
    /// this number then means a line of the header.
    pub fn renumbered(&self, number: u32) -> Option<&gpio::Chip> {
        self.header().filter(|chip| chip.may_have_been(number) && self.vacant.contains(&number))
    }

    /// The names of a line by the [former](Inventory::renumbered) numbers of its chip.
    pub fn former_names(&self, chip: &gpio::Chip, offset: u32) -> Vec<String> {
        let former =
            self.vacant.iter().filter(|number| self.renumbered(**number).is_some_and(|it| it.number == chip.number));
        let names = former.flat_map(|number| {
            let full = format!("gpiochip{number}/gpio{offset}");
            if *number == 0 { vec![format!("gpio{offset}"), full] } else { vec![full] }
        });
        names.collect()
    }

    /// One line for people: each chip and ADC with the number of its lines or channels.
    pub fn describe(&self) -> String {
        let chips = self.chips.iter().map(|chip| {
            let lines = chip.lines.len();
            format!("gpiochip{} {} ({lines} lines)", chip.number, chip.label)
        });
        let adcs = self.adcs.iter().map(|adc| {
            let channels = adc.channels.len();
            format!("iio {} ({channels} channels)", adc.name)
        });
        let nodes: Vec<String> = self.spi.iter().map(spi::Node::to_string).collect();
        let buses: Vec<String> = self.i2c.iter().map(|bus| format!("i2c.{bus}")).collect();
        let (chips, adcs) = (chips.collect::<Vec<_>>().join(", "), adcs.collect::<Vec<_>>().join(", "));
        let ports: Vec<&str> = self.uarts.iter().map(|uart| uart.name.as_str()).collect();
        let parts = [chips, adcs, nodes.join(" "), buses.join(" "), ports.join(" ")];
        let parts: Vec<String> = parts.into_iter().filter(|part| !part.is_empty()).collect();
        match parts.is_empty() {
            true => "linux: no GPIO chip, ADC, SPI device, I2C bus or serial port was found".to_owned(),
            false => format!("linux: {}", parts.join("; ")),
        }
    }
}
