// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer itself: what stands still, and what moves.
//!
//! The eye is above the room. So of two things on one line of sight the higher one is in front, and all is drawn from
//! the bed up.

use crate::lens::{Lens, Point, Room, plus};
use crate::paint::{Canvas, lit, mix};
use crate::scene::{Bed, Gantry, Pin, Printer, Probe, Rgb, Scene};

pub const BED: Rgb = [58, 64, 76];
/// The color of a bed of 110 C.
pub const HOT_BED: Rgb = [214, 74, 40];
const GRID: Rgb = [88, 96, 112];
const FLOOR: Rgb = [33, 37, 45];
const FRAME: Rgb = [104, 112, 128];
const RAIL: Rgb = [140, 150, 168];
const MOTOR: Rgb = [52, 57, 68];
const ARM: Rgb = [176, 186, 202];
pub const HEAD: Rgb = [244, 140, 36];
const BLOCK: Rgb = [168, 172, 180];
const NOZZLE: Rgb = [212, 172, 72];
const GLOWING: Rgb = [255, 96, 32];
const BELTS: [Rgb; 2] = [[86, 156, 255], [255, 120, 170]];
/// The mark for lost steps.
pub const LOST: Rgb = [255, 64, 64];
const PROBE: Rgb = [228, 232, 240];
const PIN: Rgb = [200, 80, 210];
/// Most parked carriages that are drawn.
const PARKED_MAX: usize = 4;
/// How far a push-pin goes up.
const PIN_MM: f64 = 7.0;

/// From the bed's edge to the middle of the posts.
const MARGIN_MM: f64 = 40.0;
const POST_MM: f64 = 14.0;
/// The front of the room, where the strips of lights are.
const APRON_MM: f64 = 26.0;
const FLOOR_MM: f64 = -34.0;
/// The middle of the gantry, over the tip of the nozzle.
const GANTRY_MM: f64 = 38.0;
const HEAD_TOP_MM: f64 = 62.0;
/// From the lower ends of a delta's arms to the axis of its nozzle, and how far they are apart.
const EFFECTOR_MM: f64 = 26.0;
const ARMS_APART_MM: f64 = 9.0;
/// The opacity of the head and the gantry in a near view.
const VEIL: f64 = 0.16;
/// The color of a heater begins to change here, and is as hot as can be there.
const WARM_CELSIUS: [f64; 2] = [35.0, 110.0];
const HOT_CELSIUS: [f64; 2] = [50.0, 250.0];

fn solid(x: [f64; 2], y: [f64; 2], z: [f64; 2]) -> Room {
    Room { min: [x[0], y[0], z[0]], max: [x[1], y[1], z[1]] }
}

/// A square bar of this thickness around a line along an axis.
fn bar(from: Point, to: Point, thick_mm: f64) -> Room {
    let half = thick_mm / 2.0;
    Room { min: from.map(|at| at - half), max: to.map(|at| at + half) }
}

impl Bed {
    /// Left, right, front and back.
    fn ends(&self) -> [f64; 4] {
        match *self {
            Bed::Rectangle { x_mm, y_mm } => [x_mm[0], x_mm[1], y_mm[0], y_mm[1]],
            Bed::Disc { radius_mm } => [-radius_mm, radius_mm, -radius_mm, radius_mm],
        }
    }

    /// The outline, this much wider than the bed, at a height.
    fn outline(&self, wider_mm: f64, z: f64) -> Vec<Point> {
        match *self {
            Bed::Rectangle { x_mm: [x0, x1], y_mm: [y0, y1] } => {
                let w = wider_mm;
                vec![[x0 - w, y0 - w, z], [x1 + w, y0 - w, z], [x1 + w, y1 + w, z], [x0 - w, y1 + w, z]]
            }
            Bed::Disc { radius_mm } => circle([0.0, 0.0, z], radius_mm + wider_mm).collect(),
        }
    }
}

fn circle(middle: Point, radius_mm: f64) -> impl Iterator<Item = Point> {
    (0..64).map(move |part| {
        let (sin, cos) = (f64::from(part) / 64.0 * std::f64::consts::TAU).sin_cos();
        plus(middle, [radius_mm * cos, radius_mm * sin, 0.0])
    })
}

