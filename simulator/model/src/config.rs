// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's description: TOML in, checked values out.

use serde::{Deserialize, Serialize};

use super::catalog::PartConfig;
use super::description::axes::{AxisConfig, BedConfig, CarriageConfig, DeltaConfig, Limits};
use super::description::boards::{Boards, McuConfig, UsedPins};
use super::description::buses::{I2cBusConfig, SpiBusConfig};
use super::description::check::{Trouble, no_name, wrong};
use super::description::heater::{FanConfig, HeaterConfig};
use super::description::kinematics::KinematicsConfig;
use super::description::outputs::{AnalogConfig, InputConfig, LedConfig, OutputConfig};
use super::description::pin::is_klippy_name;
use super::description::printer::Printer;
use super::part::workshop::{Part, Socket};

/// A simulated printer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// Seed of the sensors' noise: the same seed gives the same readings.
    #[serde(default)]
    pub seed: u64,
    /// The boards. Without this there is one, a Linux process.
    #[serde(default, rename = "mcu", skip_serializing_if = "Vec::is_empty")]
    pub mcus: Vec<McuConfig>,
    /// The limits of the motion in printer.cfg.
    #[serde(default)]
    pub limits: Limits,
    /// The axes; `x`, `y`, `z` and `extruder` make a cartesian printer.
    #[serde(default, rename = "axis")]
    pub axes: Vec<AxisConfig>,
    /// Rails without a motor of their own.
    #[serde(default, rename = "carriage")]
    pub carriages: Vec<CarriageConfig>,
    /// How the axes move the head.
    pub kinematics: Option<KinematicsConfig>,
    /// Whether the motors of x and y drive the two belts of a CoreXY printer.
    #[serde(default)]
    pub corexy: bool,
    /// The towers of a delta printer.
    pub delta: Option<DeltaConfig>,
    /// The heaters with their sensors.
    #[serde(default, rename = "heater")]
    pub heaters: Vec<HeaterConfig>,
    /// The fans.
    #[serde(default, rename = "fan")]
    pub fans: Vec<FanConfig>,
    /// Lights that the host may dim.
    #[serde(default, rename = "led")]
    pub leds: Vec<LedConfig>,
    /// Outputs for things that need no simulation.
    #[serde(default, rename = "output")]
    pub outputs: Vec<OutputConfig>,
    /// Inputs that stay at one level: buttons, a door.
    #[serde(default, rename = "input")]
    pub inputs: Vec<InputConfig>,
    /// Analog pins at a fixed level.
    #[serde(default, rename = "analog")]
    pub analogs: Vec<AnalogConfig>,
    /// The shape of the bed.
    #[serde(default)]
    pub bed: BedConfig,
    /// SPI buses.
    #[serde(default, rename = "spi_bus")]
    pub spi_buses: Vec<SpiBusConfig>,
    /// I2C buses.
    #[serde(default, rename = "i2c_bus")]
    pub i2c_buses: Vec<I2cBusConfig>,
    /// Chips, probes and other parts.
    #[serde(default, rename = "part")]
    pub parts: Vec<PartConfig>,
}

/// Highest number of parts. Each is compared with each.
const PARTS_MAX: usize = 1000;

/// The default printer's description. A test makes sure that it is valid.
const DEFAULT: &str = include_str!("default.toml");

