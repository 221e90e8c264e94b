// SPDX-License-Identifier: GPL-3.0-or-later
//! The contents of a picture, by its pixels.

use super::*;
use crate::laid::speed_color;
use crate::lens::Point;
use crate::machine::{BED, HEAD, LOST, light_near};
use crate::panel::OUT;
use crate::scene::{Axis, Bed, Display, Fan, Gantry, Heater, Laid, Lamp, Pin, Probe, Rgb, Servo, Strip};

fn cartesian() -> Printer {
    let bed = Bed::Rectangle { x_mm: [0.0, 220.0], y_mm: [0.0, 220.0] };
    Printer { bed, height_mm: 240.0, gantry: Gantry::Cartesian }
}

fn core_xy() -> Printer {
    Printer { gantry: Gantry::CoreXy, ..cartesian() }
}

fn delta() -> Printer {
    let towers_mm = [210.0f64, 330.0, 90.0].map(|degrees| {
        let (sin, cos) = degrees.to_radians().sin_cos();
        [105.0 * cos, 105.0 * sin]
    });
    Printer { bed: Bed::Disc { radius_mm: 90.0 }, height_mm: 250.0, gantry: Gantry::Delta { towers_mm, arm_mm: 215.0 } }
}

/// The middle of the bed.
fn middle(printer: &Printer) -> [f64; 2] {
    match printer.bed {
        Bed::Rectangle { .. } => [110.0, 110.0],
        Bed::Disc { .. } => [0.0, 0.0],
    }
}

/// A cold printer with its nozzle over the middle, this far from it.
fn at(printer: &Printer, [x, y, z]: Point) -> Scene {
    let [mx, my] = middle(printer);
    Scene { nozzle_mm: [mx + x, my + y, z], ..Scene::default() }
}

fn drawn(printer: &Printer, scene: &Scene) -> Picture {
    let mut picture = Picture::new(printer.clone()).unwrap();
    picture.show(scene);
    picture
}

const WIDTH: usize = 960;

impl Picture {
    /// Takes in and draws a scene.
    fn show(&mut self, scene: &Scene) {
        self.take(scene);
        self.draw(scene, Layout::Wide);
    }

    fn wide(&self) -> &[u8] {
        self.pixels(Layout::Wide)
    }

    fn place(&self, point: Point) -> [f64; 2] {
        self.sheets[0].lens.place(point)
    }

    fn pixel(&self, [x, y]: [f64; 2]) -> Rgb {
        let at = 4 * (y as usize * WIDTH + x as usize);
        self.wide()[at..at + 3].try_into().unwrap()
    }

    /// The color of a point of the room, if nothing hides it.
    fn color_of(&self, point: Point) -> Rgb {
        self.pixel(self.place(point))
    }

    /// Where the pixels of exactly this color are: their number and their middle.
    fn find(&self, color: Rgb) -> (usize, [f64; 2]) {
        let pixels = self.wide().chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[..3] == color);
        let places: Vec<_> = pixels.map(|(at, _)| [at % WIDTH, at / WIDTH]).collect();
        let mean = |axis: usize| places.iter().map(|place| place[axis] as f64).sum::<f64>() / places.len() as f64;
        (places.len(), [mean(0), mean(1)])
    }
}

/// Whether two colors are the same to an eye.
fn alike(a: Rgb, b: Rgb) -> bool {
    a.iter().zip(b).all(|(a, b)| a.abs_diff(b) < 40)
}

#[test]
fn the_head_is_where_the_nozzle_is() {
    for printer in [cartesian(), core_xy(), delta()] {
        let head = |by: Point| drawn(&printer, &at(&printer, by)).find(HEAD).1;
        let [x, y] = head([0.0, 0.0, 20.0]);
        assert!(head([30.0, 0.0, 20.0])[0] > x + 8.0, "{printer:?}: x is to the right");
        assert!(head([0.0, 30.0, 20.0])[1] < y - 5.0, "{printer:?}: y is to the back");
        let [up_x, up_y] = head([0.0, 0.0, 60.0]);
        assert!(up_y < y - 15.0 && (up_x - x).abs() < 10.0, "{printer:?}: z is up");
    }
}

