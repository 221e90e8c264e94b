// SPDX-License-Identifier: GPL-3.0-or-later
//! The cost of a picture of the simulated printer: `cargo bench -p pinion-benches --bench camera`. At 15 pictures a second, 1 ms for a
//! picture is 1.5 % of a processor.

use std::f64::consts::TAU;
use std::hint::black_box;

use criterion::Criterion;
use pinion_camera::scene::{Bed, Display, Fan, Gantry, Heater, Laid, Lamp, Pin, Printer, Probe, Scene, Servo, Strip};
use pinion_camera::{Layout, Picture};

/// A printer with everything that the built-in one has, at the end of a print.
fn scene() -> Scene {
    let named = |name: &str| name.to_owned();
    Scene {
        nozzle_mm: [122.0, 108.0, 30.0],
        heaters: vec![
            Heater { name: named("extruder"), celsius: 214.8, target_celsius: Some(215.0), on: true },
            Heater { name: named("heater_bed"), celsius: 60.1, target_celsius: Some(60.0), on: false },
        ],
        fans: vec![Fan { name: named("fan"), rpm: 4480.0 }],
        lamps: ["light", "beeper", "laser"]
            .map(|name| Lamp { name: named(name), brightness: 0.5, color: [255, 240, 205] })
            .to_vec(),
        strips: vec![
            Strip { name: named("strip"), lights: vec![[255, 120, 0]; 8] },
            Strip { name: named("dots"), lights: vec![[0, 80, 255]; 4] },
        ],
        displays: vec![Display {
            name: named("display"),
            width: 128,
            pixels: (0..128 * 64).map(|at| at % 7 < 3 && at / 128 % 9 < 6).collect(),
        }],
        servos: vec![Servo { name: named("arm"), degrees: 60.0 }],
        probes: vec![
            Probe { name: named("probe"), offset_mm: [24.0, -8.0, -1.5], pin: None },
            Probe { name: named("bltouch"), offset_mm: [-28.0, 12.0, -2.2], pin: Some(Pin::In) },
        ],
        ..Scene::default()
    }
}

/// A round wall of this many pieces.
fn wall(count: usize) -> Vec<Laid> {
    let point = |piece: usize| {
        let (sin, cos) = (piece as f64 / 120.0 * TAU).sin_cos();
        [110.0 + 40.0 * cos, 110.0 + 40.0 * sin, piece as f64 / 120.0 * 0.2].map(|mm| mm as f32)
    };
    let piece = |piece| Laid { from_mm: point(piece), to_mm: point(piece + 1), mm_per_s: 60.0, begins: piece == 0 };
    (0..count).map(piece).collect()
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let bed = Bed::Rectangle { x_mm: [0.0, 220.0], y_mm: [0.0, 220.0] };
    let printer = Printer { bed, height_mm: 240.0, gantry: Gantry::Cartesian };
    let Some(mut picture) = Picture::new(printer) else { return };
    let calm = scene();
    let later = Scene { seconds: 100.0, ..scene() };
    picture.take(&Scene { laid: wall(20_000), ..scene() });
    // While it is printed, and the whole printer after that.
    for (name, layout, scene) in
        [("near", Layout::Wide, &calm), ("near and tall", Layout::Tall, &calm), ("whole", Layout::Wide, &later)]
    {
        criterion.bench_function(&format!("camera/frame, {name}"), |bencher| {
            bencher.iter(|| {
                picture.draw(scene, layout);
                black_box(picture.jpeg(layout))
            });
        });
        criterion.bench_function(&format!("camera/draw, {name}"), |bencher| {
            bencher.iter(|| picture.draw(scene, layout));
        });
    }
    criterion.bench_function("camera/change of the view", |bencher| {
        let mut scenes = [&calm, &later].into_iter().cycle();
        bencher.iter(|| scenes.next().map(|scene| picture.draw(scene, Layout::Wide)));
    });
    let laid = Scene { laid: wall(1000), ..scene() };
    criterion.bench_function("camera/1000 pieces of filament", |bencher| bencher.iter(|| picture.take(&laid)));
    criterion.final_summary();
}
