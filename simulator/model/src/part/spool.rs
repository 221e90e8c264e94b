// SPDX-License-Identifier: GPL-3.0-or-later
//! A spool of filament. The filament closes a switch and turns an encoder, both directly before the extruder.
//!
//! Simulated: a filament that moves with the extruder's axis, forward and backward. It ends after a length. It can be
//! stuck from a length on, so that the extruder grinds it. A pin stands for the person who inserts a new spool.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Bound, Trouble, check};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::motion::Axis;
use crate::engine::wire::{Wire, edges, input};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;

/// The spool's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpoolConfig {
    /// For example `filament`.
    pub name: String,
    /// The axis that pulls the filament.
    pub axis: String,
    /// Length of the filament.
    pub length_mm: f64,
    /// The length after which the spool holds the filament.
    pub stuck_after_mm: Option<f64>,
    /// High while there is filament.
    pub switch_pin: Option<PinName>,
    /// Changes its level as the filament moves.
    pub encoder_pin: Option<PinName>,
    /// Inserts a new spool when it goes high.
    pub refill_pin: Option<PinName>,
    /// Length of filament between two changes of the encoder.
    #[serde(default = "default_encoder_mm")]
    pub encoder_mm: f64,
}

fn default_encoder_mm() -> f64 {
    1.44
}

impl Part for SpoolConfig {
    fn name(&self) -> String {
        format!("spool {}", self.name)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![
            ("switch_pin", self.switch_pin.as_ref()),
            ("encoder_pin", self.encoder_pin.as_ref()),
            ("refill_pin", self.refill_pin.as_ref()),
        ]
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        printer.check_axis(whose, &self.axis)?;
        check(whose, "length_mm", self.length_mm, Bound::NotNegative)?;
        check(whose, "stuck_after_mm", self.stuck_after_mm.unwrap_or(0.0), Bound::NotNegative)?;
        check(whose, "encoder_mm", self.encoder_mm, Bound::AboveZero)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(axis) = workshop.axis(&self.axis) {
            let spool = Arc::new(Spool::new(self, axis));
            workshop.wire(self.switch_pin.as_ref(), switch_pin(spool.clone()));
            workshop.wire(self.encoder_pin.as_ref(), encoder_pin(spool.clone()));
            workshop.wire(self.refill_pin.as_ref(), refill_pin(spool));
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        if let Some(pin) = &self.switch_pin {
            cfg.section(format_args!("filament_switch_sensor {}", self.name));
            cfg.key("switch_pin", pin);
        }
        // klippy compares the encoder with an extruder's motion.
        if let Some(pin) = self.encoder_pin.as_ref().filter(|_| layout.is_hot_end(&self.axis)) {
            cfg.section(format_args!("filament_motion_sensor {}_motion", self.name));
            cfg.needs(&self.axis);
            cfg.key("switch_pin", pin);
            cfg.key("extruder", &self.axis);
            cfg.key("detection_length", (3.0 * self.encoder_mm).max(7.0));
        }
        if let Some(pin) = &self.refill_pin {
            cfg.section(format_args!("output_pin {}_refill", self.name));
            cfg.comment(format_args!(
                "SET_PIN PIN={}_refill VALUE=1 puts in a new spool. VALUE=0 gets ready for",
                self.name
            ));
            cfg.comment("the next one.");
            cfg.key("pin", pin);
        }
    }
}

struct Spool {
    name: String,
    axis: Arc<Axis>,
    /// The axis's position in steps when the spool was inserted.
    start: AtomicI64,
    length_mm: f64,
    stuck_after_mm: Option<f64>,
    encoder_mm: f64,
}

impl Spool {
    fn new(config: &SpoolConfig, axis: Arc<Axis>) -> Spool {
        Spool {
            name: config.name.clone(),
            start: AtomicI64::new(axis.position_steps()),
            axis,
            length_mm: config.length_mm,
            stuck_after_mm: config.stuck_after_mm,
            encoder_mm: config.encoder_mm,
        }
    }

