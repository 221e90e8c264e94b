// SPDX-License-Identifier: GPL-3.0-or-later
//! Perspective: where a point of the room appears in the picture.

/// A point or a direction in the room: x to the right, y to the back, z up.
pub type Point = [f64; 3];

/// Direction of the eye's place, seen from the middle of the room: toward the right, and up.
const AZIMUTH_DEGREES: f64 = 22.0;
const ELEVATION_DEGREES: f64 = 33.0;
/// Distance of the eye, as a multiple of the room's diagonal.
const DISTANCE: f64 = 1.9;
/// A point behind the eye has no place in the picture. It counts as this near, as a part of the eye's distance.
const NEAREST: f64 = 0.1;

/// A box with edges along the axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Room {
    pub min: Point,
    pub max: Point,
}

impl Room {
    pub fn corners(&self) -> [Point; 8] {
        let end = |corner: usize, axis: usize| if corner >> axis & 1 == 0 { self.min[axis] } else { self.max[axis] };
        [0, 1, 2, 3, 4, 5, 6, 7].map(|corner| [end(corner, 0), end(corner, 1), end(corner, 2)])
    }
}

/// The eye and the picture plane.
#[derive(Clone, Debug)]
pub struct Lens {
    eye: Point,
    /// Unit vectors: to the right of the picture, up, and into it.
    right: Point,
    up: Point,
    forward: Point,
    nearest: f64,
    /// Pixels for each unit of the plane at distance 1, and where its middle is.
    scale: f64,
    offset: [f64; 2],
}

