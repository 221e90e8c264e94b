// SPDX-License-Identifier: GPL-3.0-or-later
//! The buses of a description.

#![forbid(unsafe_code)]

use std::path::PathBuf;

use serde::Deserialize;

use super::check::{Trouble, fault};
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
    /// A file for the trace, with one line per transfer: the selected chips, the bytes in both directions, the levels
    /// of `trace_pins` at each byte.
    pub trace_file: Option<PathBuf>,
    /// The pins of `[[led]]` and `[[output]]` with levels in the trace.
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

    /// The error for a `trace_file` that cannot be created.
    pub(crate) fn no_trace_file(&self, error: &std::io::Error) -> Trouble {
        fault(
            &format!("spi_bus `{}`", self.name),
            "trace_file",
            &format!("it cannot be made: {error}"),
            "name a file in a folder that may be written",
        )
    }
}