fn places(lens: &Lens, points: impl IntoIterator<Item = Point>) -> impl Iterator<Item = [f64; 2]> {
    points.into_iter().map(|point| lens.place(point))
}

/// The place of a delta's tower: as far from the arms' upper ends as the nozzle's axis is from their lower ends.
fn tower([x, y]: [f64; 2]) -> [f64; 2] {
    let away = x.hypot(y).max(1.0);
    [x, y].map(|part| part * (away + EFFECTOR_MM) / away)
}

impl Printer {
    /// The room that the printer takes.
    pub fn room(&self) -> Room {
        let [left, right, front, back] = self.bed.ends();
        match self.gantry {
            Gantry::Cartesian | Gantry::CoreXy => {
                let out = MARGIN_MM + POST_MM / 2.0;
                let top = self.height_mm + HEAD_TOP_MM + POST_MM;
                solid([left - out, right + out], [front - out - APRON_MM / 2.0, back + out], [FLOOR_MM, top])
            }
            Gantry::Delta { towers_mm, arm_mm } => {
                let out =
                    towers_mm.map(|at| tower(at).map(f64::abs)).concat().into_iter().fold(right, f64::max) + POST_MM;
                let reach = towers_mm.map(|[x, y]| x.hypot(y)).into_iter().fold(0.0, f64::min);
                let top =
                    self.height_mm + (arm_mm * arm_mm - reach * reach).max(0.0).sqrt() + GANTRY_MM + 2.0 * POST_MM;
                solid([-out, out], [-out, out], [FLOOR_MM, top])
            }
        }
    }

    /// The part of the room where filament is laid.
    pub fn stage(&self) -> Room {
        let [left, right, front, back] = self.bed.ends();
        solid([left, right], [front, back], [0.0, self.height_mm])
    }

    /// Where the strips of lights are: this part of the way from the left to the right, in one of several rows.
    pub fn light(&self, part: f64, row: usize) -> Point {
        let room = self.room();
        let [left, right, front, _] = self.bed.ends();
        let z = FLOOR_MM + 10.0 + 13.0 * row as f64;
        match self.gantry {
            Gantry::Cartesian | Gantry::CoreXy => [left + (right - left) * part, room.min[1], z],
            Gantry::Delta { .. } => [left + (right - left) * part, front - MARGIN_MM / 2.0, z],
        }
    }

    /// Draws what stands still behind everything else.
    pub fn draw_still(&self, canvas: &mut Canvas, lens: &Lens) {
        let room = self.room();
        let [left, right, front, back] = self.bed.ends();
        let delta = matches!(self.gantry, Gantry::Delta { .. });
        let middle = lens.place([(left + right) / 2.0, (front + back) / 2.0, FLOOR_MM]);
        canvas.glow(middle, 420.0, [60, 72, 96], 0.5);
        // The floor, with the apron for the lights at its front.
        if delta {
            let around = |z: f64| Bed::Disc { radius_mm: right + MARGIN_MM * 0.5 }.outline(0.0, z);
            canvas.polygon(places(lens, around(FLOOR_MM)), lit(FLOOR, 0.6), 1.0);
            canvas.line(places(lens, around(FLOOR_MM + 12.0)), 24.0, lit(FLOOR, 0.7), 1.0);
            canvas.polygon(places(lens, around(-8.0)), FLOOR, 1.0);
        } else {
            let floor = solid([room.min[0], room.max[0]], [room.min[1], room.max[1]], [FLOOR_MM, -8.0]);
            canvas.solid(lens, &floor, FLOOR, 1.0);
        }
        for post in self.posts().into_iter().filter(|post| !self.is_front(post)) {
            canvas.solid(lens, &post, FRAME, 1.0);
        }
        if !delta {
            let [x0, x1, y0, y1] = [left - MARGIN_MM, right + MARGIN_MM, front - MARGIN_MM, back + MARGIN_MM];
            let z = room.max[2] - POST_MM / 2.0;
            canvas.solid(lens, &bar([x0, y1, z], [x1, y1, z], POST_MM), FRAME, 1.0);
            canvas.solid(lens, &bar([x0, y0, z], [x0, y1, z], POST_MM), FRAME, 1.0);
        }
        // The bed's thickness, then its surface.
        for step in 0..=5 {
            let z = f64::from(step) - 5.0;
            let color = if step == 5 { BED } else { lit(BED, 0.55) };
            canvas.polygon(places(lens, self.bed.outline(4.0, z)), color, 1.0);
        }
        self.draw_grid(canvas, lens);
    }

