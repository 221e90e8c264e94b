// SPDX-License-Identifier: GPL-3.0-or-later
//! The part of the room that a picture shows: near while something is printed, otherwise the whole printer.
//!
//! The view follows the last heights that were printed. So a line at the edge of the bed, which clears the nozzle before
//! the print, keeps the view far only for the first millimeter.

use crate::lens::Room;
use crate::scene::Laid;

/// Height of a band: several layers, so that a spiral has whole turns in it.
const BAND_MM: f64 = 0.5;
/// Shortest edge of a view.
const SIDE_MIN_MM: f64 = 30.0;
/// Free space around what was laid: a length, and a share of its longer edge. So the view changes seldom.
const MARGIN_MM: f64 = 4.0;
const MARGIN: f64 = 0.12;
/// Free space above what was laid.
const ABOVE_MM: f64 = 8.0;
const ABOVE: f64 = 0.4;
/// A view that is this much longer than necessary is given up for a nearer one.
const TOO_FAR: f64 = 1.6;
/// The whole printer is shown when nothing was laid for this time.
const PAUSE_S: f64 = 20.0;

/// Watches what is laid.
pub struct Focus {
    /// Where filament can be laid.
    stage: Room,
    /// The pieces in the last band of heights, and in the one below it.
    band: Option<Room>,
    below: Option<Room>,
    /// The height at which the last band began.
    floor_mm: f64,
    view: Option<Room>,
    laid_at: f64,
}

impl Focus {
    pub fn new(stage: Room) -> Focus {
        Focus { stage, band: None, below: None, floor_mm: 0.0, view: None, laid_at: 0.0 }
    }

    /// Takes in what was laid until now.
    pub fn take(&mut self, pieces: &[Laid], seconds: f64) {
        for piece in pieces {
            if piece.begins {
                (self.band, self.below, self.view) = (None, None, None);
            }
            let ends = [piece.from_mm, piece.to_mm].map(|end| end.map(f64::from));
            if ends
                .iter()
                .all(|end| (0..3).all(|axis| (self.stage.min[axis]..=self.stage.max[axis]).contains(&end[axis])))
            {
                self.add(Room {
                    min: [ends[0][0].min(ends[1][0]), ends[0][1].min(ends[1][1]), 0.0],
                    max: [0, 1, 2].map(|axis| ends[0][axis].max(ends[1][axis])),
                });
            }
        }
        if !pieces.is_empty() {
            self.laid_at = seconds;
        }
        let Some(band) = self.band else { return };
        let printed = self.below.map_or(band, |below| join(below, band));
        let best = around(&printed);
        let fits = |view: &Room| contains(view, &printed) && length(view) <= TOO_FAR * length(&best);
        if !self.view.as_ref().is_some_and(fits) {
            self.view = Some(best);
        }
    }

    fn add(&mut self, piece: Room) {
        let height = piece.max[2];
        if self.band.is_none() || height > self.floor_mm + BAND_MM {
            self.below = self.band.take();
            self.floor_mm = height;
        } else if height < self.floor_mm - BAND_MM {
            // The next of several objects that are printed one after the other.
            (self.band, self.below) = (None, None);
            self.floor_mm = height;
        }
        self.band = Some(self.band.map_or(piece, |band| join(band, piece)));
    }

    /// The part to show; `None` for the whole printer.
    pub fn view(&self, seconds: f64) -> Option<Room> {
        self.view.filter(|_| seconds - self.laid_at < PAUSE_S)
    }
}

fn join(a: Room, b: Room) -> Room {
    let both = |pick: fn(f64, f64) -> f64, a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|axis| pick(a[axis], b[axis]));
    Room { min: both(f64::min, a.min, b.min), max: both(f64::max, a.max, b.max) }
}

fn contains(view: &Room, part: &Room) -> bool {
    (0..3).all(|axis| view.min[axis] <= part.min[axis] && part.max[axis] <= view.max[axis])
}

