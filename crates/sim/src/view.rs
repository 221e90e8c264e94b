// SPDX-License-Identifier: GPL-3.0-or-later
//! What a person would see of a simulated printer.

#![forbid(unsafe_code)]

use std::sync::Arc;

use super::engine::world::World;
use pinion_firmware::time::{Clock, TimeSource};

/// A view of a simulated printer, from any thread, while it runs.
#[derive(Clone)]
pub struct SimProbe {
    pub(super) world: Arc<World>,
    pub(super) clock: Arc<dyn TimeSource>,
}

/// An axis as it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisView<'a> {
    /// Such as `x`.
    pub name: &'a str,
    /// Where it stands.
    pub position_mm: f64,
    /// It goes from 0 to here, if it ends.
    pub travel_mm: Option<f64>,
    /// Whether its motor is held.
    pub enabled: bool,
    /// Whether its endstop is closed; none if it has none.
    pub endstop: Option<bool>,
    /// Steps that it could not go since the start.
    pub lost_steps: u64,
}

/// A heater as it is.
#[derive(Clone, Debug, PartialEq)]
pub struct HeaterView<'a> {
    /// Such as `heater_bed`.
    pub name: &'a str,
    /// Temperature of the heated mass.
    pub celsius: f64,
    /// Temperature of its sensor, which lags behind.
    pub sensor_celsius: f64,
    /// Whether power is on.
    pub on: bool,
}

/// A fan as it turns.
#[derive(Clone, Debug, PartialEq)]
pub struct FanView<'a> {
    /// Such as `fan`.
    pub name: &'a str,
    /// Revolutions in a minute.
    pub rpm: f64,
}

/// A light, or another output that is on or off.
#[derive(Clone, Debug, PartialEq)]
pub struct OutputView<'a> {
    /// Such as `light`.
    pub name: &'a str,
    /// Whether it is on.
    pub on: bool,
    /// How bright an eye takes it for, 0 to 1: half if it is switched on and off quickly.
    pub brightness: f64,
}

impl SimProbe {
    /// The instant of the printer's clock.
    pub fn now(&self) -> Clock {
        self.clock.now()
    }

    /// The axes, in the description's order.
    pub fn axes(&self) -> impl Iterator<Item = AxisView<'_>> {
        self.world.axes.iter().map(|axis| AxisView {
            name: &axis.name,
            position_mm: axis.position_mm(),
            travel_mm: axis.travel_mm,
            enabled: axis.is_enabled(),
            endstop: axis.endstop(),
            lost_steps: axis.lost_steps(),
        })
    }

    /// The heaters at this instant.
    pub fn heaters(&self) -> impl Iterator<Item = HeaterView<'_>> {
        let now = self.now();
        self.world.heaters.iter().map(move |heater| {
            let heat = heater.at(now);
            HeaterView { name: &heater.name, celsius: heat.celsius, sensor_celsius: heat.sensor_celsius, on: heat.on }
        })
    }

    /// The fans at this instant.
    pub fn fans(&self) -> impl Iterator<Item = FanView<'_>> {
        let now = self.now();
        self.world.fans.iter().map(move |fan| FanView { name: &fan.name, rpm: fan.rpm(now) })
    }

    /// The lights, then the other outputs.
    pub fn outputs(&self) -> impl Iterator<Item = OutputView<'_>> {
        let now = self.now();
        let lamps = self.world.lamps.iter();
        lamps.map(move |lamp| OutputView { name: &lamp.name, on: lamp.is_on(), brightness: lamp.brightness(now) })
    }

    /// What a person would see of the other parts at this instant: the part's name, and a line or a
    /// picture of several lines.
    pub fn sights(&self) -> impl Iterator<Item = (&str, String)> {
        let now = self.now();
        self.world.sights.iter().map(move |sight| (sight.name(), sight.look(now)))
    }

    /// An axis by name.
    pub fn axis(&self, name: &str) -> Option<AxisView<'_>> {
        self.axes().find(|axis| axis.name == name)
    }

    /// A heater by name.
    pub fn heater(&self, name: &str) -> Option<HeaterView<'_>> {
        self.heaters().find(|heater| heater.name == name)
    }

    /// A fan by name.
    pub fn fan(&self, name: &str) -> Option<FanView<'_>> {
        self.fans().find(|fan| fan.name == name)
    }

    /// A light or another output by name.
    pub fn output(&self, name: &str) -> Option<OutputView<'_>> {
        self.outputs().find(|output| output.name == name)
    }
}
