// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion latency`: how late this computer wakes up, and for which outputs that is good enough.

use std::env;
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use pinion_linux::gpio::FastGpio;

use pinion_firmware::lateness::{Lateness, us};
use pinion_runtime::latency::{Assessment, Fitness, Half, judge, measure_both};

use super::failed;
use super::page::{Page, print};
use pinion_system::Computer;
use pinion_system::complete::offering;
use pinion_system::files::Output;
use pinion_system::running::{print_at_risk, print_of_another};

mod figures;
mod pin;

pub use figures::{EdgeCost, Figures, HalfFigures, LateUs, Latency};

/// Options of `pinion latency`.
#[derive(Args, Clone, Debug)]
pub(crate) struct LatencyArgs {
    /// How long to measure, in seconds: half of it idle, half under load
    #[arg(long, value_name = "N", default_value_t = 10, value_hint = clap::ValueHint::Other, value_parser = clap::value_parser!(u32).range(1..=3600))]
    seconds: u32,
    /// Draw the histograms
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print JSON, for example for the option --latency of pinion sim
    #[arg(long)]
    json: bool,
    /// Toggle this line, which nothing may be connected to and nobody may hold, for two seconds, and print what an edge
    /// costs
    #[arg(long, value_name = "NAME", conflicts_with_all = ["seconds", "svg"], value_hint = clap::ValueHint::Other)]
    pin: Option<String>,
    /// How the registers are reached for --pin: on, or /dev/mem
    #[arg(long, value_name = "HOW", requires = "pin", default_value = "on", hide_possible_values = true, value_parser = offering::<FastGpio>(&FastGpio::WORDS))]
    fast_gpio: FastGpio,
}

/// Measures, prints and judges.
pub(crate) fn run(args: &LatencyArgs) -> ExitCode {
    let svg = match args.svg.as_deref().map(|path| Output::check(path, &[])).transpose() {
        Ok(svg) => svg,
        Err(error) => return failed(error),
    };
    let computer = Computer::at(Path::new("/"));
    if let Some(why) = print_at_risk(&computer) {
        return failed(format!("the latency is not measured: {why}"));
    }
    if let Some(whose) = print_of_another(&computer) {
        log::warn!("{whose}");
    }
    if let Some(pin) = &args.pin {
        let measured = pin::measure(pin, args.fast_gpio);
        let page = measured.and_then(|(text, cost)| match args.json {
            true => Figures::of_edge(Some(cost)).json().map(|json| Page::json(&json)),
            false => Ok(Page::text(&text)),
        });
        return page.and_then(|page| print(&page)).map_or_else(failed, |()| ExitCode::SUCCESS);
    }
    let span = Duration::from_secs(args.seconds.into()) / 2;
    let (scheduling, halves) = match measure_both(span) {
        Ok(measured) => measured,
        Err(error) => return failed(error),
    };
    let verdict = judge(&halves, scheduling);
    let drawn = svg.map_or(Ok(()), |svg| svg.write(|out| out.write_all(draw(&halves, verdict.fitness).as_bytes())));
    let page = match args.json {
        true => Figures::of_latency(&halves, &verdict).json().map(|json| Page::json(&json)),
        false => Ok(Page::text(&report(&halves, &verdict))),
    };
    page.and_then(|page| print(&page)).and(drawn).map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn report(halves: &[Half; 2], verdict: &Assessment) -> String {
    let mut text = String::new();
    for Half { name, wakeup, edge, margin } in halves {
        let _ = writeln!(text, "{name}:\n  wake-ups  {wakeup}\n  edges     {edge}  (margin {:.1} us)", us(*margin));
    }
    let _ = writeln!(text, "verdict: {verdict}");
    text + &share(halves, &computer_name())
}

/// One line with the figures, to paste into a discussion. docs/develop/performance.md uses the same names.
fn share(halves: &[Half; 2], computer: &str) -> String {
    let late = halves.each_ref().map(|Half { name, edge, .. }| {
        let late_us = |late| format!("{:.1}", us(late));
        let [p50, p999] = [0.5, 0.999].map(|share| late_us(edge.quantile(share)));
        format!("{name} {p50} / {p999} / {}", late_us(edge.max()))
    });
    let version = env!("CARGO_PKG_VERSION");
    format!("to share: Pinion {version} on {computer}: edges late, us: p50 / p99.9 / max: {}\n", late.join(", "))
}

/// The computer's model and kernel.
fn computer_name() -> String {
    let model = fs::read_to_string("/proc/device-tree/model").unwrap_or_else(|_| env::consts::ARCH.to_owned());
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    format!("{}, Linux {}", model.trim_end_matches('\0'), kernel.trim())
}

const WIDTH: f64 = 860.0;
const PANEL: f64 = 190.0;
const LEFT: f64 = 50.0;
const RIGHT: f64 = 50.0;

/// The place of a lateness on the horizontal axis, which is logarithmic from 0.02 us to 100 ms.
fn place(late_us: f64) -> f64 {
    LEFT + (late_us.max(0.02) / 0.02).log10() / 6.7 * (WIDTH - LEFT - RIGHT)
}

/// Both halves as histograms, one above the other.
fn draw(halves: &[Half; 2], fitness: Fitness) -> String {
    let height = 40.0 + 2.0 * PANEL;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
         <text x=\"{LEFT}\" y=\"22\" font-size=\"15\">Lateness of this computer: {}</text>\n",
        match fitness {
            Fitness::Steppers => "fit for steppers",
            Fitness::SlowOutputs => "fit for heaters and fans",
            Fitness::Nothing => "not fit",
        }
    );
    for (row, half) in halves.iter().enumerate() {
        let top = 40.0 + PANEL * row as f64;
        let base = top + PANEL - 40.0;
        let _ = writeln!(svg, "<text x=\"{LEFT}\" y=\"{:.0}\">{}</text>", top + 12.0, half.name);
        for (label, color, lateness, line) in
            [("wake-ups", "#d9822b", &half.wakeup, 0.0), ("edges", "#2b6cb0", &half.edge, 16.0)]
        {
            let _ = writeln!(
                svg,
                "<text x=\"{:.0}\" y=\"{:.0}\" fill=\"{color}\">{label}: {lateness}</text>",
                LEFT + 90.0,
                top + 12.0 + line
            );
            draw_bars(&mut svg, lateness, color, base);
        }
        draw_scale(&mut svg, base);
    }
    svg.push_str("</svg>\n");
    svg
}

