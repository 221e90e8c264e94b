// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion latency`: how late this computer wakes up, and for which outputs that is good enough.

#![forbid(unsafe_code)]

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use clap::Args;

use crate::lateness::{Lateness, us};
use crate::runtime::realtime::{self, Processors, Role, Scheduling};
use crate::runtime::wakeup::{MarginLimits, Waiter};
use crate::time::{Clock, Monotonic, Ticks, TimeSource};

use super::doctor::{is_preempt_rt, print_at_risk};
use super::failed;
use super::page::{Page, print};

/// Options of `pinion latency`.
#[derive(Args, Clone, Debug)]
pub(super) struct LatencyArgs {
    /// How long to measure, half of it idle and half under load
    #[arg(long, value_name = "N", default_value_t = 10, value_hint = clap::ValueHint::Other, value_parser = clap::value_parser!(u32).range(2..=3600))]
    seconds: u32,
    /// Draw the histograms
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

/// The time between two events: 1,000 a second, so that the program really sleeps in between.
const PERIOD: Ticks = Ticks::from_us(1000);

/// What was measured in one half.
struct Half {
    name: &'static str,
    /// How late sleeps ended.
    wakeup: Lateness,
    /// How late events were, with the program's own way of waiting: it wakes early and spins the rest.
    edge: Lateness,
    /// How early the program woke at last.
    margin: Ticks,
}

/// Measures, prints and judges.
pub(super) fn run(args: &LatencyArgs) -> ExitCode {
    if let Some(why) = print_at_risk() {
        return failed(format!("the latency is not measured: {why}"));
    }
    let span = Duration::from_secs(args.seconds.into()) / 2;
    let (scheduling, halves) = match measure_both(span) {
        Ok(measured) => measured,
        Err(error) => return failed(error),
    };
    let verdict = judge(&halves, scheduling);
    let drawn = args.svg.as_ref().map_or(Ok(()), |path| {
        fs::write(path, draw(&halves, verdict.fitness))
            .map_err(|error| format!("{} can not be written: {error}", path.display()))
    });
    print(&Page::text(&report(&halves, &verdict))).and(drawn).map_or_else(failed, |()| ExitCode::SUCCESS)
}

/// Measures for `span` idle and for as long under load.
fn measure_both(span: Duration) -> Result<(Scheduling, [Half; 2]), String> {
    let processors = Processors::new(None).map_err(|error| format!("the processors can not be told: {error}"))?;
    in_thread(move || {
        realtime::lock_memory();
        let scheduling = realtime::enter(Role::Core);
        let new_waiter = |clock, limits| Waiter::new(clock, limits, scheduling, processors);
        let idle = measure("idle", span, new_waiter);
        let load = Load::start();
        let loaded = measure("under load", span, new_waiter);
        drop(load);
        (scheduling, [idle, loaded])
    })
}

/// Measures for `span` while Pinion serves a host: below it, and without load or spinning, so that it
/// does not make it late.
fn measure_beside(span: Duration) -> Result<(Scheduling, Half), String> {
    let processors = Processors::new(None).map_err(|error| format!("the processors can not be told: {error}"))?;
    in_thread(move || {
        let scheduling = realtime::enter(Role::Worker);
        let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
        let end = clock.now().ticks() + (span.as_nanos() / 20) as u64;
        let bare = MarginLimits { min: Ticks(0), max: Ticks(0) };
        let mut wakeup = Lateness::default();
        let margin = run_for(&clock, Waiter::new(clock.clone(), bare, scheduling, processors), end, &mut wakeup);
        (scheduling, Half { name: "beside Pinion", edge: wakeup.clone(), wakeup, margin })
    })
}

/// Runs this in a thread of its own, which may change its scheduling.
fn in_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
    let thread = thread::Builder::new().name("core".into()).spawn(work);
    match thread.map(thread::JoinHandle::join) {
        Ok(Ok(done)) => Ok(done),
        _ => Err("the measuring thread can not be started: raise TasksMax or ulimit -u".into()),
    }
}

