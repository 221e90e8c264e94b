// SPDX-License-Identifier: GPL-3.0-or-later
//! Checks that the values of a description make a printer. An error names the first wrong value and a remedy.

use std::collections::HashSet;

use super::axes::{AxisConfig, BedConfig, DeltaConfig, End, Limits};
use super::boards::UsedPins;
use super::buses::{I2cBusConfig, SpiBusConfig};
use super::check::{Bound, Trouble, check, no_name, there_is, unique, wrong};
use super::heater::{FanConfig, HeaterConfig};
use super::kinematics::WinchConfig;
use super::outputs::LedConfig;
use super::pin::is_local;
use super::printer::{Kinematics, Printer};
use super::rails::Gears;
use super::thermistor::KELVIN;

/// Software buses may share lines.
const LINES: Option<&str> = Some("lines of buses");

impl Printer<'_> {
    /// Checks that the values make a printer.
    ///
    /// # Errors
    ///
    /// The first wrong value, with its key and a remedy.
    pub(crate) fn validate(&self, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        self.limits.validate()?;
        unique("[[axis]]", self.axes.iter().map(|axis| &axis.name))?;
        unique("[[heater]]", self.heaters.iter().map(|heater| &heater.name))?;
        unique("[[fan]]", self.fans.iter().map(|fan| &fan.name))?;
        unique("[[led]]", self.leds.iter().map(|led| &led.name))?;
        unique("[[output]]", self.outputs.iter().map(|output| &output.name))?;
        unique("[[input]]", self.inputs.iter().map(|input| &input.name))?;
        unique("[[analog]]", self.analogs.iter().map(|analog| &analog.name))?;
        unique("[[carriage]]", self.carriages.iter().map(|carriage| &carriage.name))?;
        unique_on_boards("[[spi_bus]]", self.spi_buses.iter().map(|bus| &bus.name))?;
        self.axes.iter().try_for_each(|axis| axis.validate(pins))?;
        self.validate_places()?;
        self.validate_carriages(pins)?;
        if self.corexy {
            self.validate_corexy()?;
        }
        match (self.chosen, self.kinematics()) {
            (Some(_), _) if self.delta.is_some() || self.corexy => {
                let trouble = Trouble::new("it also has another kinematics").remedy("remove `corexy` and `[delta]`");
                return Err(trouble.of("[kinematics]"));
            }
            (_, Kinematics::Delta(delta)) => delta.validate(self)?,
            (Some(_), kinematics) => self.validate_rails(kinematics)?,
            (None, _) => {}
        }
        Gears::of(self)?;
        self.heaters.iter().try_for_each(|heater| heater.validate(self, pins))?;
        self.fans.iter().try_for_each(|fan| fan.validate(self, pins))?;
        self.leds.iter().try_for_each(|led| led.validate(pins))?;
        for output in self.outputs {
            pins.claim(&format!("output `{}`", output.name), "pin", Some(&output.pin))?;
        }
        for input in self.inputs {
            pins.claim(&format!("input `{}`", input.name), "pin", Some(&input.pin))?;
        }
        unique_on_boards("[[i2c_bus]]", self.i2c_buses.iter().map(|bus| &bus.name))?;
        self.bed.validate()?;
        for bus in self.spi_buses {
            bus.validate(self)?;
            let whose = &format!("spi_bus `{}`", bus.name);
            match bus.lines() {
                None => pins.claim(whose, "name", Some(&bus.output_pin()))?,
                Some([miso, mosi, sclk]) => {
                    for (key, pin) in [("miso_pin", miso), ("mosi_pin", mosi), ("sclk_pin", sclk)] {
                        pins.claim_for(LINES, whose, key, Some(pin))?;
                    }
                }
            }
        }
        for analog in self.analogs {
            let whose = &format!("analog `{}`", analog.name);
            pins.claim(whose, "pin", Some(&analog.pin))?;
            check(whose, "fraction", analog.fraction, Bound::NotNegative)?;
        }
        for bus in self.i2c_buses {
            bus.validate()?;
            for (key, pin) in ["scl_pin", "sda_pin"].into_iter().zip(bus.lines().into_iter().flatten()) {
                pins.claim_for(LINES, &format!("i2c_bus `{}`", bus.name), key, Some(pin))?;
            }
        }
        Ok(())
    }

    fn validate_carriages(&self, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        self.carriages.iter().try_for_each(|carriage| {
            let whose = &format!("carriage `{}`", carriage.name);
            if self.axes.iter().any(|axis| axis.name == carriage.name && axis.carriages.is_empty()) {
                return wrong(whose, "name", "an axis with a rail of its own has this name", "rename one");
            }
            pins.claim(whose, "endstop_pin", carriage.endstop_pin.as_ref())?;
            let travel_mm = (carriage.min_mm, carriage.travel_mm);
            check_travel(whose, travel_mm, carriage.overtravel_mm, carriage.start_mm)?;
            check(whose, "endstop_mm", carriage.endstop_mm.unwrap_or(0.0), Bound::Any)
        })
    }

    /// Checks that the rails of a kinematics are there, and its lengths.
    fn validate_rails(&self, kinematics: Kinematics<'_>) -> Result<(), Trouble> {
        const WHOSE: &str = "[kinematics]";
        let is_there =
            |rail: &&&str| self.axis(rail).is_some() || self.carriages.iter().any(|carriage| carriage.name == **rail);
        if let Some(missing) = kinematics.rails().iter().find(|rail| !is_there(rail)) {
            let trouble = Trouble::new(format!("there is no axis `{missing}`"));
            return Err(trouble.remedy("add an [[axis]] for each rail").of(WHOSE));
        }
        let above_zero =
            |key, lengths: &[f64]| lengths.iter().try_for_each(|mm| check(WHOSE, key, *mm, Bound::AboveZero));
        match kinematics {
            Kinematics::Deltesian(deltesian) => {
                above_zero("arms_mm", &deltesian.arms_mm)?;
                above_zero("arm_x_mm", &deltesian.arm_x_mm)?;
                if deltesian.arms_mm.iter().zip(deltesian.arm_x_mm).any(|(arm, x)| *arm <= x) {
                    return wrong(WHOSE, "arms_mm", "an arm does not reach over its arm_x_mm", "give longer arms");
                }
                Ok(())
            }
            Kinematics::RotaryDelta(rotary) => {
                above_zero("upper_arms_mm", &rotary.upper_arms_mm)?;
                above_zero("lower_arms_mm", &rotary.lower_arms_mm)?;
                above_zero("bed_radius_mm", &[rotary.bed_radius_mm])?;
                let places = [rotary.shoulder_radius_mm, rotary.shoulder_height_mm];
                places.iter().try_for_each(|mm| check(WHOSE, "shoulder_radius_mm", *mm, Bound::Any))?;
                rotary
                    .angles_degrees
                    .iter()
                    .try_for_each(|degrees| check(WHOSE, "angles_degrees", *degrees, Bound::Any))
            }
            Kinematics::Winch(winch) => {
                let count = winch.anchors_mm.len();
                if !(3..=WinchConfig::CABLES.len()).contains(&count) {
                    let cause = format!("there are {count}");
                    return wrong(WHOSE, "anchors_mm", &cause, "give three to eight");
                }
                above_zero("bed_radius_mm", &[winch.bed_radius_mm])?;
                winch.anchors_mm.iter().flatten().try_for_each(|mm| check(WHOSE, "anchors_mm", *mm, Bound::Any))
            }
            _ => Ok(()),
        }
    }

    /// Checks the axes of a CoreXY printer.
    fn validate_corexy(&self) -> Result<(), Trouble> {
        const WHOSE: &str = "key `corexy`";
        if self.delta.is_some() {
            return Err(Trouble::new("a delta printer has no belts along x and y")
                .remedy("remove `[delta]`")
                .of(WHOSE));
        }
        let homed = |name: &&str| self.axis(name).is_some_and(|axis| axis.endstop_pin.is_some());
        if let Some(missing) = Kinematics::CoreXy.rails().iter().find(|name| !homed(name)) {
            let trouble = Trouble::new(format!("there is no axis `{missing}` with an `endstop_pin`"));
            return Err(trouble.remedy("add it").of(WHOSE));
        }
        Ok(())
    }

    /// Checks the places where the motors of the z axis hold the gantry or the bed.
    fn validate_places(&self) -> Result<(), Trouble> {
        let has_gantry = self.kinematics().has_gantry();
        let motors: Vec<&AxisConfig> = self.motors("z").filter(|_| has_gantry).collect();
        let whose = |axis: &AxisConfig| format!("axis `{}`", axis.name);
        if let Some(other) =
            self.axes.iter().find(|axis| axis.at_mm.is_some() && !motors.iter().any(|motor| motor.name == axis.name))
        {
            let cause = "only a motor of the z axis of a cartesian or CoreXY printer has a place";
            return wrong(&whose(other), "at_mm", cause, "remove it, or call the axes z, z1, z2 and so on");
        }
        let lost = motors.iter().find(|axis| axis.at_mm.is_none());
        if let (Some(lost), true) = (lost, motors.iter().any(|axis| axis.at_mm.is_some())) {
            return wrong(&whose(lost), "at_mm", "the other motors of the z axis have one", "add it");
        }
        motors.iter().try_for_each(|axis| {
            let mut places = axis.at_mm.into_iter().flatten();
            places.try_for_each(|mm| check(&whose(axis), "at_mm", mm, Bound::Any))
        })
    }
}