/// One distribution as bars that stand on `base`.
fn draw_bars(svg: &mut String, lateness: &Lateness, color: &str, base: f64) {
    let most = lateness.buckets().map(|(_, count)| count).max().unwrap_or(1) as f64;
    let mut before = 0.0;
    for (upper, count) in lateness.buckets() {
        // The height is logarithmic too, so that one late event in ten thousand is visible.
        let tall = (count as f64 + 1.0).ln() / (most + 1.0).ln() * (PANEL - 90.0);
        let (from, to) = (place((us(upper) * 8.0 / 9.0).max(before)), place(us(upper)));
        before = us(upper);
        let _ = writeln!(
            svg,
            "<rect x=\"{from:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{tall:.1}\" fill=\"{color}\" fill-opacity=\"0.7\"/>",
            base - tall,
            (to - from).max(2.0)
        );
    }
}

/// The horizontal axis with its labels.
fn draw_scale(svg: &mut String, base: f64) {
    let _ = writeln!(svg, "<path d=\"M{LEFT} {base}H{}\" stroke=\"#444444\"/>", WIDTH - RIGHT);
    for (late_us, label) in [
        (0.1, "0.1 us"),
        (1.0, "1 us"),
        (10.0, "10 us"),
        (100.0, "100 us"),
        (1e3, "1 ms"),
        (1e4, "10 ms"),
        (1e5, "100 ms"),
    ] {
        let _ = writeln!(
            svg,
            "<path d=\"M{0:.1} {base}v4\" stroke=\"#444444\"/><text x=\"{0:.1}\" y=\"{1:.0}\" text-anchor=\"middle\">{label}</text>",
            place(late_us),
            base + 17.0
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::Ticks;

    fn half(name: &'static str, late: &[u32]) -> Half {
        let mut edge = Lateness::default();
        late.iter().for_each(|late| edge.record(Ticks(*late)));
        Half { name, wakeup: edge.clone(), edge, margin: Ticks(0) }
    }

    #[test]
    fn a_line_to_share_has_the_figures_and_the_computer() {
        let late: Vec<u32> = (1..=1000).map(|us| 50 * us / 100).collect();
        let line = share(&[half("idle", &late), half("under load", &[50])], "a board, Linux 6.1");
        let start = format!("to share: Pinion {} on a board, Linux 6.1: edges late, us", env!("CARGO_PKG_VERSION"));
        assert!(line.starts_with(&start), "{line}");
        assert!(line.ends_with(": idle 5.1 / 10.0 / 10.0, under load 1.0 / 1.0 / 1.0\n"), "{line}");
    }

    #[test]
    fn the_picture_shows_both_halves() {
        let svg = draw(&[half("idle", &[1, 50]), half("under load", &[4000])], Fitness::Steppers);
        assert!(svg.contains("idle") && svg.contains("under load") && svg.ends_with("</svg>\n"));
    }
}
