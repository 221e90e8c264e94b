// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's description: TOML in, checked values out.

#![forbid(unsafe_code)]

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::catalog::PartConfig;
use crate::description::thermistor::{NoThermistor, Thermistor};

mod axes;
mod validate;

pub(super) use axes::Kinematics;
pub use axes::{AxisConfig, DeltaConfig, End};
use validate::fault;
pub(super) use validate::{Bound, check, check_lights, wrong};

/// What is wrong with a description: one line with file, key, cause and remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SimError(String);

impl fmt::Display for SimError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for SimError {}

/// A pin as the description names it: `x_step`, or `!x_step` for an inverted one.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct PinName {
    /// The name that the board publishes.
    pub name: String,
    /// Whether a low level means on.
    pub inverted: bool,
}

impl TryFrom<String> for PinName {
    type Error = String;
    fn try_from(text: String) -> Result<PinName, String> {
        let (name, inverted) = match text.strip_prefix('!') {
            Some(name) => (name, true),
            None => (text.as_str(), false),
        };
        if is_word(name) {
            Ok(PinName { name: name.to_owned(), inverted })
        } else {
            Err(format!(
                "`{text}` is no pin name: use letters, digits, `_`, `-`, `.` and `/`, with `!` \
                 in front to invert"
            ))
        }
    }
}

impl fmt::Display for PinName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.inverted { "!" } else { "" })?;
        f.write_str(&self.name)
    }
}

/// Whether klippy takes `text` as the name of a pin or of a section.
fn is_word(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
}

/// A simulated printer.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// Seed of the sensors' noise: the same seed gives the same readings.
    #[serde(default)]
    pub seed: u64,
    /// The limits of the motion in printer.cfg.
    #[serde(default)]
    pub limits: Limits,
    /// The axes; `x`, `y`, `z` and `extruder` are those of a cartesian printer.
    #[serde(default, rename = "axis")]
    pub axes: Vec<AxisConfig>,
    /// The towers, if it is a delta printer.
    pub delta: Option<DeltaConfig>,
    /// The heaters with their sensors.
    #[serde(default, rename = "heater")]
    pub heaters: Vec<HeaterConfig>,
    /// The fans.
    #[serde(default, rename = "fan")]
    pub fans: Vec<FanConfig>,
    /// Lights, which the host may dim.
    #[serde(default, rename = "led")]
    pub leds: Vec<LedConfig>,
    /// Outputs that switch something that needs no simulation.
    #[serde(default, rename = "output")]
    pub outputs: Vec<OutputConfig>,
    /// Inputs that stay at one level: buttons, a door.
    #[serde(default, rename = "input")]
    pub inputs: Vec<InputConfig>,
    /// The shape of the bed.
    #[serde(default)]
    pub bed: BedConfig,
    /// SPI buses.
    #[serde(default, rename = "spi_bus")]
    pub spi_buses: Vec<SpiBusConfig>,
    /// I2C buses.
    #[serde(default, rename = "i2c_bus")]
    pub i2c_buses: Vec<I2cBusConfig>,
    /// Chips, probes and whatever else.
    #[serde(default, rename = "part")]
    pub parts: Vec<PartConfig>,
}

/// The limits of the motion in printer.cfg. The simulated axes themselves follow at any speed.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Highest speed of the head.
    pub velocity_mm_per_s: f64,
    /// Highest acceleration of the head.
    pub accel_mm_per_s2: f64,
    /// Highest speed of the z axis.
    pub z_velocity_mm_per_s: f64,
    /// Highest acceleration of the z axis.
    pub z_accel_mm_per_s2: f64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            velocity_mm_per_s: 300.0,
            accel_mm_per_s2: 3000.0,
            z_velocity_mm_per_s: 15.0,
            z_accel_mm_per_s2: 100.0,
        }
    }
}