    /// How far the filament has moved. Stuck filament does not move, nor does filament that has run out.
    fn moved_mm(&self) -> f64 {
        let end_mm = self.stuck_after_mm.map_or(self.length_mm, |stuck_mm| self.length_mm.min(stuck_mm));
        let steps = self.axis.position_steps().wrapping_sub(self.start.load(Ordering::Relaxed));
        self.axis.mm(steps).min(end_mm)
    }

    /// Inserts a new spool.
    fn refill(&self) {
        self.start.store(self.axis.position_steps(), Ordering::Relaxed);
    }
}

fn switch_pin(spool: Arc<Spool>) -> impl Wire {
    input(format!("filament switch of spool {}", spool.name), move |_| spool.moved_mm() < spool.length_mm)
}

fn encoder_pin(spool: Arc<Spool>) -> impl Wire {
    input(format!("filament encoder of spool {}", spool.name), move |_| {
        (spool.moved_mm() / spool.encoder_mm).floor() as i64 & 1 == 1
    })
}

/// The person who inserts a new spool. A pin that is high from the start inserts nothing.
fn refill_pin(spool: Arc<Spool>) -> impl Wire {
    edges(format!("refill of spool {}", spool.name), move |on, _| {
        if on {
            spool.refill();
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::Clock;

    /// A spool of 50 mm, and the axis that pulls it.
    struct Bench {
        axis: Arc<Axis>,
        spool: Arc<Spool>,
    }

    impl Bench {
        fn new(stuck_after_mm: Option<f64>) -> Bench {
            let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[3]));
            axis.set_enabled(true);
            let config = SpoolConfig {
                name: "filament".into(),
                axis: "extruder".into(),
                length_mm: 50.0,
                stuck_after_mm,
                switch_pin: None,
                encoder_pin: None,
                refill_pin: None,
                encoder_mm: 2.0,
            };
            Bench { spool: Arc::new(Spool::new(&config, axis.clone())), axis }
        }

        /// The switch and the number of encoder changes after each move. A move is in mm, with 100 steps per mm.
        fn feed(&self, moves: &[i32]) -> Vec<(bool, u32)> {
            let (switch, encoder) = (switch_pin(self.spool.clone()), encoder_pin(self.spool.clone()));
            let now = Clock::EPOCH;
            let feed = |mm: &i32| {
                self.axis.set_forward(*mm > 0);
                let mut changes = 0;
                for _ in 0..100 * mm.abs() {
                    let before = encoder.sense(false, now);
                    self.axis.edge(true, now);
                    self.axis.edge(false, now);
                    changes += u32::from(encoder.sense(false, now) != before);
                }
                (switch.sense(false, now), changes)
            };
            moves.iter().map(feed).collect()
        }
    }

    #[test]
    fn filament_runs_out_after_its_length_and_can_be_drawn_back_to_the_switch() {
        // 5 mm have two edges, at 2 and 4 mm. The way back crosses them again.
        assert_eq!(Bench::new(None).feed(&[5, -5, 49]), [(true, 2), (true, 2), (true, 24)]);
        assert_eq!(Bench::new(None).feed(&[49, 1, 20, -21]), [(true, 24), (false, 1), (false, 0), (true, 1)]);
    }

    #[test]
    fn filament_that_is_stuck_stands_while_the_extruder_turns() {
        assert_eq!(Bench::new(Some(10.0)).feed(&[10, 30]), [(true, 5), (true, 0)]);
    }

    #[test]
    fn a_new_spool_is_as_long_as_the_first() {
        let bench = Bench::new(None);
        let refill = refill_pin(bench.spool.clone());
        refill.settle(true, Clock::EPOCH);
        assert_eq!(bench.feed(&[60]), [(false, 25)]);
        refill.drive(false, Clock::EPOCH);
        assert_eq!(bench.feed(&[1]), [(false, 0)], "only the rising edge puts it in");
        refill.drive(true, Clock::EPOCH);
        // The encoder starts again.
        assert_eq!(bench.feed(&[49, 1]), [(true, 24), (false, 1)]);
    }
}
