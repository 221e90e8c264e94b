// SPDX-License-Identifier: GPL-3.0-or-later
//! A picture of the homing just done: position, endstop and step rate over time.

#![forbid(unsafe_code)]

use std::fmt::Write;

use super::{AxisReport, AxisSample, Report};
use pinion_linux::foreign::plain_xml;

const WIDTH: f64 = 900.0;
const LEFT: f64 = 78.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 62.0;
const GAP: f64 = 40.0;
/// Heights of the three diagrams.
const POSITION: f64 = 190.0;
const LANE: f64 = 22.0;
const RATE: f64 = 130.0;
const BOTTOM: f64 = 46.0;
/// Colors that are visible on white and on black.
const COLOURS: [&str; 6] = ["#d9580d", "#1a8fe3", "#2f9e44", "#b04fc4", "#c49a00", "#e0457b"];

/// Draws the homing of the report's axes as an SVG document: readable on light and on dark
/// backgrounds.
pub fn homing(report: &Report) -> String {
    let axes = &report.axes;
    let samples = || axes.iter().flat_map(|axis| &axis.samples);
    let time = Scale::over(samples().map(|s| s.t_s), LEFT, WIDTH - RIGHT);
    let lanes = LANE * axes.len().max(1) as f64;
    let endstops_at = TOP + POSITION + GAP;
    let rates_at = endstops_at + lanes + GAP;
    let height = rates_at + RATE + BOTTOM;
    let zero = std::iter::once(0.0);
    let position = Scale::over(samples().map(|s| s.mm).chain(zero.clone()), TOP + POSITION, TOP);
    let rate = Scale::over(samples().map(|s| s.steps_per_s.abs()).chain(zero), rates_at + RATE, rates_at);
    let mut svg = Svg::new(height);
    svg.legend(report);

    svg.grid(&time, &position, TOP, TOP + POSITION);
    svg.caption(TOP - 8.0, "position, mm from home; a dot where the endstop triggered");
    svg.grid(&time, &rate, rates_at, rates_at + RATE);
    svg.caption(rates_at - 8.0, "step rate, steps/s");
    svg.caption(endstops_at - 8.0, "endstop, closed where filled");
    svg.time_axis(&time, rates_at + RATE);

    for (i, axis) in axes.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        svg.line(colour, axis, |s| (time.at(s.t_s), position.at(s.mm)));
        svg.line(colour, axis, |s| (time.at(s.t_s), rate.at(s.steps_per_s.abs())));
        for trigger in &axis.triggers_s {
            svg.dot(colour, time.at(*trigger), position.at(mm_at(axis, *trigger)));
        }
        svg.lane(colour, axis, &time, endstops_at + LANE * i as f64);
    }
    svg.finish()
}

/// The axis' position at that time, between the samples around it.
fn mm_at(axis: &AxisReport, t_s: f64) -> f64 {
    let after = axis.samples.iter().position(|s| s.t_s >= t_s);
    let after = after.unwrap_or(axis.samples.len());
    let before = after.checked_sub(1).and_then(|i| axis.samples.get(i));
    match (before, axis.samples.get(after)) {
        (Some(a), Some(b)) if b.t_s > a.t_s => a.mm + (b.mm - a.mm) * (t_s - a.t_s) / (b.t_s - a.t_s),
        (Some(s), _) | (_, Some(s)) => s.mm,
        (None, None) => 0.0,
    }
}

/// Maps a range of values to a range of the drawing.
struct Scale {
    least: f64,
    most: f64,
    step: f64,
    from: f64,
    to: f64,
}

