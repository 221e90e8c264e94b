// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's description: TOML in, checked values out.

#![forbid(unsafe_code)]

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::part::PartConfig;
use super::thermistor::{NoThermistor, Thermistor};

mod validate;

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
    /// The heaters with their sensors.
    #[serde(default, rename = "heater")]
    pub heaters: Vec<HeaterConfig>,
    /// The fans.
    #[serde(default, rename = "fan")]
    pub fans: Vec<FanConfig>,
    /// Lights, which the host may dim.
    #[serde(default, rename = "led")]
    pub leds: Vec<OutputConfig>,
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

/// The end of an axis at which its endstop sits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum End {
    /// At 0 mm.
    Min,
    /// At `travel_mm`.
    Max,
}

/// A stepper motor and what it moves.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisConfig {
    /// Such as `x`.
    pub name: String,
    /// The step pin. Each rising edge is a step.
    pub step_pin: PinName,
    /// The direction pin. While it is high, steps count up.
    pub dir_pin: PinName,
    /// The motor is held, and steps, only while this is high. Without this pin it always is.
    pub enable_pin: Option<PinName>,
    /// Whether the falling edge of the step pin is a step too.
    #[serde(default)]
    pub step_both_edges: bool,
    /// Steps in a millimetre.
    pub steps_per_mm: f64,
    /// Microsteps in a full step, for printer.cfg. The motor has 200 full steps in a turn.
    #[serde(default = "default_microsteps")]
    pub microsteps: u32,
    /// The axis goes from 0 to here. Without this it has no end.
    pub travel_mm: Option<f64>,
    /// How far beyond either end of its travel the axis goes before it hits something and loses steps.
    #[serde(default = "default_overtravel_mm")]
    pub overtravel_mm: f64,
    /// The position of the axis at first.
    #[serde(default)]
    pub start_mm: f64,
    /// The endstop's pin. It is high while the axis is at that end of its travel or beyond.
    pub endstop_pin: Option<PinName>,
    /// The end of the travel at which the endstop sits.
    #[serde(default = "default_end")]
    pub endstop_at: End,
    /// Speed of homing, for printer.cfg.
    #[serde(default = "default_homing_mm_per_s")]
    pub homing_mm_per_s: f64,
}

fn default_microsteps() -> u32 {
    16
}

fn default_overtravel_mm() -> f64 {
    2.0
}

fn default_end() -> End {
    End::Min
}

fn default_homing_mm_per_s() -> f64 {
    5.0
}

/// A heater, the mass that it heats, and the thermistor in it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeaterConfig {
    /// Such as `extruder` or `heater_bed`.
    pub name: String,
    /// Power is on while this is high.
    pub pin: PinName,
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
}

fn default_pulses_per_revolution() -> u32 {
    2
}

fn default_spin_up_s() -> f64 {
    0.5
}

/// An output that switches a light or something that needs no simulation.
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

