// SPDX-License-Identifier: GPL-3.0-or-later
//! The laid filament as a body.

#![forbid(unsafe_code)]

use std::f64::consts::PI;
use std::io::{self, Write};

use super::{Line, distance, lines, nearest};
use crate::engine::recorder::PathPoint;

/// Highest number of bars: 12 triangles of 50 bytes each, 120 MB.
const BARS_MAX: usize = 200_000;
/// Greatest distance of the finest body from the path.
const FINEST_MM: f64 = 0.01;
/// The cross section of filament 1.75 mm thick.
const FILAMENT_MM2: f64 = PI * 1.75 * 1.75 / 4.0;
/// The width of a line is between these.
const WIDTHS_MM: [f64; 2] = [0.1, 2.0];

/// Straight bars of filament: from, to, width and height.
struct Bar {
    from: [f64; 3],
    to: [f64; 3],
    width_mm: f64,
    height_mm: f64,
}

/// Lines that follow each other without a travel, in one layer.
fn runs<'a>(points: &'a [PathPoint]) -> Vec<Vec<Line<'a>>> {
    let mut runs: Vec<Vec<Line<'_>>> = Vec::new();
    for line in lines(points).filter(|line| line.is_laid()) {
        match runs.last_mut().filter(|run| {
            run.last().is_some_and(|last| std::ptr::eq(last.to, line.from) && last.to.layer == line.to.layer)
        }) {
            Some(run) => run.push(line),
            None => runs.push(vec![line]),
        }
    }
    runs
}

/// Keeps the places of a polyline that are needed to stay within this distance (Douglas and Peucker, 1973). Returns
/// their numbers.
fn simplified(places: &[[f64; 3]], off_mm: f64) -> Vec<usize> {
    let mut kept = vec![false; places.len()];
    let mut open = vec![(0, places.len().saturating_sub(1))];
    while let Some((first, last)) = open.pop() {
        kept[first] = true;
        kept[last] = true;
        let off = |n: usize| distance(places[n], nearest(places[n], places[first], places[last]));
        let farthest = (first + 1..last).map(|n| (n, off(n))).max_by(|(_, a), (_, b)| a.total_cmp(b));
        if let Some((n, _)) = farthest.filter(|(_, off)| *off > off_mm) {
            open.extend([(first, n), (n, last)]);
        }
    }
    (0..places.len()).filter(|n| kept[*n]).collect()
}

/// The bars of the path, each within this distance of it.
fn bars(runs: &[Vec<Line<'_>>], off_mm: f64) -> Vec<Bar> {
    let mut bars = Vec::new();
    for run in runs {
        let Some(start) = run.first() else { continue };
        let places: Vec<[f64; 3]> =
            [start.from.nozzle_mm].into_iter().chain(run.iter().map(|line| line.to.nozzle_mm)).collect();
        for two in simplified(&places, off_mm).windows(2) {
            let joined = &run[two[0]..two[1]];
            let laid_mm: f64 = joined.iter().map(|line| f64::from(line.to.laid_mm)).sum();
            let way_mm: f64 = joined.iter().map(Line::mm).sum();
            let height_mm = f64::from(joined[0].to.height_mm).max(WIDTHS_MM[0]);
            let width_mm = (laid_mm * FILAMENT_MM2 / way_mm / height_mm).clamp(WIDTHS_MM[0], WIDTHS_MM[1]);
            bars.push(Bar { from: places[two[0]], to: places[two[1]], width_mm, height_mm });
        }
    }
    bars
}

impl Bar {
    /// Its eight corners: the first four at its start, the upper two of each four last.
    fn corners(&self) -> [[f64; 3]; 8] {
        let along = [0, 1].map(|i: usize| self.to[i] - self.from[i]);
        let length = along[0].hypot(along[1]);
        let [ux, uy] = if length > 0.0 { along.map(|mm| mm / length) } else { [1.0, 0.0] };
        let half = self.width_mm / 2.0;
        let corner = |end: [f64; 3], ahead: f64, side: f64, down: f64| {
            [end[0] + ux * ahead - uy * side, end[1] + uy * ahead + ux * side, end[2] - down]
        };
        // Half a width more at each end closes the corners.
        let four = |end, ahead| {
            [(-half, self.height_mm), (half, self.height_mm), (half, 0.0), (-half, 0.0)]
                .map(|(side, down)| corner(end, ahead, side, down))
        };
        let ([a, b, c, d], [e, f, g, h]) = (four(self.from, -half), four(self.to, half));
        [a, b, c, d, e, f, g, h]
    }
}

/// What a body has left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// How far its bars are off the path at most.
    pub off_mm: f64,
    /// Lines of filament that had no room.
    pub left_out: usize,
}

