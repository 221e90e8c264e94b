// SPDX-License-Identifier: GPL-3.0-or-later
//! The laid filament: each piece is drawn once, and stays. So a picture costs the same after ten hours of printing.
//!
//! The order in which pieces are laid is the right order of drawing. The eye is above the room. So on each line of sight
//! a higher piece is in front of a lower one, and pieces of one height never hide each other. It is wrong only for
//! objects that are printed one after the other, where a lower piece comes after a higher one.

use crate::lens::{Lens, Point};
use crate::paint::{Canvas, lit, mix};
use crate::scene::{Laid, Rgb};

/// The speed of the last color.
pub const FASTEST_MM_PER_S: f64 = 200.0;
/// The colors of speeds, from 0 to the fastest.
pub const SPEEDS: [Rgb; 5] = [[70, 96, 224], [40, 178, 226], [88, 214, 104], [250, 206, 62], [244, 92, 58]];
/// The width of a piece.
const WIDTH_MM: f64 = 0.5;
/// A piece is brightest along this direction, counted from the x axis. No usual infill lies along it, so its layers
/// differ.
const BRIGHT_DEGREES: f64 = 20.0;
const BRIGHT: f64 = 1.0;
const DARK: f64 = 0.66;

/// The color of a speed.
pub fn speed_color(mm_per_s: f64) -> Rgb {
    let place = (mm_per_s / FASTEST_MM_PER_S).clamp(0.0, 1.0) * (SPEEDS.len() - 1) as f64;
    let below = (place as usize).min(SPEEDS.len() - 2);
    mix(SPEEDS[below], SPEEDS[below + 1], place - below as f64)
}

/// Draws pieces onto those that are there already.
pub fn draw(canvas: &mut Canvas, lens: &Lens, pieces: &[Laid]) {
    if pieces.first().is_some_and(|piece| piece.begins) {
        canvas.pixmap.fill(tiny_skia::Color::TRANSPARENT);
    }
    for piece in pieces {
        let [from, to] = [piece.from_mm, piece.to_mm].map(|point| point.map(f64::from));
        let light = light(from, to);
        canvas.rod(lens, [from, to], WIDTH_MM, lit(speed_color(piece.mm_per_s.into()), light), 1.0);
    }
}

fn light(from: Point, to: Point) -> f64 {
    let direction = (to[1] - from[1]).atan2(to[0] - from[0]) - BRIGHT_DEGREES.to_radians();
    let part = (1.0 + (2.0 * direction).cos()) / 2.0;
    DARK + (BRIGHT - DARK) * part
}