impl Limits {
    fn validate(&self) -> Result<(), Trouble> {
        for (key, value) in [
            ("velocity_mm_per_s", self.velocity_mm_per_s),
            ("accel_mm_per_s2", self.accel_mm_per_s2),
            ("z_velocity_mm_per_s", self.z_velocity_mm_per_s),
            ("z_accel_mm_per_s2", self.z_accel_mm_per_s2),
        ] {
            check("[limits]", key, value, Bound::AboveZero)?;
        }
        Ok(())
    }
}

impl DeltaConfig {
    /// Checks the towers, and that each has its axis.
    fn validate(&self, printer: &Printer<'_>) -> Result<(), Trouble> {
        const WHOSE: &str = "[delta]";
        check(WHOSE, "radius_mm", self.radius_mm, Bound::AboveZero)?;
        check(WHOSE, "bed_radius_mm", self.bed_radius_mm, Bound::AboveZero)?;
        check(WHOSE, "arm_mm", self.arm_mm, Bound::AboveZero)?;
        if self.arm_mm <= self.radius_mm {
            let cause = format!("{} does not reach over radius_mm", self.arm_mm);
            return wrong(WHOSE, "arm_mm", &cause, "give longer arms");
        }
        self.angles_degrees.iter().try_for_each(|degrees| check(WHOSE, "angles_degrees", *degrees, Bound::Any))?;
        let [a, b, c] = self.angles_degrees;
        let apart = [a - b, b - c, c - a].map(|degrees| (degrees.to_radians() / 2.0).sin().abs());
        if apart.into_iter().any(|apart| apart < 0.1) {
            return wrong(WHOSE, "angles_degrees", "two towers stand at one place", "set them apart");
        }
        for tower in DeltaConfig::TOWERS {
            let Some(axis) = printer.axis(tower) else {
                let trouble = Trouble::new(format!("there is no axis `{tower}`"));
                return Err(trouble.remedy("add an [[axis]] for each tower").of(WHOSE));
            };
            let whose = &format!("axis `{tower}`");
            if axis.endstop_pin.is_none() || axis.endstop_at != End::Max {
                let cause = "a delta printer homes to the upper ends of its towers";
                return wrong(whose, "endstop_at", cause, "give it an `endstop_pin`, and `endstop_at = \"max\"`");
            }
            let lowest_mm = self.lowest_mm();
            if axis.travel_mm.unwrap_or(0.0) <= lowest_mm {
                let cause = format!("the nozzle is on the bed while the carriages are at {lowest_mm:.1}");
                return wrong(whose, "travel_mm", &cause, "raise it");
            }
        }
        Ok(())
    }
}

