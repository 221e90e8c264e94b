// SPDX-License-Identifier: GPL-3.0-or-later
//! How far the motors' path is from the path that a G-code file asks for.
//!
//! The host chooses the speeds, so an instant does not say where the nozzle should be. Both paths are laid side by side
//! in their order instead (dynamic time warping between two polylines). Each point of the motors' path is on one line of
//! the file, and each point of the file is on one line of the motors' path. The sum of all squared distances is as
//! small as it can be. The greatest distance of two lines is at an end of one of them, so the points are enough.

use std::collections::BTreeMap;

use super::asked::{AskedPath, AskedPoint};
use super::{PIECE_MM, PIECES_MAX, count_pieces, distance, lines, nearest};
use crate::description::check::Trouble;
use crate::engine::recorder::PathPoint;

/// A line of the motors that the file does not ask for costs as if it were off by this: before the file, after it, and
/// at a macro.
const BEFORE_MM: f64 = 0.05;
const AFTER_MM: f64 = 0.02;
const MACRO_MM: f64 = 0.2;
/// A distance counts up to here when the paths are laid side by side.
const FAR_MM: f64 = 20.0;
/// How much of a height counts then. A bed mesh moves the nozzle up and down without the file.
const HEIGHT: f64 = 0.02;
/// Places that cost this much more than the best one are given up.
const BEAM: f64 = 500.0;
/// Each point stands for this length at least. Else a point between short lines could be far off at no cost.
const LEAST_MM: f64 = 0.5;
/// The file has begun when the motors have followed it this far, at most `BEFORE_MM` off.
const BEGUN_MM: f64 = 50.0;
/// Highest number of pairs of a piece of the motors and a state: 256 MiB of memory, and a number of 32 bits. Ten hours
/// of printing have about 50 million, unless lines are laid over each other again and again.
const PAIRS_MAX: usize = 1 << 31;

/// Distances between the two paths.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distances {
    /// The greatest distance seen from above, along x and y.
    pub greatest_mm: f64,
    /// The line of the file where it is.
    pub line: u32,
    /// The mean distance seen from above, by length of the motors' path.
    pub mean_mm: f64,
    /// The greatest distance along z.
    pub greatest_z_mm: f64,
    /// The length of the motors' path.
    pub length_mm: f64,
}

impl Distances {
    /// Takes in a point of a path, which stands for this length.
    fn add(&mut self, place: [f64; 3], on: [f64; 3], line: u32, length_mm: f64) {
        let off_mm = (place[0] - on[0]).hypot(place[1] - on[1]);
        if off_mm > self.greatest_mm {
            (self.greatest_mm, self.line) = (off_mm, line);
        }
        self.greatest_z_mm = self.greatest_z_mm.max((place[2] - on[2]).abs());
        let sum = self.mean_mm * self.length_mm + off_mm * length_mm;
        self.length_mm += length_mm;
        self.mean_mm = if self.length_mm > 0.0 { sum / self.length_mm } else { 0.0 };
    }

    fn join(self, other: Distances) -> Distances {
        let length_mm = self.length_mm + other.length_mm;
        let mean = |of: Distances| if length_mm > 0.0 { of.mean_mm * of.length_mm / length_mm } else { 0.0 };
        let farther = if other.greatest_mm > self.greatest_mm { other } else { self };
        Distances {
            greatest_mm: farther.greatest_mm,
            line: farther.line,
            mean_mm: mean(self) + mean(other),
            greatest_z_mm: self.greatest_z_mm.max(other.greatest_z_mm),
            length_mm,
        }
    }
}

/// The comparison of two paths.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// By layer of the file, each with its height.
    pub layers: Vec<(u32, f64, Distances)>,
    /// Everything.
    pub all: Distances,
    /// The line of the file where the motors' path ends; `None` if it goes to the file's end.
    pub ends_at_line: Option<u32>,
    /// Filament that the file pushes, without retractions.
    pub filament_mm: f64,
}

/// Cost of a point that is off, and stands for this length.
fn cost(off_mm: f64, mm: f64) -> f64 {
    off_mm.min(FAR_MM).powi(2) * mm.max(LEAST_MM)
}

/// A place with a height that counts less.
fn flat(place: [f64; 3]) -> [f64; 3] {
    [place[0], place[1], place[2] * HEIGHT]
}

