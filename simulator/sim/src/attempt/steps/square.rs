// SPDX-License-Identifier: GPL-3.0-or-later
//! The G-code of a small print in the middle of any bed.

use std::fmt::Write as _;

/// Half a side of the square, if the bed is larger than that.
const HALF_MM: f64 = 10.0;
/// How far apart the layers are.
pub(super) const LAYER_MM: f64 = 0.2;
/// Filament for each millimeter of a line.
const FEED: f64 = 0.033;

/// The G-code of a square with diagonals, in two layers, within these limits.
pub(super) fn square(low: [f64; 3], high: [f64; 3]) -> String {
    let middle = [0, 1].map(|n: usize| (low[n] + high[n]) / 2.0);
    let half = [0, 1].map(|n: usize| (high[n] - low[n]) / 4.0).into_iter().fold(HALF_MM, f64::min);
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0)];
    let place = |(x, y): (f64, f64)| (middle[0] + x * half, middle[1] + y * half);
    let mut text = "G90\nM83\nG92 E0\n".to_owned();
    for z in [0.3, 0.3 + LAYER_MM] {
        let z = z + low[2].max(0.0);
        let (x, y) = place(corners[0]);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "G1 Z{z:.3} F600\nG1 X{x:.3} Y{y:.3} F3000");
        for lines in corners.windows(2) {
            let ((x, y), (from_x, from_y)) = (place(lines[1]), place(lines[0]));
            let e = (x - from_x).hypot(y - from_y) * FEED;
            let _ = writeln!(text, "G1 X{x:.3} Y{y:.3} E{e:.5} F1500");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_model::AskedPath;

    #[test]
    fn the_square_is_in_the_middle_of_any_bed() {
        for (low, high) in [([0.0; 3], [220.0, 220.0, 250.0]), ([-90.0, -90.0, -2.0], [90.0, 90.0, 200.0])] {
            let text = square(low, high);
            let asked = AskedPath::read(text.as_bytes(), "square").unwrap();
            assert!(!text.contains("NaN"));
            drop(asked);
            let middle = (low[0] + high[0]) / 2.0;
            assert!(text.contains(&format!("G1 X{:.3} Y{:.3} F3000", middle - 10.0, middle - 10.0)), "{text}");
        }
    }
}
