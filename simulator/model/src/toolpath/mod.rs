// SPDX-License-Identifier: GPL-3.0-or-later
//! Exports of a recorded path, and a comparison with the G-code that asked for it.

pub(crate) mod asked;
pub(crate) mod compare;
pub(crate) mod drawing;
pub(crate) mod moves;
pub(crate) mod solid;

use std::f64::consts::PI;

use crate::engine::recorder::PathPoint;
use crate::engine::time::seconds;

/// The cross section of filament 1.75 mm thick.
const FILAMENT_MM2: f64 = PI * 1.75 * 1.75 / 4.0;
/// Least width and height of a line of filament.
const THINNEST_MM: f64 = 0.1;
/// The filament on a line may be off by this number of steps of the extruder. Each end of the line is up to a step off.
const STEPS_OFF: f64 = 2.0;

/// A line of the path, from one point to the next.
#[derive(Clone, Copy)]
struct Line<'a> {
    from: &'a PathPoint,
    to: &'a PathPoint,
}

impl Line<'_> {
    fn seconds(&self) -> f64 {
        seconds(self.from.at, self.to.at)
    }

    /// How far the nozzle goes.
    fn mm(&self) -> f64 {
        distance(self.from.nozzle_mm, self.to.nozzle_mm)
    }

    fn mm_per_s(&self) -> f64 {
        self.mm() / self.seconds()
    }

    /// Whether filament is laid along it. A nozzle that stands lays a drop, which is no line.
    fn is_laid(&self) -> bool {
        self.to.laid_mm > 0.0 && self.mm() > 0.0
    }

    fn height_mm(&self) -> f64 {
        f64::from(self.to.height_mm).max(THINNEST_MM)
    }
}

/// The lines of a path. No line leads over a gap.
fn lines(points: &[PathPoint]) -> impl Iterator<Item = Line<'_>> + Clone {
    let line = |(from, to): (_, _)| Line { from, to };
    points.iter().zip(points.iter().skip(1)).map(line).filter(|line| !line.to.is_start)
}

/// The lines of filament that follow each other without a travel, in one layer. `step_mm`: a step of the extruder.
fn runs<'a>(points: &'a [PathPoint], step_mm: f64) -> Vec<Vec<Line<'a>>> {
    let mut runs: Vec<Vec<Line<'_>>> = Vec::new();
    // Lines behind the last run on which nothing was laid.
    let mut empty: Vec<Line<'_>> = Vec::new();
    for line in lines(points) {
        let is_next = |last: &Line<'_>| std::ptr::eq(last.to, line.from) && last.to.layer == line.to.layer;
        let run = runs.last_mut().filter(|run| empty.last().or(run.last()).is_some_and(is_next));
        if line.is_laid() {
            // The extruder may make no step on a short line. It makes one on the shortest travel.
            let travel_mm = step_mm * FILAMENT_MM2 / (THINNEST_MM * line.height_mm());
            match run.filter(|_| empty.iter().map(Line::mm).sum::<f64>() <= travel_mm) {
                Some(run) => run.extend(empty.drain(..).chain([line])),
                None => {
                    empty.clear();
                    runs.push(vec![line]);
                }
            }
        } else {
            // A retraction or a drop ends the run.
            let fed_mm = line.to.filament_mm - line.from.filament_mm;
            match run.filter(|_| fed_mm.abs() <= STEPS_OFF * step_mm) {
                Some(_) => empty.push(line),
                None => empty.clear(),
            }
        }
    }
    runs
}

/// The distance of two points.
fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// Longest piece of a line that is laid as a whole beside another path. The cost of a way then grows step by step.
const PIECE_MM: f64 = 2.0;
/// Highest number of pieces of a path that is compared: 64 bytes of memory each.
const PIECES_MAX: f64 = 8_388_608.0;

/// The number of pieces of a line.
fn count_pieces(from: [f64; 3], to: [f64; 3]) -> f64 {
    (distance(from, to) / PIECE_MM).ceil().max(1.0)
}

