// SPDX-License-Identifier: GPL-3.0-or-later
//! The default printer without its parts, for the tests of the engine and of the parts.

use serde::{Deserialize, Serialize};

use super::axes::{AxisConfig, BedConfig};
use super::heater::HeaterConfig;

/// The tables of the default printer that those tests use.
#[derive(Serialize, Deserialize)]
pub(crate) struct DefaultPrinter {
    #[serde(rename = "axis")]
    pub(crate) axes: Vec<AxisConfig>,
    #[serde(rename = "heater")]
    pub(crate) heaters: Vec<HeaterConfig>,
    pub(crate) bed: BedConfig,
}

impl DefaultPrinter {
    pub(crate) fn read() -> DefaultPrinter {
        toml::from_str(include_str!("../default.toml")).unwrap()
    }
}
