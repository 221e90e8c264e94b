// SPDX-License-Identifier: GPL-3.0-or-later
//! The rails of a description, and how its motors move them.

use super::axes::{AxisConfig, CarriageConfig, End};
use super::check::{Trouble, fault};
use super::pin::PinName;
use super::printer::{Kinematics, Printer};

/// A part that motors move between two ends: the rail of an axis, or a carriage.
#[derive(Clone, Debug)]
pub(crate) struct RailConfig<'a> {
    pub(crate) name: &'a str,
    /// Its lowest and its highest place.
    pub(crate) travel_mm: Option<(f64, f64)>,
    pub(crate) overtravel_mm: f64,
    pub(crate) start_mm: f64,
    /// The end with the endstop, and the place where it closes.
    pub(crate) endstop: Option<(End, f64)>,
}

impl<'a> RailConfig<'a> {
    /// The rail of an axis.
    pub(crate) fn of(axis: &'a AxisConfig) -> RailConfig<'a> {
        let travel_mm = axis.travel_mm.map(|max_mm| (axis.min_mm, max_mm));
        RailConfig {
            name: &axis.name,
            travel_mm,
            overtravel_mm: axis.overtravel_mm,
            start_mm: axis.start_mm,
            endstop: endstop(axis.endstop_pin.as_ref(), axis.endstop_at, axis.endstop_mm, travel_mm),
        }
    }

    fn of_carriage(carriage: &'a CarriageConfig) -> RailConfig<'a> {
        let travel_mm = Some((carriage.min_mm, carriage.travel_mm));
        RailConfig {
            name: &carriage.name,
            travel_mm,
            overtravel_mm: carriage.overtravel_mm,
            start_mm: carriage.start_mm,
            endstop: endstop(carriage.endstop_pin.as_ref(), carriage.endstop_at, carriage.endstop_mm, travel_mm),
        }
    }
}

fn endstop(pin: Option<&PinName>, at: End, place_mm: Option<f64>, travel_mm: Option<(f64, f64)>) -> Option<(End, f64)> {
    let (min_mm, max_mm) = travel_mm.unwrap_or_default();
    let end_mm = if at == End::Min { min_mm } else { max_mm };
    pin.map(|_| (at, place_mm.unwrap_or(end_mm)))
}

/// How motors move rails: the way of each motor's belt, and back.
#[derive(Debug)]
pub(crate) struct Gears<'a> {
    pub(crate) rails: Vec<RailConfig<'a>>,
    /// For each axis of the description: how its belt moves with each rail.
    belts: Vec<Vec<f64>>,
    /// For each rail: how it moves with the belt of each axis.
    ways: Vec<Vec<f64>>,
}

impl<'a> Gears<'a> {
    /// The gears of a printer.
    ///
    /// # Errors
    ///
    /// A motor moves a carriage that is not there, or the motors leave a carriage loose.
    pub(crate) fn of(printer: &Printer<'a>) -> Result<Gears<'a>, Trouble> {
        let has_rail = |axis: &&AxisConfig| axis.carriages.is_empty() && !printer.is_second_on_belt(&axis.name);
        let own = printer.axes.iter().filter(has_rail).map(RailConfig::of);
        let rails: Vec<_> = own.chain(printer.carriages.iter().map(RailConfig::of_carriage)).collect();
        let mut belts = Vec::new();
        for axis in printer.axes {
            let mut belt = vec![0.0; rails.len()];
            let of_kinematics = printer.belt(&axis.name);
            let carriages: Vec<(&str, f64)> = match &axis.carriages {
                own if !own.is_empty() => own.iter().map(|(name, way)| (name.as_str(), *way)).collect(),
                _ if !of_kinematics.is_empty() => of_kinematics.to_vec(),
                _ => vec![(axis.name.as_str(), 1.0)],
            };
            for (name, way) in carriages {
                let Some(place) = rails.iter().position(|rail| rail.name == name) else {
                    let cause = format!("there is no carriage `{name}`");
                    return Err(fault(&format!("axis `{}`", axis.name), "carriages", &cause, "add a [[carriage]]"));
                };
                belt[place] += way;
            }
            belts.push(belt);
        }
        match pseudo_inverse(&belts, rails.len()) {
            Ok(ways) => Ok(Gears { rails, belts, ways }),
            Err(place) => Err(Trouble::new("the motors leave it loose")
                .remedy("give it a motor of its own, in `carriages` of an [[axis]]")
                .of(format_args!("carriage `{}`", rails[place].name))),
        }
    }

    /// The place of the belt of an axis at the start.
    pub(crate) fn start_mm(&self, axis: usize) -> f64 {
        self.rails.iter().zip(&self.belts[axis]).map(|(rail, way)| rail.start_mm * way).sum()
    }

    /// How a rail moves with the belt of an axis.
    pub(crate) fn way(&self, rail: usize, axis: usize) -> f64 {
        self.ways[rail][axis]
    }

    /// The rail that an axis has for itself.
    pub(crate) fn own_rail(&self, axis: &AxisConfig) -> Option<usize> {
        self.rails.iter().position(|rail| axis.carriages.is_empty() && rail.name == axis.name)
    }
}

impl Kinematics<'_> {
    /// The belt of a motor: the rails that it runs along, and which way. Empty for a motor with a rail of its own.
    pub(crate) fn belt(&self, axis: &str) -> &'static [(&'static str, f64)] {
        match (self, axis) {
            (Kinematics::CoreXy, "x") => &[("x", 1.0), ("y", 1.0)],
            (Kinematics::CoreXy, "y") => &[("x", 1.0), ("y", -1.0)],
            (Kinematics::CoreXz, "x") => &[("x", 1.0), ("z", 1.0)],
            (Kinematics::CoreXz, "z") => &[("x", 1.0), ("z", -1.0)],
            (Kinematics::HybridCoreXy, "x") => &[("x", 1.0), ("y", -1.0)],
            (Kinematics::HybridCoreXy, "dual_carriage") => &[("dual_carriage", 1.0), ("y", 1.0)],
            (Kinematics::HybridCoreXz, "x") => &[("x", 1.0), ("z", -1.0)],
            (Kinematics::HybridCoreXz, "dual_carriage") => &[("dual_carriage", 1.0), ("z", 1.0)],
            _ => &[],
        }
    }
}

/// The matrix that finds the columns' values from the rows' (least squares). Fails with a column that the rows do not
/// determine.
fn pseudo_inverse(rows: &[Vec<f64>], columns: usize) -> Result<Vec<Vec<f64>>, usize> {
    let dot = |i: usize, j: usize| rows.iter().map(|row| row[i] * row[j]).sum::<f64>();
    // Beside the square matrix is what becomes the result.
    let mut lines: Vec<Vec<f64>> =
        (0..columns).map(|i| (0..columns).map(|j| dot(i, j)).chain(rows.iter().map(|row| row[i])).collect()).collect();
    for i in 0..columns {
        let pivot = (i..columns).max_by(|a, b| lines[*a][i].abs().total_cmp(&lines[*b][i].abs())).unwrap_or(i);
        lines.swap(i, pivot);
        if lines[i][i].abs() < 1e-9 {
            return Err(i);
        }
        let factor = lines[i][i];
        lines[i].iter_mut().for_each(|value| *value /= factor);
        let line = lines[i].clone();
        for (_, other) in lines.iter_mut().enumerate().filter(|(j, _)| *j != i) {
            let factor = other[i];
            other.iter_mut().zip(&line).for_each(|(value, own)| *value -= factor * own);
        }
    }
    Ok(lines.into_iter().map(|line| line[columns..].to_vec()).collect())
}