/// The point on a line that is nearest to a place.
fn nearest(place: [f64; 3], from: [f64; 3], to: [f64; 3]) -> [f64; 3] {
    let dot = |a: [f64; 3], b: [f64; 3]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
    let along = [0, 1, 2].map(|i: usize| to[i] - from[i]);
    let square = dot(along, along);
    let share = match square {
        0.0 => 0.0,
        square => (dot(along, [0, 1, 2].map(|i: usize| place[i] - from[i])) / square).clamp(0.0, 1.0),
    };
    [0, 1, 2].map(|i: usize| from[i] + along[i] * share)
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::{CLOCK_FREQ, Clock};

    /// A path at 50 mm/s through these places, with the filament laid on the way to each.
    pub(crate) fn path(places: &[([f64; 3], f32)]) -> Vec<PathPoint> {
        let mut ticks = 0;
        let mut points: Vec<PathPoint> = Vec::new();
        for (nozzle_mm, laid_mm) in places {
            let last = points.last();
            ticks +=
                last.map_or(0, |last| (distance(last.nozzle_mm, *nozzle_mm) / 50.0 * f64::from(CLOCK_FREQ)) as u64);
            points.push(PathPoint {
                at: Clock::from_ticks(ticks),
                nozzle_mm: *nozzle_mm,
                filament_mm: last.map_or(0.0, |last| last.filament_mm) + f64::from(*laid_mm),
                laid_mm: *laid_mm,
                height_mm: 0.2,
                layer: 1,
                is_start: points.is_empty(),
            });
        }
        points
    }

    #[test]
    fn the_written_g_code_asks_for_the_path() {
        let points =
            path(&[([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([30.0, 50.0, 0.2], 0.0), ([1.0, 2.0, 3.0], 1.0)]);
        let mut text = Vec::new();
        moves::write_gcode(&points, &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        assert!(text.contains("G1 X30.0000 Y5.0000 Z0.2000 E0.7000 F3000.0\n"), "{text}");
        let asked = asked::AskedPath::read(text.as_bytes(), "a").unwrap();
        let places: Vec<_> = asked.points.iter().map(|point| point.nozzle_mm).collect();
        assert_eq!(places, points.iter().map(|point| point.nozzle_mm).collect::<Vec<_>>());
        assert!((asked.filament_mm - 1.7).abs() < 1e-6);
    }

    #[test]
    fn the_drawing_has_a_group_for_each_layer_and_a_class_for_each_speed() {
        let mut points =
            path(&[([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([30.0, 50.0, 0.2], 0.0), ([1.0, 2.0, 0.4], 1.0)]);
        points[3].layer = 2;
        let mut svg = Vec::new();
        drawing::write_svg(&points, 0.01, &mut svg).unwrap();
        let svg = String::from_utf8(svg).unwrap();
        for part in [
            "<g id=\"layer-1\">\n<path class=\"s7\" d=\"M10.00 -5.00L30.00 -5.00\"/>\n<path class=\"s8\" d=\"M30.00 -5.00L30.00 -50.00\"/>",
            "<g id=\"layer-2\">\n<path class=\"s7\"",
            ">10 mm</text>",
            ">0 to 50 mm/s</text>",
        ] {
            assert!(svg.contains(part), "{part} is not in\n{svg}");
        }
        // A line without a step of the extruder, which is too short for one.
        points[2].nozzle_mm = [30.0, 5.2, 0.2];
        points[3].layer = 1;
        let mut svg = Vec::new();
        drawing::write_svg(&points, 0.01, &mut svg).unwrap();
        let svg = String::from_utf8(svg).unwrap();
        assert!(svg.contains("<path class=\"s7\" d=\"M10.00 -5.00L30.00 -5.00\"/>"), "{svg}");
        assert!(!svg.contains("<path class=\"s8\" d=\"M30.00"), "{svg}");
        let mut empty = Vec::new();
        drawing::write_svg(&[], 0.01, &mut empty).unwrap();
        assert!(empty.ends_with(b"</svg>\n"));
    }
}
