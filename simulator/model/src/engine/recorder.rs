// SPDX-License-Identifier: GPL-3.0-or-later
//! The path of the nozzle, from the steps of the motors.
//!
//! A recorder reads the tracks of all axes and merges them by the instants of the steps. It joins places that lie on
//! one line, so that the path of a long print fits in memory. Nothing that it does slows the core.

use std::sync::Arc;

use super::bed::Bed;
use super::follower::Followers;
use super::motion::Axis;
use super::rail::Rail;
use pinion_firmware::time::{Clock, Ticks};

/// Highest number of points that a recorder keeps: 235 MB. A print of ten hours has about half of them.
pub(crate) const POINTS_MAX: usize = 1 << 22;

/// Longest time without a step in which the head still moves. A step after a longer time ends a rest.
const REST: Ticks = Ticks::from_ms(50);

/// A line may miss the places that it joins by this number of steps. A motor is up to half a step off the path that the
/// host asks for, so the ends of a line and a place between them can be a full step apart.
const STEPS_OFF: f64 = 1.5;

/// Least change of height that is a new layer.
const LAYER_MM: f64 = 0.05;

/// A point of the nozzle's path, and the straight line that leads to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathPoint {
    /// When the nozzle was here. The speed along the line is constant.
    pub at: Clock,
    /// The nozzle's place: x, y and z.
    pub nozzle_mm: [f64; 3],
    /// The position of the filament: the sum of all hot ends' axes.
    pub filament_mm: f64,
    /// Filament that left the nozzle on the line to this point. A retraction lays nothing. The way back after it lays
    /// nothing either.
    pub laid_mm: f32,
    /// How high the line is over what is below it, if filament was laid on it; else as before.
    pub height_mm: f32,
    /// The layer, counted from 1 in the order of printing; 0 before anything was laid.
    pub layer: u32,
    /// Whether no line leads here: the path begins, or continues after steps that nobody read in time.
    pub is_start: bool,
}

/// All positions after the steps of one instant.
#[derive(Clone, Copy, Debug)]
struct Sample {
    at: Clock,
    nozzle_mm: [f64; 3],
    filament_mm: f64,
    /// Filament that has left the nozzle since the start.
    laid_mm: f64,
}

impl Sample {
    /// Everything that a line joins.
    fn values(&self) -> [f64; 4] {
        let [x, y, z] = self.nozzle_mm;
        [x, y, z, self.filament_mm]
    }
}

/// Reads the steps of all motors in the order of their instants.
struct Merger {
    bed: Arc<Bed>,
    followers: Followers,
    /// They feed filament.
    extruders: Vec<Arc<Rail>>,
    last: Sample,
    /// The farthest position of the filament.
    pushed_mm: f64,
}

impl Merger {
    fn new(bed: Arc<Bed>, extruders: &[Arc<Axis>], now: Clock) -> Merger {
        let extruders: Vec<Arc<Rail>> = extruders.iter().map(|axis| axis.rail().clone()).collect();
        let followers = Followers::from_here(bed.head().rails().into_iter().chain(&extruders));
        let last = Sample { at: now, nozzle_mm: [0.0; 3], filament_mm: 0.0, laid_mm: 0.0 };
        let mut merger = Merger { bed, followers, extruders, last, pushed_mm: 0.0 };
        merger.place(now);
        merger.pushed_mm = merger.last.filament_mm;
        merger.last.laid_mm = 0.0;
        merger
    }

    /// Computes the present place from the motors' positions.
    fn place(&mut self, at: Clock) {
        let nozzle_mm = self.bed.head().nozzle_mm(|rail| self.followers.place_mm(rail));
        let filament_mm: f64 = self.extruders.iter().map(|rail| self.followers.place_mm(rail)).sum();
        let laid_mm = self.last.laid_mm + (filament_mm - self.pushed_mm).max(0.0);
        self.pushed_mm = self.pushed_mm.max(filament_mm);
        self.last = Sample { at, nozzle_mm, filament_mm, laid_mm };
    }

    /// The place after the next step, if it was not later than `until`, and whether steps before it were overwritten.
    /// Steps of one instant are one.
    fn next(&mut self, until: Clock) -> Option<(Sample, bool)> {
        let (first, lost) = self.followers.next(until)?;
        // A step that comes out of order counts as the next one.
        self.place(first.max(Clock::from_ticks(self.last.at.ticks() + 1)));
        Some((self.last, lost))
    }
}

/// A line that grows: the slopes that keep it near all places since its start.
struct Line {
    from: Sample,
    end: Sample,
    least: [f64; 4],
    most: [f64; 4],
}

impl Line {
    fn from(from: Sample) -> Line {
        Line { from, end: from, least: [f64::NEG_INFINITY; 4], most: [f64::INFINITY; 4] }
    }

    /// Ends the line at this place instead, if it is then near all places between. `off` is the greatest distance
    /// along each coordinate, at each instant.
    fn extend(&mut self, to: Sample, off: &[f64; 4]) -> bool {
        let (from, values) = (self.from.values(), to.values());
        let ticks = to.at.since(self.from.at) as f64;
        let fits = |i: usize| (self.least[i]..=self.most[i]).contains(&((values[i] - from[i]) / ticks));
        if !(0..4).all(fits) {
            return false;
        }
        for i in 0..4 {
            let rise = values[i] - from[i];
            self.least[i] = self.least[i].max((rise - off[i]) / ticks);
            self.most[i] = self.most[i].min((rise + off[i]) / ticks);
        }
        self.end = to;
        true
    }
}

