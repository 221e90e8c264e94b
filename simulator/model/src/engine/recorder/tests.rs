// SPDX-License-Identifier: GPL-3.0-or-later
//! The recorder in virtual time.

use super::*;
use crate::description::default::DefaultPrinter;
use crate::engine::bed::Bed;
use crate::engine::track::KEPT;
use pinion_firmware::time::CLOCK_FREQ;
use proptest::prelude::*;

/// The built-in printer's axes and a flat bed, and every place of the nozzle with its instant and its filament.
struct Bench {
    axes: Vec<Arc<Axis>>,
    recorder: Recorder,
    at_s: f64,
    places: Vec<(Clock, [f64; 4])>,
}

fn clock(at_s: f64) -> Clock {
    Clock::from_ticks((at_s * f64::from(CLOCK_FREQ)).round() as u64)
}

impl Bench {
    fn new() -> Bench {
        let axes: Vec<Arc<Axis>> = DefaultPrinter::read().axes[..4].iter().map(|a| Arc::new(Axis::new(a))).collect();
        axes.iter().for_each(|axis| axis.set_enabled(true));
        let [x, y, z] = [0, 1, 2].map(|i| Some(axes[i].clone()));
        let bed = Arc::new(Bed::under(Default::default(), x, y, z));
        let recorder = Recorder::new(bed, &axes[3..], Ticks(0), clock(1.0));
        Bench { axes, recorder, at_s: 1.0, places: Vec::new() }
    }

    fn values(&self) -> [f64; 4] {
        [0, 1, 2, 3].map(|i: usize| self.axes[i].position_mm())
    }

    /// Moves along a line in this time, like a host: each axis steps when the line passes the middle of a step.
    /// The share of the way at each share of the time is `way`.
    fn go(&mut self, by_mm: [f64; 4], seconds: f64, way: impl Fn(f64) -> f64) {
        let from = self.values();
        let slices = 5000;
        for n in 1..=slices {
            let share = f64::from(n) / f64::from(slices);
            let at = clock(self.at_s + seconds * share);
            for i in 0..4 {
                let goal_mm = from[i] + by_mm[i] * way(share);
                let axis = &self.axes[i];
                while (goal_mm - axis.position_mm()).abs() > axis.step_mm() * 0.5 + 1e-9 {
                    let before = axis.position_mm();
                    axis.set_forward(goal_mm > before);
                    axis.edge(true, at);
                    axis.edge(false, at);
                    if axis.position_mm() == before {
                        break;
                    }
                }
            }
            if n % 125 == 0 {
                self.recorder.read(at);
            }
            self.places.push((at, self.values()));
        }
        self.at_s += seconds;
    }

    fn end(&mut self) -> &[PathPoint] {
        self.at_s += 1.0;
        self.recorder.read(clock(self.at_s));
        self.recorder.points()
    }
}

fn evenly(share: f64) -> f64 {
    share
}

fn assert_near(value: f64, expected: f64, by: f64) {
    assert!((value - expected).abs() <= by, "{value} {expected}");
}

#[test]
fn an_even_move_is_one_line_and_a_corner_is_kept() {
    let mut bench = Bench::new();
    bench.go([40.0, 13.0, 0.0, 0.0], 0.5, evenly);
    bench.go([0.0, 20.0, 0.0, 0.0], 0.25, evenly);
    let points = bench.end();
    assert!(points.len() <= 5, "{points:#?}");
    assert!(points[0].is_start && points[1..].iter().all(|point| !point.is_start));
    let corner = points.iter().map(|p| (p.nozzle_mm[0] - 100.0).hypot(p.nozzle_mm[1] - 58.0)).fold(9.0, f64::min);
    assert_near(corner, 0.0, 0.03);
    assert_eq!(points.last().unwrap().nozzle_mm, [100.0, 78.0, 12.0]);
}

#[test]
fn a_rest_is_a_line_without_a_way() {
    let mut bench = Bench::new();
    bench.go([10.0, 0.0, 0.0, 0.0], 0.1, evenly);
    bench.at_s += 5.0;
    bench.go([10.0, 0.0, 0.0, 0.0], 0.1, evenly);
    let points = bench.end();
    let speed = |two: &[PathPoint]| {
        let [from, to] = two else { panic!() };
        let seconds = to.at.since(from.at) as f64 / f64::from(CLOCK_FREQ);
        (to.nozzle_mm[0] - from.nozzle_mm[0]) / seconds
    };
    let speeds: Vec<f64> = points.windows(2).map(speed).collect();
    let even = |speed: &f64| speed.abs() < 0.1 || (*speed - 100.0).abs() < 2.0;
    assert!(speeds.iter().all(even) && points.len() <= 6, "{speeds:?}");
}

