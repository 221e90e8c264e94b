// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer of a description, and how its axes move the head.

use super::axes::{AxisConfig, BedConfig, CarriageConfig, DeltaConfig, Limits};
use super::buses::{I2cBusConfig, SpiBusConfig};
use super::check::{Trouble, there_is};
use super::heater::{FanConfig, HeaterConfig};
use super::kinematics::{DeltesianConfig, KinematicsConfig, RotaryDeltaConfig, WinchConfig};
use super::outputs::{AnalogConfig, InputConfig, LedConfig, OutputConfig};
use super::pin::PinName;

/// A description without its parts: everything that a part may know of its printer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Printer<'a> {
    pub(crate) seed: u64,
    pub(crate) limits: &'a Limits,
    pub(crate) axes: &'a [AxisConfig],
    pub(crate) carriages: &'a [CarriageConfig],
    /// `[kinematics]`. The next two keys are older.
    pub(crate) chosen: Option<&'a KinematicsConfig>,
    pub(crate) corexy: bool,
    pub(crate) delta: Option<&'a DeltaConfig>,
    pub(crate) heaters: &'a [HeaterConfig],
    pub(crate) fans: &'a [FanConfig],
    pub(crate) leds: &'a [LedConfig],
    pub(crate) outputs: &'a [OutputConfig],
    pub(crate) inputs: &'a [InputConfig],
    pub(crate) analogs: &'a [AnalogConfig],
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
    /// As `Cartesian`, but the motors `x` and `z` drive two belts.
    CoreXz,
    /// As `Cartesian`, but the belt of `x` runs along y too.
    HybridCoreXy,
    /// As `Cartesian`, but the belt of `x` runs along z too.
    HybridCoreXz,
    /// Carriages, and motors that say which of them they move.
    Generic,
    /// `a`, `b` and `c` together.
    Delta(&'a DeltaConfig),
    /// `left`, `right` and `y`.
    Deltesian(&'a DeltesianConfig),
    /// `bed`, `arm` and `z`.
    Polar,
    /// `a`, `b` and `c` turn.
    RotaryDelta(&'a RotaryDeltaConfig),
    /// `a`, `b`, `c` and so on are cables.
    Winch(&'a WinchConfig),
    /// Each axis is only a motor.
    None,
}

impl Kinematics<'_> {
    /// Whether x, y and z are independent directions of the head.
    pub(crate) fn has_gantry(&self) -> bool {
        !self.rails().is_empty() && self.rails() == Kinematics::Cartesian.rails()
    }

    /// The axes of klippy's kinematics, in its order. Each may have more than one motor.
    pub(crate) fn rails(&self) -> &'static [&'static str] {
        match self {
            Kinematics::Cartesian
            | Kinematics::CoreXy
            | Kinematics::CoreXz
            | Kinematics::HybridCoreXy
            | Kinematics::HybridCoreXz
            | Kinematics::Generic => &["x", "y", "z"],
            Kinematics::Delta(_) | Kinematics::RotaryDelta(_) => &DeltaConfig::TOWERS,
            Kinematics::Deltesian(_) => &["left", "right", "y"],
            Kinematics::Polar => &["bed", "arm", "z"],
            Kinematics::Winch(winch) => &WinchConfig::CABLES[..winch.anchors_mm.len().min(WinchConfig::CABLES.len())],
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
        if let Some(chosen) = self.chosen {
            return match chosen {
                KinematicsConfig::None(_) => Kinematics::None,
                KinematicsConfig::Cartesian(_) => Kinematics::Cartesian,
                KinematicsConfig::CoreXy(_) => Kinematics::CoreXy,
                KinematicsConfig::CoreXz(_) => Kinematics::CoreXz,
                KinematicsConfig::HybridCoreXy(_) => Kinematics::HybridCoreXy,
                KinematicsConfig::HybridCoreXz(_) => Kinematics::HybridCoreXz,
                KinematicsConfig::GenericCartesian(_) => Kinematics::Generic,
                KinematicsConfig::Delta(delta) => Kinematics::Delta(delta),
                KinematicsConfig::Deltesian(deltesian) => Kinematics::Deltesian(deltesian),
                KinematicsConfig::Polar(_) => Kinematics::Polar,
                KinematicsConfig::RotaryDelta(rotary) => Kinematics::RotaryDelta(rotary),
                KinematicsConfig::Winch(winch) => Kinematics::Winch(winch),
            };
        }
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

    /// The first motor of the rail that a further motor such as `x1` moves too. The motors of the z axis of a gantry do
    /// not: each of them holds the gantry, or the bed, at a place of its own.
    pub(crate) fn first_motor(&self, axis: &str) -> Option<&'a AxisConfig> {
        let kinematics = self.kinematics();
        let rails = kinematics.rails().iter().filter(|rail| !kinematics.has_gantry() || **rail != "z");
        let of_rail = |rail: &&str| self.motors(rail).skip(1).any(|motor| motor.name == axis);
        rails.into_iter().copied().find(|rail| of_rail(rail)).and_then(|rail| self.axis(rail))
    }

    /// Whether an axis is a further motor on the belt of another one: a CoreXY with four motors has `x1` and `y1`.
    pub(crate) fn is_second_on_belt(&self, axis: &str) -> bool {
        !self.belt(axis).is_empty() && self.first_motor(axis).is_some()
    }

    /// The belt of an axis, or of the axis whose belt it shares.
    pub(crate) fn belt(&self, axis: &str) -> &'static [(&'static str, f64)] {
        let first = self.first_motor(axis).map_or(axis, |first| &first.name);
        self.kinematics().belt(first)
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

    /// Whether the motor of an axis moves several rails, or other motors move its rail.
    pub(crate) fn shares_belt(&self, axis: &str) -> bool {
        let others = self.axes.iter().filter(|other| other.name != axis);
        let mut belts = others.flat_map(|other| self.belt(&other.name));
        !self.belt(axis).is_empty()
            || belts.any(|(rail, _)| *rail == axis)
            || self.axis(axis).is_some_and(|axis| !axis.carriages.is_empty())
    }

    /// Checks that the axis in a part's key `axis` exists.
    pub(crate) fn check_axis(&self, whose: &str, axis: &str) -> Result<(), Trouble> {
        there_is(whose, "axis", axis, self.axes.iter().map(|axis| &axis.name), "[[axis]]")
    }

    /// Checks that there is an axis or a carriage of this name.
    pub(crate) fn check_rail(&self, whose: &str, rail: &str) -> Result<(), Trouble> {
        let names = self.axes.iter().map(|axis| &axis.name).chain(self.carriages.iter().map(|rail| &rail.name));
        there_is(whose, "axis", rail, names, "[[axis]]")
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