/// Checks the ends of a rail, and that it starts between them.
fn check_travel(whose: &str, (min_mm, max_mm): (f64, f64), overtravel_mm: f64, start_mm: f64) -> Result<(), Trouble> {
    check(whose, "min_mm", min_mm, Bound::Any)?;
    check(whose, "overtravel_mm", overtravel_mm, Bound::NotNegative)?;
    // Most axes begin at 0.
    check(whose, "travel_mm", max_mm, if min_mm == 0.0 { Bound::AboveZero } else { Bound::Any })?;
    check(whose, "start_mm", start_mm, Bound::Any)?;
    if max_mm <= min_mm {
        return wrong(whose, "travel_mm", &format!("{max_mm} is not above min_mm"), "raise it");
    }
    if !(min_mm - overtravel_mm..=max_mm + overtravel_mm).contains(&start_mm) {
        let cause = format!("{start_mm} is out of its reach");
        return wrong(whose, "start_mm", &cause, &format!("start between {min_mm} and {max_mm}"));
    }
    Ok(())
}

/// Checks the names of buses, which may be on several boards.
fn unique_on_boards<'a>(kind: &str, names: impl Iterator<Item = &'a String>) -> Result<(), Trouble> {
    let mut seen = HashSet::new();
    for name in names {
        if !is_local(name) {
            return no_name(kind, name);
        }
        if !seen.insert(name) {
            return wrong(kind, "name", &format!("two have the name `{name}`"), "rename one");
        }
    }
    Ok(())
}

