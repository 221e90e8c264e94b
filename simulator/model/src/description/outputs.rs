// SPDX-License-Identifier: GPL-3.0-or-later
//! The lights of a description, and the other outputs that are on or off.

use serde::{Deserialize, Serialize};

use super::pin::PinName;

/// A light of one to four colors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LedConfig {
    /// For example `light`.
    pub name: String,
    /// A light that is on while this pin is high; the white part of a light with colors.
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
    pub(crate) fn pins(&self) -> [(&'static str, Option<&PinName>); 4] {
        [
            ("red_pin", self.red_pin.as_ref()),
            ("green_pin", self.green_pin.as_ref()),
            ("blue_pin", self.blue_pin.as_ref()),
            ("pin", self.pin.as_ref()),
        ]
    }
}

/// An output for something that needs no simulation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputConfig {
    /// For example `light`.
    pub name: String,
    /// On while high.
    pub pin: PinName,
}

/// An input that stays at one level.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputConfig {
    /// For example `door`.
    pub name: String,
    /// The input.
    pub pin: PinName,
    /// Whether it is on.
    pub level: bool,
}

/// An analog pin at a fixed level.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnalogConfig {
    /// For example `supply`.
    pub name: String,
    /// The ADC's channel.
    pub pin: PinName,
    /// The voltage as a fraction of the ADC's reference.
    pub fraction: f64,
}
