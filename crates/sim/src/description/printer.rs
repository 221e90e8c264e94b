// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer of a description, and how its axes move the head.

#![forbid(unsafe_code)]

use super::axes::{AxisConfig, BedConfig, DeltaConfig, Limits};
use super::buses::{I2cBusConfig, SpiBusConfig};
use super::check::{Trouble, there_is};
use super::heater::{FanConfig, HeaterConfig};
use super::outputs::{InputConfig, LedConfig, OutputConfig};
use super::pin::PinName;

/// A description without its parts: everything that a part may know of its printer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Printer<'a> {
    pub(crate) seed: u64,
    pub(crate) limits: &'a Limits,
    pub(crate) axes: &'a [AxisConfig],
    pub(crate) corexy: bool,
    pub(crate) delta: Option<&'a DeltaConfig>,
    pub(crate) heaters: &'a [HeaterConfig],
    pub(crate) fans: &'a [FanConfig],
    pub(crate) leds: &'a [LedConfig],
    pub(crate) outputs: &'a [OutputConfig],
    pub(crate) inputs: &'a [InputConfig],
    pub(crate) bed: &'a BedConfig,
    pub(crate) spi_buses: &'a [SpiBusConfig],
    pub(crate) i2c_buses: &'a [I2cBusConfig],
}

/// How the axes move the head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Kinematics<'a> {
    /// `x`, `y` and `z` with endstops, each independent.
    Cartesian,
    /// As `Cartesian`, but the motors `x` and `y` drive two belts.
    CoreXy,
    /// `a`, `b` and `c` together.
    Delta(&'a DeltaConfig),
    /// Each axis is only a motor.
    None,
}

impl Kinematics<'_> {
    /// Whether the rails are x, y and z.
    pub(crate) fn has_gantry(&self) -> bool {
        self.rails().contains(&"z")
    }

    /// The axes of klippy's kinematics. Each may have more than one motor.
    pub(crate) fn rails(&self) -> &'static [&'static str] {
        match self {
            Kinematics::Cartesian | Kinematics::CoreXy => &["x", "y", "z"],
            Kinematics::Delta(_) => &DeltaConfig::TOWERS,
            Kinematics::None => &[],
        }
    }
}

impl<'a> Printer<'a> {
    /// An axis by its name.
    pub(crate) fn axis(&self, name: &str) -> Option<&'a AxisConfig> {
        self.axes.iter().find(|axis| axis.name == name)
    }

    pub(crate) fn kinematics(&self) -> Kinematics<'a> {
        let can_home = |name| self.axis(name).is_some_and(|axis| axis.endstop_pin.is_some());
        match self.delta {
            Some(delta) => Kinematics::Delta(delta),
            None if self.corexy => Kinematics::CoreXy,
            None if ["x", "y", "z"].into_iter().all(can_home) => Kinematics::Cartesian,
            None => Kinematics::None,
        }
    }

    /// The motors of a rail, for example `z`, `z1` and `z2`.
    pub(crate) fn motors(&self, rail: &str) -> impl Iterator<Item = &'a AxisConfig> {
        in_a_row(rail, |name| self.axis(name))
    }

    /// The heaters of the hot ends: `extruder`, `extruder1` and so on.
    pub(crate) fn hot_ends(&self) -> impl Iterator<Item = &'a HeaterConfig> {
        in_a_row("extruder", |name| self.heaters.iter().find(|heater| heater.name == name))
    }

    /// The pins of all lights and other outputs.
    pub(crate) fn switched(&self) -> impl Iterator<Item = &'a PinName> {
        let leds = self.leds.iter().flat_map(|led| led.pins().into_iter().filter_map(|(_, pin)| pin));
        leds.chain(self.outputs.iter().map(|output| &output.pin))
    }

    /// The fan that cools a heater; `None` if there is no such fan.
    pub(crate) fn fan_of(&self, heater: &str) -> Option<&'a FanConfig> {
        self.fans.iter().find(|fan| fan.cools.as_deref() == Some(heater))
    }

    /// Checks that the axis in a part's key `axis` exists.
    pub(crate) fn check_axis(&self, whose: &str, axis: &str) -> Result<(), Trouble> {
        there_is(whose, "axis", axis, self.axes.iter().map(|axis| &axis.name), "[[axis]]")
    }

    /// Checks that the heater in a part's key `heater` exists.
    pub(crate) fn check_heater(&self, whose: &str, heater: &str) -> Result<(), Trouble> {
        there_is(whose, "heater", heater, self.heaters.iter().map(|heater| &heater.name), "[[heater]]")
    }

    pub(crate) fn check_spi_bus(&self, whose: &str, bus: &str) -> Result<(), Trouble> {
        there_is(whose, "bus", bus, self.spi_buses.iter().map(|bus| &bus.name), "[[spi_bus]]")
    }

    pub(crate) fn check_i2c_bus(&self, whose: &str, bus: &str) -> Result<(), Trouble> {
        there_is(whose, "bus", bus, self.i2c_buses.iter().map(|bus| &bus.name), "[[i2c_bus]]")
    }
}

/// The element called `first`, then the same name with 1, 2 and so on until one is missing. klippy searches in this
/// way.
fn in_a_row<T>(first: &str, find: impl Fn(&str) -> Option<T>) -> impl Iterator<Item = T> {
    let name = move |n| if n == 0 { first.to_owned() } else { format!("{first}{n}") };
    (0..).map_while(move |n| find(&name(n)))
}
