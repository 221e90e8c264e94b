// SPDX-License-Identifier: GPL-3.0-or-later
//! Whether the values of a description make a printer. An error names the first one that is wrong, and a remedy.

#![forbid(unsafe_code)]

use std::collections::HashSet;

use super::{
    AxisConfig, BedConfig, DeltaConfig, End, FanConfig, HeaterConfig, I2cBusConfig, Kinematics, LedConfig, Limits,
    PinName, SimConfig, SimError, SpiBusConfig, is_word,
};
use crate::catalog::PartConfig;
use crate::description::thermistor::KELVIN;
use crate::part::workshop::{Part, Socket};

impl SimConfig {
    /// Checks that the values make a printer.
    ///
    /// # Errors
    ///
    /// The first value that is wrong, with its key and a remedy.
    pub(crate) fn validate(&self) -> Result<(), SimError> {
        self.limits.validate()?;
        unique("[[axis]]", self.axes.iter().map(|axis| &axis.name))?;
        unique("[[heater]]", self.heaters.iter().map(|heater| &heater.name))?;
        unique("[[fan]]", self.fans.iter().map(|fan| &fan.name))?;
        unique("[[led]]", self.leds.iter().map(|led| &led.name))?;
        unique("[[output]]", self.outputs.iter().map(|output| &output.name))?;
        unique("[[input]]", self.inputs.iter().map(|input| &input.name))?;
        unique("[[spi_bus]]", self.spi_buses.iter().map(|bus| &bus.name))?;
        let mut pins = UsedPins::default();
        self.axes.iter().try_for_each(|axis| axis.validate(&mut pins))?;
        self.validate_places()?;
        if let Some(delta) = &self.delta {
            delta.validate(self)?;
        }
        self.heaters.iter().try_for_each(|heater| heater.validate(self, &mut pins))?;
        self.fans.iter().try_for_each(|fan| fan.validate(self, &mut pins))?;
        self.leds.iter().try_for_each(|led| led.validate(&mut pins))?;
        for output in &self.outputs {
            pins.claim(&format!("output `{}`", output.name), "pin", Some(&output.pin))?;
        }
        for input in &self.inputs {
            pins.claim(&format!("input `{}`", input.name), "pin", Some(&input.pin))?;
        }
        unique("[[i2c_bus]]", self.i2c_buses.iter().map(|bus| &bus.name))?;
        self.bed.validate()?;
        for bus in &self.spi_buses {
            bus.validate(self)?;
            pins.claim(&format!("spi_bus `{}`", bus.name), "name", Some(&bus.mosi_pin()))?;
        }
        self.i2c_buses.iter().try_for_each(I2cBusConfig::validate)?;
        self.parts.iter().try_for_each(|part| self.validate_part(part.part(), &mut pins))
    }

