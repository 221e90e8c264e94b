// SPDX-License-Identifier: GPL-3.0-or-later
//! A person's view of a simulated printer.

use std::fs::File;
use std::sync::Arc;

use super::engine::bed::{Bed, Space};
use super::engine::look::Look;
use super::engine::pace::PaceWatch;
use super::engine::rail::Rail;
use super::engine::recorder::Recorder;
use super::engine::ring::RingWatch;
use super::engine::spi::SpiBus;
use super::engine::world::World;
use pinion_firmware::time::{Clock, Ticks, TimeSource};

/// A view of a simulated printer, from any thread, while it runs.
#[derive(Clone)]
pub struct SimProbe {
    pub(super) world: Arc<World>,
    pub(super) bed: Arc<Bed>,
    pub(super) spi_buses: Vec<Arc<SpiBus>>,
    pub(super) clock: Arc<dyn TimeSource>,
    /// How long the steps of an instant may still come.
    pub(super) settles: Ticks,
}

/// The present state of an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisView<'a> {
    /// For example `x`.
    pub name: &'a str,
    /// Its position. On a CoreXY printer it is the head's place along x or y, and not the motor's.
    pub position_mm: f64,
    /// The lowest place of its travel.
    pub min_mm: f64,
    /// The highest place of its travel; `None` for an axis without an end.
    pub travel_mm: Option<f64>,
    /// Whether its motor is held.
    pub enabled: bool,
    /// Whether its endstop is closed; `None` without an endstop.
    pub endstop: Option<bool>,
    /// Steps since the start that it could not make.
    pub lost_steps: u64,
}

/// The present state of a heater.
#[derive(Clone, Debug, PartialEq)]
pub struct HeaterView<'a> {
    /// For example `heater_bed`.
    pub name: &'a str,
    /// Temperature of the heated mass.
    pub celsius: f64,
    /// Temperature of its sensor, which lags behind.
    pub sensor_celsius: f64,
    /// Whether power is on.
    pub on: bool,
}

/// The present state of a fan.
#[derive(Clone, Debug, PartialEq)]
pub struct FanView<'a> {
    /// For example `fan`.
    pub name: &'a str,
    /// Revolutions per minute.
    pub rpm: f64,
}

/// A light, or another output that is on or off.
#[derive(Clone, Debug, PartialEq)]
pub struct OutputView<'a> {
    /// For example `light`.
    pub name: &'a str,
    /// Whether it is on.
    pub on: bool,
    /// The brightness that an eye sees, 0 to 1. It is half if the output is switched on and off quickly.
    pub brightness: f64,
}

impl SimProbe {
    /// Writes a line for each SPI transfer into this file from now on: the bus, the selected chips, the bytes in both
    /// directions, and the levels of the bus's `trace_pins` at each byte.
    pub fn record_spi(&self, file: File) {
        let file = Arc::new(file);
        self.spi_buses.iter().for_each(|bus| bus.record_to(file.clone()));
    }

    /// The present instant of the printer's clock.
    pub fn now(&self) -> Clock {
        self.clock.now()
    }

    /// The axes, in the description's order, then the carriages that have no motor of their own.
    pub fn axes(&self) -> impl Iterator<Item = AxisView<'_>> {
        let view = |rail: &'_ Rail| AxisView {
            name: "",
            position_mm: rail.position_mm(),
            min_mm: rail.travel_mm.map_or(0.0, |(min_mm, _)| min_mm),
            travel_mm: rail.travel_mm.map(|(_, max_mm)| max_mm),
            enabled: true,
            endstop: rail.endstop(),
            lost_steps: 0,
        };
        let axes = self.world.axes.iter().map(move |axis| AxisView {
            name: &axis.name,
            enabled: axis.is_enabled(),
            lost_steps: axis.lost_steps(),
            ..view(axis.rail())
        });
        let carriages = self.world.carriages.iter();
        axes.chain(carriages.map(move |rail| AxisView { name: &rail.name, ..view(rail) }))
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

    /// Where the steps have put the nozzle: x, y and z. klippy's place is the same if it has homed, lost no step, and
    /// uses neither a bed mesh nor another transformation.
    pub fn nozzle_mm(&self) -> [f64; 3] {
        self.bed.head().nozzle_mm(Rail::position_mm)
    }

    /// The space that the nozzle can reach, over the bed. It never changes. `None` if an axis is missing or has no end.
    pub fn space(&self) -> Option<Space> {
        self.bed.space()
    }

    /// Its boards run in one clock: the steps of several come in the order of their time, except for a few ticks by which
    /// their clocks drift. A recorder that waited longer would lose steps of a motor with 256 microsteps.
    pub fn in_one_clock(mut self) -> SimProbe {
        self.settles = self.settles.min(Ticks::from_ms(1));
        self
    }

    /// Records the path of the nozzle from now on.
    pub fn recorder(&self) -> Recorder {
        Recorder::new(self.bed.clone(), &self.world.extruders, self.settles, self.now())
    }

    /// Watches how fast the motors are, from now on.
    pub fn paces(&self) -> PaceWatch {
        PaceWatch::new(&self.world.axes, self.now())
    }

    /// Watches what rings on the axes, from now on.
    pub fn rings(&self) -> Vec<RingWatch> {
        let now = self.now();
        self.world.rings.iter().map(|(rail, config)| RingWatch::new(rail.clone(), config, now)).collect()
    }

    /// A person's view of the other parts at this instant: the part's name, and what it looks like.
    pub fn sights(&self) -> impl Iterator<Item = (&str, Look)> {
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