/// A heater, the mass that it heats, and the thermistor in it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeaterConfig {
    /// Such as `extruder` or `heater_bed`.
    pub name: String,
    /// Power is on while this is high; always, if left out.
    pub pin: Option<PinName>,
    /// The ADC channel of the thermistor.
    pub sensor_pin: PinName,
    /// Power while on.
    pub heater_watts: f64,
    /// Heat capacity of the heated mass.
    pub heat_capacity_j_per_k: f64,
    /// Heat lost to the surroundings for each kelvin above them.
    pub loss_w_per_k: f64,
    /// Time constant with which the sensor follows the heated mass; 0 means at once.
    #[serde(default)]
    pub sensor_lag_s: f64,
    /// Temperature of the surroundings.
    #[serde(default = "default_ambient_celsius")]
    pub ambient_celsius: f64,
    /// Temperature at first. Without this it is that of the surroundings.
    pub start_celsius: Option<f64>,
    /// `min_temp` in printer.cfg: below this the host stops.
    #[serde(default)]
    pub min_celsius: f64,
    /// `max_temp` in printer.cfg: above this the host stops.
    pub max_celsius: f64,
    /// Standard deviation of a reading, in counts of the ADC.
    #[serde(default)]
    pub noise_counts: f64,
    /// Resistor from the ADC's input to its reference.
    #[serde(default = "default_pullup_ohm")]
    pub pullup_ohm: f64,
    /// The thermistor's resistance at one temperature (with `beta_k`) or at three.
    pub points_celsius_ohm: Vec<(f64, f64)>,
    /// The thermistor's beta.
    pub beta_k: Option<f64>,
}

fn default_ambient_celsius() -> f64 {
    25.0
}

fn default_pullup_ohm() -> f64 {
    4700.0
}

/// A fan that takes its time to spin up and down.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FanConfig {
    /// Such as `fan`, which is the part's cooling fan.
    pub name: String,
    /// Power is on while this is high.
    pub pin: PinName,
    /// A second pin that must be high, too, for the fan to have power.
    pub enable_pin: Option<PinName>,
    /// An input that is high for the first half of each pulse of the tachometer.
    pub tachometer_pin: Option<PinName>,
    /// Pulses of the tachometer in a revolution.
    #[serde(default = "default_pulses_per_revolution")]
    pub pulses_per_revolution: u32,
    /// Speed at full power.
    pub max_rpm: f64,
    /// Time constant with which the speed follows the power.
    #[serde(default = "default_spin_up_s")]
    pub spin_up_s: f64,
    /// The heater that it blows at.
    pub cools: Option<String>,
    /// What that loses while the fan has power, for each kelvin above the surroundings and beyond what it
    /// loses without.
    #[serde(default)]
    pub cooling_w_per_k: f64,
}

fn default_pulses_per_revolution() -> u32 {
    2
}

fn default_spin_up_s() -> f64 {
    0.5
}

/// A light of one to four colours.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LedConfig {
    /// Such as `light`.
    pub name: String,
    /// A light that is on while high; of one with colours, its white part.
    pub pin: Option<PinName>,
    /// Its red part.
    pub red_pin: Option<PinName>,
    /// Its green part.
    pub green_pin: Option<PinName>,
    /// Its blue part.
    pub blue_pin: Option<PinName>,
}

impl LedConfig {
    /// Its pins with their keys: red, green, blue, and white.
    pub(super) fn pins(&self) -> [(&'static str, Option<&PinName>); 4] {
        [
            ("red_pin", self.red_pin.as_ref()),
            ("green_pin", self.green_pin.as_ref()),
            ("blue_pin", self.blue_pin.as_ref()),
            ("pin", self.pin.as_ref()),
        ]
    }
}

/// An output that switches something that needs no simulation.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputConfig {
    /// Such as `light`.
    pub name: String,
    /// On while high.
    pub pin: PinName,
}

/// An input that stays at one level.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputConfig {
    /// Such as `door`.
    pub name: String,
    /// The input.
    pub pin: PinName,
    /// Whether it is on.
    pub level: bool,
}

/// An SPI bus.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpiBusConfig {
    /// The name that the board publishes, such as `spidev0.0`.
    pub name: String,
    /// How long each transfer takes.
    #[serde(default)]
    pub delay_us: u64,
    /// A file that gets a line for each transfer: the chips that were selected, the bytes both
    /// ways, the levels of `trace_pins` at each byte.
    pub trace_file: Option<PathBuf>,
    /// The pins of `[[led]]` and `[[output]]` whose levels are to be in the trace.
    #[serde(default)]
    pub trace_pins: Vec<String>,
}

/// An I2C bus.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct I2cBusConfig {
    /// The name that the board publishes, such as `i2c.1`.
    pub name: String,
    /// How long each transfer takes.
    #[serde(default)]
    pub delay_us: u64,
}

/// The shape of the bed; its middle is at 0.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BedConfig {
    /// How much higher it is at the end of the x axis than at its start.
    pub x_slope_mm: f64,
    /// How much higher it is at the end of the y axis than at its start.
    pub y_slope_mm: f64,
    /// How much lower it is at the corners than in the middle.
    pub bow_mm: f64,
}

/// The default printer's description. A test makes sure that it is valid.
const DEFAULT: &str = include_str!("default.toml");

