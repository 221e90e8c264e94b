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

impl SpiBusConfig {
    /// Its data output as a pin, which has the bus's own name, as on a Linux board.
    pub(crate) fn mosi_pin(&self) -> PinName {
        PinName { name: self.name.clone(), inverted: false }
    }

    /// The error of a `trace_file` that can not be made.
    pub(crate) fn no_trace_file(&self, error: &std::io::Error) -> Trouble {
        fault(
            &format!("spi_bus `{}`", self.name),
            "trace_file",
            &format!("it can not be made: {error}"),
            "name a file in a folder that may be written",
        )
    }
}