impl Scale {
    /// Covers all values, widened to round numbers.
    fn over(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Scale {
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.filter(|value| value.is_finite()) {
            least = least.min(value);
            most = most.max(value);
        }
        if least > most {
            (least, most) = (0.0, 1.0);
        }
        // Steps of 1, 2 or 5 times a power of ten, one for every 45 units at least.
        let most_steps = ((to - from).abs() / 45.0).max(1.0);
        let coarse = ((most - least) / most_steps).clamp(1e-3, 1e12);
        let power = 10f64.powf(coarse.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .map(|factor| factor * power)
            .find(|step| *step >= coarse * 0.999)
            .unwrap_or(coarse);
        // A value just beyond a round number does not widen the range by a whole step.
        let least = (least / step + 0.02).floor() * step;
        let most = ((most / step - 0.02).ceil() * step).max(least + step);
        Scale { least, most, step, from, to }
    }

    fn at(&self, value: f64) -> f64 {
        let part = (value - self.least) / (self.most - self.least);
        let part = if part.is_nan() { 0.0 } else { part };
        self.from + (self.to - self.from) * part.clamp(0.0, 1.0)
    }

    fn marks(&self) -> impl Iterator<Item = f64> + '_ {
        let count = ((self.most - self.least) / self.step).round() as u32;
        (0..=count.min(100)).map(|i| self.least + self.step * f64::from(i))
    }

    fn label(&self, value: f64) -> String {
        let decimals = (-self.step.log10().floor()).clamp(0.0, 3.0) as usize;
        // A value near zero would be labeled "-0".
        let value = if value.abs() < self.step / 2.0 { 0.0 } else { value };
        format!("{value:.decimals$}")
    }
}

struct Svg {
    text: String,
}

impl Svg {
    fn new(height: f64) -> Svg {
        let mut svg = Svg { text: String::new() };
        svg.put(format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" \
             width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <style>text {{ fill: #6e7781 }} .grid {{ stroke: #8b949e; stroke-opacity: .3 }} \
             @media (prefers-color-scheme: dark) {{ text {{ fill: #adbac7 }} }}</style>"
        ));
        svg
    }

    fn finish(mut self) -> String {
        self.put(format_args!("</svg>"));
        self.text
    }

    // Writing to a string does not fail.
    fn put(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = writeln!(self.text, "{element}");
    }

    fn legend(&mut self, report: &Report) {
        let title = format!("Homing by {} {}", report.app, report.version);
        self.put(format_args!(
            "<title>{0}</title>\n<text x=\"{LEFT}\" y=\"24\" font-size=\"15\">{0}</text>",
            plain_xml(title.trim())
        ));
        let mut x = WIDTH - RIGHT;
        for (i, axis) in report.axes.iter().enumerate().rev() {
            let colour = COLOURS[i % COLOURS.len()];
            // Estimated: a letter is about eight units wide.
            x -= 8.0 * axis.name.chars().count() as f64 + 42.0;
            self.put(format_args!(
                "<line x1=\"{x:.1}\" y1=\"20\" x2=\"{:.1}\" y2=\"20\" stroke=\"{colour}\" \
                 stroke-width=\"3\"/><text x=\"{:.1}\" y=\"24\">{}</text>",
                x + 20.0,
                x + 26.0,
                plain_xml(&axis.name)
            ));
        }
    }

    fn caption(&mut self, y: f64, text: &str) {
        self.put(format_args!("<text x=\"{LEFT}\" y=\"{y}\">{text}</text>"));
    }

    fn grid(&mut self, time: &Scale, values: &Scale, top: f64, bottom: f64) {
        let (left, right) = (LEFT, WIDTH - RIGHT);
        for t in time.marks() {
            let x = time.at(t);
            self.put(format_args!("<line class=\"grid\" x1=\"{x:.1}\" y1=\"{top}\" x2=\"{x:.1}\" y2=\"{bottom}\"/>"));
        }
        for value in values.marks() {
            let y = values.at(value);
            self.put(format_args!(
                "<line class=\"grid\" x1=\"{left}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 8.0,
                y + 4.0,
                values.label(value)
            ));
        }
    }