impl SimConfig {
    /// The description of [`SimConfig::default_printer`], with comments: a start for one's own.
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

    /// Reads a description from a file.
    pub fn load(path: &Path) -> Result<SimConfig, SimError> {
        let file = path.display();
        let text = fs::read_to_string(path).map_err(|error| {
            SimError(format!(
                "{file}: {error}: name a readable TOML file, or take `--board sim` for the \
                 built-in printer"
            ))
        })?;
        SimConfig::parse(&text, &file.to_string())
    }

    /// Reads a description; `origin` is how an error calls it.
    pub fn parse(text: &str, origin: &str) -> Result<SimConfig, SimError> {
        let config: SimConfig = toml::from_str(text).map_err(|error| {
            let (line, key) = place(text, error.span().map_or(0, |span| span.start));
            let key = key.map_or_else(String::new, |key| format!(", key `{key}`"));
            let cause = error.message().replace('\n', " ");
            SimError(format!("{origin} line {line}{key}: {cause}: correct it"))
        })?;
        config.validate().map_err(|SimError(cause)| SimError(format!("{origin}: {cause}")))?;
        Ok(config)
    }

    /// The pins of all lights and other outputs.
    pub(super) fn switched(&self) -> impl Iterator<Item = &PinName> {
        let leds = self.leds.iter().flat_map(|led| led.pins().into_iter().filter_map(|(_, pin)| pin));
        leds.chain(self.outputs.iter().map(|output| &output.pin))
    }

    /// The fan that cools a heater, if there is one.
    pub(super) fn fan_of(&self, heater: &str) -> Option<&FanConfig> {
        self.fans.iter().find(|fan| fan.cools.as_deref() == Some(heater))
    }
}

impl SpiBusConfig {
    /// Its data output as a pin, which has the bus's own name, as on a Linux board.
    pub(super) fn mosi_pin(&self) -> PinName {
        PinName { name: self.name.clone(), inverted: false }
    }

    /// The error of a `trace_file` that can not be made.
    pub(super) fn no_trace_file(&self, error: &std::io::Error) -> SimError {
        fault(
            &format!("spi_bus `{}`", self.name),
            "trace_file",
            &format!("it can not be made: {error}"),
            "name a file in a folder that may be written",
        )
    }
}

impl HeaterConfig {
    /// The temperature at first, in °C.
    pub(super) fn start_celsius(&self) -> f64 {
        self.start_celsius.unwrap_or(self.ambient_celsius)
    }

    /// The thermistor that these points and this beta describe.
    ///
    /// # Errors
    ///
    /// The key whose values no thermistor has, and a remedy.
    pub(super) fn thermistor(&self) -> Result<Thermistor, SimError> {
        const POINTS: &str = "points_celsius_ohm";
        Thermistor::new(&self.points_celsius_ohm, self.beta_k, self.pullup_ohm).map_err(|why| {
            let (key, cause, remedy) = match why {
                NoThermistor::PointOutOfRange => {
                    (POINTS, "kelvins and resistances are above zero", "take the points from the data sheet")
                }
                NoThermistor::BetaOutOfRange => ("beta_k", "a beta is above zero", "such as 3950.0"),
                NoThermistor::BetaMissing => ("beta_k", "one point needs a beta", "add it, or three points"),
                NoThermistor::PointsBesideBeta => (POINTS, "with `beta_k` there is one point", "keep one"),
                NoThermistor::PointCount => {
                    (POINTS, "none, two or more than three points", "give three, or one and `beta_k`")
                }
                NoThermistor::PointsOnNoCurve => {
                    (POINTS, "no thermistor has these three", "take others from the data sheet, or one and `beta_k`")
                }
            };
            fault(&format!("heater `{}`", self.name), key, cause, remedy)
        })
    }
}

/// The number of the line that has the byte `at` of the text, and the key whose value is there.
fn place(text: &str, at: usize) -> (usize, Option<&str>) {
    let before = text.get(..at).unwrap_or(text);
    let line = before.matches('\n').count() + 1;
    let key = before.rsplit_once('=').and_then(|(keys, value)| {
        // If lines lie between the key and that byte, it belongs to the value only if that is a list
        // which is not closed yet.
        let open = value.matches('[').count() > value.matches(']').count();
        let goes_on = value.trim_start().starts_with('[') && open;
        if value.contains('\n') && !goes_on {
            return None;
        }
        keys.trim_end().rsplit([' ', ',', '{', '\n', '\t']).next().filter(|key| is_word(key))
    });
    (line, key)
}

#[cfg(test)]
pub(super) mod tests;
