// SPDX-License-Identifier: GPL-3.0-or-later
//! The laid filament as a body.

use std::io::{self, Write};

use super::{FILAMENT_MM2, Line, STEPS_OFF, distance, nearest, runs};
use crate::engine::recorder::PathPoint;

/// Highest number of bars: 12 triangles of 50 bytes each, 120 MB.
const BARS_MAX: usize = 200_000;
/// Greatest distance of the finest body from the path.
const FINEST_MM: f64 = 0.01;
/// Greatest width of a line. A nozzle that nearly stands lays a blob.
const WIDEST_MM: f64 = 2.0;
/// Sharpest turn with joined bars, as the tangent of half the angle: 127 degrees. At a sharper one the corner of the
/// bars would be farther out than their width.
const SHARPEST: f64 = 2.0;

/// A straight bar of filament.
struct Bar {
    from: [f64; 3],
    to: [f64; 3],
    width_mm: f64,
    height_mm: f64,
    /// How its ends are cut to meet its neighbors: the tangents of half the turns to the left. Zero: at a right angle.
    cuts: [f64; 2],
}

/// The points of a curve that straight lines near all others need (Douglas and Peucker, 1973). `off` is how far a point
/// is off the line between two others.
fn simplified(count: usize, off_max: f64, off: impl Fn(usize, [usize; 2]) -> f64) -> Vec<bool> {
    let mut kept = vec![false; count];
    let mut open = vec![[0, count.saturating_sub(1)]];
    while let Some([first, last]) = open.pop() {
        kept[first] = true;
        kept[last] = true;
        let farthest = (first + 1..last).map(|n| (n, off(n, [first, last]))).max_by(|(_, a), (_, b)| a.total_cmp(b));
        if let Some((n, _)) = farthest.filter(|(_, off)| *off > off_max) {
            open.extend([[first, n], [n, last]]);
        }
    }
    kept
}

/// A run as a curve: the places between its lines, and the way and the filament until each of them.
struct Curve {
    places: Vec<[f64; 3]>,
    way_mm: Vec<f64>,
    laid_mm: Vec<f64>,
}

