// SPDX-License-Identifier: GPL-3.0-or-later
//! Jumps of the wall clock, as time synchronization makes them on a computer without a battery for its clock.

use std::fs::{self, File};
use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use nix::time::{ClockId, clock_gettime, clock_settime};
use pinion_trace::file::{End, Trace as Recording};

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, run, shutdown_of};
use crate::sysfs;
use crate::trace::Trace;

const HOUR: Duration = Duration::from_secs(3600);
/// The folder of the recordings.
const STATE: &str = "/tmp/state";
/// 50 ticks take a microsecond.
const STEP_TICKS: u32 = 500_000;
const STEPS: usize = 400;
const CYCLE_TICKS: u32 = 1_000_000;
const MAX_DURATION_TICKS: u32 = 50_000_000;

/// Sets the wall clock this many hours ahead. It has its own time again when this is dropped.
struct Ahead(i32);

impl Ahead {
    fn set(&mut self, hours: i32) {
        let now = Duration::from(clock_gettime(ClockId::CLOCK_REALTIME).expect("a clock"));
        let by = HOUR * (hours - self.0).unsigned_abs();
        let now = if hours > self.0 { now + by } else { now - by };
        clock_settime(ClockId::CLOCK_REALTIME, now.into()).expect("root's right");
        self.0 = hours;
    }
}

impl Drop for Ahead {
    fn drop(&mut self) {
        self.set(0);
    }
}

fn uptime_s(link: &Path) -> f64 {
    let answer = Command::new("pinion").args(["status", "--json", "-I"]).arg(link).output().expect("pinion");
    let status: serde_json::Value = serde_json::from_slice(&answer.stdout).expect("JSON");
    status["uptime_s"].as_f64().expect("a number")
}

/// The recordings, the newest first as `pinion trace` lists them.
fn recordings() -> Vec<Recording> {
    let folder = Path::new(STATE).join("pinion");
    let files = pinion_trace::folder::all(&[folder]);
    files.iter().map(|path| Recording::read(&mut File::open(path).expect("a file")).expect("a recording")).collect()
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn jumps_of_the_wall_clock_move_no_edge_and_no_time_that_pinion_tells() {
        let sim = GpioSim::builder("lab", 8).name(3, "STEP").name(5, "DIR").name(6, "HEATER").build();
        let program = Program::with(&["-r"], &[("XDG_STATE_HOME", STATE)]);
        let mut ahead = Ahead(0);
        for hours in [7, -30] {
            let client = &mut program.connect();
            configure(
                client,
                2,
                &[
                    format!(
                        "config_digital_out oid=0 pin=HEATER value=0 default_value=0 max_duration={MAX_DURATION_TICKS}"
                    ),
                    format!("set_digital_out_pwm_cycle oid=0 cycle_ticks={CYCLE_TICKS}"),
                    "config_stepper oid=1 step_pin=STEP dir_pin=DIR invert_step=0 step_pulse_ticks=100".to_owned(),
                ],
            );
            let trace = Trace::start();
            let (began, up_before_s) = (Instant::now(), uptime_s(program.link()));
            // A refresh begins a pulse, so it comes after whole cycles.
            let first = client.clock_in(0.05).expect("the clock").wire();
            let heat = |client: &mut pinion_client::Client| {
                let since = client.clock_in(0.05).expect("the clock").wire().wrapping_sub(first);
                let at = first.wrapping_add(since.next_multiple_of(CYCLE_TICKS));
                run(client, &format!("queue_digital_out oid=0 clock={at} on_ticks={}", CYCLE_TICKS / 2));
            };
            heat(client);
            let start = client.clock_in(0.2).expect("the clock").wire();
            for line in [
                format!("reset_step_clock oid=1 clock={start}"),
                "set_next_step_dir oid=1 dir=1".to_owned(),
                format!("queue_step oid=1 interval={STEP_TICKS} count={STEPS} add=0"),
            ] {
                run(client, &line);
            }
            // The heater is on for longer than one refresh lasts.
            let step = sim.kernel_number(3);
            for jump in 0.. {
                ahead.set(if jump % 2 == 0 { hours } else { -hours });
                thread::sleep(Duration::from_millis(400));
                heat(client);
                if trace.writes_to(step).len() == 2 * STEPS {
                    break;
                }
            }
            client.check().expect("no shutdown");
            for (offset, ticks) in [(3, STEP_TICKS), (6, CYCLE_TICKS)] {
                let writes = trace.writes_to(sim.kernel_number(offset));
                let rises: Vec<u64> = writes.iter().filter(|write| write.level).map(|write| write.at_ns).collect();
                assert!(rises.len() > 100, "{offset}: {} pulses", rises.len());
                let apart = rises.windows(2).map(|pair| pair[1] - pair[0]);
                let wrong = apart.map(|ns| ns.abs_diff(u64::from(ticks) * 20)).max().expect("pulses");
                assert!(wrong < 1_000_000, "line {offset}: a pulse comes {wrong} ns early or late");
            }
            let up_s = uptime_s(program.link()) - up_before_s;
            assert!((up_s - began.elapsed().as_secs_f64()).abs() < 1.0, "up for {up_s} s more");

            // A stop has the wall clock's time of now, and its recording is the newest one.
            let ended_at = || recordings().first().map(|newest| newest.head.ended_at);
            let last = ended_at();
            assert_eq!(shutdown_of(client), "Missed scheduling of next digital out event");
            sysfs::wait_until("the recording is kept", || ended_at() != last);
            let newest = &recordings()[0];
            let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("after 1970");
            let ago_ms = (now.as_millis() as i64) - newest.head.utc_ms as i64;
            assert!((0..10_000).contains(&ago_ms), "stopped {ago_ms} ms ago");
            assert!(matches!(newest.head.end, End::Shutdown { .. }));
        }
        let log = program.log();
        assert!(!log.contains("stood still"), "{log}");
        // Its verdict on both stops: the host, which said nothing for a second.
        assert_eq!(log.matches("the host sent its last block 1.").count(), 2, "{log}");
        let _ = fs::remove_dir_all(STATE);
    }
}