    fn draw_grid(&self, canvas: &mut Canvas, lens: &Lens) {
        let [left, right, front, back] = self.bed.ends();
        let steps = |from: f64, to: f64| {
            let first = (from / 20.0).ceil() as i64;
            // A huge bed has no more lines than anybody can see.
            (first..=(to / 20.0).floor() as i64).take(100).map(|step| step as f64 * 20.0)
        };
        let half_chord = |at: f64| match self.bed {
            Bed::Disc { radius_mm } => Some((radius_mm * radius_mm - at * at).max(0.0).sqrt()),
            Bed::Rectangle { .. } => None,
        };
        for x in steps(left, right) {
            let [from, to] = half_chord(x).map_or([front, back], |half| [-half, half]);
            canvas.line(places(lens, [[x, from, 0.0], [x, to, 0.0]]), 1.0, GRID, if x == 0.0 { 0.9 } else { 0.35 });
        }
        for y in steps(front, back) {
            let [from, to] = half_chord(y).map_or([left, right], |half| [-half, half]);
            canvas.line(places(lens, [[from, y, 0.0], [to, y, 0.0]]), 1.0, GRID, if y == 0.0 { 0.9 } else { 0.35 });
        }
        // The directions of x and y, at the origin.
        canvas.line(places(lens, [[0.0, 0.0, 0.0], [24.0, 0.0, 0.0]]), 2.0, [236, 90, 80], 0.9);
        canvas.line(places(lens, [[0.0, 0.0, 0.0], [0.0, 24.0, 0.0]]), 2.0, [96, 210, 110], 0.9);
    }

    /// Posts in the corners, or a delta's towers.
    fn posts(&self) -> Vec<Room> {
        let room = self.room();
        let [left, right, front, back] = self.bed.ends();
        let post = |[x, y]: [f64; 2]| bar([x, y, FLOOR_MM], [x, y, room.max[2]], POST_MM);
        match self.gantry {
            Gantry::Delta { towers_mm, .. } => towers_mm.map(|at| post(tower(at))).to_vec(),
            Gantry::Cartesian | Gantry::CoreXy => {
                let (x0, x1, y0, y1) = (left - MARGIN_MM, right + MARGIN_MM, front - MARGIN_MM, back + MARGIN_MM);
                [[x0, y1], [x1, y1], [x0, y0], [x1, y0]].map(post).to_vec()
            }
        }
    }

    fn is_front(&self, post: &Room) -> bool {
        let [_, _, front, back] = self.bed.ends();
        post.min[1] < (front + back) / 2.0
    }

    /// Draws the light of the bed's heat.
    pub fn draw_heat(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene) {
        let celsius = scene.heaters.iter().find(|heater| heater.name == "heater_bed").map_or(0.0, |bed| bed.celsius);
        let part = part_of(celsius, WARM_CELSIUS);
        if part > 0.0 {
            canvas.polygon(places(lens, self.bed.outline(4.0, 0.0)), HOT_BED, 0.6 * part);
        }
    }

    /// Draws the strips of lights. In a near view, which does not have their place, they are along its lower edge.
    pub fn draw_lights(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene, near: Option<[f64; 4]>) {
        for (row, strip) in scene.strips.iter().enumerate().take(2) {
            let count = strip.lights.len().max(1) as f64;
            for (index, color) in strip.lights.iter().enumerate() {
                let part = (index as f64 + 0.5) / count;
                let radius = (110.0 / count).clamp(1.5, 5.5);
                let place = match near {
                    Some(area) => light_near(area, part, row),
                    None => lens.place(self.light(part, row)),
                };
                let brightness = f64::from(*color.iter().max().unwrap_or(&0)) / 255.0;
                canvas.circle(place, radius, [20, 22, 26], 1.0);
                if brightness > 0.0 {
                    canvas.glow(place, radius * 4.5, *color, 0.55);
                    canvas.circle(place, radius, mix(*color, [255; 3], 0.12), 1.0);
                }
            }
        }
    }