impl LedConfig {
    /// Checks that it has a pin, and that its pins are free.
    fn validate(&self, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        let whose = &format!("led `{}`", self.name);
        if self.pins().into_iter().all(|(_, pin)| pin.is_none()) {
            return wrong(whose, "pin", "it has none", "add it, or `red_pin`, `green_pin` and `blue_pin`");
        }
        self.pins().into_iter().try_for_each(|(key, pin)| pins.claim(whose, key, pin))
    }
}

impl AxisConfig {
    /// Checks the axis alone, and that its pins are free.
    fn validate(&self, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        use Bound::{AboveZero, Any, NotNegative};
        let whose = &format!("axis `{}`", self.name);
        pins.claim(whose, "step_pin", Some(&self.step_pin))?;
        pins.claim(whose, "dir_pin", Some(&self.dir_pin))?;
        // One line may enable several motors.
        pins.claim_for(Some("enable"), whose, "enable_pin", self.enable_pin.as_ref())?;
        pins.claim(whose, "endstop_pin", self.endstop_pin.as_ref())?;
        check(whose, "steps_per_mm", self.steps_per_mm, AboveZero)?;
        check(whose, "microsteps", self.microsteps.into(), AboveZero)?;
        check(whose, "overtravel_mm", self.overtravel_mm, NotNegative)?;
        check(whose, "start_mm", self.start_mm, Any)?;
        check(whose, "homing_mm_per_s", self.homing_mm_per_s, AboveZero)?;
        check(whose, "min_mm", self.min_mm, Any)?;
        check(whose, "endstop_mm", self.endstop_mm.unwrap_or(0.0), Any)?;
        self.carriages.values().try_for_each(|way| check(whose, "carriages", *way, Any))?;
        match self.travel_mm {
            Some(travel_mm) => check_travel(whose, (self.min_mm, travel_mm), self.overtravel_mm, self.start_mm)?,
            None if self.endstop_pin.is_some() => {
                return wrong(
                    whose,
                    "travel_mm",
                    "an axis with an endstop needs it",
                    "add it, or remove `endstop_pin`",
                );
            }
            None => {}
        }
        Ok(())
    }
}

impl FanConfig {
    /// Checks the fan, and that its pins are free.
    fn validate(&self, printer: &Printer<'_>, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        use Bound::{AboveZero, NotNegative};
        let whose = &format!("fan `{}`", self.name);
        pins.claim(whose, "pin", Some(&self.pin))?;
        pins.claim(whose, "enable_pin", self.enable_pin.as_ref())?;
        pins.claim(whose, "tachometer_pin", self.tachometer_pin.as_ref())?;
        check(whose, "pulses_per_revolution", self.pulses_per_revolution.into(), AboveZero)?;
        check(whose, "max_rpm", self.max_rpm, AboveZero)?;
        check(whose, "spin_up_s", self.spin_up_s, AboveZero)?;
        check(whose, "cooling_w_per_k", self.cooling_w_per_k, NotNegative)?;
        let Some(heater) = &self.cools else {
            return match self.cooling_w_per_k {
                0.0 => Ok(()),
                _ => wrong(whose, "cooling_w_per_k", "it cools nothing", "add `cools`, or remove this"),
            };
        };
        there_is(whose, "cools", heater, printer.heaters.iter().map(|heater| &heater.name), "[[heater]]")?;
        if printer.fans.iter().filter(|fan| fan.cools == self.cools).count() > 1 {
            return wrong(whose, "cools", &format!("two fans cool `{heater}`"), "keep one");
        }
        Ok(())
    }
}