/// The beam follows y and z, the carriages follow their towers.
#[test]
fn the_gantry_moves_with_the_nozzle() {
    for printer in [cartesian(), core_xy(), delta()] {
        let [low, high] = [10.0, 70.0].map(|z| drawn(&printer, &at(&printer, [0.0, 0.0, z])));
        // Far from the head: the left end of the beam, or the left carriage.
        let changed = |from: usize, to: usize| {
            let (low, high) = (low.wide().chunks_exact(4), high.wide().chunks_exact(4));
            let differ = low
                .zip(high)
                .enumerate()
                .filter(|(at, (low, high))| (from..to).contains(&(at % WIDTH)) && low != high && at / WIDTH < 490);
            differ.count()
        };
        let left = low.place([low.printer.room().min[0], 110.0, 50.0])[0].max(0.0) as usize;
        assert!(changed(left, left + 80) > 200, "{printer:?}");
    }
    // The two belts of a CoreXY have two colors, on both rails.
    let [one, other] = [cartesian(), core_xy()].map(|printer| drawn(&printer, &at(&printer, [0.0, 0.0, 20.0])));
    assert!(one.wide() != other.wide());
}

#[test]
fn a_light_of_a_strip_is_its_color_at_its_place() {
    for printer in [cartesian(), delta()] {
        let strip = |lights: &[Rgb]| Strip { name: "strip".into(), lights: lights.to_vec() };
        let strips = vec![strip(&[[255, 0, 0], [0, 0, 0], [0, 0, 255], [0, 0, 0]]), strip(&[[0, 255, 0]])];
        let picture = drawn(&printer, &Scene { strips, ..at(&printer, [0.0, 0.0, 20.0]) });
        let light = |part: f64, row: usize| picture.color_of(printer.light(part, row));
        let [red, off, blue, _] = [0.125, 0.375, 0.625, 0.875].map(|part| light(part, 0));
        assert!(red[0] > 230 && red[1] < 90 && red[2] < 90, "{red:?}");
        assert!(blue[2] > 230 && blue[0] < 90, "{blue:?}");
        assert!(off.iter().all(|part| *part < 100), "{off:?}");
        let green = light(0.5, 1);
        assert!(green[1] > 230 && green[0] < 90, "{green:?}");
    }
}

/// While something is printed, the picture shows only that part.
#[test]
fn a_strip_has_its_color_in_a_near_view_too() {
    let strips = vec![Strip { name: "strip".into(), lights: vec![[255, 0, 0], [0, 0, 255]] }];
    let piece = Laid { from_mm: [100.0, 100.0, 0.2], to_mm: [120.0, 110.0, 0.2], mm_per_s: 50.0, begins: true };
    let picture = drawn(&cartesian(), &Scene { strips, laid: vec![piece], ..at(&cartesian(), [0.0, 0.0, 0.2]) });
    assert!(picture.sheets[0].view.is_some(), "it is near");
    let light = |part: f64| picture.pixel(light_near(Layout::Wide.area(), part, 0));
    let [red, blue] = [0.25, 0.75].map(light);
    assert!(red[0] > 230 && red[2] < 90 && blue[2] > 230 && blue[0] < 90, "{red:?} {blue:?}");
}

#[test]
fn both_carriages_are_there() {
    let scene = at(&cartesian(), [60.0, 0.0, 20.0]);
    let one = drawn(&cartesian(), &scene).find(HEAD);
    let both = drawn(&cartesian(), &Scene { parked_mm: vec![[10.0, 110.0, 20.0]], ..scene }).find(HEAD);
    assert!(both.0 > one.0 * 3 / 2 && both.1[0] < one.1[0] - 20.0, "{one:?} {both:?}");
}

#[test]
fn a_character_of_the_display_has_its_pixels() {
    const LETTER: [&str; 7] = [".###.", "#...#", "#...#", "#####", "#...#", "#...#", "#...#"];
    let (left, top) = (40, 20);
    let mut display = Display { name: "display".into(), width: 128, pixels: vec![false; 128 * 64] };
    for (row, line) in LETTER.iter().enumerate() {
        for (column, dot) in line.bytes().enumerate() {
            display.pixels[(top + row) * 128 + left + column] = dot == b'#';
        }
    }
    let scene = Scene { displays: vec![display.clone()], ..at(&cartesian(), [0.0; 3]) };
    let picture = drawn(&cartesian(), &scene);
    for (row, line) in LETTER.iter().enumerate() {
        let shown: String = (0..line.len())
            .map(|column| {
                let ([x, y], size) = picture.sheets[0].panel.pixel(&display, left + column, top + row);
                if picture.pixel([x + size / 2.0, y + size / 2.0])[2] > 128 { '#' } else { '.' }
            })
            .collect();
        assert_eq!(shown, *line, "row {row}");
    }
}