    /// Draws what moves, and the posts in front of it. In a near view they are a veil, because the head is over the
    /// part that it prints.
    pub fn draw_moving(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene, turns: &[f64], is_near: bool) {
        if !is_near {
            draw_shadow(canvas, lens, scene.nozzle_mm);
            return self.draw_solid(canvas, lens, scene, turns);
        }
        canvas.opacity = VEIL;
        self.draw_solid(canvas, lens, scene, turns);
        canvas.opacity = 1.0;
        draw_tip(canvas, lens, scene);
    }

    fn draw_solid(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene, turns: &[f64]) {
        let lost = |name: &str| scene.axes.iter().any(|axis| axis.lost_steps > 0 && axis.name.starts_with(name));
        match self.gantry {
            Gantry::Delta { towers_mm, arm_mm } => {
                self.draw_delta(canvas, lens, scene, towers_mm, arm_mm, turns);
                for (post, name) in self.posts().iter().zip(["a", "b", "c"]) {
                    if self.is_front(post) {
                        canvas.solid(lens, post, if lost(name) { LOST } else { FRAME }, 0.55);
                    }
                }
            }
            Gantry::Cartesian | Gantry::CoreXy => {
                self.draw_beams(canvas, lens, scene, [lost("x"), lost("y")], turns);
                let room = self.room();
                let [left, right, front, back] = self.bed.ends();
                let [x0, x1, y0, y1] = [left - MARGIN_MM, right + MARGIN_MM, front - MARGIN_MM, back + MARGIN_MM];
                let z = room.max[2] - POST_MM / 2.0;
                let color = if lost("z") { LOST } else { FRAME };
                canvas.solid(lens, &bar([x1, y0, z], [x1, y1, z], POST_MM), FRAME, 0.8);
                canvas.solid(lens, &bar([x0, y0, z], [x1, y0, z], POST_MM), FRAME, 0.8);
                for post in self.posts().into_iter().filter(|post| self.is_front(post)) {
                    canvas.solid(lens, &post, color, 0.45);
                }
            }
        }
    }

    fn draw_beams(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene, [lost_x, lost_y]: [bool; 2], turns: &[f64]) {
        let [left, right, front, back] = self.bed.ends();
        let [_, y, nozzle_z] = scene.nozzle_mm;
        let (z, behind) = (nozzle_z + GANTRY_MM, y + 26.0);
        let [x0, x1, y0, y1] = [left - MARGIN_MM, right + MARGIN_MM, front - MARGIN_MM, back + MARGIN_MM];
        let rail_color = if lost_y { LOST } else { RAIL };
        let motor = |at: Point| bar(plus(at, [-6.0, -6.0, -8.0]), plus(at, [6.0, 6.0, 8.0]), 14.0);
        let core_xy = self.gantry == Gantry::CoreXy;
        let mut rail = |x: f64| {
            canvas.solid(lens, &bar([x, y0, z], [x, y1, z], 11.0), rail_color, 1.0);
            canvas.solid(lens, &motor([x, y1, z]), MOTOR, 1.0);
        };
        rail(x0);
        // The right rail is beside the beam, and its lower part behind the beam's end.
        rail(x1);
        canvas.solid(lens, &bar([x0, behind, z], [x1, behind, z], 13.0), if lost_x { LOST } else { RAIL }, 1.0);
        let top = z + 8.0;
        let belt = |canvas: &mut Canvas, points: &[Point], color: Rgb| {
            canvas.line(places(lens, points.iter().copied()), 1.6, color, 0.95);
        };
        if core_xy {
            // Each belt goes from its motor along one rail, over the beam to the head, and back along the other rail.
            for (belt_color, [from, to], y_offset) in [(BELTS[0], [x0, x1], -3.0), (BELTS[1], [x1, x0], 3.0)] {
                let across = behind + y_offset;
                belt(canvas, &[[from, y1, top], [from, across, top], [to, across, top], [to, y0, top]], belt_color);
            }
        } else {
            for x in [x0, x1] {
                belt(canvas, &[[x, y0, top - 1.0], [x, y1, top - 1.0]], BELTS[0]);
            }
            belt(canvas, &[[x0, behind, top], [x1, behind, top]], BELTS[1]);
            canvas.solid(lens, &motor([x0 + 8.0, behind, z + 4.0]), MOTOR, 1.0);
        }
        for parked in scene.parked_mm.iter().take(PARKED_MAX) {
            let heaters = scene.heaters.clone();
            self.draw_head(canvas, lens, &Scene { nozzle_mm: *parked, heaters, ..Scene::default() }, &[]);
        }
        self.draw_head(canvas, lens, scene, turns);
    }

