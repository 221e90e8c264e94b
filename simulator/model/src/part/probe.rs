// SPDX-License-Identifier: GPL-3.0-or-later
//! A switch beside the nozzle that closes when it touches the bed: an inductive probe, a Klicky, a microswitch. It has
//! no noise and no hysteresis.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Trouble, check_offsets};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::bed::Bed;
use crate::engine::dock::Dock;
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
    /// Where the nozzle is when the head comes to the probe's dock, along the x and y axes. The probe is in the dock at
    /// first. The head takes it up there, and leaves it there the next time. Without it the pin is high.
    pub dock_mm: Option<[f64; 2]>,
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
        let place = self.dock_mm.and_then(|mm| Some((workshop.rail("x")?, workshop.rail("y")?, mm)));
        let dock = place.map(|(x, y, mm)| Arc::new(Dock::new(x, y, mm)));
        if let Some(dock) = &dock {
            workshop.head_passes(dock);
        }
        workshop.wire(Some(&self.pin), switch(workshop.bed(), tip, dock));
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
fn switch(bed: Bed, tip: [f64; 3], dock: Option<Arc<Dock>>) -> impl Wire {
    input("probe".into(), move |_| match &dock {
        Some(dock) if dock.has_probe() => true,
        // The dock is beside the bed.
        Some(dock) if dock.is_there() => false,
        _ => bed.clearance_mm(tip) <= 0.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::Clock;

    #[test]
    fn it_closes_at_the_step_that_takes_it_to_the_bed() {
        let printer = DefaultPrinter::read();
        let [x, y, z] = [0, 1, 2].map(|place| Arc::new(Axis::new(&printer.axes[place])));
        for axis in [&x, &y, &z] {
            axis.set_enabled(true);
        }
        let bed = || Bed::under(printer.bed.clone(), Some(x.clone()), Some(y.clone()), Some(z.clone()));
        let probe = switch(bed(), [-30.0, 10.0, -2.5], None);
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

    /// The x axis, a dock, and a probe in it. The nozzle is at 60, 45 and 12 mm.
    fn docked(dock_mm: [f64; 2], tip: [f64; 3]) -> (Arc<Axis>, Arc<Dock>, impl Wire) {
        let printer = DefaultPrinter::read();
        let [x, y, z] = [0, 1, 2].map(|place| Arc::new(Axis::new(&printer.axes[place])));
        let bed = Bed::under(printer.bed.clone(), Some(x.clone()), Some(y.clone()), Some(z));
        let dock = Arc::new(Dock::new(x.rail().clone(), y.rail().clone(), dock_mm));
        (x, dock.clone(), switch(bed, tip, Some(dock)))
    }

    #[test]
    fn the_head_takes_it_up_in_its_dock_and_leaves_it_there() {
        let (x, dock, probe) = docked([70.0, 45.0], [0.0; 3]);
        let now = Clock::from_ticks(0);
        x.set_enabled(true);
        x.passes(dock);
        let mut go_to = |mm: f64| {
            x.set_forward(mm > x.position_mm());
            while (x.position_mm() - mm).abs() > x.step_mm() {
                x.edge(true, now);
            }
            probe.sense(false, now)
        };
        let places = [65.0, 70.0, 65.0, 60.0, 71.0, 69.0, 75.0, 60.0];
        assert_eq!(places.map(&mut go_to), [true, false, false, false, true, true, true, false]);
    }

    #[test]
    fn in_its_dock_it_touches_no_bed() {
        // 20 mm below the nozzle, which is 12 mm above the bed.
        let (x, dock, probe) = docked([60.0, 45.0], [0.0, 0.0, -20.0]);
        let now = Clock::from_ticks(0);
        assert!(probe.sense(false, now), "it is in the dock");
        dock.passed();
        assert!(!probe.sense(false, now), "at the head, in the dock");
        x.set_enabled(true);
        x.passes(dock);
        x.set_forward(true);
        while x.position_mm() < 64.0 {
            x.edge(true, now);
        }
        assert!(probe.sense(false, now), "over the bed");
    }
}
