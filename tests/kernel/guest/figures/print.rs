// SPDX-License-Identifier: GPL-3.0-or-later
//! A print with the real klippy, from the computer's KLIPPER_DIR: what klippy and the MCU take of the processor, how
//! late the MCU is, and how long klippy may stall.

use std::collections::BTreeMap;
use std::env;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead, BufReader, Write as _};
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

use super::{Others, figure, is_pinion};
use crate::gpio_sim::GpioSim;
use crate::program::{self, Program};
use crate::sysfs;
use crate::trace::Trace;

/// See `PLACES` in `tests/kernel/klippy.rs`.
const PLACES: &str = "/tests/klippy";
const FOLDER: &str = "/tmp/print";
/// klippy ends each message of its socket with it.
const END: u8 = 3;
/// Time for klippy to start, and for the print to begin.
const BEGIN: Duration = Duration::from_secs(5);
/// How much longer the print's file is than the measured part.
const LONGER_S: f64 = 60.0;
/// The trace has room for the edges of four minutes.
const READ_TRACE: Duration = Duration::from_secs(60);
/// A heater's software PWM shows how late the MCU is: an edge each millisecond.
const PWM_LINE: u32 = 15;
const PWM_EDGE_NS: u64 = 1_000_000;

/// The measured part of a print: see `init.sh`.
fn span() -> Duration {
    Duration::from_secs(env::var("PRINT_SECONDS").ok().and_then(|text| text.parse().ok()).expect("a number of seconds"))
}

/// A print on four motors: a spiral at 100 mm/s, in lines of half a millimeter. X and Y make up to 8000 steps a second.
struct Print {
    klippy: Child,
    socket: BufReader<UnixStream>,
    program: Program,
    sim: GpioSim,
}

impl Print {
    fn start() -> Print {
        let places = sysfs::read(PLACES);
        let [python, search_path, klippy] = places.lines().collect::<Vec<_>>()[..] else { panic!("{places}") };
        let sim = GpioSim::new("lab", 16);
        let program = Program::measured();
        fs::create_dir_all(FOLDER).expect("a folder");
        let path = |name: &str| format!("{FOLDER}/{name}");
        let pin = |line: u32| format!("{}/gpio{line}", sim.chip_name());
        fs::write(path("printer.cfg"), printer(program.link().to_str().expect("text"), pin)).expect("a file");
        fs::write(path("print.gcode"), spiral()).expect("a file");
        let klippy = Command::new(python)
            .arg(format!("{klippy}/klippy.py"))
            .args([&path("printer.cfg"), "-l", &path("log"), "-a", &path("socket"), "-I", &path("pty")])
            .env("PYTHONPATH", search_path)
            .env("PYTHONHASHSEED", "1")
            .stdin(Stdio::null())
            .spawn()
            .expect("klippy");
        sysfs::wait_until("klippy listens", || UnixStream::connect(path("socket")).is_ok());
        let socket = BufReader::new(UnixStream::connect(path("socket")).expect("klippy's socket"));
        let mut print = Print { klippy, socket, program, sim };
        sysfs::wait_until("klippy is ready", || print.stop().is_none());
        print.ask(
            "gcode/script",
            json!({"script": "SET_KINEMATIC_POSITION X=100 Y=100 Z=5\nSDCARD_PRINT_FILE FILENAME=print.gcode"}),
        );
        sleep(BEGIN);
        print
    }

    /// klippy's answer to a request.
    fn ask(&mut self, method: &str, params: Value) -> Value {
        let request = json!({"id": 1, "method": method, "params": params}).to_string();
        self.socket.get_mut().write_all(&[request.as_bytes(), &[END]].concat()).expect("klippy listens");
        let mut answer = Vec::new();
        self.socket.read_until(END, &mut answer).expect("klippy answers");
        let answer: Value = serde_json::from_slice(answer.strip_suffix(&[END]).unwrap_or_default()).expect("JSON");
        assert!(answer["error"].is_null(), "{answer}");
        answer["result"].clone()
    }

    /// Why klippy is not ready, in a few words of its own.
    fn stop(&mut self) -> Option<String> {
        let info = self.ask("info", json!({}));
        let message = info["state_message"].as_str().unwrap_or_default();
        (info["state"] != "ready").then(|| message.lines().next().unwrap_or_default().to_owned())
    }

    /// Whether it prints. If it has stopped, that is the figure. Pinion must not stop.
    fn prints(&mut self, of: &str, case: &str) -> bool {
        if let Some(reason) = self.stop() {
            assert!(!is_pinion(), "{reason}");
            figure(of, case, &format!("stops: {reason}"));
            return false;
        }
        let status = self.ask("objects/query", json!({"objects": {"print_stats": ["state"]}}));
        assert_eq!(status["status"]["print_stats"]["state"], "printing");
        true
    }

    fn signal(&self, signal: Signal) {
        kill(self.klippy_pid(), signal).expect("klippy runs");
    }

    fn klippy_pid(&self) -> Pid {
        Pid::from_raw(self.klippy.id().try_into().expect("a process id"))
    }

    /// The processor time of klippy and of the MCU's threads so far, by name.
    fn cpu_time(&self) -> BTreeMap<String, Duration> {
        let mut times = BTreeMap::new();
        let mut add = |whose: &str, thread: Pid| {
            // Time on the processor in ns, time in its queue, number of turns.
            let ns = sysfs::read(format!("/proc/{thread}/schedstat"));
            let ns = ns.split(' ').next().and_then(|ns| ns.parse().ok()).expect("a time");
            *times.entry(whose.to_owned()).or_default() += Duration::from_nanos(ns);
        };
        program::threads(self.klippy_pid()).for_each(|thread| add("klippy", thread));
        for thread in self.program.threads() {
            add("the MCU", thread);
            add(&format!("the MCU: {}", sysfs::read(format!("/proc/{thread}/comm"))), thread);
        }
        times
    }
}

