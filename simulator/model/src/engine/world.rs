// SPDX-License-Identifier: GPL-3.0-or-later
//! Everything that a printer is made of, and what a person sees of it.

use std::sync::Arc;

use super::look::Look;
use super::motion::Axis;
use super::physics::{Fan, Heater, Lamp};
use super::rail::Rail;
use super::ring::RingConfig;
use pinion_firmware::board::Thermometer;
use pinion_firmware::time::Clock;

/// A person's view of a part.
pub(crate) trait Sight: Send + Sync {
    /// The name of the part.
    fn name(&self) -> &str;

    /// The appearance at this instant.
    fn look(&self, now: Clock) -> Look;
}

/// Opens a thermometer of the one-wire bus.
pub(crate) type OpenThermometer = Box<dyn Fn() -> Box<dyn Thermometer> + Send + Sync>;

/// Everything that moves, heats, spins or shines, and everything that a person can see.
#[derive(Default)]
pub(crate) struct World {
    pub(crate) axes: Vec<Arc<Axis>>,
    /// The rails without a motor of their own.
    pub(crate) carriages: Vec<Arc<Rail>>,
    /// The axes that feed filament to hot ends.
    pub(crate) extruders: Vec<Arc<Axis>>,
    pub(crate) heaters: Vec<Arc<Heater>>,
    pub(crate) fans: Vec<Arc<Fan>>,
    pub(crate) lamps: Vec<Arc<Lamp>>,
    /// The oscillators on an axis.
    pub(crate) rings: Vec<(Arc<Rail>, RingConfig)>,
    pub(crate) sights: Vec<Arc<dyn Sight>>,
    /// By their serial numbers.
    pub(crate) thermometers: Vec<(String, OpenThermometer)>,
}