    /// Checks where the motors of the z axis hold what they lift.
    fn validate_places(&self) -> Result<(), SimError> {
        let is_cartesian = self.kinematics() == Kinematics::Cartesian;
        let motors: Vec<&AxisConfig> = self.motors("z").filter(|_| is_cartesian).collect();
        let whose = |axis: &AxisConfig| format!("axis `{}`", axis.name);
        if let Some(other) =
            self.axes.iter().find(|axis| axis.at_mm.is_some() && !motors.iter().any(|motor| motor.name == axis.name))
        {
            let cause = "only a motor of the z axis of a cartesian printer has a place";
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

    /// Checks that there is the axis that a part's key `axis` names.
    pub(crate) fn check_axis(&self, whose: &str, axis: &str) -> Result<(), SimError> {
        there_is(whose, "axis", axis, self.axes.iter().map(|axis| &axis.name), "[[axis]]")
    }

    /// Checks that there is the heater that a part's key `heater` names.
    pub(crate) fn check_heater(&self, whose: &str, heater: &str) -> Result<(), SimError> {
        there_is(whose, "heater", heater, self.heaters.iter().map(|heater| &heater.name), "[[heater]]")
    }

    fn check_spi_bus(&self, whose: &str, bus: &str) -> Result<(), SimError> {
        there_is(whose, "bus", bus, self.spi_buses.iter().map(|bus| &bus.name), "[[spi_bus]]")
    }

    fn check_i2c_bus(&self, whose: &str, bus: &str) -> Result<(), SimError> {
        there_is(whose, "bus", bus, self.i2c_buses.iter().map(|bus| &bus.name), "[[i2c_bus]]")
    }

    /// Checks a part against the rest of the printer, and that its pins are free.
    fn validate_part(&self, part: &dyn Part, pins: &mut UsedPins) -> Result<(), SimError> {
        let whose = &format!("part `{}`", part.name());
        if self.parts.iter().filter(|other| other.part().name() == part.name()).count() > 1 {
            return Err(SimError(format!("{whose}: there are two of it: remove one, or tell them apart")));
        }
        part.pins().into_iter().try_for_each(|(key, pin)| pins.claim(whose, key, pin))?;
        let socket = part.socket();
        let neighbours = self.parts.iter().map(PartConfig::part).filter(|other| other.name() != part.name());
        let mut neighbours = neighbours.filter_map(Part::socket);
        match socket {
            Some(Socket::Spi { bus, select_pin }) => {
                pins.claim(whose, "select_pin", select_pin)?;
                self.check_spi_bus(whose, bus)?;
                if select_pin.is_some_and(|pin| pin.inverted) {
                    let cause = "klippy knows chips that are selected by a low level only";
                    return wrong(whose, "select_pin", cause, "remove the `!`");
                }
                let shares = neighbours.any(|other| matches!(other, Socket::Spi { bus: its, .. } if its == bus));
                if select_pin.is_none() && shares {
                    return wrong(whose, "select_pin", "it is not the only chip on its bus", "add it");
                }
            }
            Some(Socket::I2c { bus, address }) => {
                self.check_i2c_bus(whose, bus)?;
                if !(0x08..0x78).contains(&address) {
                    return wrong(whose, "address", &format!("{address} is no 7 bit address"), "give 8 to 119");
                }
                if neighbours.any(|other| Some(other) == socket) {
                    return wrong(whose, "address", &format!("{address} is taken on this bus"), "give another");
                }
            }
            Some(Socket::Mosi { bus }) => self.check_spi_bus(whose, bus)?,
            None => {}
        }
        part.validate(whose, self)?;
        // What stands behind the kind was named by the description, and names a section of printer.cfg.
        let name = part.name();
        match name.split_once(' ') {
            Some((_, own)) if !is_word(own) => no_name(whose, own),
            _ => Ok(()),
        }
    }
}

impl Limits {
    fn validate(&self) -> Result<(), SimError> {
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
    fn validate(&self, printer: &SimConfig) -> Result<(), SimError> {
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
                return Err(SimError(format!("{WHOSE}: there is no axis `{tower}`: add an [[axis]] for each tower")));
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

impl LedConfig {
    /// Checks that it has a pin, and that its pins are free.
    fn validate(&self, pins: &mut UsedPins) -> Result<(), SimError> {
        let whose = &format!("led `{}`", self.name);
        if self.pins().into_iter().all(|(_, pin)| pin.is_none()) {
            return wrong(whose, "pin", "it has none", "add it, or `red_pin`, `green_pin` and `blue_pin`");
        }
        self.pins().into_iter().try_for_each(|(key, pin)| pins.claim(whose, key, pin))
    }
}

impl AxisConfig {
    /// Checks the axis by itself, and that its pins are free.
    fn validate(&self, pins: &mut UsedPins) -> Result<(), SimError> {
        use Bound::{AboveZero, Any, NotNegative};
        let whose = &format!("axis `{}`", self.name);
        pins.claim(whose, "step_pin", Some(&self.step_pin))?;
        pins.claim(whose, "dir_pin", Some(&self.dir_pin))?;
        pins.claim(whose, "enable_pin", self.enable_pin.as_ref())?;
        pins.claim(whose, "endstop_pin", self.endstop_pin.as_ref())?;
        check(whose, "steps_per_mm", self.steps_per_mm, AboveZero)?;
        check(whose, "microsteps", self.microsteps.into(), AboveZero)?;
        check(whose, "overtravel_mm", self.overtravel_mm, NotNegative)?;
        check(whose, "start_mm", self.start_mm, Any)?;
        check(whose, "homing_mm_per_s", self.homing_mm_per_s, AboveZero)?;
        match self.travel_mm {
            Some(travel_mm) => {
                check(whose, "travel_mm", travel_mm, AboveZero)?;
                let free = -self.overtravel_mm..=travel_mm + self.overtravel_mm;
                if !free.contains(&self.start_mm) {
                    return wrong(
                        whose,
                        "start_mm",
                        &format!("{} is out of its reach", self.start_mm),
                        &format!("start between 0 and {travel_mm}"),
                    );
                }
            }
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
    fn validate(&self, printer: &SimConfig, pins: &mut UsedPins) -> Result<(), SimError> {
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
    /// Checks the bus, and that the pins to trace are outputs of the printer.
    fn validate(&self, printer: &SimConfig) -> Result<(), SimError> {
        let whose = &format!("spi_bus `{}`", self.name);
        check(whose, "delay_us", self.delay_us as f64, Bound::NotNegative)?;
        let unknown = self.trace_pins.iter().find(|name| !printer.switched().any(|pin| pin.name == **name));
        unknown.map_or(Ok(()), |name| {
            let cause = format!("`{name}` is no pin of an [[output]] or [[led]]");
            wrong(whose, "trace_pins", &cause, "name such a pin, without `!`")
        })
    }
}

impl I2cBusConfig {
    fn validate(&self) -> Result<(), SimError> {
        check(&format!("i2c_bus `{}`", self.name), "delay_us", self.delay_us as f64, Bound::NotNegative)
    }
}

impl BedConfig {
    fn validate(&self) -> Result<(), SimError> {
        for (key, value) in [("x_slope_mm", self.x_slope_mm), ("y_slope_mm", self.y_slope_mm), ("bow_mm", self.bow_mm)]
        {
            check("[bed]", key, value, Bound::Any)?;
        }
        Ok(())
    }
}

impl HeaterConfig {
    /// Checks the heater with its fan, and that its pins are free.
    fn validate(&self, printer: &SimConfig, pins: &mut UsedPins) -> Result<(), SimError> {
        use Bound::{AboveZero, NotNegative};
        let whose = &format!("heater `{}`", self.name);
        pins.claim(whose, "pin", self.pin.as_ref())?;
        if self.pin.is_none()
            && (self.name == "heater_bed" || printer.hot_ends().any(|hot_end| hot_end.name == self.name))
        {
            return wrong(whose, "pin", "klippy's heater of this name has one", "add it, or rename the heater");
        }
        pins.claim(whose, "sensor_pin", Some(&self.sensor_pin))?;
        if self.sensor_pin.inverted {
            return wrong(whose, "sensor_pin", "an analog pin has no polarity", "remove the `!`");
        }
        check(whose, "heater_watts", self.heater_watts, AboveZero)?;
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
        self.thermistor()?;
        Ok(())
    }

    fn validate_temperatures(&self, whose: &str) -> Result<(), SimError> {
        let absolute_zero = -KELVIN;
        for (key, celsius) in [
            ("ambient_celsius", self.ambient_celsius),
            ("start_celsius", self.start_celsius()),
            ("min_celsius", self.min_celsius),
        ] {
            check(whose, key, celsius, Bound::Any)?;
            if celsius <= absolute_zero {
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

/// The range that a number must be in.
pub(crate) enum Bound {
    Any,
    NotNegative,
    AboveZero,
}

/// The pins that have a use already, by name.
#[derive(Default)]
struct UsedPins(HashSet<String>);

impl UsedPins {
    /// Uses a pin, if there is one; fails if it has a use already.
    fn claim(&mut self, whose: &str, key: &str, pin: Option<&PinName>) -> Result<(), SimError> {
        match pin {
            Some(pin) if !self.0.insert(pin.name.clone()) => {
                wrong(whose, key, &format!("pin `{}` has a use already", pin.name), "give every pin its own name")
            }
            _ => Ok(()),
        }
    }
}

/// Checks that the parts of a kind have names, and that no two share one.
fn unique<'a>(kind: &str, mut names: impl Iterator<Item = &'a String>) -> Result<(), SimError> {
    let mut seen = HashSet::new();
    names.try_for_each(|name| {
        if !is_word(name) {
            no_name(kind, name)
        } else if !seen.insert(name) {
            wrong(kind, "name", &format!("two are called `{name}`"), "rename one")
        } else {
            Ok(())
        }
    })
}

/// The error of a name that klippy would not take.
fn no_name(whose: &str, name: &str) -> Result<(), SimError> {
    wrong(whose, "name", &format!("`{name}` is no name"), "use letters, digits, `_`, `-`, `.` and `/`")
}

/// Checks that something of this name is in the description; `kind` is its table.
fn there_is<'a>(
    whose: &str,
    key: &str,
    name: &str,
    mut names: impl Iterator<Item = &'a String>,
    kind: &str,
) -> Result<(), SimError> {
    if names.any(|other| other == name) {
        return Ok(());
    }
    wrong(whose, key, &format!("there is no `{name}`"), &format!("name an {kind}"))
}

/// The error of a key.
pub(super) fn fault(whose: &str, key: &str, cause: &str, remedy: &str) -> SimError {
    SimError(format!("{whose}, key `{key}`: {cause}: {remedy}"))
}

/// The error of a key, as a result.
pub(crate) fn wrong(whose: &str, key: &str, cause: &str, remedy: &str) -> Result<(), SimError> {
    Err(fault(whose, key, cause, remedy))
}

/// Larger numbers describe no printer, and could overflow a position or a time.
const MAX_NUMBER: f64 = 1e9;

/// The lights of the longest strip.
const MAX_LIGHTS: u32 = 1000;

/// Checks how many lights a strip has.
pub(crate) fn check_lights(whose: &str, count: u32) -> Result<(), SimError> {
    check(whose, "count", count.into(), Bound::AboveZero)?;
    if count > MAX_LIGHTS {
        return wrong(whose, "count", &format!("{count} is too many"), &format!("{MAX_LIGHTS} at most"));
    }
    Ok(())
}

/// Checks that a number is in its range.
pub(crate) fn check(whose: &str, key: &str, value: f64, bound: Bound) -> Result<(), SimError> {
    let fault = match bound {
        _ if !(-MAX_NUMBER..=MAX_NUMBER).contains(&value) => "is out of range",
        Bound::NotNegative if value < 0.0 => "is below zero",
        Bound::AboveZero if value < 1.0 / MAX_NUMBER => "is not above zero",
        _ => return Ok(()),
    };
    wrong(whose, key, &format!("{value} {fault}"), "set a value of the printer's")
}