/// The triangles of a bar, each by its corners against the clock seen from outside.
const TRIANGLES: [[usize; 3]; 12] = [
    [0, 3, 2],
    [0, 2, 1],
    [4, 5, 6],
    [4, 6, 7],
    [0, 1, 5],
    [0, 5, 4],
    [3, 7, 6],
    [3, 6, 2],
    [0, 4, 7],
    [0, 7, 3],
    [1, 2, 6],
    [1, 6, 5],
];

/// Writes a binary STL in millimeters: a bar for each line of filament. A long print gets a coarser body of at most
/// 120 MB.
///
/// # Errors
///
/// The file cannot be written.
pub fn write_stl(points: &[PathPoint], out: &mut dyn Write) -> io::Result<Body> {
    let runs = runs(points);
    let mut off_mm = FINEST_MM;
    let mut found = bars(&runs, off_mm);
    // A run of one line stays one bar.
    while found.len() > BARS_MAX.max(runs.len()) {
        off_mm *= 2.0;
        found = bars(&runs, off_mm);
    }
    let left_out = found.len().saturating_sub(BARS_MAX);
    found.truncate(BARS_MAX);
    let mut head = [b' '; 80];
    let title = b"filament laid by a simulated printer (pinion sim --toolpath)";
    head[..title.len()].copy_from_slice(title);
    out.write_all(&head)?;
    out.write_all(&(found.len() as u32 * 12).to_le_bytes())?;
    for bar in &found {
        let corners = bar.corners();
        for triangle in TRIANGLES {
            let [a, b, c] = triangle.map(|n| corners[n]);
            let (u, v) = ([0, 1, 2].map(|i: usize| b[i] - a[i]), [0, 1, 2].map(|i: usize| c[i] - a[i]));
            let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            let length = cross.iter().map(|part| part * part).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            let normal = cross.map(|part| part / length);
            for number in [normal, a, b, c].iter().flatten() {
                out.write_all(&(*number as f32).to_le_bytes())?;
            }
            out.write_all(&[0; 2])?;
        }
    }
    Ok(Body { off_mm, left_out })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toolpath::tests::path;
    use proptest::prelude::*;

    /// The corners of all triangles of an STL.
    fn triangles(stl: &[u8]) -> Vec<[[f32; 3]; 3]> {
        let count = u32::from_le_bytes(stl[80..84].try_into().unwrap()) as usize;
        assert_eq!(stl.len(), 84 + 50 * count);
        let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
        let triangle = |bytes: &[u8]| {
            let numbers: Vec<f32> = bytes[..48].chunks(4).map(number).collect();
            [3, 6, 9].map(|at| [numbers[at], numbers[at + 1], numbers[at + 2]])
        };
        stl[84..].chunks(50).map(triangle).collect()
    }

    #[test]
    fn a_line_of_filament_is_a_closed_bar_of_its_volume() {
        let points = path(&[([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([30.0, 50.0, 0.2], 0.0)]);
        let mut stl = Vec::new();
        assert_eq!(write_stl(&points, &mut stl).unwrap(), Body { off_mm: FINEST_MM, left_out: 0 });
        let found = triangles(&stl);
        assert_eq!(found.len(), 12, "the travel lays nothing");
        // The volume by the divergence theorem. The bar is half a width longer at each end.
        let volume: f32 = found
            .iter()
            .map(|[a, b, c]| {
                let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
                a.iter().zip(cross).map(|(a, cross)| a * cross).sum::<f32>() / 6.0
            })
            .sum();
        let width = 0.7 * FILAMENT_MM2 / 20.0 / 0.2;
        let expected = width * 0.2 * (20.0 + width);
        assert!((f64::from(volume) - expected).abs() < 0.01 * expected, "{volume} {expected}");
        let top = found.iter().flatten().map(|corner| corner[2]).fold(0.0, f32::max);
        assert_eq!(top, 0.2);
    }

    proptest! {
        /// Each place left out is near the line between the kept ones around it.
        #[test]
        fn a_simplified_line_is_never_farther_off_than_asked(
            places in prop::collection::vec(prop::array::uniform3(0.0..10.0f64), 2..60), off_mm in 0.01..5.0f64,
        ) {
            let kept = simplified(&places, off_mm);
            prop_assert_eq!((kept[0], kept[kept.len() - 1]), (0, places.len() - 1));
            for two in kept.windows(2) {
                for place in &places[two[0]..two[1]] {
                    prop_assert!(distance(*place, nearest(*place, places[two[0]], places[two[1]])) <= off_mm + 1e-9);
                }
            }
        }
    }
}
