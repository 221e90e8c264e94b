// SPDX-License-Identifier: GPL-3.0-or-later
//! The documentation's examples in virtual time; lights and the edges of a tachometer.

use super::*;
use crate::config::tests::example;
use crate::engine::bed::{BedShape, Space};

/// The printer of an example.
fn bench(heading: &str) -> Bench {
    Bench::new(SimConfig::parse(&example(heading), heading).unwrap())
}

/// Moves an axis by this number of steps, toward its start or away from it.
fn travel(bench: &mut Bench, axis: &str, steps: i32) {
    let step = bench.output(&format!("{axis}_step"), false);
    let _dir = bench.output(&format!("{axis}_dir"), steps > 0);
    let _enable = bench.output(&format!("{axis}_enable"), false);
    (0..steps.abs()).for_each(|_| pulse(&*step));
}

#[test]
fn the_probe_feels_how_a_gantry_hangs_on_its_motors() {
    let mut bench = bench("Four Z motors");
    let probe = bench.input("probe");
    // The nozzle is at 60 and 45 mm. The probe beside it is at 84 and 37 mm, 1.5 mm deeper.
    let height = |[z, z1, z2, z3]: [f64; 4]| {
        let (left, right) = ((z + z1) / 2.0, (z2 + z3) / 2.0);
        let (front, rear) = ((z + z3) / 2.0, (z1 + z2) / 2.0);
        let middle = (left + right) / 2.0;
        middle + (right - left) * (84.0 - 110.0) / 280.0 + (rear - front) * (37.0 - 110.0) / 240.0 - 1.5
    };
    let (u, v) = (2.0 * 84.0 / 220.0 - 1.0, 2.0 * 37.0 / 220.0 - 1.0);
    let bed = (0.12 * u - 0.08 * v) / 2.0 - 0.1 * (u * u + v * v) / 2.0;
    let mut at = [12.0, 12.6, 11.8, 11.3];
    for (axis, place) in [("z", 0), ("z2", 2), ("z1", 1), ("z3", 3)] {
        travel(&mut bench, axis, -400 * 10);
        at[place] -= 10.0;
        assert_eq!(probe.read().unwrap(), height(at) <= bed, "{axis}");
    }
    let mut steps = 0;
    while !probe.read().unwrap() {
        travel(&mut bench, "z1", -1);
        at[1] -= 0.0025;
        steps += 1;
        assert!(steps < 4000);
    }
    assert!((height(at) - bed).abs() < 0.0025, "{} {bed}", height(at));
}

#[test]
fn the_probe_of_a_delta_feels_the_bed() {
    let mut bench = bench("A delta printer");
    let probe = bench.input("probe");
    // In the middle the nozzle is as high as the carriages, minus the arms' height.
    let arms = (215.0f64 * 215.0 - 105.0 * 105.0).sqrt();
    let down = ((380.0 - arms - 1.5) * 100.0) as i32;
    for axis in ["a", "b", "c"] {
        travel(&mut bench, axis, 1 - down);
    }
    assert!(!probe.read().unwrap());
    for axis in ["a", "b", "c"] {
        travel(&mut bench, axis, -2);
    }
    assert!(probe.read().unwrap());
}

