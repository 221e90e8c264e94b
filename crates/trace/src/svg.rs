// SPDX-License-Identifier: GPL-3.0-or-later
//! A picture of a trace's end: what each thread did in the last 200 ms, and the verdict.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fmt::{Arguments, Write as _};
use std::io::{self, Write};

use pinion_firmware::time::Ticks;

use super::event::Event;
use super::file::{End, Trace};
use super::history::{Deed, History, Output, TICKS_PER_MS, cut, ms, short};
use super::verdict::verdict;
use pinion_linux::foreign::plain_xml;

/// The span of the picture.
const SPAN: i64 = 200 * TICKS_PER_MS;
/// How long the picture goes on after the MCU stopped.
const AFTER_STOP: i64 = 10 * TICKS_PER_MS;
const MARK_MS: i64 = 20;

const WIDTH: f64 = 1000.0;
const LEFT: f64 = 150.0;
const RIGHT: f64 = 24.0;
/// Height of the title and the facts, and of a line of the verdict.
const HEAD: f64 = 52.0;
const LINE: f64 = 17.0;
/// Height of the labels of the red lines.
const LABELS: f64 = 46.0;
/// Heights of a row, of its bars, and of the diagram of lateness.
const ROW: f64 = 26.0;
const BAR: f64 = 16.0;
const LATENESS: f64 = 130.0;
const BOTTOM: f64 = 74.0;
/// Letters of a row's name that have room.
const NAME_MAX: usize = 20;
/// Highest number of letters of the verdict, and of one of its lines.
const VERDICT_MAX: usize = 600;
const VERDICT_LINE_MAX: usize = 140;
/// Highest number of rows of buses, of outputs, and of outputs that the host sets.
const BUSES_MAX: usize = 12;
const OUTPUTS_MAX: usize = 16;
const SET_MAX: usize = 10;
/// The range of the lateness, in powers of ten of a µs: 1 µs to 100 ms.
const DECADES: i32 = 5;

/// Colors that are visible on white and on black.
const HOST: &str = "#1a8fe3";
const COMMANDS: &str = "#b04fc4";
const SET: &str = "#e8720c";
const OTHER: &str = "#2f9e44";
const BUS: &str = "#c49a00";
const CORE: &str = "#6e8aa6";
const LATE: &str = "#e0457b";
const STOP: &str = "#e5372c";

/// Writes the picture as an SVG document: 200 ms until 10 ms after the MCU stopped, or until the end of the recording.
/// It is readable on light and on dark backgrounds and needs no other file.
///
/// # Errors
///
/// Those of `out`.
pub fn write(trace: &Trace, out: &mut impl Write) -> io::Result<()> {
    let history = History::of(trace);
    let stopped = history.stopped().filter(|_| matches!(trace.head.end, End::Shutdown { .. }));
    let end = stopped.map_or(0, |at| at.saturating_add(AFTER_STOP).min(history.last));
    let window = Window { from: end.saturating_sub(SPAN), to: end };
    let rows = rows(&history, &window);
    let verdict = wrapped(&cut(&format!("verdict: {}", verdict(trace).text), VERDICT_MAX), VERDICT_LINE_MAX);
    let top = HEAD + LINE * verdict.len() as f64 + LABELS;
    let lateness_at = top + ROW * rows.len() as f64 + 34.0;
    let bottom = lateness_at + LATENESS;
    let mut svg = Svg { text: String::new(), window };
    svg.begin(bottom + BOTTOM, &history, trace, &verdict);
    svg.times(top, bottom, if history.stopped() == Some(0) { "the stop" } else { "the end of the recording" });
    for (index, row) in rows.iter().enumerate() {
        svg.row(row, top + ROW * index as f64);
    }
    svg.lateness(&history, lateness_at);
    if let Some(stopped) = history.stopped() {
        svg.marker(stopped, "stopped", "8 4", top - 22.0, bottom);
        if let Some(due) = history.due() {
            let early = if due <= stopped { "before" } else { "after" };
            let label = format!("due {} ms {early} the stop", ms(due.abs_diff(stopped)));
            svg.marker(due, &label, "2 3", top - 8.0, bottom);
        }
    }
    svg.legend(bottom + 58.0);
    svg.put(format_args!("</svg>"));
    out.write_all(svg.text.as_bytes())
}

/// The times of the picture, in ticks relative to the end of the recording.
#[derive(Clone, Copy)]
struct Window {
    from: i64,
    to: i64,
}

impl Window {
    fn x(&self, at: i64) -> f64 {
        let part = at.clamp(self.from, self.to).abs_diff(self.from) as f64 / SPAN as f64;
        LEFT + (WIDTH - RIGHT - LEFT) * part
    }

    fn has(&self, at: i64) -> bool {
        (self.from..=self.to).contains(&at)
    }

