// SPDX-License-Identifier: GPL-3.0-or-later
//! Measures how late this computer wakes up, and judges for which outputs that is good enough.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use pinion_firmware::lateness::{Lateness, us};
use pinion_firmware::time::{Clock, Ticks, TimeSource};
use pinion_linux::clock::Monotonic;

use crate::core::wakeup::{MarginLimits, Waiter};
use crate::process::realtime::{self, Processors, Role, Scheduling};

/// The time between two events: 1,000 a second, so that the program really sleeps in between.
const PERIOD: Ticks = Ticks::from_us(1000);

/// The measurements of one half: idle, or under load.
pub struct Half {
    /// The load on the computer during the measurement.
    pub name: &'static str,
    /// How late sleeps ended.
    pub wakeup: Lateness,
    /// How late events were with the program's own waiting: it wakes early and spins the rest.
    pub edge: Lateness,
    /// How early the program woke at the end.
    pub margin: Ticks,
}

/// Measures for `span` while idle, then as long under load.
pub fn measure_both(span: Duration) -> Result<(Scheduling, [Half; 2]), String> {
    let processors = Processors::new(None).map_err(|error| format!("the processors are unknown: {error}"))?;
    in_thread(move || {
        realtime::lock_memory();
        let scheduling = realtime::enter(Role::Core);
        let new_waiter = |clock, limits| Waiter::new(clock, Arc::default(), limits, scheduling, processors);
        let idle = measure("idle", span, new_waiter);
        let load = Load::start();
        let loaded = measure("under load", span, new_waiter);
        drop(load);
        (scheduling, [idle, loaded])
    })
}

/// Measures for `span` while Pinion serves a host. It runs below Pinion's priority, without load or spinning. So it
/// does not delay Pinion.
fn measure_beside(span: Duration) -> Result<(Scheduling, Half), String> {
    let processors = Processors::new(None).map_err(|error| format!("the processors are unknown: {error}"))?;
    in_thread(move || {
        let scheduling = realtime::enter(Role::Worker);
        let clock: Arc<dyn TimeSource> = Arc::new(Monotonic::start());
        let bare = MarginLimits::always(Ticks(0));
        let waiter = Waiter::new(clock.clone(), Arc::default(), bare, scheduling, processors);
        let end = clock.now().ticks() + (span.as_nanos() / 20) as u64;
        let mut wakeup = Lateness::default();
        let margin = run_for(&clock, waiter, end, &mut wakeup);
        (scheduling, Half { name: "beside Pinion", edge: wakeup.clone(), wakeup, margin })
    })
}

/// Runs `work` in a thread of its own, because `work` may change the scheduling of its thread.
fn in_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
    let thread = thread::Builder::new().name("core".into()).spawn(work);
    match thread.map(thread::JoinHandle::join) {
        Ok(Ok(done)) => Ok(done),
        _ => Err("the measuring thread cannot be started: raise TasksMax or ulimit -u".into()),
    }
}

/// Measures the latency for two seconds. While Pinion serves a host, it measures gently.
pub fn sample(is_serving: bool) -> Result<Assessment, String> {
    const SPAN: Duration = Duration::from_secs(2);
    if is_serving {
        let (scheduling, half) = measure_beside(SPAN)?;
        return Ok(judge(&[half], scheduling));
    }
    let (scheduling, halves) = measure_both(SPAN / 2)?;
    Ok(judge(&halves, scheduling))
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
    let bare = MarginLimits::always(Ticks(0));
    run_for(&clock, new_waiter(clock.clone(), bare), bare_end, &mut half.wakeup);
    half.margin = run_for(&clock, new_waiter(clock.clone(), MarginLimits::default()), end, &mut half.edge);
    half
}