impl Curve {
    fn of(run: &[Line<'_>]) -> Curve {
        let mut curve = Curve { places: vec![run[0].from.nozzle_mm], way_mm: vec![0.0], laid_mm: vec![0.0] };
        let (mut way_mm, mut laid_mm) = (0.0, 0.0);
        for line in run {
            way_mm += line.mm();
            laid_mm += f64::from(line.to.laid_mm);
            curve.places.push(line.to.nozzle_mm);
            curve.way_mm.push(way_mm);
            curve.laid_mm.push(laid_mm);
        }
        curve
    }

    fn off_mm(&self, n: usize, [first, last]: [usize; 2]) -> f64 {
        distance(self.places[n], nearest(self.places[n], self.places[first], self.places[last]))
    }

    /// How far the filament is off, compared with filament that is laid evenly between two points.
    fn uneven_mm(&self, n: usize, [first, last]: [usize; 2]) -> f64 {
        let [way_mm, laid_mm] = [&self.way_mm, &self.laid_mm].map(|sum| move |n: usize| sum[n] - sum[first]);
        let share = if way_mm(last) > 0.0 { way_mm(n) / way_mm(last) } else { 0.0 };
        (laid_mm(n) - laid_mm(last) * share).abs()
    }

    /// The bars, each within `off_mm` of the path. `laid_off_mm`: by how much the filament may be off. The extruder's
    /// steps are coarse: a short line has one or none, and its neighbors show how wide it is.
    fn bars(&self, height_mm: f64, off_mm: f64, laid_off_mm: f64) -> Vec<Bar> {
        let count = self.places.len();
        let bends = simplified(count, off_mm, |n, ends| self.off_mm(n, ends));
        let changes = simplified(count, laid_off_mm, |n, ends| self.uneven_mm(n, ends));
        let mut bars: Vec<Bar> = Vec::new();
        let (mut begin, mut from) = (0, 0);
        for end in (1..count).filter(|end| changes[*end]) {
            let [way_mm, laid_mm] = [&self.way_mm, &self.laid_mm].map(|sum| sum[end] - sum[begin]);
            let width_mm = (laid_mm * FILAMENT_MM2 / way_mm / height_mm).min(WIDEST_MM);
            for to in (begin + 1..=end).filter(|to| bends[*to] || *to == end) {
                let mut bar = Bar { from: self.places[from], to: self.places[to], width_mm, height_mm, cuts: [0.0; 2] };
                from = to;
                if width_mm > 0.0 && bar.mm() > 0.0 {
                    if let Some(last) = bars.last_mut().filter(|last| last.to == bar.from) {
                        last.join(&mut bar);
                    }
                    bars.push(bar);
                }
            }
            begin = end;
        }
        bars
    }
}

/// The bars of the path, each within this distance of it.
fn bars(runs: &[Vec<Line<'_>>], step_mm: f64, off_mm: f64) -> Vec<Bar> {
    let laid_off_mm = STEPS_OFF * step_mm * off_mm / FINEST_MM;
    runs.iter().flat_map(|run| Curve::of(run).bars(run[0].height_mm(), off_mm, laid_off_mm)).collect()
}

impl Bar {
    /// Its direction from above, and its length.
    fn along(&self) -> ([f64; 2], f64) {
        let along = [0, 1].map(|i: usize| self.to[i] - self.from[i]);
        let mm = along[0].hypot(along[1]);
        (along.map(|part| part / mm), mm)
    }

    fn mm(&self) -> f64 {
        self.along().1
    }

    /// Cuts the end of this bar and the start of the next one so that they meet. Both keep their volume.
    fn join(&mut self, next: &mut Bar) {
        let ((u, mm), (v, next_mm)) = (self.along(), next.along());
        let tangent = (u[0] * v[1] - u[1] * v[0]) / (1.0 + u[0] * v[0] + u[1] * v[1]);
        // The cuts at both ends of a bar must not cross.
        let deepest_mm = self.width_mm.max(next.width_mm) / 2.0 * tangent.abs();
        if tangent.abs() <= SHARPEST && deepest_mm <= mm.min(next_mm) / 2.0 {
            (self.cuts[1], next.cuts[0]) = (tangent, tangent);
        }
    }

    /// Its eight corners: the first four at its start, the upper two of each four last.
    fn corners(&self) -> [[f64; 3]; 8] {
        let ([ux, uy], _) = self.along();
        let half = self.width_mm / 2.0;
        let four = |end: [f64; 3], cut: f64| {
            [(-half, self.height_mm), (half, self.height_mm), (half, 0.0), (-half, 0.0)].map(|(side, down)| {
                let ahead = side * cut;
                [end[0] + ux * ahead - uy * side, end[1] + uy * ahead + ux * side, end[2] - down]
            })
        };
        let ([a, b, c, d], [e, f, g, h]) = (four(self.from, self.cuts[0]), four(self.to, -self.cuts[1]));
        [a, b, c, d, e, f, g, h]
    }
}

/// The pieces that a body leaves out.
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
/// 120 MB. `step_mm` is the filament of an extruder's step.
///
/// # Errors
///
/// The file cannot be written.
pub fn write_stl(points: &[PathPoint], step_mm: f64, out: &mut dyn Write) -> io::Result<Body> {
    let runs = runs(points, step_mm);
    let mut off_mm = FINEST_MM;
    let mut found = bars(&runs, step_mm, off_mm);
    // A run of one line stays one bar.
    while found.len() > BARS_MAX.max(runs.len()) {
        off_mm *= 2.0;
        found = bars(&runs, step_mm, off_mm);
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

    /// The volume of a body by the divergence theorem.
    fn volume_mm3(triangles: &[[[f32; 3]; 3]]) -> f64 {
        let parts = triangles.iter().map(|triangle| {
            let [a, b, c] = triangle.map(|corner| corner.map(f64::from));
            let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
            a.iter().zip(cross).map(|(a, cross)| a * cross).sum::<f64>() / 6.0
        });
        parts.sum()
    }

    const STEP_MM: f64 = 0.01;

    fn stl(points: &[PathPoint]) -> Vec<[[f32; 3]; 3]> {
        let mut stl = Vec::new();
        assert_eq!(write_stl(points, STEP_MM, &mut stl).unwrap(), Body { off_mm: FINEST_MM, left_out: 0 });
        triangles(&stl)
    }

    #[test]
    fn a_line_of_filament_is_a_closed_bar_of_its_volume() {
        let points = path(&[([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([30.0, 50.0, 0.2], 0.0)]);
        let found = stl(&points);
        assert_eq!(found.len(), 12, "the travel lays nothing");
        let (volume, laid) = (volume_mm3(&found), 0.7 * FILAMENT_MM2);
        assert!((volume - laid).abs() < 1e-3 * laid, "{volume} {laid}");
        let top = found.iter().flatten().map(|corner| corner[2]).fold(0.0, f32::max);
        assert_eq!(top, 0.2);
    }

    /// A circle of 0.28 mm wide filament in lines of 0.04 mm. The extruder makes a step on each tenth of them or so.
    #[test]
    fn short_lines_are_as_wide_as_the_filament_on_all_of_them() {
        let (width, height, radius, each) = (0.28, 0.2, 10.0, 0.04);
        let rate = width * height / FILAMENT_MM2;
        let count = 1500;
        let place = |n: u32| {
            let angle = f64::from(n) * each / radius;
            [100.0 + radius * angle.cos(), 100.0 + radius * angle.sin(), height]
        };
        let steps = |n: u32| (f64::from(n) * each * rate / STEP_MM).floor();
        let circle = (0..=count).map(|n| {
            let laid = if n == 0 { 0.0 } else { (steps(n) - steps(n - 1)) * STEP_MM };
            (place(n), laid as f32)
        });
        // Then a travel, and a line of twice the width.
        let last = place(count);
        let wide = [([150.0, 100.0, height], 0.0), ([190.0, 100.0, height], (40.0 * 2.0 * rate) as f32)];
        let places: Vec<_> = circle.chain(wide).collect();
        let points = path(&places);
        let laid: f64 = points.iter().map(|point| f64::from(point.laid_mm)).sum::<f64>() * FILAMENT_MM2;
        let volume = volume_mm3(&stl(&points));
        assert!((volume - laid).abs() < 0.005 * laid, "{volume} {laid}");

        let runs = runs(&points, STEP_MM);
        assert_eq!(runs.len(), 2, "a short line without a step is no travel");
        let bars = bars(&runs, STEP_MM, FINEST_MM);
        let (line, circle) = bars.split_last().unwrap();
        assert!((line.width_mm - 2.0 * width).abs() < 1e-3, "{}", line.width_mm);
        for bar in circle {
            assert!((bar.width_mm - width).abs() < 0.02 * width, "{}", bar.width_mm);
        }
        assert!(circle.len() > 30 && distance(circle.last().unwrap().to, last) < 1.0);
        // All joints of the circle are closed: the corners of two bars are the same.
        for two in circle.windows(2) {
            let (before, after) = (two[0].corners(), two[1].corners());
            for n in 0..4 {
                assert!(distance(before[n + 4], after[n]) < 0.005, "{:?} {:?}", before[n + 4], after[n]);
            }
        }
    }

    #[test]
    fn bars_meet_at_corners_that_are_not_too_sharp() {
        for (to, is_joined) in [([30.0, 25.0], true), ([30.0, -15.0], true), ([12.0, 5.5], false)] {
            let mm = distance([30.0, 5.0, 0.2], [to[0], to[1], 0.2]);
            let places = [([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([to[0], to[1], 0.2], (0.035 * mm) as f32)];
            let points = path(&places);
            let (found, laid) = (stl(&points), (0.7 + 0.035 * mm) * FILAMENT_MM2);
            assert!((volume_mm3(&found) - laid).abs() < 1e-3 * laid, "{to:?}");
            let bars = bars(&runs(&points, STEP_MM), STEP_MM, FINEST_MM);
            let (before, after) = (bars[0].corners(), bars[1].corners());
            assert_eq!((0..4).all(|n| distance(before[n + 4], after[n]) < 1e-6), is_joined, "{to:?}");
        }
    }

    #[test]
    fn a_short_line_behind_a_retraction_is_a_travel() {
        let mut points =
            path(&[([10.0, 5.0, 0.2], 0.0), ([30.0, 5.0, 0.2], 0.7), ([30.0, 5.1, 0.2], 0.0), ([10.0, 5.1, 0.2], 0.7)]);
        assert_eq!(runs(&points, STEP_MM).len(), 1);
        points[2].filament_mm -= 0.8;
        assert_eq!(runs(&points, STEP_MM).len(), 2);
    }

    proptest! {
        /// Each place left out is near the line between the kept ones around it.
        #[test]
        fn a_simplified_line_is_never_farther_off_than_asked(
            places in prop::collection::vec(prop::array::uniform3(0.0..10.0f64), 2..60), off_mm in 0.01..5.0f64,
        ) {
            let off = |n: usize, [first, last]: [usize; 2]| {
                distance(places[n], nearest(places[n], places[first], places[last]))
            };
            let kept = simplified(places.len(), off_mm, off);
            let kept: Vec<usize> = (0..places.len()).filter(|n| kept[*n]).collect();
            prop_assert_eq!((kept[0], kept[kept.len() - 1]), (0, places.len() - 1));
            for two in kept.windows(2) {
                for n in two[0]..two[1] {
                    prop_assert!(off(n, [two[0], two[1]]) <= off_mm + 1e-9);
                }
            }
        }
    }
}
