// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy and its MCU on two computers, over `pinion link`. A script is in the place of ssh. It delays the bytes.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, geteuid};

use super::Printer;
use super::links::print_a_while;
use crate::checkout;
use crate::klippy::{UNHOMED, WHERE_IT_STANDS, pinion_path, python};

/// A child that ends with its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // In order, so that it ends its own children and takes its link away.
        let _ = kill(Pid::from_raw(self.0.id() as i32), Signal::SIGTERM);
        let _ = self.0.wait();
    }
}

/// `pinion link` from `near` to the Pinion of `far`.
fn link(near: &Path, far: &Path, round_trip_ms: u32, jitter_ms: u32) -> Running {
    let pinion = pinion_path().to_str().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/klippy/delayed_ssh.py");
    let ssh = format!("{} {} {pinion} {round_trip_ms} {jitter_ms}", python(), script.display());
    // Only the network's delay counts, also on a busy computer. Real time is root's.
    let mut words = vec![pinion, "link", "toolhead", "--ssh", &ssh, "-I"];
    if geteuid().is_root() {
        words.splice(0..0, ["chrt", "--rr", "10"]);
    }
    let child = Command::new(words[0])
        .args(&words[1..])
        .arg(near)
        .arg("--remote")
        .arg(far)
        .stderr(File::create(near.with_extension("log")).unwrap())
        .spawn();
    Running(child.unwrap())
}

/// The path of the MCU's link in a configuration.
fn serial(config: &str) -> PathBuf {
    config.lines().find_map(|line| line.strip_prefix("serial: ")).unwrap().into()
}

/// The printer's only MCU is behind ssh.
fn far_printer(checkout: &Path, round_trip_ms: u32, jitter_ms: u32) -> (Running, PathBuf, Printer) {
    let mut started = None;
    let printer = Printer::start_with(checkout, |config| {
        let far = serial(&config);
        let near = far.with_file_name("near");
        started = Some((link(&near, &far, round_trip_ms, jitter_ms), near.clone()));
        config.replace(far.to_str().unwrap(), near.to_str().unwrap()) + UNHOMED
    });
    let (link, near) = started.unwrap();
    (link, near, printer)
}

#[test]
fn klippy_prints_over_ssh_and_returns_after_the_connection_was_lost() {
    let Some(checkout) = checkout("klippy_prints_over_ssh_and_returns_after_the_connection_was_lost") else { return };
    let (near, path, mut printer) = far_printer(&checkout, 2, 1);
    printer.until_state("ready");
    print_a_while(&mut printer);
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28 X");
    // The connection is cut: ssh, the child of `pinion link`, is killed.
    let children = std::fs::read_to_string(format!("/proc/{0}/task/{0}/children", near.0.id())).unwrap();
    let ssh = children.split_whitespace().next().unwrap().parse().unwrap();
    kill(Pid::from_raw(ssh), Signal::SIGKILL).unwrap();
    printer.until_state("shutdown");
    printer.host_log("Lost communication with MCU 'mcu'", 1);
    // klippy cannot reset an MCU that does not answer it, and FIRMWARE_RESTART takes this for a failure. A RESTART goes on
    // with the configuration that the MCU has.
    printer.restart("RESTART");
    printer.gcode("G28");
    let log = std::fs::read_to_string(path.with_extension("log")).unwrap();
    assert!(log.contains("round trip to toolhead: "), "{log}");
}

/// The delays that klippy tolerates: a table of round trips and results.
///
/// `PINION_SSH_MS="none 0+0 5+0 20+10"` has the round trips, each with the jitter of one direction. `none` is a pty
/// without `pinion link`: what fails there is this computer's fault.
#[test]
#[ignore = "a measurement of minutes"]
fn round_trips_that_klippy_lives_with() {
    let Some(checkout) = checkout("round_trips_that_klippy_lives_with") else { return };
    let trips = std::env::var("PINION_SSH_MS").unwrap_or_else(|_| "none 0+0 5+0 20+0 50+0 100+0 200+0".into());
    for trip in trips.split_whitespace() {
        let delay = trip.split_once('+');
        let delay = delay.map(|(round_trip, jitter)| (round_trip.parse().unwrap(), jitter.parse().unwrap()));
        println!("{trip} ms");
        alone(&checkout, delay);
        beside_another(&checkout, delay);
    }
}

/// Runs G-code, and says how it ended. False if klippy refused it.
fn tried(printer: &mut Printer, what: &str, script: &str) -> bool {
    let began = Instant::now();
    let result = printer.try_gcode(script);
    let is_done = result.is_ok();
    let why = result.err().map_or_else(|| "ok".to_owned(), |error| error.replace("\\n", " "));
    println!("  {what}: {} ({:.1} s)", why.get(..200).unwrap_or(&why), began.elapsed().as_secs_f64());
    let log = printer.log();
    for line in log.lines().filter(|line| !is_done && (line.contains("ERROR") || line.contains("block came"))) {
        println!("    {}", line.split_once(']').map_or(line, |(_, line)| line));
    }
    is_done
}

/// Whether klippy connects. It says how long that took.
fn connects(printer: &mut Printer) -> bool {
    let began = Instant::now();
    let state = printer.settled();
    println!("  connects: {state} ({:.1} s)", began.elapsed().as_secs_f64());
    state == "ready"
}

/// All of the printer is behind ssh.
fn alone(checkout: &Path, delay: Option<(u32, u32)>) {
    let (link, near, mut printer) = match delay {
        Some((round_trip_ms, jitter_ms)) => {
            let (link, near, printer) = far_printer(checkout, round_trip_ms, jitter_ms);
            (Some(link), Some(near), printer)
        }
        None => (None, None, Printer::start_with(checkout, |config| config + UNHOMED)),
    };
    if connects(&mut printer) && tried(&mut printer, "G28", "G28") {
        printer.gcode(WHERE_IT_STANDS);
        let zigzag: String = (0..200).map(|n| format!("G1 X{} F12000\n", 60 + n % 2)).collect();
        tried(&mut printer, "200 moves of 1 mm at 200 mm/s", &(zigzag + "M400"));
    }
    drop(link);
    let log = near.map(|near| std::fs::read_to_string(near.with_extension("log")).unwrap()).unwrap_or_default();
    if let Some(line) = log.lines().rfind(|line| line.contains("round trip")) {
        println!("  {}", line.split_once("INFO").unwrap().1.trim());
    }
}

/// Only an endstop is behind ssh. Its axis is not, so it never triggers.
fn beside_another(checkout: &Path, delay: Option<(u32, u32)>) {
    let mut started = None;
    let mut printer = Printer::start_with(checkout, |config| {
        let here = serial(&config);
        let [far, near] = ["far", "near"].map(|name| here.with_file_name(name));
        let child = Command::new(pinion_path())
            .args(["run", "--board", "sim", "-r", "-I"])
            .arg(&far)
            .stderr(Stdio::null())
            .spawn();
        let pinion = Running(child.unwrap());
        while !far.exists() {
            thread::sleep(Duration::from_millis(10));
        }
        let link = delay.map(|(round_trip_ms, jitter_ms)| link(&near, &far, round_trip_ms, jitter_ms));
        let serial = if link.is_some() { near } else { far };
        started = Some((link, pinion));
        config.replace("endstop_pin: x_endstop", "endstop_pin: far:x_endstop")
            + &format!("\n[mcu far]\nserial: {}\n", serial.display())
    });
    if connects(&mut printer) {
        // With every round trip in time klippy says that the endstop did not trigger.
        tried(&mut printer, "G28 X, endstop behind ssh", "G28 X");
    }
    drop(started);
}