#[test]
fn a_chamber_is_warm_by_itself_and_its_fan_cools_it() {
    let mut bench = bench("A chamber with a fan");
    let celsius = |bench: &Bench| bench.probe.heater("chamber").unwrap().celsius;
    // 60 W at 1 W/K; it starts at 45 C.
    let warm = celsius(&bench);
    bench.advance(300.0);
    assert!((celsius(&bench) - (85.0 - 40.0 * (-1.0f64).exp())).abs() < 0.01, "{warm} {}", celsius(&bench));
    bench.advance(1e5);
    assert!((celsius(&bench) - 85.0).abs() < 0.01);
    // 5 W/K more, in the steps of a dimmed fan.
    let fan = bench.output("exhaust_fan", false);
    let from = celsius(&bench);
    for _ in 0..3000 {
        fan.write(true).unwrap();
        bench.advance(0.005);
        fan.write(false).unwrap();
        bench.advance(0.005);
    }
    // 30 s at 3 W/K on average.
    let end = 25.0 + 60.0 / 3.0;
    let expected = end + (from - end) * (-30.0f64 / 100.0).exp();
    assert!((celsius(&bench) - expected).abs() < 0.1, "{} {expected}", celsius(&bench));
    fan.write(true).unwrap();
    bench.advance(1e5);
    assert!((celsius(&bench) - 37.0).abs() < 0.01, "{}", celsius(&bench));
}

#[test]
fn a_light_of_four_colours_mixes_them() {
    let mut bench = bench("An RGBW strip");
    let [red, _green, white] = ["shelf_red", "shelf_green", "shelf_white"].map(|pin| bench.output(pin, false));
    let shown = |bench: &Bench| bench.probe.sights().find(|(name, _)| *name == "shelf").unwrap().1.to_string();
    assert_eq!(shown(&bench), "off");
    white.write(true).unwrap();
    let mut seen = Vec::new();
    for cycle in 0..50 {
        red.write(true).unwrap();
        bench.advance(0.002);
        seen.extend((cycle > 30).then(|| shown(&bench)));
        red.write(false).unwrap();
        bench.advance(0.008);
        seen.extend((cycle > 30).then(|| shown(&bench)));
    }
    // The light does not flicker.
    assert!(seen.iter().all(|shown| shown == "#330000+ff"), "{seen:?}");
    assert!(bench.probe.output("shelf").is_none() && bench.probe.output("light").is_some());
}

#[test]
fn a_light_that_is_switched_quickly_looks_dimmed() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let led = bench.output("led", false);
    let brightness = |bench: &Bench| bench.probe.output("light").unwrap().brightness;
    for _ in 0..100 {
        led.write(true).unwrap();
        bench.advance(0.0025);
        led.write(false).unwrap();
        bench.advance(0.0075);
    }
    assert_eq!(brightness(&bench), 0.25);
    bench.advance(0.2);
    assert_eq!(brightness(&bench), 0.0);
    led.write(true).unwrap();
    bench.advance(0.2);
    assert_eq!(brightness(&bench), 1.0);
    // Off for a moment, after a long time on.
    led.write(false).unwrap();
    bench.advance(0.001);
    led.write(true).unwrap();
    assert_eq!(brightness(&bench), 1.0);
}

#[test]
fn the_edges_of_a_tachometer_are_counted_and_dated() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let pin = bench.pin("fan_tachometer");
    let mut counted = bench.board.counted_line(pin, Bias::PullUp).unwrap();
    let edges = &mut counted.edges.as_mut().unwrap().device;
    let mut seen = Vec::new();
    edges.take(&mut |edge| seen.push(edge)).unwrap();
    assert_eq!(seen, []);
    let fan = bench.output("fan", true);
    let (mut levels, mut level) = (0, true);
    for _ in 0..300_000 {
        bench.advance(1e-5);
        levels += u32::from(
            counted.line.line.read().unwrap() != std::mem::replace(&mut level, counted.line.line.read().unwrap()),
        );
    }
    edges.take(&mut |edge| seen.push(edge)).unwrap();
    assert_eq!(seen.len(), levels as usize);
    assert_eq!(seen.last().unwrap().level, level);
    assert!(seen.windows(2).all(|pair| pair[0].level != pair[1].level && pair[0].at <= pair[1].at));
    // 75 turns a second give 300 edges, each 1/300 s after the one before.
    bench.advance(1.0);
    seen.clear();
    edges.take(&mut |edge| seen.push(edge)).unwrap();
    assert!((299..=301).contains(&seen.len()), "{}", seen.len());
    let gaps = seen.windows(2).map(|pair| (pair[1].at - pair[0].at).as_secs_f64());
    assert!(gaps.into_iter().all(|gap| (gap - 1.0 / 300.0).abs() < 5e-5), "{seen:?}");
    // A fan that stands still has no more edges. Edges that were not taken in time are dropped.
    fan.write(false).unwrap();
    bench.advance(20.0);
    seen.clear();
    edges.take(&mut |edge| seen.push(edge)).unwrap();
    assert!(!seen.is_empty() && seen.iter().all(|edge| edge.dropped == 0), "{seen:?}");
    bench.advance(20.0);
    edges.take(&mut |_| panic!("it stands")).unwrap();
    fan.write(true).unwrap();
    bench.advance(60.0);
    seen.clear();
    edges.take(&mut |edge| seen.push(edge)).unwrap();
    assert_eq!(seen.len(), 1024);
    assert!(seen[0].dropped > 10_000 && seen[1..].iter().all(|edge| edge.dropped == 0), "{:?}", seen[0]);
    let pin = bench.pin("x_endstop");
    let endstop = bench.board.counted_line(pin, Bias::PullUp).unwrap();
    assert_eq!(endstop.edges.err().unwrap(), "nobody counts the edges of endstop of axis x".into());
}