impl Drop for Print {
    fn drop(&mut self) {
        let _ = self.klippy.kill();
        let _ = self.klippy.wait();
        if thread::panicking() {
            println!("--- klippy's log\n{}---", fs::read_to_string(format!("{FOLDER}/log")).unwrap_or_default());
        }
    }
}

fn printer(link: &str, pin: impl Fn(u32) -> String) -> String {
    let mut text = format!(
        "[mcu]\nserial: {link}\n[printer]\nkinematics: cartesian\nmax_velocity: 300\nmax_accel: 3000\n\
         [force_move]\nenable_force_move: True\n[virtual_sdcard]\npath: {FOLDER}\n\
         [output_pin heater]\npin: {}\npwm: True\ncycle_time: 0.002\nvalue: 0.5\n",
        pin(PWM_LINE)
    );
    for (line, (axis, distance)) in (0..).step_by(3).zip([("x", 40), ("y", 40), ("z", 8), ("z1", 8)]) {
        let _ = write!(
            text,
            "[stepper_{axis}]\nstep_pin: {}\ndir_pin: {}\nmicrosteps: 16\nrotation_distance: {distance}\n",
            pin(line),
            pin(line + 1),
        );
        if axis != "z1" {
            let _ = write!(text, "endstop_pin: {}\nposition_endstop: 0\nposition_max: 200\n", pin(line + 2));
        }
    }
    text
}

fn spiral() -> String {
    const MM_S: f64 = 100.0;
    const LINE_MM: f64 = 0.5;
    const RADIUS_MM: f64 = 30.0;
    const LAYER_MM: f64 = 0.2;
    let mut text = format!("G90\nG1 F{}\n", MM_S * 60.0);
    for line in 0..((span().as_secs_f64() + LONGER_S) * MM_S / LINE_MM) as u32 {
        let turns = f64::from(line) * LINE_MM / (TAU * RADIUS_MM);
        let (y, x) = (turns * TAU).sin_cos();
        let [x, y] = [x, y].map(|part| 100.0 + RADIUS_MM * part);
        let _ = writeln!(text, "G1 X{x:.4} Y{y:.4} Z{:.4}", 5.0 + LAYER_MM * turns);
    }
    text
}

/// Prints, and figures how late the heater's edges were, beyond the earliest of them. The earliest is late by the time
/// that the program and the kernel need: see `edges_are_late`.
fn late_in_print(beside: &str) {
    const CASE: &str = "a heater's software PWM";
    let of = format!("{} s of a print {beside}", span().as_secs());
    let late_us = format!("{of}: edges late, us beyond the earliest: p50 / p99.9 / max");
    let mut print = Print::start();
    if !print.prints(&late_us, CASE) {
        return;
    }
    let trace = Trace::of_line(print.sim.kernel_number(PWM_LINE));
    let before = print.cpu_time();
    let from = Instant::now();
    let mut edges = Vec::new();
    while let Some(rest) = span().checked_sub(from.elapsed()).filter(|rest| !rest.is_zero()) {
        sleep(rest.min(READ_TRACE));
        edges = trace.writes();
    }
    let (span, after) = (from.elapsed(), print.cpu_time());
    if !print.prints(&late_us, CASE) {
        return;
    }
    for (whose, time) in after {
        let taken = time - before.get(&whose).copied().unwrap_or_default();
        let share = 100.0 * taken.as_secs_f64() / span.as_secs_f64();
        if share >= 0.05 {
            figure(&format!("{of}: share of the processor, %"), &whose, &format!("{share:.1}"));
        }
    }

    drop(trace);
    let first = edges.first().expect("the heater's PWM").at_ns;
    let half = (PWM_EDGE_NS / 2) as i64;
    let mut late: Vec<i64> =
        edges.iter().map(|edge| ((edge.at_ns - first) as i64 + half).rem_euclid(PWM_EDGE_NS as i64) - half).collect();
    late.sort_unstable();
    assert!(late.len() as u64 > span.as_nanos() as u64 / PWM_EDGE_NS * 9 / 10, "{} edges", late.len());
    let us = |share: f64| (late[((late.len() - 1) as f64 * share) as usize] - late[0]) as f64 / 1000.0;
    figure(&late_us, CASE, &format!("{:.2} / {:.2} / {:.2}", us(0.5), us(0.999), us(1.0)));
    assert!(!is_pinion() || us(0.999) <= 200.0, "late by {} us", us(0.999));
}

#[test]
fn shares() {
    late_in_print("with klippy");
}

#[test]
fn shares_beside_other_programs() {
    let _others = Others::start();
    late_in_print("beside programs that copy and compress");
}

/// Stops klippy for longer and longer.
#[test]
fn stalls() {
    const LONGER: Duration = Duration::from_millis(50);
    const RECOVER: Duration = Duration::from_secs(2);
    const OF: &str = "A print with klippy: it goes on after a stall of klippy, s";
    let mut print = Print::start();
    if !print.prints(OF, "4 motors") {
        return;
    }
    let mut held = Duration::ZERO;
    for number in 1..=40 {
        let stall = LONGER * number;
        print.signal(Signal::SIGSTOP);
        sleep(stall);
        print.signal(Signal::SIGCONT);
        sleep(RECOVER);
        if print.stop().is_some() {
            break;
        }
        held = stall;
    }
    figure(OF, "4 motors", &format!("{:.2}", held.as_secs_f64()));
    assert!(!is_pinion() || held >= LONGER);
}
