// SPDX-License-Identifier: GPL-3.0-or-later
//! Makes the motors and the rails of a description.

use std::sync::Arc;

use super::motion::Axis;
use super::rail::{Motor, Rail};
use crate::description::axes::AxisConfig;
use crate::description::check::Trouble;
use crate::description::printer::Printer;
use crate::description::rails::{Gears, RailConfig};

/// The motors of the description in its order, and its carriages.
pub(crate) struct Motion {
    pub(crate) axes: Vec<Arc<Axis>>,
    pub(crate) carriages: Vec<Arc<Rail>>,
}

/// Makes the motors and the rails of a printer.
///
/// # Errors
///
/// The motors do not determine the place of a carriage.
pub(crate) fn assemble(printer: &Printer<'_>) -> Result<Motion, Trouble> {
    let gears = Gears::of(printer)?;
    let first = |axis: &AxisConfig| printer.first_motor(&axis.name);
    let start_mm = |axis: &AxisConfig| {
        let place = printer.axes.iter().position(|other| other.name == first(axis).unwrap_or(axis).name);
        place.map_or(axis.start_mm, |place| gears.start_mm(place))
    };
    let motors: Vec<Arc<Motor>> = printer.axes.iter().map(|axis| Motor::at(start_mm(axis), axis)).collect();
    // The way of a rail in a step of a motor.
    let step_mm = |rail: usize, motor: usize| gears.way(rail, motor) / printer.axes[motor].steps_per_mm;
    let is_moved = |mm: f64| mm.abs() > 1e-12;
    let rails = gears.rails.iter().enumerate().map(|(place, rail)| {
        let moved_by = motors.iter().enumerate().map(|(n, motor)| (motor.clone(), step_mm(place, n)));
        Arc::new(Rail::new(rail, moved_by.filter(|(_, mm)| is_moved(*mm)).collect()))
    });
    let rails: Vec<Arc<Rail>> = rails.collect();
    let mut axes: Vec<Arc<Axis>> = Vec::new();
    for (n, config) in printer.axes.iter().enumerate() {
        let moves = rails.iter().enumerate().map(|(place, rail)| (rail.clone(), step_mm(place, n)));
        let moves: Vec<_> = moves.filter(|(_, mm)| is_moved(*mm)).collect();
        let rail = gears.own_rail(config).map_or_else(
            // It moves carriages, and has no rail. This one shows its belt.
            || Arc::new(Rail::new(&RailConfig::of(config), vec![(motors[n].clone(), 1.0 / config.steps_per_mm)])),
            |place| rails[place].clone(),
        );
        let axis = Axis::driving(config, motors[n].clone(), rail, moves);
        let beside = first(config).and_then(|first| axes.iter().find(|axis| axis.name == first.name));
        axes.push(Arc::new(match beside {
            Some(first) => axis.beside(first),
            None => axis,
        }));
    }
    let carriages = rails.into_iter().skip(gears.rails.len() - printer.carriages.len()).collect();
    Ok(Motion { axes, carriages })
}