impl SimConfig {
    /// The description of [`SimConfig::default_printer`], with comments: a start for a description of your own.
    pub const fn default_toml() -> &'static str {
        DEFAULT
    }

    /// A cartesian printer with a hot end, a heated bed, a fan, a light, filament sensors and chips.
    pub fn default_printer() -> SimConfig {
        match SimConfig::parse(DEFAULT, "the built-in printer") {
            Ok(config) => config,
            Err(error) => unreachable!("{error}"),
        }
    }

    /// Reads a description; `origin` is its name in an error.
    pub fn parse(text: &str, origin: &str) -> Result<SimConfig, Trouble> {
        let config: SimConfig = toml::from_str(text).map_err(|error| {
            let byte = error.span().map_or(0, |span| span.start);
            let trouble = Trouble::new(error.message().replace('\n', " ")).remedy("correct it");
            match key(text, byte) {
                Some(key) => trouble.of(format_args!("key `{key}`")),
                None => trouble,
            }
            .at(origin, text, byte)
        })?;
        config.validate().map_err(|trouble| trouble.of(origin))?;
        Ok(config)
    }

    /// Whether the motor of this axis moves more than the axis, for example a belt of a CoreXY printer. Alone it homes no
    /// axis.
    pub fn is_on_belts(&self, axis: &str) -> bool {
        self.printer().shares_belt(axis)
    }

    /// The description without its parts.
    pub(super) fn printer(&self) -> Printer<'_> {
        Printer {
            seed: self.seed,
            limits: &self.limits,
            axes: &self.axes,
            carriages: &self.carriages,
            chosen: self.kinematics.as_ref(),
            corexy: self.corexy,
            delta: self.delta.as_ref(),
            heaters: &self.heaters,
            fans: &self.fans,
            leds: &self.leds,
            outputs: &self.outputs,
            inputs: &self.inputs,
            analogs: &self.analogs,
            bed: &self.bed,
            spi_buses: &self.spi_buses,
            i2c_buses: &self.i2c_buses,
        }
    }

    /// Checks that the values make a printer.
    ///
    /// # Errors
    ///
    /// The first wrong value, with its key and a remedy.
    pub(super) fn validate(&self) -> Result<(), Trouble> {
        let printer = self.printer();
        let boards = Boards(&self.mcus);
        boards.validate()?;
        let mut pins = UsedPins::of(boards);
        for pin in self.mcus.iter().map(McuConfig::free_pins) {
            pin?.iter().try_for_each(|pin| pins.claim("[[mcu]]", "pins", Some(pin)))?;
        }
        printer.validate(&mut pins)?;
        if self.parts.len() > PARTS_MAX {
            let trouble = Trouble::new(format!("there are {} parts", self.parts.len()));
            return Err(trouble.remedy(format!("{PARTS_MAX} at most")));
        }
        self.parts.iter().try_for_each(|part| self.validate_part(part.part(), &printer, &mut pins))
    }

    /// Checks a part against the rest of the printer, and that its pins are free.
    fn validate_part(&self, part: &dyn Part, printer: &Printer<'_>, pins: &mut UsedPins) -> Result<(), Trouble> {
        let whose = &format!("part `{}`", part.name());
        if self.parts.iter().filter(|other| other.part().name() == part.name()).count() > 1 {
            return Err(Trouble::new("there are two with this name")
                .remedy("remove one, or give them different names")
                .of(whose));
        }
        part.pins().into_iter().try_for_each(|(key, pin)| pins.claim(whose, key, pin))?;
        part.uart_pins().into_iter().try_for_each(|(key, pin)| pins.claim_for(Some("UART"), whose, key, pin))?;
        for pin in part.select_pins() {
            pins.claim_for(Some("select line"), whose, "select_pins", Some(pin))?;
        }
        let socket = part.socket();
        let neighbours = self.parts.iter().map(PartConfig::part).filter(|other| other.name() != part.name());
        let mut neighbours = neighbours.filter_map(Part::socket);
        match socket {
            Some(Socket::Spi { bus, select_pin }) => {
                pins.claim_for(part.chain().map(|_| "chain"), whose, "select_pin", select_pin)?;
                printer.check_spi_bus(whose, bus)?;
                if select_pin.is_some_and(|pin| pin.inverted) {
                    let cause = "klippy knows chips that are selected by a low level only";
                    return wrong(whose, "select_pin", cause, "remove the `!`");
                }
                let shares = neighbours.any(|other| matches!(other, Socket::Spi { bus: its, .. } if its == bus));
                if select_pin.is_none() && shares {
                    return wrong(whose, "select_pin", "it is not the only chip on its bus", "add it");
                }
            }
            Some(Socket::I2c { bus, address }) => {
                printer.check_i2c_bus(whose, bus)?;
                if !(0x08..0x78).contains(&address) {
                    return wrong(whose, "address", &format!("{address} is not a 7-bit address"), "give 8 to 119");
                }
                if neighbours.any(|other| Some(other) == socket) {
                    return wrong(whose, "address", &format!("{address} is taken on this bus"), "give another");
                }
            }
            Some(Socket::Mosi { bus }) => printer.check_spi_bus(whose, bus)?,
            Some(Socket::Serial { port, address }) => {
                let shares = |other: &Socket<'_>| matches!(other, Socket::Serial { port: its, .. } if *its == port);
                let mut chips = self.parts.iter().map(PartConfig::part);
                let first = chips.find(|chip| chip.socket().as_ref().is_some_and(shares));
                // The chips of a port share its name.
                if first.is_some_and(|first| first.name() == part.name()) {
                    pins.claim(whose, "uart_port", Some(port))?;
                }
                if neighbours.any(|other| Some(other) == socket) {
                    return wrong(whose, "address", &format!("{address} is taken on this port"), "give another");
                }
            }
            None => {}
        }
        part.validate(whose, printer)?;
        // The description chose the text after the kind. It names a section of printer.cfg.
        let name = part.name();
        match name.split_once(' ') {
            Some((_, own)) if !is_klippy_name(own) => no_name(whose, own),
            _ => Ok(()),
        }
    }
}

/// The key with the value that contains the byte `at` of the text.
fn key(text: &str, at: usize) -> Option<&str> {
    let (keys, value) = text.get(..at)?.rsplit_once('=')?;
    // After a line break the byte belongs to the value only if the value is an unclosed list.
    let open = value.matches('[').count() > value.matches(']').count();
    let goes_on = value.trim_start().starts_with('[') && open;
    if value.contains('\n') && !goes_on {
        return None;
    }
    keys.trim_end().rsplit([' ', ',', '{', '\n', '\t']).next().filter(|key| is_klippy_name(key))
}

#[cfg(test)]
pub(super) mod tests;