    fn draw_delta(
        &self,
        canvas: &mut Canvas,
        lens: &Lens,
        scene: &Scene,
        towers_mm: [[f64; 2]; 3],
        arm_mm: f64,
        turns: &[f64],
    ) {
        let nozzle = scene.nozzle_mm;
        let mut order = [0, 1, 2];
        // The rear tower first.
        order.sort_by(|a, b| towers_mm[*b][1].total_cmp(&towers_mm[*a][1]));
        let mut is_head_drawn = false;
        for index in order {
            let at = towers_mm[index];
            if at[1] < nozzle[1] && !is_head_drawn {
                is_head_drawn = true;
                self.draw_head(canvas, lens, scene, turns);
            }
            let away = (at[0] - nozzle[0]).hypot(at[1] - nozzle[1]);
            let z = nozzle[2] + GANTRY_MM + (arm_mm * arm_mm - away * away).max(0.0).sqrt();
            let [tower_x, tower_y] = tower(at);
            let (out_x, out_y) = (tower_x - at[0], tower_y - at[1]);
            let name = ["a", "b", "c"][index];
            let lost = scene.axes.iter().any(|axis| axis.lost_steps > 0 && axis.name == name);
            let carriage =
                bar([tower_x - 4.0, tower_y - 4.0, z - 12.0], [tower_x + 4.0, tower_y + 4.0, z + 12.0], 18.0);
            canvas.solid(lens, &carriage, if lost { LOST } else { HEAD }, 1.0);
            // Across the direction of the tower.
            let length = out_x.hypot(out_y).max(1e-9);
            for side in [-ARMS_APART_MM, ARMS_APART_MM] {
                let aside = [-out_y / length * side, out_x / length * side, 0.0];
                let upper = plus([tower_x, tower_y, z], aside);
                let lower = plus([nozzle[0] + out_x, nozzle[1] + out_y, nozzle[2] + GANTRY_MM], aside);
                canvas.rod(lens, [upper, lower], 5.0, lit(ARM, 0.6), 1.0);
                canvas.rod(lens, [upper, lower], 2.5, ARM, 1.0);
            }
        }
        if !is_head_drawn {
            self.draw_head(canvas, lens, scene, turns);
        }
    }