fn run_for(clock: &Arc<dyn TimeSource>, mut waiter: Waiter, end: u64, lateness: &mut Lateness) -> Ticks {
    let mut at = clock.now() + PERIOD;
    while at < Clock::from_ticks(end) {
        waiter.wait(clock.now(), at, Some(at), |_| false);
        let now = clock.now();
        lateness.record(Ticks::between(at, now));
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
        // The threads inherit this thread's scheduling class. They must not run as SCHED_FIFO.
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

/// The outputs for which the computer is good enough.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fitness {
    /// Everything.
    Steppers,
    /// Heaters, fans and other outputs that change seldom.
    SlowOutputs,
    /// No output.
    Nothing,
}

/// The uses that the measurements allow.
pub struct Assessment {
    /// The outputs.
    pub fitness: Fitness,
    /// The figure that decided.
    pub why: String,
    /// Settings that may improve the latency.
    pub remedy: Option<String>,
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

impl std::fmt::Display for Assessment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.fitness, self.why)?;
        match &self.remedy {
            Some(remedy) => write!(f, "; {remedy}"),
            None => Ok(()),
        }
    }
}

/// A step that is more than 1 ms late stops the MCU ("Stepper too far in past"). So for steppers no edge may be that
/// late, and 999 of 1000 must stay below a tenth of it. A heater has to be set again within 5 s, and klippy does so
/// every 300 ms. So 50 ms do no harm there.
const STEPPERS_P999_US: f64 = 100.0;
const STEPPERS_MAX_US: f64 = 1000.0;
const SLOW_MAX_US: f64 = 50_000.0;

/// The uses that the measurements of both halves allow.
pub fn judge(halves: &[Half], scheduling: Scheduling) -> Assessment {
    let worst = |q: fn(&Lateness) -> Ticks| halves.iter().map(|half| us(q(&half.edge))).fold(0.0, f64::max);
    let p999 = worst(|lateness| lateness.quantile(0.999));
    let max = worst(Lateness::max);
    let fitness = match () {
        () if p999 <= STEPPERS_P999_US && max <= STEPPERS_MAX_US => Fitness::Steppers,
        () if max <= SLOW_MAX_US => Fitness::SlowOutputs,
        () => Fitness::Nothing,
    };
    let why = format!("999 of 1000 edges came within {p999:.1} us, the latest {max:.1} us late");
    Assessment { fitness, why, remedy: remedy(fitness, scheduling) }
}

fn remedy(fitness: Fitness, scheduling: Scheduling) -> Option<String> {
    if scheduling == Scheduling::Ordinary {
        return Some("run it as root, or with CAP_SYS_NICE, so that it may be scheduled in real time".into());
    }
    if fitness == Fitness::Steppers {
        return None;
    }
    Some(if realtime::is_preempt_rt(Path::new("/")) == Some(true) {
        "this kernel is PREEMPT_RT already: keep a processor free with isolcpus= and --cpu, set the cpufreq governor to performance, or look for a driver that keeps interrupts off".into()
    } else {
        "install a PREEMPT_RT kernel (package linux-image-rt-amd64, linux-image-rt-arm64 or linux-image-rpi-v8-rt), or keep a processor free with isolcpus= and --cpu".into()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A half in which the events were this late, in ticks.
    fn half(name: &'static str, late: &[u32]) -> Half {
        let mut edge = Lateness::default();
        late.iter().for_each(|late| edge.record(Ticks(*late)));
        Half { name, wakeup: edge.clone(), edge, margin: Ticks(0) }
    }

    #[test]
    fn a_gentle_measurement_lasts_as_long_as_it_was_asked_to() {
        let began = std::time::Instant::now();
        let (_, half) = measure_beside(Duration::from_millis(100)).unwrap();
        assert!(half.edge.samples() > 0);
        let took = began.elapsed();
        assert!(took > Duration::from_millis(50) && took < Duration::from_secs(20), "{took:?}");
    }

    #[test]
    fn the_verdict_follows_the_worse_half() {
        let judged =
            |loaded: &[u32]| judge(&[half("idle", &[1; 1000]), half("under load", loaded)], Scheduling::RealTime);
        assert_eq!(judged(&[1; 1000]).fitness, Fitness::Steppers);
        assert_eq!(judged(&[40_000; 1000]).fitness, Fitness::SlowOutputs);
        let verdict = judged(&[5_000_000; 1000]);
        assert_eq!(verdict.fitness, Fitness::Nothing);
        assert!(verdict.remedy.is_some());
    }
}
