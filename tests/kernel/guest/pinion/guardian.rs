// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian: in every kind of end of the program, its outputs go to their shutdown values, and a restart claims
//! them.

use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::thread;
use std::time::Duration;

use nix::mount::{MntFlags, MsFlags, mount, umount2};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::outputs::Outputs;
use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, exists, run, shutdown_of};
use crate::sysfs;
use crate::trace::Trace;

/// The guardian's promise.
const WITHIN_US: u64 = 600_000;

/// Starts a program with its outputs on, ends it with a signal, and returns its log.
fn end_by(outputs: &Outputs, signal: Signal) -> String {
    let mut program = Program::with(&["-r"], &[("PINION_TEST_HANG", "1")]);
    let mut client = program.connect();
    outputs.switch_on(&mut client, 0);
    let guardian = program.guardian();
    let trace = Trace::start();
    outputs.wait_until_on();
    let began_us = sysfs::monotonic().as_micros() as u64;
    program.signal(signal);
    if signal == Signal::SIGSEGV {
        // Rust's handler treats the first signal as a possible stack overflow, and waits for the access to fail again.
        program.signal(signal);
    }
    let safe_us = outputs.assert_safe(&trace);
    assert!(safe_us - began_us < WITHIN_US, "{signal}: it took {} us", safe_us - began_us);
    sysfs::wait_until("the guardian is gone", || !exists(guardian));
    // SIGUSR2 makes the core hang, and SIGSTOP the whole program. The guardian then kills it.
    let hangs = [Signal::SIGUSR2, Signal::SIGSTOP].contains(&signal);
    let death = if hangs { Signal::SIGKILL } else { signal };
    assert_eq!(program.wait().signal(), Some(death as i32));
    println!("{signal}: safe after {} us", safe_us - began_us);
    program.log()
}

#[test]
fn killed_crashed_or_aborted_the_outputs_are_safe_and_free() {
    let outputs = Outputs::new();
    for signal in [Signal::SIGKILL, Signal::SIGSEGV, Signal::SIGABRT] {
        let log = end_by(&outputs, signal);
        assert!(log.contains("guardian: "), "{signal}: {log}");
        assert!(log.contains("outputs are driven to their shutdown values"), "{signal}: {log}");
    }
    // Each program after the first one had to claim the lines of the program before.
}

/// Beside heaters, fans and hardware PWM ([`Outputs`]): what else drives a line.
#[test]
fn a_killed_program_s_other_lines_go_to_their_shutdown_values() {
    let sim = GpioSim::new("lab", 8);
    let mut program = Program::start();
    let client = &mut program.connect();
    let output = |oid, pin, default| {
        format!("config_digital_out oid={oid} pin=lab/gpio{pin} value={default} default_value={default} max_duration=0")
    };
    configure(
        client,
        7,
        &[
            // It stays on.
            "set_digital_out pin=lab/gpio0 value=1".to_owned(),
            // The enable pin of a motor: high is off.
            output(0, 1, 1),
            "config_stepper oid=1 step_pin=lab/gpio2 dir_pin=lab/gpio3 invert_step=1 step_pulse_ticks=100".to_owned(),
            "config_spi oid=2 pin=lab/gpio4 cs_active_high=0".to_owned(),
            // An input becomes an output, and an output becomes an input.
            "config_endstop oid=3 pin=lab/gpio5 pull_up=0".to_owned(),
            output(4, 5, 0),
            output(5, 6, 1),
            "config_endstop oid=6 pin=lab/gpio6 pull_up=0".to_owned(),
        ],
    );
    run(client, "update_digital_out oid=0 value=0");
    run(client, "update_digital_out oid=4 value=1");
    assert_eq!([0, 1, 2, 4, 5].map(|offset| sim.level(offset)), [true, false, true, true, true]);
    let guardian = program.guardian();
    let trace = Trace::start();
    program.kill();
    sysfs::wait_until("the guardian is gone", || !exists(guardian));
    let last = |offset| trace.writes_to(sim.kernel_number(offset)).pop().map(|write| write.level);
    let expected = [Some(true), Some(true), Some(true), Some(false), Some(true), Some(false), None];
    assert_eq!([0, 1, 2, 3, 4, 5, 6].map(last), expected);
    program.wait_for_line(&["guardian: ", "all 6 outputs are driven to their shutdown values"]);
}

/// A program started now gets the lines.
fn assert_starts_anew(outputs: &Outputs) {
    let program = Program::start();
    outputs.switch_on(&mut program.connect(), 0);
}

/// Sends a signal to the guardian, for which the program stops with these words. Returns after how many milliseconds
/// the outputs are safe.
fn lose_guardian_by(signal: Signal, words: &str) -> u64 {
    let outputs = Outputs::new();
    let mut program = Program::start();
    let mut client = program.connect();
    outputs.switch_on(&mut client, 0);
    let guardian = program.guardian();
    let trace = Trace::start();
    outputs.wait_until_on();
    let began_us = sysfs::monotonic().as_micros() as u64;
    kill(guardian, signal).expect("a guardian");
    assert_eq!(shutdown_of(&mut client), "Guardian process lost");
    let safe_us = outputs.assert_safe(&trace);
    assert_eq!(program.wait().code(), Some(1));
    assert!(!exists(guardian), "it would keep the lines");
    program.wait_for_line(&["shutdown: Guardian process lost", words]);
    assert_starts_anew(&outputs);
    let after_ms = (safe_us - began_us) / 1000;
    println!("safe after {after_ms} ms");
    after_ms
}

/// A line that is on, without a limit (`max_duration`). Nothing else would notice lost time.
struct Heater {
    sim: GpioSim,
}

