// SPDX-License-Identifier: GPL-3.0-or-later
//! The buses of a description.

#![forbid(unsafe_code)]

use serde::Deserialize;

use super::pin::PinName;

/// An SPI bus.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpiBusConfig {
    /// The name that the board publishes, for example `spidev0.0`.
    pub name: String,
    /// How long each transfer takes.
    #[serde(default)]
    pub delay_us: u64,
    /// The pins of `[[led]]` and `[[output]]` with levels in the record of the bus's transfers.
    #[serde(default)]
    pub trace_pins: Vec<String>,
}

/// An I2C bus.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct I2cBusConfig {
    /// The name that the board publishes, for example `i2c.1`.
    pub name: String,
    /// How long each transfer takes.
    #[serde(default)]
    pub delay_us: u64,
}

impl SpiBusConfig {
    /// Its data output as a pin. The pin has the bus's name, as on a Linux board.
    pub(crate) fn mosi_pin(&self) -> PinName {
        PinName { name: self.name.clone(), inverted: false }
    }
}