#[test]
fn a_hot_bed_glows_and_a_cold_one_has_its_color() {
    for printer in [cartesian(), delta()] {
        let bed = |celsius: f64| {
            let heaters = vec![Heater { name: "heater_bed".into(), celsius, ..Heater::default() }];
            let picture = drawn(&printer, &Scene { heaters, ..at(&printer, [0.0, 0.0, 20.0]) });
            // Away from the lines of the grid, the head and its shadow.
            let [x, y] = middle(&printer);
            picture.color_of([x - 35.0, y - 43.0, 0.0])
        };
        assert_eq!(bed(25.0), BED);
        let (warm, hot) = (bed(60.0), bed(110.0));
        assert!(warm[0] > BED[0] + 20 && hot[0] > warm[0] + 20 && hot[2] < BED[2], "{warm:?} {hot:?}");
    }
}

#[test]
fn a_hot_end_glows() {
    let block = |celsius: f64| {
        let heaters = vec![Heater { name: "extruder".into(), celsius, ..Heater::default() }];
        let scene = Scene { heaters, ..at(&cartesian(), [0.0, 0.0, 20.0]) };
        drawn(&cartesian(), &scene).color_of([110.0, 102.0, 28.5])
    };
    let (cold, hot) = (block(25.0), block(250.0));
    assert!(cold[2] > 80 && hot[0] > hot[2] + 100, "{cold:?} {hot:?}");
}

#[test]
fn lost_steps_are_marked() {
    for (printer, axis) in [(cartesian(), "x"), (core_xy(), "y"), (cartesian(), "z1"), (delta(), "b")] {
        let with = |lost_steps: u64| {
            let axes = vec![Axis { name: axis.into(), position_mm: 1.0, lost_steps }];
            drawn(&printer, &Scene { axes, ..at(&printer, [0.0, 0.0, 20.0]) })
        };
        let red = |picture: &Picture| {
            let pixels = picture.wide().chunks_exact(4);
            pixels.filter(|pixel| pixel[0] > 100 && pixel[0] / 2 > pixel[1] && pixel[0] / 2 > pixel[2]).count()
        };
        let (none, some, more) = (with(0), with(7), with(8));
        assert_eq!(none.find(LOST).0, 0);
        assert!(some.find(LOST).0 > 100, "{axis}: the number is red");
        assert!(red(&some) > red(&none) + 800, "{axis}: so is what should have moved");
        assert!(some.wide() != more.wide(), "{axis}: and the number is there");
    }
}

#[test]
fn filament_appears_where_it_was_laid_and_stays() {
    for printer in [cartesian(), core_xy(), delta()] {
        let [x, y] = middle(&printer).map(|at| at as f32);
        let wall = |z: f32, begins: bool| Laid {
            from_mm: [x - 50.0, y - 40.0, z],
            to_mm: [x - 30.0, y - 40.0, z],
            mm_per_s: 100.0,
            begins,
        };
        let scene = at(&printer, [40.0, 40.0, 30.0]);
        let place = [f64::from(x) - 40.0, f64::from(y) - 40.0];
        let [low, high] = [[place[0], place[1], 1.0], [place[0], place[1], 9.8]];
        let mut picture = drawn(&printer, &scene);
        let laid = (0..50).map(|layer| wall(0.2 * layer as f32, layer == 0)).collect();
        picture.show(&Scene { laid, ..scene.clone() });
        let color = speed_color(100.0);
        assert!(alike(picture.color_of(low), color) && alike(picture.color_of(high), color), "{printer:?}");
        picture.show(&scene);
        assert!(alike(picture.color_of(high), color), "{printer:?}: it stays");
        // The whole printer: it is small, and there.
        picture.show(&Scene { seconds: 100.0, ..scene.clone() });
        assert!(alike(picture.color_of([place[0], place[1], 5.0]), color), "{printer:?}: it stays in another view");
        // The same view again, with the next piece.
        picture.show(&Scene { seconds: 101.0, laid: vec![wall(10.0, false)], ..scene.clone() });
        assert!(alike(picture.color_of(high), color), "{printer:?}: it is there when the view comes back");
        // Next to it is nothing.
        assert!(!alike(picture.color_of([place[0] + 14.0, place[1], 0.0]), color), "{printer:?}");
        picture.show(&Scene { laid: vec![wall(0.2, true)], ..scene.clone() });
        assert!(!alike(picture.color_of([place[0], place[1], 3.0]), color), "{printer:?}: a new print takes it off");
    }
}