/// Records the path of the nozzle. Somebody has to call [`Recorder::read`] every 0.1 s or so: the printer keeps half a
/// second of an axis at 32,000 steps per second.
pub struct Recorder {
    merger: Merger,
    line: Line,
    points: Vec<PathPoint>,
    /// How far a line may be off along x, y, z and the filament.
    off_mm: [f64; 4],
    points_max: usize,
    /// How long to wait for the steps of an instant. Boards do not make them in one order.
    settles: Ticks,
    /// The height of the present layer: over the bed's plane, and over its shape.
    layer_mm: Option<[f64; 2]>,
    gaps: u64,
}

impl Recorder {
    /// `settles` says how long to wait for the steps of an instant.
    pub(crate) fn new(bed: Arc<Bed>, extruders: &[Arc<Axis>], settles: Ticks, now: Clock) -> Recorder {
        let head_mm = bed.head().step_mm() * STEPS_OFF;
        let filament_mm = extruders.iter().map(|axis| axis.step_mm()).fold(0.0, f64::max) * STEPS_OFF;
        let merger = Merger::new(bed, extruders, now);
        let start = merger.last;
        let mut recorder = Recorder {
            line: Line::from(start),
            merger,
            points: Vec::new(),
            off_mm: [head_mm, head_mm, head_mm, filament_mm],
            points_max: POINTS_MAX,
            settles,
            layer_mm: None,
            gaps: 0,
        };
        recorder.add(start, 0.0, true);
        recorder
    }

    /// Continues the path to the last step.
    pub fn read(&mut self, now: Clock) {
        let until = match self.settles.0 {
            // Steps of one board are in order, so none is missing before a step that is there.
            0 => Clock::from_ticks(u64::MAX >> 1),
            settles => now.earlier(settles.into()),
        };
        while let Some((sample, lost)) = self.merger.next(until) {
            if lost {
                self.gaps += 1;
                self.end_line();
                self.line = Line::from(sample);
                self.add(sample, 0.0, true);
                continue;
            }
            if sample.at.since(self.line.end.at) > i64::from(REST.0) {
                self.join(Sample { at: Clock::from_ticks(sample.at.ticks() - 1), ..self.line.end });
            }
            self.join(sample);
        }
        if now.since(self.line.end.at) > i64::from(REST.0) {
            self.end_line();
        }
    }

    /// Ends the path: no step comes any more.
    pub fn end(&mut self, now: Clock) {
        self.read(now.later(u64::from(self.settles.0) + u64::from(REST.0) + 1));
    }

    /// The path so far. It only grows. The line that the nozzle draws now is missing.
    pub fn points(&self) -> &[PathPoint] {
        &self.points
    }

    /// The filament of a step, of the extruder with the longest steps.
    pub fn filament_step_mm(&self) -> f64 {
        self.off_mm[3] / STEPS_OFF
    }

    /// How often steps were overwritten before they were read.
    pub fn gaps(&self) -> u64 {
        self.gaps
    }

    /// Whether the path has become too long, and ends before the present.
    pub fn is_full(&self) -> bool {
        self.points.len() >= self.points_max
    }

    fn join(&mut self, sample: Sample) {
        if !self.line.extend(sample, &self.off_mm) {
            self.end_line();
            self.line.extend(sample, &self.off_mm);
        }
    }

    /// Adds the line that has grown until now, and begins another at its end.
    fn end_line(&mut self) {
        let Line { from, end, .. } = self.line;
        if end.at != from.at {
            self.add(end, end.laid_mm - from.laid_mm, false);
        }
        self.line = Line::from(end);
    }

    fn add(&mut self, to: Sample, laid_mm: f64, is_start: bool) {
        if self.is_full() {
            return;
        }
        let (mut layer, mut height_mm) = self.points.last().map_or((0, 0.0), |last| (last.layer, last.height_mm));
        if laid_mm > 0.0 {
            let [x_mm, y_mm, z_mm] = to.nozzle_mm;
            let over_mm = [z_mm, z_mm - self.merger.bed.height_mm(x_mm, y_mm)];
            // The host may follow the shape of the bed. Then the nozzle's height over the plane changes in a layer.
            let rises = |below: [f64; 2]| (0..2).all(|i| (over_mm[i] - below[i]).abs() > LAYER_MM);
            if self.layer_mm.is_none_or(rises) {
                layer += 1;
                let rise_mm = over_mm[1] - self.layer_mm.map_or(0.0, |below| below[1]);
                if rise_mm > 0.0 {
                    height_mm = rise_mm as f32;
                }
                self.layer_mm = Some(over_mm);
            }
        }
        let Sample { at, nozzle_mm, filament_mm, .. } = to;
        self.points.push(PathPoint { at, nozzle_mm, filament_mm, laid_mm: laid_mm as f32, height_mm, layer, is_start });
    }
}

#[cfg(test)]
mod tests;
