// SPDX-License-Identifier: GPL-3.0-or-later
//! Everything that a printer is made of, and what a person sees of it.

#![forbid(unsafe_code)]

use std::sync::Arc;

use super::physics::{Axis, Fan, Heater, Lamp};
use pinion_firmware::board::Thermometer;
use pinion_firmware::time::Clock;

/// What a person would see of a part.
pub(crate) trait Sight: Send + Sync {
    /// Whose sight it is.
    fn name(&self) -> &str;

    /// What is to be seen at this instant: a line, or several for a picture. A colour is written as
    /// `#rrggbb`, and `pinion sim --show` paints it where it can.
    fn look(&self, now: Clock) -> String;
}

/// Opens a thermometer of the one-wire bus.
pub(crate) type OpenThermometer = Box<dyn Fn() -> Box<dyn Thermometer> + Send + Sync>;

/// Everything that moves, heats, spins, shines, and can be seen.
#[derive(Default)]
pub(crate) struct World {
    pub(crate) axes: Vec<Arc<Axis>>,
    pub(crate) heaters: Vec<Arc<Heater>>,
    pub(crate) fans: Vec<Arc<Fan>>,
    pub(crate) lamps: Vec<Arc<Lamp>>,
    pub(crate) sights: Vec<Arc<dyn Sight>>,
    /// By their serial numbers.
    pub(crate) thermometers: Vec<(String, OpenThermometer)>,
}