/// The file's path as a row of states. State 0 is before its first point, state `n` is the line to its point `n`, and
/// the last state is after its last point.
struct States {
    points: Vec<AskedPoint>,
    flat: Vec<[f64; 3]>,
}

/// The ends of the pieces of a line, without its start.
fn pieces(from: [f64; 3], to: [f64; 3]) -> impl Iterator<Item = [f64; 3]> {
    let count = count_pieces(from, to);
    let at = move |n: u32| [0, 1, 2].map(|i: usize| from[i] + (to[i] - from[i]) * (f64::from(n) / count));
    (1..count as u32).map(at).chain([to])
}

impl States {
    fn new(asked: &AskedPath) -> States {
        let mut points: Vec<AskedPoint> = Vec::with_capacity(asked.points.len());
        for point in &asked.points {
            match points.last().copied().filter(|_| !point.is_start) {
                Some(last) => {
                    let piece = |nozzle_mm| AskedPoint { nozzle_mm, ..*point };
                    points.extend(pieces(last.nozzle_mm, point.nozzle_mm).map(piece));
                }
                None => points.push(*point),
            }
        }
        States { flat: points.iter().map(|point| flat(point.nozzle_mm)).collect(), points }
    }

    fn last(&self) -> usize {
        self.flat.len()
    }

    /// How far off a state counts where the file asks for nothing; `None` for a line of the file.
    fn free(&self, state: usize) -> Option<f64> {
        match state {
            0 => Some(BEFORE_MM),
            state if state == self.last() => Some(AFTER_MM),
            state => self.points[state].is_start.then_some(MACRO_MM),
        }
    }

    /// Cost of a line of the motors that ends here.
    fn stay(&self, state: usize, place: [f64; 3], mm: f64) -> f64 {
        match self.free(state) {
            Some(off_mm) => off_mm.powi(2) * mm,
            None => cost(distance(place, nearest(place, self.flat[state - 1], self.flat[state])), mm),
        }
    }

    /// Cost of going from a state to the next one on a line of the motors: the file's point between must be near.
    fn pass(&self, state: usize, [from, to]: [[f64; 3]; 2]) -> f64 {
        let point = self.flat[state];
        let mm = match state.checked_sub(1) {
            Some(before) if !self.points[state].is_start => distance(point, self.flat[before]),
            _ => 1.0,
        };
        cost(distance(point, nearest(point, from, to)), mm)
    }
}

/// The record for each line of the motors: the first state, and the place of the first bit. A bit says that the
/// state was entered on this line.
struct Ways {
    rows: Vec<(usize, usize)>,
    bits: Vec<u64>,
    count: usize,
}

impl Ways {
    fn begin(&mut self, first: usize) {
        self.rows.push((first, self.count));
    }

    fn push(&mut self, entered: bool) {
        if self.count.is_multiple_of(64) {
            self.bits.push(0);
        }
        if let Some(word) = self.bits.last_mut() {
            *word |= u64::from(entered) << (self.count % 64);
        }
        self.count += 1;
    }

    fn entered(&self, row: usize, state: usize) -> bool {
        let (first, bit) = self.rows[row];
        let bit = bit + state - first;
        self.bits[bit / 64] >> (bit % 64) & 1 != 0
    }
}

/// The cost of a state, and the cost and the way of the motors when it left state 0.
#[derive(Clone, Copy)]
struct Cost {
    sum: f64,
    begun: (f64, f64),
}

/// Compares the motors' path with the path that a file asks for.
///
/// # Errors
///
/// The motors never followed the file, or one of the paths is too long.
pub fn compare(points: &[PathPoint], asked: &AskedPath) -> Result<Comparison, Trouble> {
    compare_within(PAIRS_MAX, points, asked)
}