#[test]
fn the_nozzle_is_over_its_bed() {
    let default = Bench::new(SimConfig::default_printer());
    assert_eq!(default.probe.nozzle_mm(), [60.0, 45.0, 12.0]);
    let bed = BedShape::Rectangle { min_mm: [0.0; 2], max_mm: [220.0, 220.0] };
    assert_eq!(default.probe.space(), Some(Space { bed, height_mm: 240.0 }));
    let delta = bench("A delta printer");
    let Space { bed, height_mm } = delta.probe.space().unwrap();
    assert_eq!(bed, BedShape::Disc { radius_mm: 90.0 });
    let [x, y, z] = delta.probe.nozzle_mm();
    assert!(x.hypot(y) < 90.0 && z > 0.0 && z < height_mm, "{x} {y} {z} of {height_mm}");
    assert_eq!(Bench::new(SimConfig::parse("", "empty").unwrap()).probe.space(), None, "no axis");
}

#[test]
fn the_belts_of_a_corexy_printer_move_one_head() {
    let mut bench = bench("A CoreXY printer");
    let places = |bench: &Bench| ["x", "y"].map(|axis| bench.axis(axis).position_mm);
    assert_eq!(places(&bench), [60.0, 45.0]);
    let endstop = bench.input("y_endstop");
    // A step of a motor moves the head by half a step along both axes: 1/160 mm. The direction line of y is inverted.
    let mut recorder = bench.probe.recorder();
    travel(&mut bench, "x", 1600);
    assert_eq!(places(&bench), [70.0, 55.0]);
    travel(&mut bench, "y", -1600);
    assert_eq!(places(&bench), [80.0, 45.0]);
    assert!(!endstop.read().unwrap());
    // To the endstop of y, and into the end of its travel 2 mm behind it. The head stands then, also along x.
    travel(&mut bench, "y", -7200);
    assert_eq!(places(&bench), [125.0, 0.0]);
    assert!(endstop.read().unwrap());
    travel(&mut bench, "y", -320);
    assert_eq!(places(&bench), [127.0, -2.0]);
    travel(&mut bench, "y", -10);
    assert_eq!(places(&bench), [127.0, -2.0]);
    assert_eq!((bench.axis("x").lost_steps, bench.axis("y").lost_steps), (0, 10));
    recorder.read(bench.probe.now());
    bench.advance(1.0);
    recorder.read(bench.probe.now());
    assert_eq!(recorder.points().last().unwrap().nozzle_mm, bench.probe.nozzle_mm());
    assert_eq!(bench.probe.nozzle_mm(), [127.0, -2.0, 12.0]);
}