    /// The spans of these deeds in the picture. Spans that cannot be distinguished are one. So their number is bounded.
    fn bars(&self, spans: impl Iterator<Item = (i64, i64)>) -> Vec<(f64, f64)> {
        let inside = spans.filter(|(from, to)| *to >= self.from && *from <= self.to);
        let mut bars: Vec<(f64, f64)> = inside.map(|(from, to)| (self.x(from), self.x(to))).collect();
        bars.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut merged: Vec<(f64, f64)> = Vec::new();
        for (from, to) in bars {
            match merged.last_mut() {
                Some((_, end)) if from <= *end + 0.5 => *end = end.max(to),
                _ => merged.push((from, to)),
            }
        }
        merged
    }
}

/// A row of the picture.
struct Row {
    name: String,
    color: &'static str,
    bars: Vec<(f64, f64)>,
    /// Only moments have text; they have no length.
    moments: bool,
}

fn rows(history: &History<'_>, window: &Window) -> Vec<Row> {
    let core = history.core();
    let of = |deeds: &[Deed], is: fn(&Event) -> bool| -> Vec<(i64, i64)> {
        deeds.iter().filter(|deed| is(&deed.event)).map(|deed| (deed.from, deed.to)).collect()
    };
    let row = |name: &str, color, spans: Vec<(i64, i64)>, moments| {
        let bars = window.bars(spans.into_iter().map(|(from, to)| (if moments { to } else { from }, to)));
        Row { name: name.to_owned(), color, bars, moments }
    };
    let all: Vec<Deed> = history.deeds().map(|(_, deed)| *deed).collect();
    let mut rows = vec![
        row("host's blocks", HOST, of(&all, |event| matches!(event, Event::BlockIn(_))), true),
        row("blocks wait", HOST, of(core, |event| matches!(event, Event::Block(_))), false),
        row("commands", COMMANDS, of(core, |event| matches!(event, Event::Command { .. })), true),
        row("wait for a bus", COMMANDS, of(core, |event| matches!(event, Event::Held | Event::Released)), false),
    ];
    let (outputs, left_out) = shown(history.outputs(), window);
    rows.extend(outputs.into_iter().map(|output| {
        let color = if output.is_set { SET } else { OTHER };
        row(&history.pin(output.pin), color, output.highs, false)
    }));
    if left_out > 0 {
        let plural = if left_out == 1 { "" } else { "s" };
        rows.push(row(&format!("(and {left_out} output{plural})"), OTHER, Vec::new(), false));
    }
    let busy = |event: &Event| matches!(event, Event::JobBegan { .. } | Event::JobEnded { .. });
    let buses = history.lanes.iter().filter(|lane| lane.deeds.iter().any(|deed| busy(&deed.event)));
    rows.extend(buses.take(BUSES_MAX).map(|lane| row(&short(lane.thread), BUS, of(&lane.deeds, busy), false)));
    rows.push(row("core is awake", CORE, history.awake(), false));
    rows
}

/// The outputs that have rows, and the number of the others. Those that the host sets come first: what is high may be
/// hot. Then come those that changed last.
fn shown(mut outputs: Vec<Output>, window: &Window) -> (Vec<Output>, usize) {
    let is_high = |output: &Output| output.highs.iter().any(|(from, to)| *to >= window.from && *from <= window.to);
    outputs.sort_by_cached_key(|output| Reverse((output.is_set, output.is_set && is_high(output), output.changed)));
    let set = outputs.iter().filter(|output| output.is_set).count().min(SET_MAX);
    outputs[set..].sort_by_key(|output| Reverse(output.changed));
    let left_out = outputs.len().saturating_sub(OUTPUTS_MAX);
    outputs.truncate(OUTPUTS_MAX);
    outputs.sort_by_key(|output| (!output.is_set, output.pin));
    (outputs, left_out)
}

/// The text in lines of at most this many letters, broken at spaces if there are some.
fn wrapped(text: &str, letters: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        let mut word: Vec<char> = word.chars().collect();
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.len() <= letters => {
                line.push(' ');
                line.extend(word);
            }
            _ => lines.extend(word.chunks_mut(letters).map(|part| part.iter().collect::<String>())),
        }
    }
    lines
}

struct Svg {
    text: String,
    window: Window,
}

impl Svg {
    // Writing to a string does not fail.
    fn put(&mut self, element: Arguments<'_>) {
        let _ = writeln!(self.text, "{element}");
    }