#[test]
fn what_was_laid_while_nobody_looked_is_in_the_next_picture() {
    let printer = cartesian();
    let scene = at(&printer, [40.0, 40.0, 30.0]);
    let laid = vec![Laid { from_mm: [90.0, 60.0, 1.0], to_mm: [120.0, 60.0, 1.0], mm_per_s: 100.0, begins: true }];
    let [mut seen, mut unseen] = [(); 2].map(|()| drawn(&printer, &scene));
    let bare = seen.wide().to_vec();
    seen.show(&Scene { laid: laid.clone(), ..scene.clone() });
    unseen.take(&Scene { laid, ..scene.clone() });
    assert!(unseen.wide() == bare, "nobody looks");
    unseen.show(&scene);
    assert!(seen.wide() != bare && unseen.wide() == seen.wide());
}

/// The walls of a box around the middle, this high, with sides of 40 mm.
fn part(printer: &Printer, layers: u16) -> Vec<Laid> {
    let [x, y] = middle(printer).map(|at| at as f32);
    let corners = [[x - 20.0, y - 20.0], [x + 20.0, y - 20.0], [x + 20.0, y + 20.0], [x - 20.0, y + 20.0]];
    let corner = |n: usize, z: f32| [corners[n % 4][0], corners[n % 4][1], z];
    let walls = (1..=layers).flat_map(|layer| (0..4).map(move |wall| (f32::from(layer) * 0.2, wall)));
    let piece =
        |(z, wall)| Laid { from_mm: corner(wall, z), to_mm: corner(wall + 1, z), mm_per_s: 100.0, begins: false };
    walls.map(piece).collect()
}

/// The share of the printer's area with a color like the filament's.
fn share_of_filament(picture: &Picture, layout: Layout) -> f64 {
    let [left, top, right, bottom] = layout.area().map(|edge| edge as usize);
    let width = usize::from(layout.size()[0]);
    let green = speed_color(100.0);
    let is_green = |at: usize| {
        let pixel = &picture.pixels(layout)[4 * at..4 * at + 3];
        pixel[1] > green[1] / 2 && pixel[1].saturating_sub(30) > pixel[0].max(pixel[2])
    };
    let found =
        (top..bottom).flat_map(|y| (left..right).map(move |x| y * width + x)).filter(|at| is_green(*at)).count();
    found as f64 / ((right - left) * (bottom - top)) as f64
}

#[test]
fn what_is_printed_fills_the_picture_and_the_head_does_not_hide_it() {
    for printer in [cartesian(), core_xy(), delta()] {
        for layout in Layout::ALL {
            let mut picture = Picture::new(printer.clone()).unwrap();
            // The nozzle is at the front, so the head is over the part.
            let scene = Scene { laid: part(&printer, 100), ..at(&printer, [0.0, -20.0, 20.0]) };
            picture.take(&scene);
            picture.draw(&scene, layout);
            let near = share_of_filament(&picture, layout);
            assert!(near > 0.15, "{printer:?} {layout:?}: {near}");
            // After a pause the whole printer is there.
            let later = Scene { seconds: 100.0, laid: vec![], ..at(&printer, [0.0, 80.0, 100.0]) };
            picture.take(&later);
            picture.draw(&later, layout);
            let far = share_of_filament(&picture, layout);
            assert!(far > 0.002 && far < near / 6.0, "{printer:?} {layout:?}: {far} of {near}");
            let [left, top, right, bottom] = layout.area();
            let lens = &picture.sheets[layout as usize].lens;
            let fits =
                |[x, y]: [f64; 2]| (left - 0.1..right + 0.1).contains(&x) && (top - 0.1..bottom + 0.1).contains(&y);
            assert!(printer.room().corners().iter().all(|corner| fits(lens.place(*corner))), "nothing is cut off");
        }
    }
}

#[test]
fn a_shutdown_is_a_red_word_in_each_layout() {
    let printer = cartesian();
    for layout in Layout::ALL {
        let red = |is_shut_down: bool| {
            let scene = Scene { is_shut_down, ..at(&printer, [0.0, 0.0, 20.0]) };
            let mut picture = Picture::new(printer.clone()).unwrap();
            picture.draw(&scene, layout);
            picture.pixels(layout).chunks_exact(4).filter(|pixel| pixel[..3] == LOST).count()
        };
        assert!(red(false) == 0 && red(true) > 200, "{layout:?}");
    }
}

#[test]
fn the_color_shows_the_speed() {
    let [slow, fast] = [20.0, 190.0].map(speed_color);
    assert!(slow[2] > slow[0] && fast[0] > fast[2]);
    assert_eq!(speed_color(f64::INFINITY), speed_color(1e9));
    let _ = speed_color(f64::NAN);
}

