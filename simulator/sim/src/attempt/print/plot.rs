// SPDX-License-Identifier: GPL-3.0-or-later
//! A drawing of a print over its time: speed, temperatures and flow.

use std::fmt::Write as _;

use super::Sample;

/// Size of a graph, and the room around it, in pixels.
const WIDTH: f64 = 900.0;
const HEIGHT: f64 = 160.0;
const LEFT: f64 = 70.0;
const TOP: f64 = 30.0;
const GAP: f64 = 40.0;
/// Highest number of points of a curve. Each is the highest of its span.
const POINTS_MAX: usize = 1800;
const COLORS: [&str; 6] = ["#d0342c", "#1f6fb2", "#2b8a3e", "#9c36b5", "#b86e00", "#495057"];

/// A graph: its title, and its curves by name.
struct Graph {
    title: &'static str,
    curves: Vec<(String, Vec<f64>)>,
}

/// The drawing. `heaters` are the names of the temperatures in each sample.
pub(super) fn svg(samples: &[Sample], heaters: &[String]) -> String {
    let curve = |of: &dyn Fn(&Sample) -> f64| samples.iter().map(of).collect::<Vec<f64>>();
    let graphs = [
        Graph { title: "speed, mm/s", curves: vec![("nozzle".into(), curve(&|sample| sample.mm_per_s))] },
        Graph {
            title: "temperature, C",
            curves: heaters
                .iter()
                .enumerate()
                .map(|(n, name)| (name.clone(), curve(&|sample| sample.celsius.get(n).copied().unwrap_or_default())))
                .collect(),
        },
        Graph { title: "flow, mm3/s", curves: vec![("filament".into(), curve(&|sample| sample.mm3_per_s))] },
    ];
    let end_s = samples.last().map_or(1.0, |sample| sample.at_s).max(1.0);
    let height = TOP + graphs.len() as f64 * (HEIGHT + GAP);
    let width = LEFT + WIDTH + 20.0;
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    for (n, graph) in graphs.iter().enumerate() {
        draw(&mut text, graph, TOP + n as f64 * (HEIGHT + GAP), samples, end_s);
    }
    text.push_str("</svg>\n");
    text
}

fn draw(text: &mut String, graph: &Graph, top: f64, samples: &[Sample], end_s: f64) {
    let most = graph.curves.iter().flat_map(|(_, values)| values).copied().fold(1.0, f64::max);
    let bottom = top + HEIGHT;
    let x = |at_s: f64| LEFT + at_s / end_s * WIDTH;
    // Writing to a String cannot fail.
    let _ = write!(
        text,
        "<text x=\"{LEFT}\" y=\"{:.0}\" font-weight=\"bold\">{}</text>\n<path d=\"M{LEFT} {top}V{bottom}H{:.0}\" \
         fill=\"none\" stroke=\"#888\"/>\n",
        top - 8.0,
        graph.title,
        LEFT + WIDTH
    );
    for (share, y) in [(1.0, top), (0.5, top + HEIGHT / 2.0), (0.0, bottom)] {
        let _ = writeln!(
            text,
            "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">{:.0}</text>",
            LEFT - 6.0,
            y + 4.0,
            most * share
        );
    }
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let at_s = end_s * share;
        let _ = writeln!(
            text,
            "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{}</text>",
            x(at_s),
            bottom + 16.0,
            super::report::span(at_s)
        );
    }
    for (n, (name, values)) in graph.curves.iter().enumerate() {
        let color = COLORS[n % COLORS.len()];
        let size = values.len().div_ceil(POINTS_MAX).max(1);
        let mut points = String::new();
        for (values, samples) in values.chunks(size).zip(samples.chunks(size)) {
            let value = values.iter().copied().fold(0.0, f64::max);
            let _ = write!(points, "{:.1},{:.1} ", x(samples[0].at_s), bottom - value / most * HEIGHT);
        }
        let _ = writeln!(
            text,
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"{color}\"><title>{name}</title></polyline>"
        );
        if graph.curves.len() > 1 {
            let at = LEFT + WIDTH - 140.0 * (graph.curves.len() - n) as f64;
            let _ = writeln!(text, "<text x=\"{at:.0}\" y=\"{:.0}\" fill=\"{color}\">{name}</text>", top - 8.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::attempt::print::phase::Phase;

    #[test]
    fn a_long_print_is_a_small_drawing_with_each_of_its_peaks() {
        let sample = |n: u32| Sample {
            at_s: f64::from(n),
            phase: Phase::Printing,
            mm_per_s: if n == 20_001 { 300.0 } else { 100.0 },
            mm3_per_s: 5.0,
            celsius: vec![200.0, 60.0],
        };
        let samples: Vec<Sample> = (0..36_000).map(sample).collect();
        let text = svg(&samples, &["extruder".into(), "heater_bed".into()]);
        assert!(text.len() < 200_000, "{}", text.len());
        let drawing = roxmltree::Document::parse(&text).unwrap();
        let curves: Vec<_> = drawing.descendants().filter(|node| node.has_tag_name("polyline")).collect();
        assert_eq!(curves.len(), 4);
        // The highest speed is at the top of the first graph.
        let points = curves[0].attribute("points").unwrap();
        assert_eq!(points.split_whitespace().filter(|point| point.ends_with(&format!(",{TOP:.1}"))).count(), 1);
        let names: Vec<_> =
            drawing.descendants().filter(|node| node.has_tag_name("title")).filter_map(|node| node.text()).collect();
        assert_eq!(names, ["nozzle", "extruder", "heater_bed", "filament"]);
    }
}