    fn time_axis(&mut self, time: &Scale, bottom: f64) {
        for t in time.marks() {
            self.put(format_args!(
                "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                time.at(t),
                bottom + 17.0,
                time.label(t)
            ));
        }
        self.put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">time, s</text>",
            (LEFT + WIDTH - RIGHT) / 2.0,
            bottom + 36.0
        ));
    }

    fn line(&mut self, colour: &str, axis: &AxisReport, at: impl Fn(&AxisSample) -> (f64, f64)) {
        let mut points = String::new();
        for sample in &axis.samples {
            let (x, y) = at(sample);
            // Writing to a string does not fail.
            let _ = write!(points, "{x:.1},{y:.1} ");
        }
        self.put(format_args!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" \
             stroke-linejoin=\"round\"/>",
            points.trim_end()
        ));
    }

    fn dot(&mut self, colour: &str, x: f64, y: f64) {
        self.put(format_args!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"/>"));
    }

    /// An axis' endstop over time: a thin line, filled while it is closed.
    fn lane(&mut self, colour: &str, axis: &AxisReport, time: &Scale, top: f64) {
        let (middle, height) = (top + LANE / 2.0, LANE * 0.6);
        self.put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>\
             <line class=\"grid\" x1=\"{LEFT}\" y1=\"{middle}\" x2=\"{}\" y2=\"{middle}\"/>",
            LEFT - 8.0,
            middle + 4.0,
            plain_xml(&axis.name),
            WIDTH - RIGHT
        ));
        let mut closed_at = None;
        let end = axis.samples.last().map(|s| (s.t_s, false));
        for (t_s, triggered) in axis.samples.iter().map(|s| (s.t_s, s.triggered)).chain(end) {
            match (closed_at, triggered) {
                (None, true) => closed_at = Some(t_s),
                (Some(from), false) => {
                    closed_at = None;
                    let x = time.at(from);
                    self.put(format_args!(
                        "<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{height:.1}\" \
                         fill=\"{colour}\"/>",
                        middle - height / 2.0,
                        (time.at(t_s) - x).max(2.0)
                    ));
                }
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::page::tests::assert_plain;
    use pinion_testkit::names::any_name;
    use proptest::prelude::*;

    fn assert_well_formed(svg: &str) {
        roxmltree::Document::parse(svg).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    fn axis(name: &str, from_s: f64) -> AxisReport {
        let sample = |i: u32| AxisSample {
            t_s: from_s + f64::from(i) * 0.02,
            mm: 10.0 - f64::from(i) * 0.1,
            steps_per_s: -400.0,
            triggered: i >= 95,
        };
        AxisReport { name: name.to_owned(), samples: (0..=100).map(sample).collect(), triggers_s: vec![from_s + 1.901] }
    }

    #[test]
    fn the_picture_names_its_axes_and_units() {
        let report = Report {
            app: "Pinion".to_owned(),
            axes: vec![axis("x", 0.0), axis("long <y> & \"co\"", 2.0)],
            ..Report::default()
        };
        let svg = homing(&report);
        assert_well_formed(&svg);
        for text in ["x", "long &lt;y&gt; &amp; &quot;co&quot;", "time, s"] {
            assert!(svg.contains(&format!(">{text}</text>")), "{text}");
        }
        assert!(svg.contains("mm from home") && svg.contains("steps/s"));
        assert_eq!(svg.matches("<polyline").count(), 4);
        assert_eq!(svg.matches("<circle").count(), 2);
        assert_eq!(svg.matches("<rect").count(), 2);
    }

    proptest! {
        #[test]
        fn whatever_an_axis_is_called_the_picture_is_well_formed(name in any_name()) {
            let svg = homing(&Report { app: name.clone(), axes: vec![axis(&name, 0.0)], ..Report::default() });
            assert_well_formed(&svg);
            assert_plain(&svg, svg.lines().count());
        }
    }

    #[test]
    fn a_picture_of_nothing_and_of_nonsense_is_well_formed() {
        assert_well_formed(&homing(&Report::default()));
        let mut odd = axis("x", f64::NAN);
        odd.samples.truncate(1);
        odd.triggers_s = vec![f64::INFINITY];
        let axes = vec![odd, AxisReport::default(), axis("far", 1e9)];
        assert_well_formed(&homing(&Report { axes, ..Report::default() }));
    }

    #[test]
    fn marks_are_round_numbers() {
        let scale = Scale::over([0.0, 9.97].into_iter(), 0.0, 200.0);
        let labels: Vec<_> = scale.marks().map(|mark| scale.label(mark)).collect();
        assert_eq!(labels, ["0", "5", "10"]);
        let scale = Scale::over([-0.3, 0.2].into_iter(), 0.0, 300.0);
        let labels: Vec<_> = scale.marks().map(|mark| scale.label(mark)).collect();
        assert_eq!(labels, ["-0.3", "-0.2", "-0.1", "0.0", "0.1", "0.2"]);
    }
}