/// The longest edge.
fn length(room: &Room) -> f64 {
    (0..3).map(|axis| room.max[axis] - room.min[axis]).fold(0.0, f64::max)
}

/// The view of what was printed, with free space around it.
fn around(printed: &Room) -> Room {
    let side = (0..2).map(|axis| printed.max[axis] - printed.min[axis]).fold(0.0, f64::max);
    let mut view = *printed;
    for axis in 0..2 {
        let missing = SIDE_MIN_MM - (printed.max[axis] - printed.min[axis]);
        let margin = (MARGIN_MM + MARGIN * side).max(missing / 2.0);
        view.min[axis] -= margin;
        view.max[axis] += margin;
    }
    view.max[2] += ABOVE_MM + ABOVE * printed.max[2];
    view
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAGE: Room = Room { min: [0.0, 0.0, 0.0], max: [220.0, 220.0, 240.0] };

    fn line(from: [f32; 2], to: [f32; 2], z: f32) -> Laid {
        Laid { from_mm: [from[0], from[1], z], to_mm: [to[0], to[1], z], mm_per_s: 50.0, begins: false }
    }

    /// The walls of a box of 40 mm.
    fn layer(z: f32) -> [Laid; 2] {
        [line([90.0, 90.0], [130.0, 90.0], z), line([130.0, 90.0], [130.0, 130.0], z)]
    }

    #[test]
    fn the_view_is_near_while_something_is_printed() {
        let mut focus = Focus::new(STAGE);
        assert_eq!(focus.view(0.0), None);
        focus.take(&layer(0.2), 1.0);
        let view = focus.view(2.0).unwrap();
        assert!(length(&view) < 70.0 && contains(&view, &Room { min: [90.0, 90.0, 0.0], max: [130.0, 130.0, 0.2] }));
        assert_eq!(focus.view(1.0 + PAUSE_S), None, "nothing is printed now");
        focus.take(&layer(0.4), 60.0);
        assert_eq!(focus.view(60.0), Some(view), "it goes on");
    }

    #[test]
    fn the_view_changes_seldom_while_a_part_grows() {
        let mut focus = Focus::new(STAGE);
        let mut views = Vec::new();
        for n in 1..=1000 {
            focus.take(&layer(n as f32 * 0.2), f64::from(n));
            let view = focus.view(f64::from(n)).unwrap();
            assert!(view.max[2] >= f64::from(n as f32 * 0.2));
            views.push(view);
        }
        views.dedup();
        assert!(views.len() < 12, "{}", views.len());
    }

    #[test]
    fn a_line_that_clears_the_nozzle_is_soon_out_of_the_view() {
        let mut focus = Focus::new(STAGE);
        focus.take(&[line([5.0, 5.0], [5.0, 200.0], 0.2)], 0.0);
        for n in 1..=10 {
            focus.take(&layer(n as f32 * 0.2), 0.0);
        }
        assert!(length(&focus.view(0.0).unwrap()) < 70.0);
    }

    #[test]
    fn the_view_goes_to_the_next_object() {
        let mut focus = Focus::new(STAGE);
        focus.take(&layer(20.0), 0.0);
        focus.take(&[line([10.0, 10.0], [20.0, 20.0], 0.2)], 0.0);
        let view = focus.view(0.0).unwrap();
        assert!(view.max[0] < 60.0 && view.max[2] < 20.0, "{view:?}");
    }

    #[test]
    fn a_piece_outside_of_the_printer_moves_nothing() {
        let mut focus = Focus::new(STAGE);
        focus.take(&layer(0.2), 0.0);
        let view = focus.view(0.0);
        for far in [f32::NAN, f32::MAX, -1.0] {
            focus.take(&[line([far, 100.0], [100.0, 100.0], 0.2), line([100.0, 100.0], [100.0, 100.0], far)], 0.0);
        }
        assert_eq!(focus.view(0.0), view);
    }
}