/// The same, with at most this many pairs.
fn compare_within(pairs_max: usize, points: &[PathPoint], asked: &AskedPath) -> Result<Comparison, Trouble> {
    let too_long = || Trouble::new("the motors' path is too long to be compared").remedy("print a shorter file");
    let never = || {
        let trouble = Trouble::new("the motors never went along the path of this file");
        trouble.remedy("print it, and check position_endstop and the offsets")
    };
    let states = States::new(asked);
    let mut moves: Vec<[[f64; 3]; 2]> = Vec::new();
    for line in lines(points).filter(|line| line.mm() > 0.0) {
        if moves.len() as f64 + count_pieces(line.from.nozzle_mm, line.to.nozzle_mm) > PIECES_MAX {
            return Err(too_long());
        }
        let mut from = line.from.nozzle_mm;
        for to in pieces(from, line.to.nozzle_mm) {
            moves.push([from, to]);
            from = to;
        }
    }
    let mut ways = Ways { rows: Vec::with_capacity(moves.len()), bits: Vec::new(), count: 0 };
    let mut first = 0;
    let mut costs = vec![Cost { sum: 0.0, begun: (0.0, 0.0) }];
    let mut went_mm = 0.0;
    for &[from, to] in &moves {
        let ends = [flat(from), flat(to)];
        let mm = distance(from, to);
        went_mm += mm;
        let best = costs.iter().map(|cost| cost.sum).fold(f64::INFINITY, f64::min);
        ways.begin(first);
        let mut row: Vec<Cost> = Vec::with_capacity(costs.len() + 8);
        let mut before: Option<Cost> = None;
        for state in first..=states.last() {
            let stayed = costs.get(state - first).copied();
            let entered = before.map(|cost| {
                let begun = if state == 1 { (cost.sum, went_mm) } else { cost.begun };
                Cost { sum: cost.sum + states.pass(state - 1, ends), begun }
            });
            let (cost, is_entered) = match (stayed, entered) {
                (Some(stayed), Some(entered)) if entered.sum < stayed.sum => (entered, true),
                (Some(stayed), _) => (stayed, false),
                (None, Some(entered)) if entered.sum <= best + BEAM => (entered, true),
                (None, _) => break,
            };
            ways.push(is_entered);
            row.push(Cost { sum: cost.sum + states.stay(state, ends[1], mm), ..cost });
            before = Some(cost);
        }
        if ways.count > pairs_max {
            return Err(too_long());
        }
        let (place, best) = least(&row).ok_or_else(never)?;
        let state = first + place;
        // Once the motors follow the file, they no longer come before it.
        let has_begun = first == 0 && state > 0 && {
            let followed_mm = went_mm - best.begun.1;
            followed_mm >= BEGUN_MM && best.sum - best.begun.0 <= BEFORE_MM.powi(2) * followed_mm
        };
        let gone = row.iter().take_while(|cost| cost.sum > best.sum + BEAM).count().max(usize::from(has_begun));
        // The bits of the first states stay where they are.
        let kept = row.len() - row.iter().rev().take_while(|cost| cost.sum > best.sum + BEAM).count();
        costs = row[gone.min(kept)..kept].to_vec();
        first += gone.min(kept);
    }
    let (place, _) = least(&costs).ok_or_else(never)?;
    let end = first + place;
    if end == 0 {
        return Err(never());
    }
    let mut layers = distances(&moves, &states, &ways, end);
    // The file's last point ends the motors' path, or is before the last line that the motors went.
    let mut ends_at_line = (end < states.last()).then(|| states.points[end].line);
    if let (Some([_, place]), Some(goal)) = (moves.last(), states.points.last())
        && end + 1 == states.last()
        && distance(*place, goal.nozzle_mm) < PIECE_MM
    {
        layers.entry(goal.layer).or_default().add(goal.nozzle_mm, *place, goal.line, 0.0);
        ends_at_line = None;
    }
    let mut heights: BTreeMap<u32, f64> = BTreeMap::new();
    for point in &asked.points {
        let height_mm = heights.entry(point.layer).or_insert(f64::INFINITY);
        *height_mm = height_mm.min(point.nozzle_mm[2]);
    }
    Ok(Comparison {
        all: layers.values().copied().fold(Distances::default(), Distances::join),
        layers: layers.into_iter().map(|(layer, found)| (layer, heights[&layer], found)).collect(),
        ends_at_line,
        filament_mm: asked.filament_mm,
    })
}

fn least(costs: &[Cost]) -> Option<(usize, Cost)> {
    let costs = costs.iter().copied().enumerate();
    costs.min_by(|(_, a), (_, b)| a.sum.total_cmp(&b.sum))
}

