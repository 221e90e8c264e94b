// SPDX-License-Identifier: GPL-3.0-or-later
//! A light of several colors, each dimmed by its own pin.

use std::sync::Arc;

use super::look::{Colour, Look};
use super::physics::Lamp;
use super::world::Sight;
use pinion_firmware::time::Clock;

pub(crate) struct ColouredLed {
    pub(crate) name: String,
    /// Red, green, blue and white; `None` for a color that the light does not have.
    pub(crate) lamps: [Option<Arc<Lamp>>; 4],
}

impl Sight for ColouredLed {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, now: Clock) -> Look {
        let brightness = |lamp: &Arc<Lamp>| (lamp.brightness(now) * 255.0).round() as u8;
        let [red, green, blue, white] = self.lamps.each_ref().map(|lamp| lamp.as_ref().map_or(0, brightness));
        Look::Lights { colours: vec![Colour { red, green, blue, white }], odd_pulses: 0 }
    }
}