/// Each of these changes the picture.
#[test]
fn texts_and_lamps_show_what_is() {
    let printer = cartesian();
    let calm = Scene {
        heaters: vec![Heater { name: "chamber".into(), celsius: 30.0, ..Heater::default() }],
        fans: vec![Fan { name: "fan".into(), rpm: 0.0 }],
        lamps: vec![Lamp { name: "light".into(), brightness: 0.0, color: [255, 250, 230] }],
        servos: vec![Servo { name: "arm".into(), degrees: 0.0 }],
        probes: vec![Probe { name: "probe".into(), offset_mm: [24.0, -8.0, -1.5], pin: Some(Pin::In) }],
        ..at(&printer, [0.0, 0.0, 20.0])
    };
    let mut changed = [(); 7].map(|()| calm.clone());
    changed[0].heaters[0].celsius = 31.0;
    changed[1].heaters[0].on = true;
    changed[2].fans[0].rpm = 1000.0;
    changed[3].lamps[0].brightness = 0.5;
    changed[4].servos[0].degrees = 90.0;
    changed[5].probes[0].pin = Some(Pin::Out);
    changed[6].heaters[0].target_celsius = Some(45.0);
    let before = drawn(&printer, &calm);
    for scene in &changed {
        assert!(drawn(&printer, scene).wide() != before.wide(), "{scene:?}");
    }
    assert_eq!(before.find(OUT).0, 0);
    assert!(drawn(&printer, &changed[5]).find(OUT).0 > 20);
}

#[test]
fn a_fan_turns_from_picture_to_picture() {
    let printer = cartesian();
    let scene = |seconds: f64| Scene {
        seconds,
        fans: vec![Fan { name: "fan".into(), rpm: 1000.0 }],
        ..at(&printer, [0.0, 0.0, 20.0])
    };
    let mut picture = drawn(&printer, &scene(100.0));
    let before = picture.wide().to_vec();
    picture.show(&scene(100.07));
    assert!(picture.wide() != before);
}

/// Descriptions may have many things with any names, and a motor without an end goes anywhere.
#[test]
fn nothing_in_a_scene_breaks_the_picture() {
    let many = 20;
    let name = "größer \u{1b}[2J \u{1f600} and much too long for a line of the panel";
    for nozzle_mm in [[f64::MAX; 3], [f64::NAN; 3], [f64::NEG_INFINITY; 3], [1e9, -1e9, 1e9]] {
        let scene = Scene {
            seconds: f64::NAN,
            is_shut_down: true,
            nozzle_mm,
            parked_mm: vec![nozzle_mm; many],
            axes: vec![Axis { name: name.into(), position_mm: f64::NAN, lost_steps: u64::MAX }; many],
            heaters: vec![
                Heater { name: name.into(), celsius: f64::INFINITY, target_celsius: Some(f64::NAN), on: true };
                many
            ],
            fans: vec![Fan { name: name.into(), rpm: f64::NAN }; many],
            lamps: vec![Lamp { name: name.into(), brightness: 7.0, color: [1, 2, 3] }; many],
            strips: vec![Strip { name: name.into(), lights: vec![[255; 3]; 1000] }; many],
            displays: vec![
                Display { name: name.into(), width: 0, pixels: Vec::new() },
                Display { name: name.into(), width: 7, pixels: vec![true; 100] },
            ],
            servos: vec![Servo { name: name.into(), degrees: f64::NAN }; many],
            probes: vec![Probe { name: name.into(), offset_mm: [f64::NAN; 3], pin: Some(Pin::Alarm) }; many],
            laid: vec![Laid { from_mm: [f32::NAN; 3], to_mm: [f32::MAX; 3], mm_per_s: f32::NAN, begins: false }; many],
        };
        for printer in [cartesian(), delta()] {
            let mut picture = drawn(&printer, &scene);
            picture.show(&Scene { displays: scene.displays[1..].to_vec(), ..scene.clone() });
            picture.draw(&scene, Layout::Tall);
            assert!(Layout::ALL.iter().all(|layout| picture.jpeg(*layout).len() > 1000));
        }
    }
}

#[test]
fn a_jpeg_has_the_size_of_the_picture() {
    for layout in Layout::ALL {
        let jpeg = drawn(&cartesian(), &at(&cartesian(), [0.0; 3])).jpeg(layout);
        assert_eq!((&jpeg[..2], &jpeg[jpeg.len() - 2..]), (&[0xff, 0xd8][..], &[0xff, 0xd9][..]));
        // Start of frame: its length, the bits of a sample, rows and columns.
        let start = jpeg.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
        let word = |at: usize| u16::from_be_bytes([jpeg[at], jpeg[at + 1]]);
        assert_eq!([word(start + 7), word(start + 5)], layout.size());
    }
}
