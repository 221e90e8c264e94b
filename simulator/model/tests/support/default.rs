// SPDX-License-Identifier: GPL-3.0-or-later
//! The default printer without its parts, for the tests of the engine and of the parts.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::axes::{AxisConfig, BedConfig};
use super::heater::HeaterConfig;
use super::rails::RailConfig;
use crate::engine::bed::{Bed, Head, Plane};
use crate::engine::motion::Axis;
use crate::engine::rail::{Motor, Rail};

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
        toml::from_str(include_str!("../../src/default.toml")).unwrap()
    }
}

impl Axis {
    /// A motor with a rail of its own.
    pub(crate) fn new(config: &AxisConfig) -> Axis {
        let motor = Motor::at(config.start_mm, config);
        let step_mm = 1.0 / config.steps_per_mm;
        let rail = Arc::new(Rail::new(&RailConfig::of(config), vec![(motor.clone(), step_mm)]));
        Axis::driving(config, motor, rail.clone(), vec![(rail, step_mm)])
    }
}

impl Bed {
    /// The bed under a cartesian printer with one motor for each axis.
    pub(crate) fn under(shape: BedConfig, x: Option<Arc<Axis>>, y: Option<Arc<Axis>>, z: Option<Arc<Axis>>) -> Bed {
        let [x, y, z] = [x, y, z].map(|axis| axis.map(|axis| axis.rail().clone()));
        let z = Plane::new(z.into_iter().map(|z| (z, [0.0; 2])).collect());
        Bed::new(shape, Head::Cartesian { x, y, z })
    }
}
