// SPDX-License-Identifier: GPL-3.0-or-later
//! The heaters of a description, and the fans.

use serde::{Deserialize, Serialize};

use super::check::{Bound, Trouble, check, fault};
use super::pin::PinName;
use super::sensor::Sensor;
use super::thermistor::{NoThermistor, Thermistor};
use super::whole;

/// A heater, the mass that it heats, and the thermistor in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeaterConfig {
    /// For example `extruder` or `heater_bed`.
    pub name: String,
    /// Power is on while this pin is high. Without this pin it is always on.
    pub pin: Option<PinName>,
    /// The ADC channel of the thermistor. Without this pin only a chip reads the temperature.
    pub sensor_pin: Option<PinName>,
    /// Power while on.
    pub heater_watts: f64,
    /// Heat capacity of the heated mass.
    pub heat_capacity_j_per_k: f64,
    /// Heat loss to the surroundings for each kelvin above them.
    pub loss_w_per_k: f64,
    /// Time constant with which the sensor follows the heated mass; 0 means at once.
    #[serde(default)]
    pub sensor_lag_s: f64,
    /// Temperature of the surroundings.
    #[serde(default = "whole::<25, _>")]
    pub ambient_celsius: f64,
    /// Initial temperature. Without this key it is the temperature of the surroundings.
    pub start_celsius: Option<f64>,
    /// `min_temp` in printer.cfg: the host stops below this temperature.
    #[serde(default)]
    pub min_celsius: f64,
    /// `max_temp` in printer.cfg: the host stops above this temperature.
    pub max_celsius: f64,
    /// Standard deviation of a reading, in counts of the ADC.
    #[serde(default)]
    pub noise_counts: f64,
    /// The pull-up resistor from the ADC's input to its reference.
    #[serde(default = "whole::<4700, _>")]
    pub pullup_ohm: f64,
    /// The thermistor's resistance at one temperature (with `beta_k`) or at three.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points_celsius_ohm: Vec<(f64, f64)>,
    /// In place of a thermistor, the readings of any other sensor: temperatures, each with a fraction of the ADC's
    /// reference.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points_celsius_fraction: Vec<(f64, f64)>,
    /// The thermistor's beta.
    pub beta_k: Option<f64>,
}

/// A fan that needs time to spin up and down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FanConfig {
    /// For example `fan`, which is the part cooling fan.
    pub name: String,
    /// Power is on while this pin is high.
    pub pin: PinName,
    /// A second pin that must also be high for the fan to have power.
    pub enable_pin: Option<PinName>,
    /// An input that is high for the first half of each pulse of the tachometer.
    pub tachometer_pin: Option<PinName>,
    /// Pulses of the tachometer per revolution.
    #[serde(default = "whole::<2, _>")]
    pub pulses_per_revolution: u32,
    /// Speed at full power.
    pub max_rpm: f64,
    /// Time constant with which the speed follows the power.
    #[serde(default = "default_spin_up_s")]
    pub spin_up_s: f64,
    /// The heater that the fan cools.
    pub cools: Option<String>,
    /// Additional heat loss of that heater while the fan has power, for each kelvin above the surroundings.
    #[serde(default)]
    pub cooling_w_per_k: f64,
}

fn default_spin_up_s() -> f64 {
    0.5
}

impl HeaterConfig {
    /// The initial temperature, in °C.
    pub(crate) fn start_celsius(&self) -> f64 {
        self.start_celsius.unwrap_or(self.ambient_celsius)
    }

    /// Its sensor at the ADC; `None` if it has none.
    ///
    /// # Errors
    ///
    /// The key with values that no sensor has, and a remedy.
    pub(crate) fn sensor(&self) -> Result<Option<Sensor>, Trouble> {
        const POINTS: &str = "points_celsius_fraction";
        let whose = &format!("heater `{}`", self.name);
        if self.sensor_pin.is_none() {
            return Ok(None);
        }
        if self.points_celsius_fraction.is_empty() {
            return self.thermistor().map(|thermistor| Some(Sensor::Thermistor(thermistor)));
        }
        if !self.points_celsius_ohm.is_empty() {
            return Err(fault(whose, POINTS, "it also has points_celsius_ohm", "remove one of them"));
        }
        for (celsius, fraction) in &self.points_celsius_fraction {
            check(whose, POINTS, *celsius, Bound::Any)?;
            check(whose, POINTS, *fraction, Bound::Any)?;
        }
        let sensor = Sensor::of_curve(&self.points_celsius_fraction);
        sensor.map(Some).ok_or_else(|| fault(whose, POINTS, "there is one", "give two or more"))
    }

    /// The thermistor that these points and this beta describe.
    ///
    /// # Errors
    ///
    /// The key with values that no thermistor has, and a remedy.
    pub fn thermistor(&self) -> Result<Thermistor, Trouble> {
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