/// Goes back along the best way, and measures.
fn distances(moves: &[[[f64; 3]; 2]], states: &States, ways: &Ways, end: usize) -> BTreeMap<u32, Distances> {
    let mut layers: BTreeMap<u32, Distances> = BTreeMap::new();
    let points = &states.points;
    let mut state = end;
    for (row, &[from, to]) in moves.iter().enumerate().rev() {
        if states.free(state).is_none() {
            let on = nearest(to, points[state - 1].nozzle_mm, points[state].nozzle_mm);
            layers.entry(points[state].layer).or_default().add(to, on, points[state].line, distance(from, to));
        }
        while state > 0 && ways.entered(row, state) {
            state -= 1;
            let point = &points[state];
            let on = nearest(point.nozzle_mm, from, to);
            layers.entry(point.layer).or_default().add(point.nozzle_mm, on, point.line, 0.0);
        }
        if state == 0 {
            break;
        }
    }
    layers
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::Clock;
    use proptest::prelude::*;

    /// A path through these places, with a point every `each_mm` or so.
    fn path(places: &[[f64; 3]], each_mm: f64) -> Vec<PathPoint> {
        let mut all = vec![places[0]];
        for two in places.windows(2) {
            let count = (distance(two[0], two[1]) / each_mm).ceil().max(1.0);
            let at = |n: u32| [0, 1, 2].map(|i: usize| two[0][i] + (two[1][i] - two[0][i]) * f64::from(n) / count);
            all.extend((1..=count as u32).map(at));
        }
        let point = |(n, nozzle_mm): (u64, [f64; 3])| PathPoint {
            at: Clock::from_ticks(n * 1_000_000),
            nozzle_mm,
            filament_mm: 0.0,
            laid_mm: 0.0,
            height_mm: 0.0,
            layer: 0,
            is_start: n == 0,
        };
        (0..).zip(all).map(point).collect()
    }

    fn asked(places: &[[f64; 3]]) -> AskedPath {
        let line = |(e, [x, y, z]): (u32, &[f64; 3])| format!("G1 X{x} Y{y} Z{z} E{e}\n");
        AskedPath::read((0..).zip(places).map(line).collect::<String>().as_bytes(), "a.gcode").unwrap()
    }

    #[test]
    fn paths_with_too_many_pairs_are_refused() {
        // Each line of the motors is as near to each line of the file.
        let to_and_fro: Vec<_> = (0..40).map(|n| [100.0 + f64::from(n % 2), 100.0, 0.2]).collect();
        let (motors, file) = (path(&to_and_fro, 1.0), asked(&to_and_fro));
        assert!(compare_within(2000, &motors, &file).is_ok());
        let refused = compare_within(200, &motors, &file).unwrap_err().to_string();
        assert!(refused.contains("the motors' path is too long to be compared"), "{refused}");
    }

    /// A square spiral, out and back over its own lines, and up.
    fn spiral() -> Vec<[f64; 3]> {
        let mut places = Vec::new();
        for layer in 0..3 {
            let z = 0.2 * f64::from(layer + 1);
            for n in 0..8 {
                let r = 5.0 * f64::from(n + 1);
                let ways = [[r, 0.0], [0.0, r], [-r, 0.0], [0.0, -r]];
                let [dx, dy] = ways[n as usize % 4];
                places.push([100.0 + dx, 100.0 + dy, z]);
            }
            let back: Vec<_> = places.iter().rev().take(5).copied().collect();
            places.extend(back);
        }
        places
    }

    #[test]
    fn the_same_path_is_nowhere_off_however_it_is_divided() {
        let places = spiral();
        for each_mm in [0.7, 3.0, 1000.0] {
            let found = compare(&path(&places, each_mm), &asked(&places)).unwrap();
            assert!(found.all.greatest_mm < 1e-6 && found.all.greatest_z_mm < 1e-6, "{each_mm}: {found:?}");
            assert_eq!(found.ends_at_line, None);
        }
    }

    #[test]
    fn each_line_of_the_motors_is_laid_beside_a_few_of_the_file() {
        // Layers of infill: 18 m, nearly all of it beside lines that are as near.
        let line = |n: u32| {
            let (layer, row) = (n / 120, n % 120);
            let [x, z] = [0.45 * f64::from(row), 0.2 * f64::from(layer + 1)];
            let ends = if row % 2 == 0 { [0.0, 50.0] } else { [50.0, 0.0] };
            ends.map(|y| if layer % 2 == 0 { [x, y, z] } else { [y, x, z] })
        };
        let places: Vec<_> = (0..3 * 120).flat_map(line).collect();
        let (went, asked) = (path(&places, 2.7), asked(&places));
        // All of the file would make 13 million pairs.
        let found = compare_within(300_000, &went, &asked).unwrap();
        assert!(found.all.greatest_mm < 1e-6 && found.ends_at_line.is_none(), "{found:?}");
        assert!(found.all.length_mm > 18_000.0, "{}", found.all.length_mm);
    }

    #[test]
    fn what_comes_before_and_after_the_file_does_not_count() {
        let places = spiral();
        let mut all =
            vec![[60.0, 45.0, 12.0], [0.0, 45.0, 12.0], [0.0, 0.0, 12.0], [105.0, 0.0, 0.0], [105.0, 0.0, 5.0]];
        all.extend(&places);
        all.extend([[0.0, 220.0, 30.0], [10.0, 200.0, 30.0]]);
        let found = compare(&path(&all, 2.0), &asked(&places)).unwrap();
        assert!(found.all.greatest_mm < 1e-6 && found.ends_at_line.is_none(), "{found:?}");
        assert!(compare(&path(&all[..4], 2.0), &asked(&places)).is_err(), "the file never began");
    }

    #[test]
    fn lost_steps_show_from_there_on_and_keep_their_size() {
        let places = spiral();
        // From the middle of the second layer on the x axis is 1.5 mm off.
        let from = 20;
        let line = asked(&places).points[from].line;
        let moved = |(n, [x, y, z]): (usize, [f64; 3])| [if n >= from { x + 1.5 } else { x }, y, z];
        let lost: Vec<_> = places.iter().copied().enumerate().map(moved).collect();
        let found = compare(&path(&lost, 1.0), &asked(&places)).unwrap();
        assert!((1.4..2.2).contains(&found.all.greatest_mm), "{found:?}");
        assert!(found.all.line >= line, "{found:?}");
        let greatest: Vec<f64> = found.layers.iter().map(|(.., found)| found.greatest_mm).collect();
        assert!(greatest[0] < 1e-6, "{greatest:?}");
    }

    #[test]
    fn a_path_that_ends_early_says_where() {
        let places = spiral();
        let found = compare(&path(&places[..20], 1.0), &asked(&places)).unwrap();
        assert!(found.all.greatest_mm < 1e-6, "{found:?}");
        let line = found.ends_at_line.unwrap();
        assert!((20..=22).contains(&line), "{line}");
    }

    #[test]
    fn a_turn_that_the_motors_cut_short_shows_at_the_files_point() {
        // Forth and back on one line: the nozzle turns 0.3 mm too early.
        let asked = asked(&[[0.0, 0.0, 1.0], [80.0, 0.0, 1.0], [20.0, 0.0, 1.0], [20.0, 40.0, 1.0]]);
        let went = path(&[[0.0, 0.0, 1.0], [79.7, 0.0, 1.0], [20.0, 0.0, 1.0], [20.0, 40.0, 1.0]], 5.0);
        let found = compare(&went, &asked).unwrap();
        assert!((found.all.greatest_mm - 0.3).abs() < 1e-6 && found.all.line == 2, "{found:?}");
        assert!(found.all.mean_mm < 1e-6, "{found:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// A path that is off by a little everywhere is found off by no more.
        #[test]
        fn the_distance_is_at_most_what_was_added(
            turns in prop::collection::vec((prop::array::uniform2(0.0..60.0f64), prop::array::uniform2(-0.02..0.02f64)), 8..40),
            each_mm in 0.5..50.0f64,
        ) {
            let places: Vec<_> = (0..).zip(&turns).map(|(n, ([x, y], _))| [x + f64::from(n % 2) * 61.0, *y, 1.0]).collect();
            let moved: Vec<_> = places.iter().zip(&turns).map(|([x, y, _], (_, [dx, dy]))| [x + dx, y + dy, 1.0]).collect();
            let greatest = turns.iter().map(|(_, [dx, dy])| dx.hypot(*dy)).fold(0.0, f64::max);
            let found = compare(&path(&moved, each_mm), &asked(&places)).unwrap();
            prop_assert!(found.all.greatest_mm <= greatest + 1e-9, "{} {greatest}", found.all.greatest_mm);
            prop_assert!(found.all.mean_mm <= found.all.greatest_mm);
            prop_assert_eq!(found.ends_at_line, None);
        }
    }
}