    fn begin(&mut self, height: f64, history: &History<'_>, trace: &Trace, verdict: &[String]) {
        let title = plain_xml(&history.end());
        let facts = plain_xml(&format!("{}, {}", short(&trace.head.version), short(&trace.head.link)));
        self.put(format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
             height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n<title>{title}</title>\n\
             <style>text {{ fill: #57606a }} .paper {{ fill: #ffffff }} .grid {{ stroke: #8b949e; stroke-opacity: .3 }} \
             @media (prefers-color-scheme: dark) {{ text {{ fill: #adbac7 }} .paper {{ fill: #0d1117 }} }}</style>\n\
             <rect class=\"paper\" width=\"{WIDTH}\" height=\"{height}\"/>\n\
             <text x=\"24\" y=\"28\" font-size=\"16\">{title}</text>\n<text x=\"24\" y=\"48\">{facts}</text>"
        ));
        for (number, line) in (1u8..).zip(verdict) {
            self.text(24.0, 48.0 + LINE * f64::from(number), "start", line);
        }
    }

    fn text(&mut self, x: f64, y: f64, anchor: &str, text: &str) {
        self.put(format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>", plain_xml(text)));
    }

    fn line(&mut self, x: f64, from: f64, to: f64, style: Arguments<'_>) {
        self.put(format_args!("<line x1=\"{x:.1}\" y1=\"{from:.1}\" x2=\"{x:.1}\" y2=\"{to:.1}\" {style}/>"));
    }

    fn times(&mut self, top: f64, bottom: f64, zero: &str) {
        let Window { from, to } = self.window;
        // The marks are at round times.
        let mark = MARK_MS * TICKS_PER_MS;
        let mut at = to.saturating_sub(to.rem_euclid(mark));
        while at >= from {
            let x = self.window.x(at);
            self.line(x, top - 4.0, bottom, format_args!("class=\"grid\""));
            self.text(x, bottom + 17.0, "middle", &(at / TICKS_PER_MS).to_string());
            let Some(before) = at.checked_sub(mark) else { break };
            at = before;
        }
        let label = format!("time, ms (0 is {zero})");
        self.text((LEFT + WIDTH - RIGHT) / 2.0, bottom + 34.0, "middle", &label);
    }

    fn row(&mut self, row: &Row, top: f64) {
        let middle = top + ROW / 2.0;
        let name: String = row.name.chars().take(NAME_MAX).collect();
        self.text(LEFT - 10.0, middle + 4.0, "end", &name);
        self.put(format_args!(
            "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{middle}\" x2=\"{}\" y2=\"{middle}\"/>",
            WIDTH - RIGHT
        ));
        let least = if row.moments { 1.5 } else { 1.0 };
        for (from, to) in &row.bars {
            self.put(format_args!(
                "<rect x=\"{from:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{BAR}\" fill=\"{}\"/>",
                middle - BAR / 2.0,
                (to - from).max(least),
                row.color
            ));
        }
    }

    /// How late timers and wake-ups were, on a logarithmic scale. Each column of the picture has its latest.
    fn lateness(&mut self, history: &History<'_>, top: f64) {
        let bottom = top + LATENESS;
        let y = |ticks: f64| {
            let us = ticks / f64::from(Ticks::from_us(1).0);
            bottom - LATENESS * (us.max(1.0).log10() / f64::from(DECADES)).min(1.0)
        };
        self.text(LEFT, top - 8.0, "start", "lateness: lines are timers, dots are wake-ups");
        for (decade, label) in (0..=DECADES).zip(["1 µs", "10 µs", "100 µs", "1 ms", "10 ms", "100 ms"]) {
            let y = bottom - LATENESS * f64::from(decade) / f64::from(DECADES);
            self.text(LEFT - 10.0, y + 4.0, "end", label);
            self.put(format_args!(
                "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{y:.1}\" x2=\"{}\" y2=\"{y:.1}\"/>",
                WIDTH - RIGHT
            ));
        }
        let mut worst: BTreeMap<(bool, i64), Ticks> = BTreeMap::new();
        for deed in history.core().iter().filter(|deed| self.window.has(deed.to)) {
            let (timer, late) = match deed.event {
                Event::Late { late, .. } => (true, late),
                Event::Woke { late, .. } => (false, late),
                _ => continue,
            };
            let worst = worst.entry((timer, self.window.x(deed.to) as i64)).or_default();
            *worst = late.max(*worst);
        }
        for ((timer, x), late) in worst {
            let (x, y) = (x as f64, y(late.0.into()));
            if timer {
                self.line(x, y.min(bottom - 2.0), bottom, format_args!("stroke=\"{LATE}\" stroke-width=\"2\""));
            } else {
                self.put(format_args!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"1.5\" fill=\"{CORE}\"/>"));
            }
        }
    }

    /// A line through all rows. A time outside of the picture has its line at the border.
    fn marker(&mut self, at: i64, label: &str, dashes: &str, y: f64, bottom: f64) {
        let x = self.window.x(at);
        let style = format_args!("stroke=\"{STOP}\" stroke-width=\"1.5\" stroke-dasharray=\"{dashes}\"");
        self.line(x, y, bottom, style);
        let (anchor, x) = if x > WIDTH / 2.0 { ("end", x - 5.0) } else { ("start", x + 5.0) };
        self.text(x, y + 6.0, anchor, label);
    }

    fn legend(&mut self, y: f64) {
        let entries = [
            (HOST, "from the host"),
            (COMMANDS, "commands"),
            (SET, "set output is high"),
            (OTHER, "other output is high"),
            (BUS, "bus is busy"),
            (CORE, "core"),
            (LATE, "late timer"),
            (STOP, "stop, due time"),
        ];
        let mut x = 24.0;
        for (color, text) in entries {
            self.put(format_args!(
                "<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"12\" height=\"10\" fill=\"{color}\"/>",
                y - 9.0
            ));
            self.text(x + 17.0, y, "start", text);
            // Estimated: a letter is about six units wide.
            x += 40.0 + 6.2 * text.len() as f64;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::history::tests::{any_trace, late_host, stopped_print, text};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn it_shows_the_stop_what_it_was_about_and_what_each_thread_did() {
        let svg = text(|out| write(&late_host(), out));
        let document = roxmltree::Document::parse(&svg).unwrap();
        let texts: Vec<&str> = document.descendants().filter_map(|node| node.text()).collect();
        for text in ["the MCU stopped: Timer too close", "stopped", "due 38.1 ms before the stop", "spi0", "gpio17"] {
            assert!(texts.contains(&text), "{text}");
        }
        let number = |node: &roxmltree::Node, name: &str| node.attribute(name).unwrap().parse::<f64>().unwrap();
        let busy: Vec<(f64, f64)> = document
            .descendants()
            .filter(|node| node.attribute("fill") == Some(BUS) && node.attribute("width") != Some("12"))
            .map(|node| (number(&node, "x"), number(&node, "width")))
            .collect();
        // 200 ms are 826 units. Work every 20 ms, one of 12 ms, and one without an end, 10 ms before the end.
        assert_eq!(busy.len(), 6);
        assert_eq!(busy[4], (488.7, 49.6));
        assert_eq!(busy[5], (934.7, 41.3));
    }

    #[test]
    fn it_shows_what_is_hot_what_changed_last_and_what_the_stop_did() {
        let svg = text(|out| write(&stopped_print(), out));
        let document = roxmltree::Document::parse(&svg).unwrap();
        let texts: Vec<&str> = document.descendants().filter_map(|node| node.text()).collect();
        let shown = |name: &str| texts.contains(&name);
        assert!(
            ["x_enable", "heater", "fan", "step0", "step12", "(and 5 outputs)"].into_iter().all(shown),
            "{texts:?}"
        );
        assert!(!shown("step13"), "{texts:?}");
        assert!(shown("time, ms (0 is the stop)"));
        let number = |node: &roxmltree::Node, name: &str| node.attribute(name).unwrap().parse::<f64>().unwrap();
        let high: Vec<(f64, f64)> = document
            .descendants()
            .filter(|node| node.attribute("fill") == Some(SET) && node.attribute("width") != Some("12"))
            .map(|node| (number(&node, "x"), (number(&node, "x") + number(&node, "width")).round()))
            .collect();
        // From -190 to 10 ms. The motor's enable pin is high after the stop, and the fan is on before it.
        assert_eq!(high.first(), Some(&(935.0, 976.0)));
        assert_eq!(high.last(), Some(&(150.0, 935.0)));
        assert_eq!(high.len(), 6);
    }

    #[test]
    fn the_verdict_is_in_lines_that_fit() {
        let mut trace = stopped_print();
        let trouble = "the host stopped the MCU because ".to_owned() + &"of its own reason ".repeat(15);
        trace.head.end = End::Shutdown { reason: "Command request".into(), trouble };
        let svg = text(|out| write(&trace, out));
        let document = roxmltree::Document::parse(&svg).unwrap();
        let texts: Vec<&str> =
            document.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect();
        let lines: Vec<&str> = texts.iter().copied().filter(|text| text.contains("of its own")).collect();
        assert!(lines.len() > 1 && lines.iter().all(|line| line.chars().count() <= VERDICT_LINE_MAX), "{lines:?}");
        assert!(lines.join(" ").starts_with(&format!("verdict: {}", verdict(&trace).text.trim())), "{lines:?}");
        assert_eq!(wrapped(&"x".repeat(5), 2), ["xx", "xx", "x"]);
        assert_eq!(wrapped("a bb ccc", 4), ["a bb", "ccc"]);
    }

    proptest! {
        #[test]
        fn any_trace_makes_a_small_picture(trace in any_trace()) {
            let svg = text(|out| write(&trace, out));
            let document = roxmltree::Document::parse(&svg).unwrap();
            prop_assert!(document.descendants().count() < 20_000);
            prop_assert!(!svg.contains("NaN") && !svg.contains("inf"));
        }
    }
}
