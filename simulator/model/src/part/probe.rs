// SPDX-License-Identifier: GPL-3.0-or-later
//! A switch beside the nozzle that closes when it touches the bed: an inductive probe, a Klicky, a microswitch. It has
//! no noise and no hysteresis.

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Trouble, check_offsets};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::bed::Bed;
use crate::engine::wire::{Wire, input};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;

/// The probe's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeConfig {
    /// High while the probe touches the bed.
    pub pin: PinName,
    /// How far the probe is from the nozzle along the x axis.
    #[serde(default)]
    pub x_offset_mm: f64,
    /// How far the probe is from the nozzle along the y axis.
    #[serde(default)]
    pub y_offset_mm: f64,
    /// How far below the nozzle the probe touches the bed.
    pub z_offset_mm: f64,
}

impl Part for ProbeConfig {
    fn name(&self) -> String {
        "probe".into()
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("pin", Some(&self.pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        check_offsets(whose, [self.x_offset_mm, self.y_offset_mm, self.z_offset_mm])
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let tip = [self.x_offset_mm, self.y_offset_mm, -self.z_offset_mm];
        workshop.wire(Some(&self.pin), switch(workshop.bed(), tip));
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.probe(layout, |cfg| {
            cfg.section("probe");
            if layout.is_homed("z") {
                cfg.comment("To home the z axis by this probe or another one, let [stepper_z] have");
                cfg.comment("endstop_pin: probe:z_virtual_endstop, and take position_endstop out there.");
            }
            cfg.key("pin", &self.pin);
            cfg.offsets([self.x_offset_mm, self.y_offset_mm, self.z_offset_mm]);
        });
    }
}

/// A switch at `tip`, which is the point of contact relative to the nozzle.
fn switch(bed: Bed, tip: [f64; 3]) -> impl Wire {
    input("probe".into(), move |_| bed.clearance_mm(tip) <= 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::Clock;
    use std::sync::Arc;

    #[test]
    fn it_closes_at_the_step_that_takes_it_to_the_bed() {
        let printer = DefaultPrinter::read();
        let [x, y, z] = [0, 1, 2].map(|place| Arc::new(Axis::new(&printer.axes[place])));
        for axis in [&x, &y, &z] {
            axis.set_enabled(true);
        }
        let bed = || Bed::under(printer.bed.clone(), Some(x.clone()), Some(y.clone()), Some(z.clone()));
        let probe = switch(bed(), [-30.0, 10.0, -2.5]);
        // The nozzle is at 60, 45 and 12 mm.
        let height = bed().height_mm(60.0 - 30.0, 45.0 + 10.0);
        let at_nozzle = bed().height_mm(60.0, 45.0);
        assert!((height - at_nozzle).abs() > 0.02, "{height} {at_nozzle}: the offset would not show");
        let now = Clock::from_ticks(0);
        z.set_forward(false);
        while !probe.sense(false, now) {
            z.edge(true, now);
        }
        let over = z.position_mm() - 2.5 - height;
        assert!((-1.0 / 400.0..=0.0).contains(&over), "{over}");
        z.set_forward(true);
        z.edge(true, now);
        assert!(!probe.sense(false, now));
    }
}
