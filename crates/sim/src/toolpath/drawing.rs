// SPDX-License-Identifier: GPL-3.0-or-later
//! The path as a drawing: layers seen from above, colored by speed.

#![forbid(unsafe_code)]

use std::io::{self, Write};

use super::lines;
use crate::engine::recorder::PathPoint;

/// The colors of slow to fast lines (viridis, eight steps).
const COLORS: [&str; 8] = ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#fde725"];
/// The class of a line on which nothing is laid.
const TRAVEL: usize = COLORS.len();
/// Width of the margin, and of a laid line.
const MARGIN_MM: f64 = 10.0;
const LINE_MM: f64 = 0.4;

/// Writes an SVG with a group for each layer. A group has a path for each class of speed. The unit is a millimeter, and
/// y points up. It has about 16 bytes for each point of the path.
///
/// # Errors
///
/// The file cannot be written.
pub fn write_svg(points: &[PathPoint], out: &mut dyn Write) -> io::Result<()> {
    let laid = || lines(points).filter(|line| line.is_laid());
    let top_mm_per_s = laid().map(|line| line.mm_per_s()).fold(1.0, f64::max);
    let class = |mm_per_s: f64| ((mm_per_s / top_mm_per_s * COLORS.len() as f64) as usize).min(COLORS.len() - 1);
    let corner = |i: usize, pick: fn(f64, f64) -> f64, start: f64| {
        points.iter().map(|point| point.nozzle_mm[i]).fold(start, pick)
    };
    let ends = |i| (corner(i, f64::min, f64::INFINITY), corner(i, f64::max, f64::NEG_INFINITY));
    let ((left, right), (low, high)) = if points.is_empty() { ((0.0, 1.0), (0.0, 1.0)) } else { (ends(0), ends(1)) };
    let (width, height) = ((right - left).max(60.0) + 2.0 * MARGIN_MM, high - low + 4.0 * MARGIN_MM);
    writeln!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.1}mm\" height=\"{height:.1}mm\" \
         viewBox=\"{:.2} {:.2} {width:.2} {height:.2}\">",
        left - MARGIN_MM,
        -high - MARGIN_MM
    )?;
    writeln!(out, "<style>path{{fill:none;stroke-width:{LINE_MM};stroke-linecap:round;stroke-linejoin:round}}")?;
    for (n, color) in COLORS.iter().enumerate() {
        writeln!(out, ".s{n}{{stroke:{color}}}")?;
    }
    writeln!(out, ".s{TRAVEL}{{stroke:#999;stroke-width:.05}}text{{font:4px sans-serif}}</style>")?;
    let mut rest = lines(points).filter(|line| line.mm() > 0.0).peekable();
    while let Some(layer) = rest.peek().map(|line| line.to.layer) {
        writeln!(out, "<g id=\"layer-{layer}\">")?;
        let mut paths: [Vec<u8>; TRAVEL + 1] = Default::default();
        let mut last: Option<(usize, [f64; 3])> = None;
        while let Some(line) = rest.next_if(|line| line.to.layer == layer) {
            let class = if line.is_laid() { class(line.mm_per_s()) } else { TRAVEL };
            let path = &mut paths[class];
            let [x, y, _] = line.from.nozzle_mm;
            if last != Some((class, line.from.nozzle_mm)) {
                write!(path, "M{x:.2} {:.2}", -y)?;
            }
            let [to_x, to_y, _] = line.to.nozzle_mm;
            write!(path, "L{to_x:.2} {:.2}", -to_y)?;
            last = Some((class, line.to.nozzle_mm));
        }
        for (class, path) in paths.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
            write!(out, "<path class=\"s{class}\" d=\"")?;
            out.write_all(path)?;
            writeln!(out, "\"/>")?;
        }
        writeln!(out, "</g>")?;
    }
    // The scales: 10 mm, and the colors of the speeds.
    let y = -low + MARGIN_MM;
    writeln!(
        out,
        "<path stroke=\"#000\" d=\"M{left:.2} {y:.2}h10\"/><text x=\"{:.2}\" y=\"{y:.2}\">10 mm</text>",
        left + 12.0
    )?;
    for (n, color) in COLORS.iter().enumerate() {
        let x = left + 6.0 * n as f64;
        writeln!(out, "<rect x=\"{x:.2}\" y=\"{:.2}\" width=\"6\" height=\"3\" fill=\"{color}\"/>", y + 5.0)?;
    }
    writeln!(out, "<text x=\"{left:.2}\" y=\"{:.2}\">0 to {top_mm_per_s:.0} mm/s</text>", y + 13.0)?;
    writeln!(out, "</svg>")
}