    fn draw_head(&self, canvas: &mut Canvas, lens: &Lens, scene: &Scene, turns: &[f64]) {
        let [x, y, z] = scene.nozzle_mm;
        let probes = |behind: bool| scene.probes.iter().filter(move |probe| (probe.offset_mm[1] > 0.0) == behind);
        for probe in probes(true) {
            draw_probe(canvas, lens, scene.nozzle_mm, probe);
        }
        if matches!(self.gantry, Gantry::Delta { .. }) {
            // A veil of seven discs would hide what is behind it.
            let between = if canvas.opacity < 1.0 { 6 } else { 1 };
            for step in (0..=6).step_by(between) {
                let ring = circle([x, y, z + GANTRY_MM - 6.0 + f64::from(step)], EFFECTOR_MM + 4.0);
                canvas.polygon(places(lens, ring), lit(MOTOR, if step == 6 { 1.5 } else { 0.9 }), 1.0);
            }
        }
        let heat = heat(scene);
        if heat > 0.0 {
            canvas.glow(lens.place([x, y, z + 8.0]), 34.0 * lens.scale_at(scene.nozzle_mm), GLOWING, 0.55 * heat);
        }
        draw_tip(canvas, lens, scene);
        let block = solid([x - 10.0, x + 10.0], [y - 8.0, y + 8.0], [z + 6.0, z + 16.0]);
        canvas.solid(lens, &block, mix(BLOCK, GLOWING, heat), 1.0);
        let body = match self.gantry {
            Gantry::Delta { .. } => solid([x - 12.0, x + 12.0], [y - 12.0, y + 12.0], [z + GANTRY_MM, z + HEAD_TOP_MM]),
            Gantry::Cartesian | Gantry::CoreXy => {
                solid([x - 20.0, x + 20.0], [y - 16.0, y + 18.0], [z + 18.0, z + HEAD_TOP_MM])
            }
        };
        canvas.solid(lens, &body, HEAD, 1.0);
        // The fan on its front.
        let middle = [x, body.min[1], (body.min[2] + body.max[2]) / 2.0];
        let radius = (body.max[0] - body.min[0]).min(body.max[2] - body.min[2]) * 0.42;
        let on_front = |turn: f64, radius: f64| {
            let (sin, cos) = (turn * std::f64::consts::TAU).sin_cos();
            lens.place(plus(middle, [radius * cos, 0.0, radius * sin]))
        };
        canvas.polygon((0..32).map(|part| on_front(f64::from(part) / 32.0, radius)), [28, 30, 36], 1.0);
        let turn = turns.first().copied().unwrap_or(0.0);
        for blade in 0..5 {
            let at = turn + f64::from(blade) / 5.0;
            let points =
                [on_front(at, radius * 0.2), on_front(at - 0.05, radius * 0.92), on_front(at + 0.06, radius * 0.92)];
            canvas.polygon(points, [120, 128, 142], 1.0);
        }
        canvas.circle(on_front(0.0, 0.0), radius * 0.25 * lens.scale_at(middle), [70, 76, 88], 1.0);
        for probe in probes(false) {
            draw_probe(canvas, lens, scene.nozzle_mm, probe);
        }
    }
}

/// The place of a light in a near view of this area: left, top, right and bottom.
pub fn light_near([left, _, right, bottom]: [f64; 4], part: f64, row: usize) -> [f64; 2] {
    [left + (right - left) * part, bottom - 10.0 - 16.0 * row as f64]
}

/// How hot the hot ends are, 0 to 1.
fn heat(scene: &Scene) -> f64 {
    let hot_ends = scene.heaters.iter().filter(|heater| heater.name.starts_with("extruder"));
    part_of(hot_ends.map(|heater| heater.celsius).fold(0.0, f64::max), HOT_CELSIUS)
}

/// The nozzle, from its tip to the block.
fn draw_tip(canvas: &mut Canvas, lens: &Lens, scene: &Scene) {
    let [x, y, z] = scene.nozzle_mm;
    let tip = [[x, y, z], [x + 3.4, y, z + 6.0], [x - 3.4, y, z + 6.0]];
    canvas.polygon(places(lens, tip), mix(NOZZLE, GLOWING, 0.5 * heat(scene)), 1.0);
}

/// How far a temperature is from the first to the second, 0 to 1.
fn part_of(celsius: f64, [from, to]: [f64; 2]) -> f64 {
    ((celsius - from) / (to - from)).clamp(0.0, 1.0)
}

/// Where the nozzle is over the bed: its shadow, and a thin line down to it.
fn draw_shadow(canvas: &mut Canvas, lens: &Lens, [x, y, z]: Point) {
    for (radius_mm, alpha) in [(20.0, 0.16), (13.0, 0.2), (6.0, 0.25)] {
        canvas.polygon(places(lens, circle([x, y, 0.0], radius_mm)), [0, 0, 0], alpha);
    }
    if z > 1.0 {
        canvas.line(places(lens, [[x, y, 0.0], [x, y, z]]), 1.0, [255; 3], 0.25);
    }
}

fn draw_probe(canvas: &mut Canvas, lens: &Lens, nozzle: Point, probe: &Probe) {
    let up_mm = if probe.pin == Some(Pin::In) { PIN_MM } else { 0.0 };
    let tip = plus(nozzle, plus(probe.offset_mm, [0.0, 0.0, up_mm]));
    let holder = plus(nozzle, [probe.offset_mm[0], probe.offset_mm[1], 20.0]);
    canvas.rod(lens, [plus(holder, [0.0, 0.0, 22.0]), holder], 11.0, PROBE, 1.0);
    canvas.rod(lens, [holder, tip], 2.6, if probe.pin == Some(Pin::Alarm) { LOST } else { PIN }, 1.0);
}