impl Heater {
    fn new() -> Heater {
        Heater { sim: GpioSim::new("lab", 8) }
    }

    fn switch_on(&self, program: &Program) -> pinion_client::Client {
        let mut client = program.connect();
        configure(&mut client, 1, &["config_digital_out oid=0 pin=lab/gpio0 value=0 default_value=0 max_duration=0"]);
        run(&mut client, "update_digital_out oid=0 value=1");
        assert!(self.is_on());
        client
    }

    fn is_on(&self) -> bool {
        self.sim.level(0)
    }

    /// The MCU is stopped and the program lives: the guardian did not treat it as hanging.
    fn assert_stopped_in_order(&self, mut program: Program, mut client: pinion_client::Client) {
        assert_eq!(shutdown_of(&mut client), "Rescheduled timer in the past");
        sysfs::wait_until("the heater is off", || !self.is_on());
        program.wait_for_line(&["Pinion stood still for"]);
        // The verdict cannot distinguish a control group from a virtual machine.
        let verdict = program.wait_for_line(&["Pinion and its guardian stood still for ", "a frozen control group"]);
        assert!(exists(program.guardian()));
        // Longer than both processes wait for each other.
        thread::sleep(Duration::from_secs(3));
        assert!(program.is_running());
        program.signal(Signal::SIGTERM);
        assert!(program.wait().success());
        assert!(!program.log().replace(&verdict, "").contains("guardian"), "{}", program.log());
    }
}

/// A separate control group (version 2).
struct ControlGroup;

impl ControlGroup {
    const ROOT: &str = "/tmp/cgroup";
    const GROUP: &str = "/tmp/cgroup/pinion";

    fn new() -> ControlGroup {
        fs::create_dir_all(Self::ROOT).expect("a folder");
        let none: Option<&str> = None;
        mount(Some("cgroup2"), Self::ROOT, Some("cgroup2"), MsFlags::empty(), none).expect("control groups");
        fs::create_dir(Self::GROUP).expect("a control group");
        ControlGroup
    }

    fn add(&self, process: Pid) {
        sysfs::write(Path::new(Self::GROUP).join("cgroup.procs"), process.to_string());
    }

    fn freeze(&self, frozen: bool) {
        let frozen = u8::from(frozen);
        sysfs::write(Path::new(Self::GROUP).join("cgroup.freeze"), frozen.to_string());
        let state = format!("frozen {frozen}");
        sysfs::wait_until(&state, || sysfs::read(Path::new(Self::GROUP).join("cgroup.events")).contains(&state));
    }
}

impl Drop for ControlGroup {
    fn drop(&mut self) {
        // Thaw it, or its processes could not even be killed.
        let _ = fs::write(Path::new(Self::GROUP).join("cgroup.freeze"), "0");
        let processes = fs::read_to_string(Path::new(Self::GROUP).join("cgroup.procs")).unwrap_or_default();
        for process in processes.lines() {
            let _ = fs::write(Path::new(Self::ROOT).join("cgroup.procs"), process);
        }
        let _ = fs::remove_dir(Self::GROUP);
        let _ = umount2(Self::ROOT, MntFlags::MNT_DETACH);
    }
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn a_core_that_hangs_is_noticed() {
        let outputs = Outputs::new();
        let log = end_by(&outputs, Signal::SIGUSR2);
        assert!(log.contains("outputs are driven to their shutdown values"), "{log}");
        assert_starts_anew(&outputs);
    }

    #[test]
    fn a_program_without_its_guardian_stops_and_says_so() {
        lose_guardian_by(Signal::SIGKILL, "somebody killed the guardian");
    }

    #[test]
    fn a_guardian_that_is_stopped_counts_as_lost() {
        // Its last check was at most 550 ms before.
        let after_ms = lose_guardian_by(Signal::SIGSTOP, "no heartbeat: was it stopped?");
        assert!((1400..2100).contains(&after_ms), "{after_ms} ms");
    }

    #[test]
    fn an_mcu_that_was_stopped_with_its_guardian_stops_when_both_go_on() {
        let heater = Heater::new();
        for guardian_first in [true, false] {
            let program = Program::start();
            let client = heater.switch_on(&program);
            let mut both = [program.guardian(), program.pid()];
            for process in both {
                kill(process, Signal::SIGSTOP).expect("a process");
            }
            thread::sleep(Duration::from_secs(20));
            assert!(heater.is_on(), "nobody is left who could switch it off");
            if !guardian_first {
                both.reverse();
            }
            for process in both {
                kill(process, Signal::SIGCONT).expect("a process");
            }
            heater.assert_stopped_in_order(program, client);
        }
    }

    #[test]
    fn an_mcu_whose_control_group_was_frozen_stops_when_it_is_thawed() {
        let heater = Heater::new();
        let program = Program::start();
        let group = ControlGroup::new();
        group.add(program.pid());
        group.add(program.guardian());
        let client = heater.switch_on(&program);
        // A freeze that is too short to be noticed.
        group.freeze(true);
        thread::sleep(Duration::from_millis(300));
        group.freeze(false);
        thread::sleep(Duration::from_secs(5));
        assert!(heater.is_on(), "{}", program.log());
        group.freeze(true);
        thread::sleep(Duration::from_secs(20));
        assert!(heater.is_on());
        group.freeze(false);
        heater.assert_stopped_in_order(program, client);
    }

    #[test]
    fn a_program_that_is_stopped_is_killed_and_its_outputs_are_safe() {
        let outputs = Outputs::new();
        let log = end_by(&outputs, Signal::SIGSTOP);
        assert!(log.contains("the core had no heartbeat for 550 ms"), "{log}");
        assert_starts_anew(&outputs);
    }
}