fn dot(a: Point, b: Point) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn minus(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub fn plus(a: Point, b: Point) -> Point {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

impl Lens {
    /// A lens that shows the whole room as large as possible between these pixels: left, top, right and bottom.
    pub fn new(room: &Room, area: [f64; 4]) -> Lens {
        let (sin_a, cos_a) = AZIMUTH_DEGREES.to_radians().sin_cos();
        let (sin_e, cos_e) = ELEVATION_DEGREES.to_radians().sin_cos();
        let size = minus(room.max, room.min);
        let middle = [0, 1, 2].map(|axis| room.min[axis] + size[axis] / 2.0);
        let distance = DISTANCE * dot(size, size).sqrt();
        let forward = [-sin_a * cos_e, cos_a * cos_e, -sin_e];
        let eye = minus(middle, forward.map(|part| part * distance));
        let (right, up) = ([cos_a, sin_a, 0.0], [-sin_a * sin_e, cos_a * sin_e, cos_e]);
        let nearest = NEAREST * distance;
        Lens { eye, right, up, forward, nearest, scale: 1.0, offset: [0.0; 2] }.framing(room, area)
    }

    /// The same eye, with a part of the room as large as possible between these pixels.
    pub fn framing(&self, part: &Room, [left, top, right_end, bottom]: [f64; 4]) -> Lens {
        let mut lens = Lens { scale: 1.0, offset: [0.0; 2], ..self.clone() };
        let places = part.corners().map(|corner| lens.place(corner));
        let end = |axis: usize, pick: fn(f64, f64) -> f64, first: f64| {
            places.iter().map(|place| place[axis]).fold(first, pick)
        };
        let (x0, x1) = (end(0, f64::min, f64::MAX), end(0, f64::max, f64::MIN));
        let (y0, y1) = (end(1, f64::min, f64::MAX), end(1, f64::max, f64::MIN));
        lens.scale = ((right_end - left) / (x1 - x0)).min((bottom - top) / (y1 - y0));
        lens.offset =
            [(left + right_end - lens.scale * (x0 + x1)) / 2.0, (top + bottom - lens.scale * (y0 + y1)) / 2.0];
        lens
    }

    /// The pixel where a point appears: from the left and from the top.
    pub fn place(&self, point: Point) -> [f64; 2] {
        let from_eye = minus(point, self.eye);
        let scale = self.scale / dot(from_eye, self.forward).max(self.nearest);
        [self.offset[0] + scale * dot(from_eye, self.right), self.offset[1] - scale * dot(from_eye, self.up)]
    }

    /// The factor and the offset that turn this lens's pixels into those of another lens of the same eye.
    pub fn to(&self, other: &Lens) -> (f64, [f64; 2]) {
        let factor = other.scale / self.scale;
        (factor, [0, 1].map(|axis| other.offset[axis] - factor * self.offset[axis]))
    }

    /// Pixels per millimeter at a point.
    pub fn scale_at(&self, point: Point) -> f64 {
        self.scale / self.depth(point).max(self.nearest)
    }

    /// Distance of a point from the eye, along the direction of view.
    pub fn depth(&self, point: Point) -> f64 {
        dot(minus(point, self.eye), self.forward)
    }

    /// Whether the eye sees the front of a face with this outward normal.
    pub fn sees(&self, point: Point, normal: Point) -> bool {
        dot(minus(self.eye, point), normal) > 0.0
    }

    /// The direction to the right of the picture, level.
    pub fn right(&self) -> Point {
        self.right
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: Room = Room { min: [-40.0, -40.0, -30.0], max: [260.0, 260.0, 320.0] };

    #[test]
    fn the_whole_room_is_in_the_picture_and_fills_it() {
        let lens = Lens::new(&ROOM, [10.0, 20.0, 510.0, 590.0]);
        let places = ROOM.corners().map(|corner| lens.place(corner));
        assert!(places.iter().all(|[x, y]| (9.99..510.01).contains(x) && (19.99..590.01).contains(y)), "{places:?}");
        let height = places.iter().map(|place| place[1]).fold(0.0, f64::max)
            - places.iter().map(|place| place[1]).fold(f64::MAX, f64::min);
        let width = places.iter().map(|place| place[0]).fold(0.0, f64::max)
            - places.iter().map(|place| place[0]).fold(f64::MAX, f64::min);
        assert!((width - 500.0).abs() < 0.01 || (height - 570.0).abs() < 0.01, "{width} {height}");
    }

    #[test]
    fn a_nearer_view_is_the_same_picture_only_larger() {
        let whole = Lens::new(&ROOM, [10.0, 20.0, 510.0, 590.0]);
        let part = Room { min: [80.0, 90.0, 0.0], max: [120.0, 130.0, 15.0] };
        let near = whole.framing(&part, [0.0, 0.0, 300.0, 300.0]);
        let (factor, offset) = whole.to(&near);
        assert!(factor > 4.0, "{factor}");
        for point in ROOM.corners() {
            let (far, near) = (whole.place(point), near.place(point));
            for axis in [0, 1] {
                assert!((far[axis] * factor + offset[axis] - near[axis]).abs() < 1e-6, "{far:?} {near:?}");
            }
        }
        let places = part.corners().map(|corner| near.place(corner));
        assert!(places.iter().flatten().all(|pixel| (-0.01..300.01).contains(pixel)), "{places:?}");
    }

    #[test]
    fn right_is_right_back_is_up_and_up_is_up() {
        let lens = Lens::new(&ROOM, [0.0, 0.0, 500.0, 600.0]);
        let [x, y] = lens.place([100.0, 100.0, 0.0]);
        let moved = |by: Point| lens.place(plus([100.0, 100.0, 0.0], by));
        assert!(moved([10.0, 0.0, 0.0])[0] > x + 5.0);
        assert!(moved([0.0, 10.0, 0.0])[1] < y - 3.0);
        let up = moved([0.0, 0.0, 10.0]);
        assert!(up[1] < y - 5.0 && (up[0] - x).abs() < 1.0);
    }

    #[test]
    fn far_things_are_small_and_what_is_behind_the_eye_breaks_nothing() {
        let lens = Lens::new(&ROOM, [0.0, 0.0, 500.0, 600.0]);
        assert!(lens.scale_at([0.0, 0.0, 0.0]) > lens.scale_at([0.0, 200.0, 0.0]));
        assert!(lens.place([0.0, -1e9, 1e9]).iter().all(|pixel| pixel.is_finite()));
    }

    /// The eye is above the whole print. So a higher place may hide a lower one, and never the other way round.
    #[test]
    fn the_eye_is_above_the_room() {
        let lens = Lens::new(&ROOM, [0.0, 0.0, 500.0, 600.0]);
        assert!(lens.eye[2] > ROOM.max[2]);
    }
}
