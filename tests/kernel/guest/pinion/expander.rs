// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines of an I/O expander: an I2C chip with a driver that sleeps during a transfer.

use std::fs;
use std::ops::Range;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::signal::Signal;
use pinion_client::Client;
use pinion_client::config::Config;
use pinion_client::motion::{Endstop, HomingEnd, MoveQueue, Profile, Stepper};

use crate::gpio_sim::GpioSim;
use crate::mock::i2c;
use crate::program::{Program, configure, exists, refusal, run, shutdown_of};
use crate::sysfs;
use crate::trace::{Trace, Write};
use crate::uapi;

const MOCK: &str = "/sys/devices/platform/mock-i2c";
const ADDRESS: u16 = 0x50;
const LINES: u32 = 8;
/// The registers of a PCA9554, and their values after its reset.
const INPUT: u8 = 0;
const OUTPUT: u8 = 1;
const RESET: [u8; 4] = [0x00, 0xff, 0x00, 0xff];
/// The guardian's promise.
const WITHIN_US: u64 = 600_000;
/// How long a chip hangs, in milliseconds: far longer than any timeout.
const HANGS_MS: u64 = 12_000;

/// A PCA9554 on the mocked bus. It is removed when dropped.
struct Expander {
    adapter: PathBuf,
    chip_name: String,
}

impl Expander {
    fn new() -> Expander {
        let registers: Vec<u8> = [INPUT].into_iter().chain(RESET).collect();
        uapi::i2c_transfer(&i2c::bus(), ADDRESS, &registers, 0).expect("a register file");
        let adapter = sysfs::entry_with("/sys/bus/i2c/devices", "name", "mock-i2c");
        sysfs::write(adapter.join("new_device"), format!("pca9554 {ADDRESS:#x}"));
        let bus = adapter.file_name().and_then(|name| name.to_str()).expect("a name").replace("i2c-", "");
        let device = adapter.join(format!("{bus}-{ADDRESS:04x}"));
        let chip = fs::read_dir(device).expect("the chip's device").flatten().map(|entry| entry.file_name());
        let chip = chip.filter_map(|name| name.into_string().ok()).find(|name| name.starts_with("gpiochip"));
        Expander { adapter, chip_name: chip.expect("a GPIO chip") }
    }

    fn pin(&self, offset: u32) -> String {
        format!("{}/gpio{offset}", self.chip_name)
    }

    fn line(&self, offset: u32) -> String {
        format!("{} line {offset}", self.chip_name)
    }

    /// The level that the chip gives the line. Waits for the current transfer on the bus.
    fn level(&self, offset: u32) -> bool {
        let output = uapi::i2c_transfer(&i2c::bus(), ADDRESS, &[OUTPUT], 1).expect("the output register");
        output[0] >> offset & 1 != 0
    }

    /// Sets the levels at the chip's inputs from outside.
    fn set_inputs(&self, levels: u8) {
        sysfs::write(format!("{MOCK}/change"), format!("{ADDRESS:x} {INPUT:x} {levels:x}"));
    }

    /// From now on each of its transfers takes this long.
    fn slow_down(&self, delay_ms: u64) -> sysfs::Setting {
        sysfs::set(format!("{MOCK}/delay_ms"), delay_ms.to_string(), "0")
    }

    /// One of its next transfers is not acknowledged.
    fn miss_one(&self) {
        sysfs::write(format!("{MOCK}/fail"), format!("{} 1", Errno::ENXIO as i32));
    }

    /// From now on it does not acknowledge.
    fn fall_silent(&self) -> sysfs::Setting {
        sysfs::set(format!("{MOCK}/fail"), format!("{} 1000000", Errno::ENXIO as i32), "0 0")
    }

    fn is_held(&self) -> bool {
        let chip = Path::new("/dev").join(&self.chip_name);
        (0..LINES).any(|offset| !uapi::line_info(&chip, offset).consumer.is_empty())
    }

