// SPDX-License-Identifier: GPL-3.0-or-later
//! The thermometer DS18B20 on the kernel's one-wire bus, after its data sheet (Maxim, DS18B20, "Operation —
//! Measuring Temperature"): steps of 1/16 of a degree, 750 ms for a conversion.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::printer::Printer;
use crate::description::whole;
use crate::engine::physics::Heater;
use crate::engine::time::pass;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::board::Thermometer;
use pinion_firmware::time::TimeSource;

/// The thermometer's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ds18b20Config {
    /// Its name in klippy.
    pub name: String,
    /// Its name in the kernel, for example `28-0123456789ab`.
    pub serial: String,
    /// The heater that it measures.
    pub heater: String,
    /// How long a reading takes.
    #[serde(default = "whole::<750, _>")]
    pub conversion_ms: u64,
}

impl Part for Ds18b20Config {
    fn name(&self) -> String {
        format!("ds18b20 {}", self.serial)
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        if self.serial.is_empty() || !self.serial.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c)) {
            let cause = format!("`{}` is not the name of a device", self.serial);
            return wrong(whose, "serial", &cause, "give `28-` and twelve hexadecimal digits");
        }
        check(whose, "conversion_ms", self.conversion_ms as f64, Bound::NotNegative)?;
        printer.check_heater(whose, &self.heater)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(heater) = workshop.heater(&self.heater) {
            let conversion = Duration::from_millis(self.conversion_ms);
            let thermometer = Ds18b20 { heater, conversion, clock: workshop.clock.clone() };
            let open = move || Box::new(thermometer.clone()) as Box<dyn Thermometer>;
            workshop.world.thermometers.push((self.serial.clone(), Box::new(open)));
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("temperature_sensor {}", self.name));
        cfg.key("sensor_type", "DS18B20");
        cfg.key("sensor_mcu", "mcu");
        cfg.key("serial_no", &self.serial);
    }
}

#[derive(Clone)]
struct Ds18b20 {
    heater: Arc<Heater>,
    conversion: Duration,
    clock: Arc<dyn TimeSource>,
}

impl Thermometer for Ds18b20 {
    fn read(&mut self) -> Result<i32, Trouble> {
        pass(self.conversion);
        let sixteenths = (self.heater.at(self.clock.now()).celsius * 16.0).floor() as i32;
        Ok((sixteenths * 1000).div_euclid(16))
    }
}
