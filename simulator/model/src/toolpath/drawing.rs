// SPDX-License-Identifier: GPL-3.0-or-later
//! The path as a drawing: layers seen from above, colored by speed.

use std::io::{self, Write};

use super::{Line, lines, runs};
use crate::engine::recorder::PathPoint;

/// The colors of slow to fast lines: dark to bright, like plasma. Each has a contrast of at least 3 to white.
const COLORS: [&str; 8] = ["#10187a", "#3a14a0", "#6a0fa8", "#96179c", "#bd2a83", "#d4405f", "#dd5a35", "#d97706"];
/// The class of a line on which nothing is laid.
const TRAVEL: usize = COLORS.len();
/// Share of the laid lines that may be faster than the scale. They have its last color.
const FASTER: f64 = 0.01;
/// Width of the margin, of a laid line, and of a travel.
const MARGIN_MM: f64 = 10.0;
const LINE_MM: f64 = 0.4;
const TRAVEL_MM: f64 = 0.15;

/// The speed that nearly all of the filament is laid below. Steps that come late may leave a short line that is far
/// faster than all others.
fn top_mm_per_s<'a>(laid: impl Iterator<Item = &'a Line<'a>>) -> f64 {
    let mut lines: Vec<(f64, f64)> = laid.map(|line| (line.mm_per_s(), line.mm())).collect();
    lines.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut left_mm = lines.iter().map(|(_, mm)| mm).sum::<f64>() * FASTER;
    let top = lines.iter().find(|(_, mm)| {
        left_mm -= mm;
        left_mm < 0.0
    });
    top.map_or(1.0, |(mm_per_s, _)| mm_per_s.max(1.0))
}

/// Writes an SVG with a group for each layer. A group has a path for each class of speed. The unit is a millimeter, and
/// y points up. The background is white. It has about 16 bytes for each point of the path. `step_mm` is the filament of
/// an extruder's step.
///
/// # Errors
///
/// The file cannot be written.
pub fn write_svg(points: &[PathPoint], step_mm: f64, out: &mut dyn Write) -> io::Result<()> {
    let runs = runs(points, step_mm);
    let top_mm_per_s = top_mm_per_s(runs.iter().flatten());
    let class = |mm_per_s: f64| ((mm_per_s / top_mm_per_s * COLORS.len() as f64) as usize).min(COLORS.len() - 1);
    let corner = |i: usize, pick: fn(f64, f64) -> f64, start: f64| {
        points.iter().map(|point| point.nozzle_mm[i]).fold(start, pick)
    };
    let ends = |i| (corner(i, f64::min, f64::INFINITY), corner(i, f64::max, f64::NEG_INFINITY));
    let ((left, right), (low, high)) = if points.is_empty() { ((0.0, 1.0), (0.0, 1.0)) } else { (ends(0), ends(1)) };
    let (width, height) = ((right - left).max(80.0) + 2.0 * MARGIN_MM, high - low + 4.0 * MARGIN_MM);
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
    writeln!(
        out,
        ".s{TRAVEL}{{stroke:#555;stroke-width:{TRAVEL_MM};stroke-dasharray:1 .5;stroke-linecap:butt}}\
         text{{font:4px sans-serif}}</style>"
    )?;
    writeln!(
        out,
        "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" fill=\"#fff\"/>",
        left - MARGIN_MM,
        -high - MARGIN_MM
    )?;
    let mut laid = runs.iter().flatten().peekable();
    let classes = lines(points).map(|line| {
        let is_laid = laid.next_if(|laid| std::ptr::eq(laid.to, line.to)).is_some();
        (line, if is_laid { class(line.mm_per_s()) } else { TRAVEL })
    });
    let mut rest = classes.filter(|(line, _)| line.mm() > 0.0).peekable();
    while let Some(layer) = rest.peek().map(|(line, _)| line.to.layer) {
        writeln!(out, "<g id=\"layer-{layer}\">")?;
        let mut paths: [Vec<u8>; TRAVEL + 1] = Default::default();
        let mut last: Option<(usize, [f64; 3])> = None;
        while let Some((line, class)) = rest.next_if(|(line, _)| line.to.layer == layer) {
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
    // The scales: 10 mm, the colors of the speeds, and a travel.
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
    writeln!(
        out,
        "<path class=\"s{TRAVEL}\" d=\"M{:.2} {y:.2}h10\"/><text x=\"{:.2}\" y=\"{y:.2}\">travel</text>",
        left + 40.0,
        left + 52.0
    )?;
    writeln!(out, "</svg>")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toolpath::tests::path;

    /// WCAG 2: 3 is the least contrast of graphics.
    #[test]
    fn each_color_is_readable_on_white() {
        let light = |color: &str| -> f64 {
            let part = |at: usize| f64::from(u8::from_str_radix(&color[at..at + 2], 16).unwrap()) / 255.0;
            let linear = |part: f64| if part <= 0.04045 { part / 12.92 } else { ((part + 0.055) / 1.055).powf(2.4) };
            0.2126 * linear(part(1)) + 0.7152 * linear(part(3)) + 0.0722 * linear(part(5))
        };
        let contrasts: Vec<f64> = COLORS.iter().map(|color| 1.05 / (light(color) + 0.05)).collect();
        assert!(contrasts.iter().all(|contrast| *contrast >= 3.0), "{contrasts:?}");
        assert!(contrasts.is_sorted_by(|slow, fast| slow > fast), "{contrasts:?}");
    }

    #[test]
    fn a_short_line_of_late_steps_does_not_change_the_scale() {
        let mut points = path(&[([0.0, 0.0, 0.2], 0.0), ([50.0, 0.0, 0.2], 1.7), ([50.0, 0.1, 0.2], 0.01)]);
        points[2].at = pinion_firmware::time::Clock::from_ticks(points[1].at.ticks() + 1000);
        let mut svg = Vec::new();
        write_svg(&points, 0.01, &mut svg).unwrap();
        let svg = String::from_utf8(svg).unwrap();
        assert!(svg.contains(">0 to 50 mm/s</text>"), "{svg}");
        assert!(svg.contains("<path class=\"s7\" d=\"M0.00 -0.00L50.00 -0.00L50.00 -0.10\"/>"), "{svg}");
    }
}