    /// Waits until no process is in its driver any more. A process that was killed during a transfer stays there until
    /// the transfer is over.
    fn wait_until_free(&self) {
        let until = Instant::now() + Duration::from_millis(2 * HANGS_MS);
        while self.is_held() && Instant::now() < until {
            thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Expander {
    fn drop(&mut self) {
        // The kernel would continue with a removed chip.
        self.wait_until_free();
        let _ = fs::write(self.adapter.join("delete_device"), format!("{ADDRESS:#x}"));
    }
}

fn output(oid: usize, pin: &str) -> String {
    format!("config_digital_out oid={oid} pin={pin} value=0 default_value=0 max_duration=0")
}

/// A program that has both a heater on a line of the processor and a fan on the expander. Dropped in this order.
struct Setup {
    program: Program,
    expander: Expander,
    sim: GpioSim,
    /// The kernel's number of the heater's line. It cannot be read while the chip hangs, because the kernel then reads
    /// every line.
    heater: u32,
}

impl Setup {
    /// Both are on.
    fn on() -> (Setup, Client) {
        let (sim, expander) = (GpioSim::new("lab", 8), Expander::new());
        let setup = Setup { program: Program::start(), expander, heater: sim.kernel_number(0), sim };
        let mut client = setup.program.connect();
        setup.switch_on(&mut client);
        (setup, client)
    }

    fn switch_on(&self, client: &mut Client) {
        configure(client, 2, &[output(0, "lab/gpio0"), output(1, &self.expander.pin(3))]);
        run(client, "update_digital_out oid=0 value=1");
        run(client, "update_digital_out oid=1 value=1");
        assert!(self.sim.level(0) && self.expander.level(3));
    }

    /// The fan's name in the log.
    fn fan(&self) -> String {
        format!("digital output oid 1 ({})", self.expander.pin(3))
    }

    /// Waits until the heater, which was on, is switched off: within this time after `began_us` (CLOCK_MONOTONIC).
    fn assert_heater_off(&self, trace: &Trace, began_us: u64, within_us: u64) {
        let first = || trace.writes_to(self.heater).first().copied();
        sysfs::wait_until("the heater is switched off", || first().is_some());
        let Write { level, at_ns, .. } = first().expect("a write");
        let took_us = at_ns / 1000 - began_us;
        println!("the heater is off after {took_us} us");
        assert!(!level && took_us < within_us, "{took_us} us");
    }

    /// A restarted program gets all lines when the chip's driver is free.
    fn assert_starts_anew(&self) {
        self.expander.wait_until_free();
        let program = Program::start();
        self.switch_on(&mut program.connect());
    }
}

fn now_us() -> u64 {
    sysfs::monotonic().as_micros() as u64
}

#[test]
fn an_axis_homes_to_an_endstop_on_it() {
    const SWITCH: u32 = 7;
    let (sim, expander) = (GpioSim::new("lab", 8), Expander::new());
    let program = Program::start();
    let client = &mut program.connect();
    let mut config = Config::default();
    let stepper = Stepper::configure(&mut config, "lab/gpio0", 0, "lab/gpio1", false, 100).expect("few objects");
    let endstop = Endstop::configure(&mut config, &expander.pin(SWITCH), 0, false).expect("few objects");
    let status = config.apply(client).expect("a configuration that it takes");
    let mut queue = MoveQueue::new(status.move_count);
    let profile = Profile::trapezoid(3000, 2000.0, 20_000.0, 50e6).expect("a profile");
    let step = sim.kernel_number(0);
    let _slow = expander.slow_down(5);
    assert!(!endstop.triggered(client).expect("a state"));
    let trace = Trace::start();
    let mut closed = None;
    let homed = queue.home(client, stepper, endstop, false, &profile, &mut |sight| {
        if closed.is_none() && sight.position <= -700 {
            expander.set_inputs(1 << SWITCH);
            closed = Some(Instant::now());
        }
    });
    let homed = homed.expect("a homing");
    assert_eq!(homed.reason, HomingEnd::Endstop);
    // Dated by the end of the read: a read that was due before the switch closed has also seen it.
    let dated = client.instant_of(homed.trigger.expect("a trigger"));
    let after = dated + Duration::from_micros(200) - closed.expect("a switch that closed");
    println!("dated {after:?} after the switch closed");
    assert!(after < Duration::from_millis(12), "{after:?}");
    assert!(endstop.triggered(client).expect("a state"));
    let rising = trace.writes_to(step).iter().filter(|write| write.level).count();
    assert_eq!(homed.position, -(rising as i64), "it is where the lines say");
    assert!((-3000..=-700).contains(&homed.position), "{}", homed.position);
}

#[test]
fn pulses_at_an_expander_are_polled() {
    let expander = Expander::new();
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 1, &[format!("config_counter oid=0 pin={} pull_up=0", expander.pin(2))]);
    program.wait_for_line(&["WARN", "its chip is behind a bus, so it is polled"]);
    let at = client.clock_in(0.02).expect("the clock").wire();
    // Polled every 20 ms, reported every 0.1 s.
    run(client, &format!("query_counter oid=0 clock={at} poll_ticks=1000000 sample_ticks=5000000"));
    let mut count = |expected: i64| {
        client.drain();
        let mut answer = None;
        for _ in 0..2 {
            let until = Instant::now() + Duration::from_secs(10);
            answer = client.wait("counter_state", Some(0), until).expect("a session");
        }
        assert_eq!(answer.expect("a state").int("count").expect("a count"), expected);
    };
    count(0);
    expander.set_inputs(1 << 2);
    count(1);
    expander.set_inputs(0);
    count(2);
}

/// A program that reads its inputs from the expander. In this order, the chip is dropped last.
fn with_inputs() -> (Expander, Program, Client) {
    let expander = Expander::new();
    let program = Program::start();
    let mut client = program.connect();
    configure_inputs(&mut client, &expander);
    // Long enough for the first queries.
    thread::sleep(Duration::from_millis(200));
    (expander, program, client)
}

/// Buttons, a homing endstop, a counter and a line of `set_digital_out`.
fn configure_inputs(client: &mut Client, expander: &Expander) {
    let pin = |offset| expander.pin(offset);
    configure(
        client,
        4,
        &[
            "config_buttons oid=0 button_count=1".to_owned(),
            format!("config_endstop oid=1 pin={} pull_up=0", pin(1)),
            "config_trsync oid=2".to_owned(),
            format!("config_counter oid=3 pin={} pull_up=0", pin(2)),
            format!("set_digital_out pin={} value=1", pin(3)),
        ],
    );
    run(client, &format!("buttons_add oid=0 pos=0 pin={} pull_up=0", pin(0)));
    let at = client.clock_in(0.05).expect("the clock").wire();
    // Every 2 ms.
    run(client, &format!("buttons_query oid=0 clock={at} rest_ticks=100000 retransmit_count=50 invert=0"));
    run(client, &format!("query_counter oid=3 clock={at} poll_ticks=100000 sample_ticks=5000000"));
}

/// Failed calls of the expander's lines, and their retries.
fn missed(program: &Program) -> (u64, u64) {
    let link = program.link().to_str().expect("a path");
    let answer = Command::new("pinion").args(["status", "--json", "-I", link]).output().expect("pinion");
    let status: serde_json::Value = serde_json::from_slice(&answer.stdout).expect("a status");
    let lines = status["lines"].as_array().expect("lines").iter();
    let counts: Vec<_> = lines.map(|line| &line["bus"]).filter(|bus| !bus.is_null()).collect();
    assert_eq!(counts.len(), 4, "{status:#}");
    let sum = |key: &str| counts.iter().map(|bus| bus[key].as_u64().expect("a count")).sum();
    (sum("errors"), sum("retries"))
}

/// The chip falls silent, and the MCU stops after a time in this range, in microseconds.
fn stops_silent(expander: &Expander, client: &mut Client, after_us: Range<u64>) -> sysfs::Setting {
    let silent = expander.fall_silent();
    let began_us = now_us();
    assert_eq!(shutdown_of(client), "GPIO line read failed");
    let took_us = now_us() - began_us;
    println!("stopped after {took_us} us");
    assert!(after_us.contains(&took_us), "{took_us} us");
    silent
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn an_emergency_stop_waits_for_no_chip_that_hangs() {
        let (mut setup, mut client) = Setup::on();
        let trace = Trace::start();
        let guardian = setup.program.guardian();
        let hangs = setup.expander.slow_down(HANGS_MS);
        let began_us = now_us();
        client.send_line("emergency_stop").expect("a session");
        setup.assert_heater_off(&trace, began_us, 50_000);
        // Only the fan's shutdown value is missing, and the guardian handles it.
        setup.program.wait_for_line(&["guardian: ", &setup.fan(), "is not at its shutdown value within 1000 ms"]);
        // One second for a shutdown value, two for the program's end, two for the chip.
        let acted_us = now_us() - began_us;
        println!("killed, and the chip given up, after {acted_us} us");
        assert!((4_900_000..5_500_000).contains(&acted_us), "{acted_us} us");
        setup.program.wait_for_line(&["only 1 of 2 outputs", &setup.expander.line(3), "its driver hangs"]);
        assert!(!exists(setup.program.pid()), "it is killed while the chip still hangs");
        sysfs::wait_until("the guardian ends", || !exists(guardian));
        assert!(now_us() - began_us < 1000 * HANGS_MS);
        drop(hangs);
        assert_eq!(setup.program.wait().signal(), Some(Signal::SIGKILL as i32));
        // The write that hung completes in the end.
        setup.expander.wait_until_free();
        assert!(!setup.expander.level(3));
        drop(trace);
        setup.assert_starts_anew();
    }

    #[test]
    fn a_chip_that_stays_silent_is_left_to_the_guardian_which_names_it() {
        let (mut setup, mut client) = Setup::on();
        let silent = setup.expander.fall_silent();
        let began_us = now_us();
        client.send_line("update_digital_out oid=1 value=0").expect("a session");
        assert_eq!(setup.program.wait().signal(), Some(Signal::SIGKILL as i32));
        let killed_us = now_us() - began_us;
        println!("killed after {killed_us} us");
        assert!((1_000_000..1_500_000).contains(&killed_us), "{killed_us} us");
        setup.program.wait_for_line(&["guardian: ", &setup.fan(), "is not at its shutdown value within 1000 ms"]);
        setup.program.wait_for_line(&["only 1 of 2 outputs", &setup.expander.line(3), "No such device or address"]);
        drop(silent);
        setup.assert_starts_anew();
    }

    #[test]
    fn a_program_that_ends_with_a_shutdown_value_owed_says_no_goodbye() {
        let (mut setup, _) = Setup::on();
        let guardian = setup.program.guardian();
        let silent = setup.expander.fall_silent();
        let trace = Trace::start();
        let began_us = now_us();
        setup.program.signal(Signal::SIGTERM);
        setup.assert_heater_off(&trace, began_us, 50_000);
        assert!(!setup.program.wait().success());
        // The chip is back while the guardian retries.
        drop(silent);
        sysfs::wait_until("the guardian ends", || !exists(guardian));
        setup.program.wait_for_line(&["guardian: ", &setup.fan(), "all 2 outputs are driven to their shutdown values"]);
        assert!(!setup.expander.level(3));
        drop(trace);
        setup.assert_starts_anew();
    }

    #[test]
    fn a_transfer_that_fails_is_tried_again_and_changes_nothing() {
        let (expander, program, mut client) = with_inputs();
        let client = &mut client;
        for count in 1..=10 {
            expander.miss_one();
            sysfs::wait_until("the transfer is tried again", || missed(&program) == (count, count));
        }
        for level in [false, true] {
            expander.miss_one();
            run(client, &format!("set_digital_out pin={} value={}", expander.pin(3), u8::from(level)));
            assert_eq!(expander.level(3), level);
        }
        expander.miss_one();
        client.drain();
        run(client, "endstop_query_state oid=1");
        expander.set_inputs(1);
        let until = Instant::now() + Duration::from_secs(5);
        let state = client.wait("buttons_state", Some(0), until).expect("a session").expect("a state");
        assert_eq!(state.bytes("state").expect("a state"), [1]);
        assert!(!client.status().expect("a session").is_shutdown, "{}", program.log());
        assert_eq!(missed(&program), (13, 13));
    }

    #[test]
    fn a_chip_that_hung_during_a_reset_keeps_no_line_once_it_is_back() {
        let (expander, program, mut client) = with_inputs();
        let client = &mut client;
        let hangs = expander.slow_down(HANGS_MS);
        thread::sleep(Duration::from_millis(50));
        client.reset().expect("a reset");
        drop(hangs);
        program.wait_for_line(&[&expander.chip_name, "does not answer"]);
        assert!(expander.is_held(), "the chip still hangs");
        expander.wait_until_free();
        assert!(!expander.is_held());
        configure_inputs(client, &expander);
        thread::sleep(Duration::from_millis(200));
        assert!(!client.status().expect("a session").is_shutdown);
    }

    #[test]
    fn a_killed_program_s_heater_waits_for_no_chip_that_hangs() {
        let (mut setup, mut client) = Setup::on();
        let trace = Trace::start();
        let guardian = setup.program.guardian();
        let hangs = setup.expander.slow_down(HANGS_MS);
        // A worker is in the driver while the MCU continues to run.
        let at = client.clock_in(0.1).expect("the clock").wire();
        run(&mut client, &format!("queue_digital_out oid=1 clock={at} on_ticks=0"));
        thread::sleep(Duration::from_secs(2));
        assert!(setup.sim.level(0) && setup.program.is_running());
        let began_us = now_us();
        setup.program.signal(Signal::SIGKILL);
        setup.assert_heater_off(&trace, began_us, WITHIN_US);
        setup.program.wait_for_line(&[
            "guardian: ",
            "only 1 of 2 outputs",
            &setup.expander.line(3),
            "its driver hangs",
        ]);
        sysfs::wait_until("the guardian ends", || !exists(guardian));
        assert!(!exists(setup.program.pid()));
        drop(hangs);
        drop(trace);
        setup.assert_starts_anew();
    }

    #[test]
    fn inputs_that_can_not_be_read_for_100_ms_stop_the_mcu() {
        let (expander, program, mut client) = with_inputs();
        let client = &mut client;
        let silent = stops_silent(&expander, client, 95_000..130_000);
        program.wait_for_line(&[
            "shutdown: GPIO line read failed",
            &expander.chip_name,
            "its chip does not answer",
            "check",
        ]);
        drop(silent);
        client.reset().expect("a reset");
        configure_inputs(client, &expander);
    }

    #[test]
    fn a_chip_that_does_not_acknowledge_stops_the_mcu_and_is_tried_again() {
        let (mut setup, mut client) = Setup::on();
        let silent = setup.expander.fall_silent();
        client.send_line("update_digital_out oid=1 value=0").expect("a session");
        assert_eq!(shutdown_of(&mut client), "GPIO line write failed");
        assert!(!setup.sim.level(0), "the heater is off");
        let (line, fan) = (setup.expander.line(3), setup.fan());
        let program = &mut setup.program;
        program.wait_for_line(&["shutdown: GPIO line write failed", &fan, &line, "its chip does not answer"]);
        thread::sleep(Duration::from_millis(300));
        assert!(!program.log().contains("has now reached"));
        drop(silent);
        program.wait_for_line(&[&fan, "has now reached its shutdown value"]);
        assert!(!setup.expander.level(3));
        // No help was necessary.
        thread::sleep(Duration::from_secs(2));
        assert!(program.is_running());
        assert!(!program.log().contains("guardian"), "{}", program.log());
        client.reset().expect("a reset");
        setup.switch_on(&mut client);
    }

    #[test]
    fn homing_stops_at_once_if_its_endstop_can_not_be_read() {
        let (expander, program, mut client) = with_inputs();
        let client = &mut client;
        let start = client.clock_in(0.05).expect("the clock").wire();
        run(client, &format!("trsync_start oid=2 report_clock={start} report_ticks=0 expire_reason=4"));
        // Every 2 ms.
        run(
            client,
            &format!(
                "endstop_home oid=1 clock={start} sample_ticks=750 sample_count=4 rest_ticks=100000 pin_value=1 trsync_oid=2 trigger_reason=1"
            ),
        );
        thread::sleep(Duration::from_millis(200));
        let _silent = stops_silent(&expander, client, 0..20_000);
        program.wait_for_line(&["shutdown: GPIO line read failed: endstop oid 1", "its chip does not answer", "check"]);
    }

    #[test]
    fn steps_beside_a_slow_output_are_in_time() {
        let (sim, expander) = (GpioSim::new("lab", 8), Expander::new());
        let program = Program::start();
        let client = &mut program.connect();
        let mut config = Config::default();
        Stepper::configure(&mut config, "lab/gpio0", 0, "lab/gpio1", false, 100).expect("few objects");
        config.oid().expect("few objects");
        config.add(output(1, &expander.pin(5)));
        config.apply(client).expect("a configuration that it takes");
        let step = sim.kernel_number(0);
        let _slow = expander.slow_down(50);
        sysfs::write(format!("{MOCK}/sent"), "0");
        let trace = Trace::start();
        let start = client.clock_in(0.2).expect("the clock").wire();
        for line in [
            format!("reset_step_clock oid=0 clock={start}"),
            "queue_step oid=0 interval=50000 count=1000 add=0".to_owned(),
            format!("queue_digital_out oid=1 clock={start} on_ticks=1"),
            format!("queue_digital_out oid=1 clock={} on_ticks=0", start.wrapping_add(client.ticks(0.3))),
        ] {
            run(client, &line);
        }
        // A command that makes the host wait.
        thread::sleep(Duration::from_millis(800));
        let began_us = now_us();
        run(client, "update_digital_out oid=1 value=1");
        assert!(now_us() - began_us >= 50_000, "it is acknowledged when it is done");
        thread::sleep(Duration::from_millis(500));
        sysfs::wait_until("all steps are made", || trace.writes_to(step).len() >= 2000);
        let edges = trace.writes_to(step);
        let rising: Vec<u64> = edges.iter().filter(|write| write.level).map(|write| write.at_ns / 1000).collect();
        assert_eq!(rising.len(), 1000);
        let worst = rising.iter().zip(0..).map(|(at_us, n)| (at_us - rising[0]).abs_diff(1000 * n)).max();
        println!("steps stray by {worst:?} us");
        assert!(worst.expect("steps") < 200, "{worst:?} us");
        let sent = sysfs::read(format!("{MOCK}/sent"));
        let outputs: Vec<&str> = sent.lines().filter(|line| line.starts_with("50 01 ")).collect();
        assert_eq!(outputs, ["50 01 ff", "50 01 df", "50 01 ff"]);
    }

    #[test]
    fn a_step_pin_on_it_is_refused_with_the_reason() {
        let (_sim, expander) = (GpioSim::new("lab", 8), Expander::new());
        let program = Program::start();
        let client = &mut program.connect();
        for (step, dir) in [(expander.pin(0), "lab/gpio1".to_owned()), ("lab/gpio0".to_owned(), expander.pin(1))] {
            let config =
                format!("config_stepper oid=0 step_pin={step} dir_pin={dir} invert_step=0 step_pulse_ticks=100");
            assert_eq!(refusal(client, 1, &[config]), "Unable to open out GPIO chip line");
        }
        for (pin, what) in [(0, "a step pin"), (1, "a dir pin")] {
            program.wait_for_line(&[&expander.pin(pin), what, "behind a bus", "choose a pin of the processor itself"]);
        }
        configure(client, 1, &[output(0, &expander.pin(0))]);
    }
}