impl SpiBusConfig {
    /// Checks the bus, and that the trace pins are outputs of the printer.
    fn validate(&self, printer: &Printer<'_>) -> Result<(), Trouble> {
        let whose = &format!("spi_bus `{}`", self.name);
        check(whose, "delay_us", self.delay_us as f64, Bound::NotNegative)?;
        let unknown = self.trace_pins.iter().find(|name| !printer.switched().any(|pin| pin.name == **name));
        unknown.map_or(Ok(()), |name| {
            let cause = format!("`{name}` is not a pin of an [[output]] or [[led]]");
            wrong(whose, "trace_pins", &cause, "name such a pin, without `!`")
        })
    }
}

impl I2cBusConfig {
    fn validate(&self) -> Result<(), Trouble> {
        check(&format!("i2c_bus `{}`", self.name), "delay_us", self.delay_us as f64, Bound::NotNegative)
    }
}

impl BedConfig {
    fn validate(&self) -> Result<(), Trouble> {
        for (key, value) in [("x_slope_mm", self.x_slope_mm), ("y_slope_mm", self.y_slope_mm), ("bow_mm", self.bow_mm)]
        {
            check("[bed]", key, value, Bound::Any)?;
        }
        Ok(())
    }
}

impl HeaterConfig {
    /// Checks the heater with its fan, and that its pins are free.
    fn validate(&self, printer: &Printer<'_>, pins: &mut UsedPins<'_>) -> Result<(), Trouble> {
        use Bound::{AboveZero, NotNegative};
        let whose = &format!("heater `{}`", self.name);
        pins.claim(whose, "pin", self.pin.as_ref())?;
        if self.pin.is_none()
            && (self.name == "heater_bed" || printer.hot_ends().any(|hot_end| hot_end.name == self.name))
        {
            return wrong(whose, "pin", "klippy's heater of this name has one", "add it, or rename the heater");
        }
        pins.claim(whose, "sensor_pin", self.sensor_pin.as_ref())?;
        if self.sensor_pin.as_ref().is_some_and(|pin| pin.inverted) {
            return wrong(whose, "sensor_pin", "an analog pin has no polarity", "remove the `!`");
        }
        // Without a heater there is only a sensor.
        check(whose, "heater_watts", self.heater_watts, if self.pin.is_some() { AboveZero } else { NotNegative })?;
        check(whose, "heat_capacity_j_per_k", self.heat_capacity_j_per_k, AboveZero)?;
        check(whose, "loss_w_per_k", self.loss_w_per_k, AboveZero)?;
        check(whose, "sensor_lag_s", self.sensor_lag_s, NotNegative)?;
        let cooling_w_per_k = printer.fan_of(&self.name).map_or(0.0, |fan| fan.cooling_w_per_k);
        let time_constant_s = self.heat_capacity_j_per_k / (self.loss_w_per_k + cooling_w_per_k);
        if self.sensor_lag_s > time_constant_s / 2.0 {
            return wrong(
                whose,
                "sensor_lag_s",
                &format!("{} is slower than the heater itself", self.sensor_lag_s),
                &format!("stay below {:.1}", time_constant_s / 2.0),
            );
        }
        self.validate_temperatures(whose)?;
        check(whose, "noise_counts", self.noise_counts, NotNegative)?;
        check(whose, "pullup_ohm", self.pullup_ohm, AboveZero)?;
        self.sensor()?;
        Ok(())
    }

    fn validate_temperatures(&self, whose: &str) -> Result<(), Trouble> {
        let absolute_zero = -KELVIN;
        for (key, celsius) in [
            ("ambient_celsius", self.ambient_celsius),
            ("start_celsius", self.start_celsius()),
            ("min_celsius", self.min_celsius),
        ] {
            check(whose, key, celsius, Bound::Any)?;
            // klippy's lowest min_temp is absolute zero itself.
            if celsius < absolute_zero || celsius == absolute_zero && key != "min_celsius" {
                return wrong(whose, key, &format!("{celsius} is below absolute zero"), "use degrees Celsius");
            }
        }
        check(whose, "max_celsius", self.max_celsius, Bound::Any)?;
        if self.max_celsius <= self.min_celsius {
            return wrong(whose, "max_celsius", &format!("{} is not above min_celsius", self.max_celsius), "raise it");
        }
        Ok(())
    }
}