#[test]
fn filament_is_laid_when_it_is_pushed_farther_than_before() {
    let mut bench = Bench::new();
    bench.go([0.0, 0.0, -11.8, 0.0], 1.0, evenly);
    bench.go([20.0, 0.0, 0.0, 1.0], 0.5, evenly);
    bench.go([0.0, 0.0, 0.0, -0.8], 0.1, evenly);
    bench.go([0.0, 30.0, 0.0, 0.0], 0.2, evenly);
    bench.go([0.0, 0.0, 0.0, 0.8], 0.1, evenly);
    bench.go([-20.0, 0.0, 0.0, 1.0], 0.5, evenly);
    bench.go([0.0, 0.0, 0.25, 0.0], 0.1, evenly);
    bench.go([20.0, 0.0, 0.0, 1.0], 0.5, evenly);
    let points = bench.end();
    let laid = |layer: u32| -> f64 {
        points.iter().filter(|point| point.layer == layer).map(|point| f64::from(point.laid_mm)).sum()
    };
    assert_near(laid(1), 2.0, 0.03);
    assert_near(laid(2), 1.0, 0.03);
    // Nothing was laid on the way along y.
    let travel: Vec<_> =
        points.windows(2).filter(|two| (two[1].nozzle_mm[1] - two[0].nozzle_mm[1]).abs() > 1.0).collect();
    assert!(!travel.is_empty() && travel.iter().all(|two| two[1].laid_mm < 0.02), "{travel:?}");
    let heights: Vec<f32> =
        [1, 2].map(|layer| points.iter().rfind(|point| point.layer == layer).unwrap().height_mm).into();
    assert_near(heights[0].into(), 0.2, 0.004);
    assert_near(heights[1].into(), 0.25, 0.004);
    assert_eq!(points.last().unwrap().layer, 2);
}

#[test]
fn overwritten_steps_are_a_gap_and_no_line() {
    let mut bench = Bench::new();
    bench.go([1.0, 0.0, 0.0, 0.0], 0.1, evenly);
    // Nobody reads while the x axis goes forth and back.
    let x = bench.axes[0].clone();
    for step in 0..3 * KEPT {
        x.set_forward(step / 1000 % 2 == 0);
        x.edge(true, clock(bench.at_s + step as f64 * 1e-5));
        x.edge(false, clock(bench.at_s + step as f64 * 1e-5));
    }
    bench.at_s += 1.0;
    bench.end();
    assert_eq!(bench.recorder.gaps(), 1);
    let starts: Vec<usize> = (0..).zip(bench.recorder.points()).filter(|(_, p)| p.is_start).map(|(n, _)| n).collect();
    assert_eq!(starts.len(), 2, "the start, and the end of the gap");
    assert_eq!(bench.recorder.points().last().unwrap().nozzle_mm[0], x.position_mm());
}

#[test]
fn lost_steps_are_no_path() {
    let mut bench = Bench::new();
    bench.go([-70.0, 0.0, 0.0, 0.0], 1.0, evenly);
    assert!(bench.axes[0].lost_steps() > 0);
    assert_eq!(bench.end().last().unwrap().nozzle_mm[0], -2.0, "the hard limit");
}

#[test]
fn a_full_recorder_says_so() {
    let mut bench = Bench::new();
    bench.recorder.points_max = 3;
    for way in [1.0, -1.0, 1.0, -1.0] {
        assert!(!bench.recorder.is_full() || bench.recorder.points().len() == 3);
        bench.go([way * 10.0, 0.0, 0.0, 0.0], 0.2, evenly);
    }
    bench.end();
    assert!(bench.recorder.is_full() && bench.recorder.points().len() == 3);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// The nozzle is near the line of the path at each instant, whatever the motion.
    #[test]
    fn the_path_is_never_farther_off_than_it_says(
        moves in prop::collection::vec((prop::array::uniform4(-5.0..5.0f64), 0.01..0.5f64, 1.0..3.0f64), 1..5),
    ) {
        let mut bench = Bench::new();
        for (by_mm, seconds, bend) in moves {
            bench.go(by_mm, seconds, |share| share.powf(bend));
        }
        bench.end();
        let points = bench.recorder.points();
        prop_assert_eq!(bench.recorder.gaps(), 0);
        // Between two steps the axis stands, and the line goes on: by a step at most.
        let allowed = |i: usize| bench.recorder.off_mm[i] + bench.axes[i].step_mm();
        let mut line = 0;
        for (at, values) in &bench.places {
            while line + 2 < points.len() && points[line + 1].at < *at {
                line += 1;
            }
            let (from, to) = (&points[line], &points[line + 1]);
            let ticks = to.at.since(from.at) as f64;
            let share = (at.since(from.at) as f64 / ticks).clamp(0.0, 1.0);
            let value = |p: &PathPoint| [p.nozzle_mm[0], p.nozzle_mm[1], p.nozzle_mm[2], p.filament_mm];
            let (a, b) = (value(from), value(to));
            for i in 0..4 {
                let off = (a[i] + (b[i] - a[i]) * share - values[i]).abs();
                prop_assert!(off <= allowed(i) + 1e-6, "{off} along {i} at {at:?}");
            }
        }
    }
}