/// A look at the latency that takes two seconds; a gentle one where Pinion serves a host.
pub(super) fn sample(is_serving: bool) -> Result<Verdict, String> {
    const SPAN: Duration = Duration::from_secs(2);
    if is_serving {
        let (scheduling, half) = measure_beside(SPAN)?;
        return Ok(judge(&[half], scheduling));
    }
    let (scheduling, halves) = measure_both(SPAN / 2)?;
    Ok(judge(&halves, scheduling))
}

fn report(halves: &[Half; 2], verdict: &Verdict) -> String {
    let mut text = String::new();
    for Half { name, wakeup, edge, margin } in halves {
        let _ = writeln!(text, "{name}:\n  wake-ups  {wakeup}\n  edges     {edge}  (margin {:.1} us)", us(*margin));
    }
    let _ = writeln!(text, "verdict: {verdict}");
    text
}

fn measure(
    name: &'static str,
    span: Duration,
    new_waiter: impl Fn(Arc<dyn TimeSource>, MarginLimits) -> Waiter,
) -> Half {
    let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
    let end = clock.now().ticks() + (span.as_nanos() / 20) as u64;
    let mut half = Half { name, wakeup: Lateness::default(), edge: Lateness::default(), margin: Ticks(0) };
    // Bare sleeps for a quarter of the time, then the program's own waiting.
    let bare_end = clock.now().ticks() + (span.as_nanos() / 80) as u64;
    let bare = MarginLimits { min: Ticks(0), max: Ticks(0) };
    run_for(&clock, new_waiter(clock.clone(), bare), bare_end, &mut half.wakeup);
    half.margin = run_for(&clock, new_waiter(clock.clone(), MarginLimits::default()), end, &mut half.edge);
    half
}

fn run_for(clock: &Arc<dyn TimeSource>, mut waiter: Waiter, end: u64, lateness: &mut Lateness) -> Ticks {
    let mut at = clock.now() + PERIOD;
    while at < Clock::from_ticks(end) {
        waiter.wait(at, Some(at), || false);
        let now = clock.now();
        lateness.record(now.since(at));
        at = at + PERIOD;
        if at < now {
            at = now + PERIOD;
        }
    }
    waiter.margin()
}

/// Threads that keep every processor and the memory busy, until this is dropped.
struct Load {
    end: Arc<AtomicBool>,
    threads: Vec<thread::JoinHandle<()>>,
}

impl Load {
    fn start() -> Load {
        let end = Arc::new(AtomicBool::new(false));
        let count = thread::available_parallelism().map_or(1, usize::from);
        let work = |end: Arc<AtomicBool>| {
            move || {
                // Larger than a cache, so that the memory is busy, too.
                let mut memory = vec![0u8; 8 << 20];
                while !end.load(Ordering::Relaxed) {
                    for byte in memory.iter_mut().step_by(64) {
                        *byte = byte.wrapping_add(1);
                    }
                    let _ = fs::metadata("/proc/self");
                }
            }
        };
        // The threads inherit the scheduling class of this one, which must not be SCHED_FIFO for them.
        let threads = (0..count).map(|_| {
            let work = work(end.clone());
            thread::spawn(move || {
                realtime::leave();
                work();
            })
        });
        Load { threads: threads.collect(), end }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// For which outputs the computer is good enough.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fitness {
    Steppers,
    SlowOutputs,
    Nothing,
}

pub(super) struct Verdict {
    pub(super) fitness: Fitness,
    pub(super) why: String,
    pub(super) remedy: Option<String>,
}

impl std::fmt::Display for Fitness {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Fitness::Steppers => "fit for steppers",
            Fitness::SlowOutputs => "fit for heaters and fans, not for steppers",
            Fitness::Nothing => "not fit",
        })
    }
}

impl std::fmt::Display for Verdict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.fitness, self.why)?;
        match &self.remedy {
            Some(remedy) => write!(f, "; {remedy}"),
            None => Ok(()),
        }
    }
}

