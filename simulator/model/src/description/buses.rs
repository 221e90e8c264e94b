// SPDX-License-Identifier: GPL-3.0-or-later
//! The buses of a description.

use serde::{Deserialize, Serialize};

use super::pin::PinName;

/// An SPI bus.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// The clock of a software bus. Such a bus has three pins, and no name for the host.
    pub sclk_pin: Option<PinName>,
    /// The data output of a software bus.
    pub mosi_pin: Option<PinName>,
    /// The data input of a software bus.
    pub miso_pin: Option<PinName>,
}

/// An I2C bus.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct I2cBusConfig {
    /// The name that the board publishes, for example `i2c.1`.
    pub name: String,
    /// How long each transfer takes.
    #[serde(default)]
    pub delay_us: u64,
    /// The clock of a software bus. Such a bus has two pins, and no name for the host.
    pub scl_pin: Option<PinName>,
    /// The data line of a software bus.
    pub sda_pin: Option<PinName>,
}

impl SpiBusConfig {
    /// Its data output as a pin. The pin has the bus's name, as on a Linux board.
    pub(crate) fn output_pin(&self) -> PinName {
        PinName { name: self.name.clone(), inverted: false }
    }

    /// Its lines, if it is a software bus: MISO, MOSI and SCLK.
    pub(crate) fn lines(&self) -> Option<[&PinName; 3]> {
        Some([self.miso_pin.as_ref()?, self.mosi_pin.as_ref()?, self.sclk_pin.as_ref()?])
    }
}

impl I2cBusConfig {
    /// Its lines, if it is a software bus: SCL and SDA.
    pub(crate) fn lines(&self) -> Option<[&PinName; 2]> {
        Some([self.scl_pin.as_ref()?, self.sda_pin.as_ref()?])
    }
}
