// SPDX-License-Identifier: GPL-3.0-or-later
//! The program for an hour on a busy computer: it neither grows nor gets later. `make soak-real` runs it.

use std::env;
use std::fmt;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::config::Config;
use pinion_client::motion::{MoveQueue, Profile, Stepper};
use pinion_client::{Client, Error};

use crate::process::{Pinion, output};

/// How long each host lives.
const HOST_LIFE: Duration = Duration::from_secs(30);
/// The simulated printer accepts steps that are up to 100 ms late.
const ARRIVES_WITHIN: Duration = Duration::from_millis(200);
/// The highest growth of the program's own memory, in KiB.
const GROWTH_KIB: u64 = 1024;

/// stress-ng: processor, memory, disk, kernel and interrupts.
struct Load(Child);

impl Load {
    fn start(workers: u64, folder: &Path) -> Load {
        let workers = workers.to_string();
        let mut command = Command::new("nice");
        command.args(["-n", "19", "stress-ng", "--quiet", "--temp-path"]).arg(folder);
        for kind in ["--cpu", "--vm", "--hdd", "--io", "--timer", "--switch"] {
            command.args([kind, &workers]);
        }
        command.args(["--vm-bytes", "128M", "--hdd-bytes", "64M"]).stdout(Stdio::null());
        Load(command.spawn().expect("stress-ng is installed (make system-packages-stress)"))
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        let _ = kill(Pid::from_raw(self.0.id() as i32), Signal::SIGTERM);
        let _ = self.0.wait();
    }
}

/// The program at one time.
struct Row {
    seconds: u64,
    resident_kib: u64,
    anonymous_kib: u64,
    descriptors: usize,
    threads: usize,
    lateness: serde_json::Value,
    loadavg: String,
}

impl Row {
    const HEAD: &str =
        "     s   RSS KiB  own KiB  descriptors  threads   events  p50 us  p99 us  p99.9 us   max us  load";

    fn of(pinion: &Pinion, began: Instant) -> Row {
        let count = |what| fs::read_dir(format!("/proc/{}/{what}", pinion.pid())).unwrap().count();
        let link = pinion.link();
        let status = output(&["status", "--json", "-I", link.to_str().unwrap()]);
        let status: serde_json::Value = serde_json::from_slice(&status.stdout).unwrap();
        Row {
            seconds: began.elapsed().as_secs(),
            resident_kib: pinion.memory_kib("VmRSS"),
            anonymous_kib: pinion.memory_kib("RssAnon"),
            descriptors: count("fd"),
            threads: count("task"),
            lateness: status["lateness"].clone(),
            loadavg: fs::read_to_string("/proc/loadavg").unwrap().split(' ').next().unwrap().to_owned(),
        }
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let late = |key: &str| self.lateness[key].as_f64().unwrap_or(f64::NAN);
        write!(
            f,
            "{:6} {:9} {:8} {:12} {:8} {:8} {:7.1} {:7.1} {:9.1} {:8.1}  {}",
            self.seconds,
            self.resident_kib,
            self.anonymous_kib,
            self.descriptors,
            self.threads,
            late("timers"),
            late("p50_us"),
            late("p99_us"),
            late("p999_us"),
            late("max_us"),
            self.loadavg
        )
    }
}

/// The hosts' observations.
#[derive(Debug, Default)]
struct Tally {
    hosts: u32,
    steps: u64,
    /// Moves whose last steps were over 10 ms late.
    late_moves: u32,
    /// Hosts that sent their steps too late.
    late_hosts: u32,
}

/// A host that configures the MCU anew and moves two axes to and fro. A stop of the MCU is an error.
fn host(client: &mut Client, until: Instant, tally: &mut Tally) -> Result<(), Error> {
    let mut config = Config::default();
    let x = Stepper::configure(&mut config, "x_step", 0, "x_dir", false, 100)?;
    let y = Stepper::configure(&mut config, "y_step", 0, "y_dir", true, 100)?;
    let sensor = config.oid()?;
    config.add(format!("config_analog_in oid={sensor} pin=hotend_sensor"));
    let status = config.apply(client)?;
    let mut queue = MoveQueue::new(status.move_count);
    let profile = Profile::trapezoid(8000, 8000.0, 200_000.0, client.frequency_hz())?;
    while Instant::now() < until {
        for (stepper, positive) in [(x, true), (y, true), (x, false), (y, false)] {
            let moved = queue.run(client, stepper, positive, &profile, None);
            if let Err(Error::Plan { .. }) = moved {
                tally.late_moves += 1;
                client.listen(Instant::now() + ARRIVES_WITHIN)?;
            } else {
                moved?;
            }
            let position = if positive { profile.steps } else { 0 };
            assert_eq!(stepper.position(client)?, i64::from(position), "steps are lost");
            tally.steps += u64::from(profile.steps);
        }
    }
    Ok(())
}

fn number(name: &str, default: u64) -> u64 {
    env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

#[test]
#[ignore = "takes an hour: make soak-real"]
fn an_hour_on_a_busy_computer_neither_grows_nor_leaks() {
    let length = Duration::from_secs(60 * number("PINION_SOAK_MINUTES", 60));
    let realtime: &[&str] = if nix::unistd::geteuid().is_root() { &["-r"] } else { &[] };
    let pinion = Pinion::simulated(realtime);
    let folder = tempfile::tempdir().unwrap();
    let _load = Load::start(number("PINION_SOAK_WORKERS", 1), folder.path());
    let began = Instant::now();
    let (mut rows, mut tally) = (Vec::new(), Tally::default());
    println!("{}", Row::HEAD);
    while began.elapsed() < length || rows.len() < 2 {
        let mut client = pinion.client();
        tally.hosts += 1;
        match host(&mut client, Instant::now() + HOST_LIFE, &mut tally) {
            Ok(()) => {}
            // A host that gets no processor sends its steps too late. That is not Pinion's fault.
            Err(Error::Shutdown { reason }) if reason == "Timer too close" => tally.late_hosts += 1,
            Err(error) => panic!("{error}\n{}", pinion.log()),
        }
        let row = Row::of(&pinion, began);
        println!("{row}");
        rows.push(row);
        drop(client);
        thread::sleep(Duration::from_millis(100));
    }
    println!("{tally:?} in {:?}", began.elapsed());
    let (first, last) = (&rows[0], &rows[rows.len() - 1]);
    assert_eq!((last.descriptors, last.threads), (first.descriptors, first.threads));
    assert!(last.anonymous_kib <= first.anonymous_kib + GROWTH_KIB, "the program grows");
    assert!(last.resident_kib <= first.resident_kib + 4 * GROWTH_KIB, "the program grows");
}
