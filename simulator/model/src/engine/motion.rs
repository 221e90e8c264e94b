// SPDX-License-Identifier: GPL-3.0-or-later
//! Axes: the pins of a stepper driver, its motor, and the rails that the motor moves.
//!
//! The core of a board drives the pins of its motors. Any thread may read. Nothing here locks, blocks or allocates.

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use super::dock::Dock;
use super::rail::{Motor, Rail};
use super::seqlock::Seqlock;
use crate::description::axes::AxisConfig;
use pinion_firmware::time::Clock;

/// How far two motors of one rail may be apart. The rail then jams, and a motor that goes on loses its steps. Homing
/// stops motors of two boards up to 25 ms apart.
const RACKED_MM: f64 = 3.0;

/// A stepper motor with its driver, and the rail of its name.
#[derive(Debug)]
pub struct Axis {
    pub name: String,
    steps_per_mm: f64,
    rail: Arc<Rail>,
    /// The part that its motor moves, and the way of one step forward.
    moves: Vec<(Arc<Rail>, f64)>,
    /// The first motor of the rail that this one moves too, and the way of its step.
    beside: Option<(Arc<Motor>, f64)>,
    /// Whether a falling edge is also a step.
    both_edges: AtomicBool,
    /// Whether the step line is on.
    stepped: AtomicBool,
    /// Whether the direction line is low for forward.
    dir_inverted: bool,
    forward: AtomicBool,
    enabled: AtomicBool,
    motor: Arc<Motor>,
    /// Steps that its driver received: those with a low direction line minus those with a high one.
    turned: AtomicI64,
    lost_steps: AtomicU64,
    /// The instant of the last step, the ticks between it and the step before, and the number of lost steps in a row
    /// until then.
    stride: Seqlock<3>,
    /// The dock that the head may come to.
    dock: OnceLock<Arc<Dock>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stride {
    /// Ticks between two steps.
    pub ticks: u64,
    /// Steps in a row that the motor could not make.
    pub lost_in_a_row: u64,
}

impl Axis {
    /// A motor that moves these rails, each by this way in a step.
    pub fn driving(config: &AxisConfig, motor: Arc<Motor>, rail: Arc<Rail>, moves: Vec<(Arc<Rail>, f64)>) -> Axis {
        Axis {
            name: config.name.clone(),
            steps_per_mm: config.steps_per_mm,
            rail,
            moves,
            beside: None,
            both_edges: AtomicBool::new(config.step_both_edges),
            stepped: AtomicBool::new(false),
            dir_inverted: config.dir_pin.inverted,
            forward: AtomicBool::new(false),
            enabled: AtomicBool::new(config.enable_pin.is_none()),
            motor,
            turned: AtomicI64::new(0),
            lost_steps: AtomicU64::new(0),
            stride: Seqlock::new([0, u64::MAX, 0]),
            dock: OnceLock::new(),
        }
    }

    /// The same motor, fixed to a rail that `first` moves.
    pub fn beside(self, first: &Axis) -> Axis {
        Axis { beside: Some((first.motor.clone(), first.step_mm())), ..self }
    }

    /// Has each of its steps look at a dock.
    pub(crate) fn passes(&self, dock: Arc<Dock>) {
        let _ = self.dock.set(dock);
    }

    pub fn set_both_edges(&self, both_edges: bool) {
        self.both_edges.store(both_edges, Ordering::Relaxed);
    }

    pub fn set_forward(&self, forward: bool) {
        self.forward.store(forward, Ordering::Relaxed);
    }

    pub fn set_enabled(&self, enabled: bool) {
        self.enabled.store(enabled, Ordering::Relaxed);
    }

    pub fn is_enabled(&self) -> bool {
        self.enabled.load(Ordering::Relaxed)
    }

    /// Whether the level of the direction line is high.
    pub fn is_dir_high(&self) -> bool {
        self.forward.load(Ordering::Relaxed) != self.dir_inverted
    }

    pub fn is_stepped(&self) -> bool {
        self.stepped.load(Ordering::Relaxed)
    }

    /// An edge of the step line.
    pub fn edge(&self, on: bool, at: Clock) {
        self.stepped.store(on, Ordering::Relaxed);
        if on || self.both_edges.load(Ordering::Relaxed) {
            let [last, _, lost_in_a_row] = self.stride.load();
            let ticks = if last == 0 { u64::MAX } else { at.since(Clock::from_ticks(last)).max(0) as u64 };
            let lost_in_a_row = if self.step(at) { 0 } else { lost_in_a_row + 1 };
            self.stride.store([at.ticks(), ticks, lost_in_a_row]);
        }
    }

    /// One step. False if the motor could not make it, because its axis had hit something.
    fn step(&self, at: Clock) -> bool {
        let turn = if self.is_dir_high() { -1 } else { 1 };
        self.turned.store(self.turned_steps().wrapping_add(turn), Ordering::Relaxed);
        if !self.is_enabled() {
            return true;
        }
        let way = if self.forward.load(Ordering::Relaxed) { 1 } else { -1 };
        let moves = |(rail, step_mm): &(Arc<Rail>, f64)| rail.moves_by(way as f64 * step_mm);
        if self.racks(way) || !self.moves.iter().all(moves) {
            let lost = self.lost_steps.load(Ordering::Relaxed);
            self.lost_steps.store(lost.wrapping_add(1), Ordering::Relaxed);
            return false;
        }
        self.motor.turn(way, at);
        if let Some(dock) = self.dock.get() {
            dock.passed();
        }
        true
    }

    /// Whether a step would take it too far from the first motor of its rail.
    fn racks(&self, way: i64) -> bool {
        self.beside.as_ref().is_some_and(|(first, its_mm)| {
            let apart_mm = self.mm(self.motor.steps()) - first.steps() as f64 * its_mm;
            apart_mm.abs() > RACKED_MM && apart_mm * way as f64 > 0.0
        })
    }

    /// The stride at this instant. The time to the next step is unknown, but at least the time since the last step.
    pub fn stride(&self, now: Clock) -> Stride {
        let [last, ticks, lost_in_a_row] = self.stride.load();
        let since = now.since(Clock::from_ticks(last)).max(0) as u64;
        Stride { ticks: ticks.max(since), lost_in_a_row }
    }

    /// The rail of its name.
    pub fn rail(&self) -> &Arc<Rail> {
        &self.rail
    }

    /// Its motor.
    pub(crate) fn motor(&self) -> &Arc<Motor> {
        &self.motor
    }

    /// The position of its motor.
    pub fn position_steps(&self) -> i64 {
        self.motor.steps()
    }

    pub fn turned_steps(&self) -> i64 {
        self.turned.load(Ordering::Relaxed)
    }

    /// The way of the motor in this number of steps, in mm.
    pub fn mm(&self, steps: i64) -> f64 {
        steps as f64 / self.steps_per_mm
    }

    /// The way of one step.
    pub fn step_mm(&self) -> f64 {
        1.0 / self.steps_per_mm
    }

    #[cfg(test)]
    pub fn position_mm(&self) -> f64 {
        self.rail.position_mm()
    }

    pub fn lost_steps(&self) -> u64 {
        self.lost_steps.load(Ordering::Relaxed)
    }
}