/// A step that is late by more than 1 ms stops the machine ("Stepper too far in past"). So for
/// steppers no edge may be that late, and 999 of 1000 must stay below a tenth of it. A heater has to be
/// set again within 5 s, and klippy does so every 300 ms: 50 ms do no harm there.
const STEPPERS_P999_US: f64 = 100.0;
const STEPPERS_MAX_US: f64 = 1000.0;
const SLOW_MAX_US: f64 = 50_000.0;

fn judge(halves: &[Half], scheduling: Scheduling) -> Verdict {
    let worst = |q: fn(&Lateness) -> Ticks| halves.iter().map(|half| us(q(&half.edge))).fold(0.0, f64::max);
    let p999 = worst(|lateness| lateness.quantile(0.999));
    let max = worst(Lateness::max);
    let fitness = match () {
        () if p999 <= STEPPERS_P999_US && max <= STEPPERS_MAX_US => Fitness::Steppers,
        () if max <= SLOW_MAX_US => Fitness::SlowOutputs,
        () => Fitness::Nothing,
    };
    let why = format!("999 of 1000 edges came within {p999:.1} us, the latest {max:.1} us late");
    Verdict { fitness, why, remedy: remedy(fitness, scheduling) }
}

fn remedy(fitness: Fitness, scheduling: Scheduling) -> Option<String> {
    if scheduling == Scheduling::Ordinary {
        return Some("run it as root, or with CAP_SYS_NICE, so that it may be scheduled in real time".into());
    }
    if fitness == Fitness::Steppers {
        return None;
    }
    Some(if is_preempt_rt(Path::new("/")) == Some(true) {
        "this kernel is PREEMPT_RT already: keep a processor free with isolcpus= and --cpu, set the cpufreq governor to performance, or look for a driver that keeps interrupts off".into()
    } else {
        "install a PREEMPT_RT kernel (package linux-image-rt-amd64, linux-image-rt-arm64 or linux-image-rpi-v8-rt), or keep a processor free with isolcpus= and --cpu".into()
    })
}

const WIDTH: f64 = 860.0;
const PANEL: f64 = 190.0;
const LEFT: f64 = 50.0;
const RIGHT: f64 = 50.0;

/// Where a lateness stands on the horizontal axis, which is logarithmic from 0.02 us to 100 ms.
fn place(late_us: f64) -> f64 {
    LEFT + (late_us.max(0.02) / 0.02).log10() / 6.7 * (WIDTH - LEFT - RIGHT)
}

/// Both halves as histograms, one above the other.
fn draw(halves: &[Half; 2], fitness: Fitness) -> String {
    let height = 40.0 + 2.0 * PANEL;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
         <text x=\"{LEFT}\" y=\"22\" font-size=\"15\">Lateness of this machine: {}</text>\n",
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
        // The height is logarithmic, too, so that one late event in ten thousand can be seen.
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

    fn half(name: &'static str, late: &[i64]) -> Half {
        let mut edge = Lateness::default();
        late.iter().for_each(|late| edge.record(*late));
        Half { name, wakeup: edge.clone(), edge, margin: Ticks(0) }
    }

    #[test]
    fn the_verdict_follows_the_worse_half() {
        let judged =
            |loaded: &[i64]| judge(&[half("idle", &[1; 1000]), half("under load", loaded)], Scheduling::RealTime);
        assert_eq!(judged(&[1; 1000]).fitness, Fitness::Steppers);
        assert_eq!(judged(&[40_000; 1000]).fitness, Fitness::SlowOutputs);
        let verdict = judged(&[5_000_000; 1000]);
        assert_eq!(verdict.fitness, Fitness::Nothing);
        assert!(verdict.remedy.is_some());
    }

    #[test]
    fn the_picture_shows_both_halves() {
        let svg = draw(&[half("idle", &[1, 50]), half("under load", &[4000])], Fitness::Steppers);
        assert!(svg.contains("idle") && svg.contains("under load") && svg.ends_with("</svg>\n"));
    }
}