/// The shape of the bed under a cartesian printer's nozzle; its middle is at 0.
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

    /// All lights and other outputs.
    pub(super) fn switched(&self) -> impl Iterator<Item = &OutputConfig> {
        self.leds.iter().chain(&self.outputs)
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
mod tests {
    use super::*;

    /// The error of the default printer with its first `from` replaced by `to`.
    fn error_of(from: &str, to: &str) -> String {
        assert!(DEFAULT.contains(from), "{from}");
        let text = DEFAULT.replacen(from, to, 1);
        match SimConfig::parse(&text, "my.toml") {
            Ok(_) => panic!("accepted {to}"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn the_default_printer_is_sound() {
        let config = SimConfig::default_printer();
        assert_eq!(config.axes.len(), 4);
        assert_eq!(config.heaters.len(), 2);
    }

    #[test]
    fn an_error_is_one_line_with_file_key_and_remedy() {
        for (from, to, key, cause) in [
            ("travel_mm = 220.0", "travel = 220.0", "`travel`", "unknown field"),
            ("steps_per_mm = 80.0\n", "", "`steps_per_mm`", "missing field"),
            ("steps_per_mm = 80.0", "steps_per_mm = \"many\"", "`steps_per_mm`", "invalid type"),
            ("steps_per_mm = 80.0", "steps_per_mm = -80.0", "`steps_per_mm`", "not above zero"),
            ("steps_per_mm = 80.0", "steps_per_mm = nan", "`steps_per_mm`", "out of range"),
            ("microsteps = 16", "microsteps = 0", "`microsteps`", "not above zero"),
            ("start_mm = 60.0", "start_mm = 600.0", "`start_mm`", "out of its reach"),
            ("travel_mm = 220.0\n", "", "`travel_mm`", "an axis with an endstop needs it"),
            ("\"y_step\"", "\"x_step\"", "`step_pin`", "`x_step` has a use already"),
            ("\"x_step\"", "\"x step\"", "`step_pin`", "no pin name"),
            ("\"x_step\"", "\"^x_step\"", "`step_pin`", "no pin name"),
            ("name = \"y\"", "name = \"x\"", "`name`", "two are called `x`"),
            ("endstop_at = \"min\"", "endstop_at = \"left\"", "`endstop_at`", "unknown variant"),
            ("\"hotend_sensor\"", "\"!hotend_sensor\"", "`sensor_pin`", "no polarity"),
            ("sensor_lag_s = 1.0", "sensor_lag_s = 60.0", "`sensor_lag_s`", "slower than"),
            ("max_celsius = 280.0", "max_celsius = -1", "`max_celsius`", "not above min"),
            ("beta_k = 3950.0\n", "", "`beta_k`", "one point"),
            ("beta_k = 3950.0", "beta_k = 0.0", "`beta_k`", "above zero"),
            (", [150.0, 1641.9]", "", "`points_celsius_ohm`", "two"),
            ("1641.9", "-1", "`points_celsius_ohm`", "above zero"),
            ("[25.0, 100000.0]", "[25.0, true]", "`points_celsius_ohm`", "invalid type"),
            ("bus = \"spidev1.0\"", "bus = \"spidev2.0\"", "`bus`", "no `spidev2.0`"),
            ("bus = \"spidev1.0\"", "bus = \"spidev0.0\"", "`select_pin`", "not the only chip"),
            ("\"z_cs\"", "\"!z_cs\"", "`select_pin`", "low level only"),
            ("\"z_cs\"", "\"z_dir\"", "`select_pin`", "has a use already"),
            ("axis = \"z\"", "axis = \"w\"", "`axis`", "no `w`"),
            ("kind = \"tmc5160\"", "kind = \"tmc9\"", "", "unknown variant `tmc9`"),
            ("axis = \"z\"", "axes = \"z\"", "", "unknown field `axes`"),
            ("axis = \"x\", hz", "axis = \"w\", hz", "`axis`", "no `w`"),
            ("hz = 43.5", "hz = 0.0", "`y`", "not above zero"),
            ("heater = \"extruder\"", "heater = \"oven\"", "`heater`", "no `oven`"),
            ("name = \"arm\"", "name = \"an arm\"", "`name`", "`an arm` is no name"),
            ("name = \"dots\"", "name = \"\"", "`name`", "`` is no name"),
            ("count = 8", "count = 1001", "`count`", "too many"),
            ("count = 4", "count = 1001", "`count`", "too many"),
            ("drive_current = 16", "drive_current = 32", "`drive_current`", "no current"),
            ("yielding = 0.9", "yielding = 1.1", "`yielding`", "more than all"),
            ("conversion_ms = 750", "conversion_ms = 1000000001", "`conversion_ms`", "out of range"),
            ("damping_ratio = 0.1", "damping_ratio = 1.0", "`x`", "does not ring"),
            ("rate_off_percent = 0.4", "rate_off_percent = 40.0", "`rate_off_percent`", "so far off"),
            ("encoder_mm = 1.44", "encoder_mm = 0.0", "`encoder_mm`", "not above zero"),
            ("max_pulse_us = 2000.0", "max_pulse_us = 900.0", "`max_pulse_us`", "not above min_pulse_us"),
            ("name = \"spidev1.0\"", "name = \"spidev0.0\"", "`name`", "two are called `spidev0.0`"),
            (
                "name = \"spidev1.0\"",
                "name = \"spidev1.0\"\ntrace_pins = [\"x_dir\"]",
                "`trace_pins`",
                "`x_dir` is no pin",
            ),
            ("seed = 1", "seed = = 1", "`seed`", ""),
            ("[[25.0, 100000.0], [150", "[[25.0, 100000.0],\n[true", "`points_celsius_ohm`", ""),
        ] {
            let error = error_of(from, to);
            assert!(error.starts_with("my.toml"), "{error}");
            assert!(error.contains(key), "{error}");
            assert!(error.contains(cause), "{error}");
            assert!(!error.contains('\n'), "{error}");
        }
    }

    /// The words that an error offers for one that nobody knows.
    fn offered(toml: &str) -> Vec<String> {
        let Err(error) = SimConfig::parse(toml, "my.toml") else { panic!("accepted {toml}") };
        let error = error.to_string();
        let Some((_, offered)) = error.split_once(", expected ") else { panic!("{error}") };
        offered.split('`').skip(1).step_by(2).map(str::to_owned).collect()
    }

    #[test]
    fn the_documentation_has_every_kind_and_every_key() {
        const DOCUMENTATION: &str = include_str!("../../../docs/simulator.md");
        // A section ends at the next heading.
        let has = |heading: &str, key: &str| {
            let Some((_, section)) = DOCUMENTATION.split_once(&format!("\n{heading}\n")) else {
                panic!("there is no `{heading}`");
            };
            let section = section.split("\n##").next().unwrap_or_default();
            let mut words = section.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
            assert!(words.any(|word| word == key), "{key} is not in `{heading}`");
        };
        for key in offered("nobody = 1") {
            has("## Its description", &key);
        }
        for (table, heading) in [
            ("[limits]", "### `[limits]`"),
            ("[[axis]]", "### `[[axis]]`"),
            ("[[heater]]", "### `[[heater]]`"),
            ("[[fan]]", "### `[[fan]]`"),
            ("[[led]]", "### `[[led]]`, `[[output]]`, `[[input]]`"),
            ("[[input]]", "### `[[led]]`, `[[output]]`, `[[input]]`"),
            ("[bed]", "### `[bed]`"),
            ("[[spi_bus]]", "### `[[spi_bus]]`, `[[i2c_bus]]`"),
            ("[[i2c_bus]]", "### `[[spi_bus]]`, `[[i2c_bus]]`"),
            ("[[part]]\nkind = \"adxl345\"\n[part.x]", "### adxl345"),
            ("[[part]]\nkind = \"hx71x\"\n[part.cell]", "### hx71x"),
        ] {
            offered(&format!("{table}\nnobody = 1")).iter().for_each(|key| has(heading, key));
        }
        let kinds = offered("[[part]]\nkind = \"nobody\"");
        assert!(kinds.len() > 10, "{kinds:?}");
        for kind in kinds {
            let keys = offered(&format!("[[part]]\nkind = \"{kind}\"\nnobody = 1"));
            // Of a chip's place on its bus the chapter's head tells.
            let own = keys.iter().filter(|key| !["bus", "select_pin"].contains(&key.as_str()));
            own.for_each(|key| has(&format!("### {kind}"), key));
        }
        has("## Parts", "bus");
        has("## Parts", "select_pin");
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = SimConfig::load(Path::new("/nonexistent/printer.toml"));
        let error = error.map_or_else(|error| error.to_string(), |_| String::new());
        assert!(error.starts_with("/nonexistent/printer.toml: "), "{error}");
    }

    #[test]
    fn an_empty_description_is_a_board_without_pins() {
        let config = SimConfig::parse("", "empty.toml");
        assert!(config.is_ok_and(|config| config.axes.is_empty()));
    }
}
