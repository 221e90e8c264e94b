// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion's outputs and inputs on GPIO chips, and the reasons for refusing some.

use std::os::unix::process::ExitStatusExt;
use std::process::Command;

use nix::errno::Errno;
use nix::sys::signal::Signal;
use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, exists, refusal, run, shutdown_of};
use crate::sysfs;
use crate::uapi::{self, BIAS_DISABLE, BIAS_PULL_DOWN, BIAS_PULL_UP};

fn output(oid: usize, pin: &str) -> String {
    format!("config_digital_out oid={oid} pin={pin} value=0 default_value=0 max_duration=0")
}

fn input(oid: usize, pin: &str, pull_up: i8) -> String {
    format!("config_endstop oid={oid} pin={pin} pull_up={pull_up}")
}

fn sees_high(client: &mut Client, oid: u8) -> bool {
    let args = [("oid", oid.into())];
    let state = client.query("endstop_query_state", &args, "endstop_state", Some(oid)).expect("a state");
    state.flag("pin_value").expect("a level")
}

#[test]
fn lines_are_found_by_number_by_name_and_by_the_chips_label() {
    let plain = GpioSim::new("plain", 8);
    let named = GpioSim::builder("pinctrl-lab", 64).name(17, "GPIO17").name(63, "HEATER").build();
    let program = Program::start();
    let client = &mut program.connect();
    let by_number = format!("{}/gpio3", plain.chip_name());
    let names = [by_number.as_str(), "plain/gpio7", "GPIO17", "HEATER", "pinctrl-lab/gpio40"];
    let lines = [(&plain, 3), (&plain, 7), (&named, 17), (&named, 63), (&named, 40)];
    configure(client, 5, &names.iter().enumerate().map(|(oid, name)| output(oid, name)).collect::<Vec<_>>());
    for (oid, (sim, offset)) in lines.into_iter().enumerate() {
        assert_eq!(uapi::line_info(&sim.path(), offset).consumer, "pinion");
        for value in [1, 0] {
            run(client, &format!("update_digital_out oid={oid} value={value}"));
            let levels = lines.map(|(sim, offset)| sim.level(offset));
            let expected = [0, 1, 2, 3, 4].map(|other| other == oid && value == 1);
            assert_eq!(levels, expected, "{}", names[oid]);
        }
    }
}

#[test]
fn an_output_stands_at_its_first_value_and_a_line_set_once_is_taken_over() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    let high = "config_digital_out oid=0 pin=lab/gpio1 value=1 default_value=0 max_duration=0";
    configure(
        client,
        2,
        &[
            "set_digital_out pin=lab/gpio0 value=1",
            "set_digital_out pin=lab/gpio2 value=0",
            high,
            "config_digital_out oid=1 pin=lab/gpio2 value=1 default_value=0 max_duration=0",
        ],
    );
    assert_eq!([0, 1, 2, 3].map(|offset| sim.level(offset)), [true, true, true, false]);
}

#[test]
fn inputs_have_the_bias_that_was_asked_for() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 3, &[input(0, "lab/gpio0", 1), input(1, "lab/gpio1", -1), input(2, "lab/gpio2", 0)]);
    let all = BIAS_PULL_UP | BIAS_PULL_DOWN | BIAS_DISABLE;
    let biases = [0, 1, 2].map(|offset| uapi::line_info(&sim.path(), offset).flags & all);
    assert_eq!(biases, [BIAS_PULL_UP, BIAS_PULL_DOWN, 0]);
    assert_eq!([0, 1].map(|oid| sees_high(client, oid)), [true, false]);
    for up in [true, false, true] {
        for oid in 0..3 {
            sim.pull(oid.into(), up);
            assert_eq!(sees_high(client, oid), up);
        }
    }
}

#[test]
fn a_line_in_use_is_refused_and_its_holder_named() {
    let sim = GpioSim::builder("lab", 8).name(4, "HEATER").hog(6, "spi0 CS1").build();
    let mut chip = gpio_cdev::Chip::new(sim.path()).expect("the chip");
    let held = chip.get_line(4).and_then(|line| line.request(gpio_cdev::LineRequestFlags::INPUT, 0, "octoprint"));
    let held = held.expect("a free line");
    let program = Program::start();
    let client = &mut program.connect();
    let line = |offset| format!("{} line {offset}", sim.chip_name());

    assert_eq!(refusal(client, 1, &[output(0, "HEATER")]), "Unable to open out GPIO chip line");
    program.wait_for_line(&["Unable to open out GPIO chip line", &line(4), "(HEATER)", "in use by \"octoprint\""]);
    assert_eq!(refusal(client, 1, &[input(0, "HEATER", 0)]), "Unable to open in GPIO chip line");
    program.wait_for_line(&["Unable to open in GPIO chip line", &line(4), "(HEATER)", "in use by \"octoprint\""]);
    assert_eq!(refusal(client, 1, &[output(0, "lab/gpio6")]), "Unable to open out GPIO chip line");
    program.wait_for_line(&[&line(6), "in use by \"spi0 CS1\""]);

    drop(held);
    configure(client, 1, &[output(0, "HEATER")]);
    let second = Program::start();
    assert_eq!(refusal(&mut second.connect(), 1, &[output(0, "HEATER")]), "Unable to open out GPIO chip line");
    second.wait_for_line(&[&line(4), "in use by \"pinion\""]);
}

#[test]
fn a_chip_that_goes_away_stops_the_mcu_and_a_restart_starts_anew() {
    let (kept, first, second) =
        (GpioSim::new("kept", 8), GpioSim::builder("first", 8).name(2, "FAN").build(), GpioSim::new("second", 8));
    let mut program = Program::start();
    let client = &mut program.connect();
    let pulses = |pin: &str| {
        [output(0, pin), output(1, "kept/gpio0"), "set_digital_out_pwm_cycle oid=0 cycle_ticks=500000".to_owned()]
    };
    let pulse = |client: &mut Client| {
        run(client, "update_digital_out oid=1 value=1");
        let at = client.clock_in(0.1).expect("the clock").wire();
        run(client, &format!("queue_digital_out oid=0 clock={at} on_ticks=250000"));
    };
    configure(client, 2, &pulses("FAN"));
    pulse(client);
    assert!(kept.level(0));
    first.unplug();
    assert_eq!(shutdown_of(client), "GPIO line write failed");
    program.wait_for_line(&["GPIO line write failed", first.chip_name(), "line 2 (FAN) can no longer be written"]);
    assert!(!kept.level(0), "the other chip's output is at its default");
    // The state of the fan's output is unknown: only the guardian handles it.
    assert_eq!(program.wait().signal(), Some(Signal::SIGKILL as i32));
    program.wait_for_line(&["only 1 of 2 outputs", first.chip_name(), "line 2: No such device"]);

    let mut program = Program::start();
    let client = &mut program.connect();
    configure(client, 3, &[output(0, "kept/gpio0"), input(1, "second/gpio1", 1), "config_trsync oid=2".to_owned()]);
    assert!(sees_high(client, 1));
    second.unplug();
    client.send_line("endstop_query_state oid=1").expect("a session");
    assert_eq!(shutdown_of(client), "GPIO line read failed");
    program.wait_for_line(&["GPIO line read failed", second.chip_name(), "line 1 can no longer be read"]);
    configure(client, 2, &pulses("kept/gpio1"));
    pulse(client);
    sysfs::wait_until("pulses are seen", || kept.level(1));
    assert!(program.is_running());
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn of_a_chip_that_came_after_the_start_the_status_knows_the_names() {
        // Every computer has names for the lines of nine chips, but not for the lines of a tenth chip.
        let before: Vec<GpioSim> = (0..9).map(|n| GpioSim::new(&format!("before{n}"), 1)).collect();
        let program = Program::start();
        let late = GpioSim::builder("late", 8).name(3, "LAMP").build();
        configure(&mut program.connect(), 1, &[output(0, "LAMP")]);
        let link = program.link().to_str().expect("a path");
        let answer = Command::new("pinion").args(["status", "--json", "-I", link]).output().expect("pinion");
        let status: serde_json::Value = serde_json::from_slice(&answer.stdout).expect("a status");
        let names = ["LAMP".to_owned(), "late/gpio3".to_owned(), format!("{}/gpio3", late.chip_name())];
        let pin = status["lines"][0]["pin"].as_str().expect("a line");
        assert!(names.iter().any(|name| name == pin), "{status}");
        assert!(status["board"].as_str().is_some_and(|board| board.contains("late (8 lines)")), "{status}");
        drop(before);
    }

    #[test]
    fn pins_that_can_not_be_are_refused_and_the_log_says_why() {
        let sim = GpioSim::builder("lab", 8).name(1, "FAN").build();
        let program = Program::start();
        let client = &mut program.connect();
        let chip = sim.chip_name();
        assert_eq!(refusal(client, 1, &[output(0, "gpiochip7/gpio3")]), "GPIO chip device not found");
        program.wait_for_line(&["there is no /dev/gpiochip7", &format!("{chip} (lab)")]);
        let beyond = format!("{chip}/gpio8");
        assert_eq!(refusal(client, 1, &[output(0, &beyond)]), "Unable to open out GPIO chip line");
        assert_eq!(refusal(client, 1, &[input(0, &beyond, 0)]), "Unable to open in GPIO chip line");
        program.wait_for_line(&[chip, "(lab) has no line 8, its lines are 0 to 7"]);
        assert_eq!(refusal(client, 1, &[output(0, "analog1")]), "Not an output pin");
        program.wait_for_line(&["analog1 (an ADC channel) cannot be an output"]);
        assert_eq!(refusal(client, 1, &[input(0, "pwmchip0/pwm1", 0)]), "Not an input pin");
        program.wait_for_line(&["pwmchip0/pwm1 (hardware PWM) cannot be an input"]);
        assert_eq!(
            refusal(client, 1, &["config_digital_out oid=0 pin=5000 value=0 default_value=0 max_duration=0"]),
            "Not an output pin"
        );
        program.wait_for_line(&["pin number 5000 (no pin has it)"]);

        configure(client, 2, &[output(0, "FAN"), input(1, "lab/gpio2", 1)]);
    }

    #[test]
    fn after_a_kill_a_restart_claims_the_lines() {
        let sim = GpioSim::new("lab", 8);
        let config = [output(0, "lab/gpio0"), input(1, "lab/gpio1", 1)];
        let mut program = Program::start();
        configure(&mut program.connect(), 2, &config);
        program.kill();
        let mut program = Program::start();
        let client = &mut program.connect();
        configure(client, 2, &config);
        run(client, "update_digital_out oid=0 value=1");
        assert!(sim.level(0));
        program.signal(Signal::SIGTERM);
        assert!(program.wait().success());
        assert_eq!(uapi::line_info(&sim.path(), 0).consumer, "");
    }

    /// The kernel cannot change a held line: Pinion releases it and requests it again.
    #[test]
    fn a_line_is_set_up_again_on_linux_before_5_5() {
        let sim = GpioSim::new("lab", 8);
        let mut program = Program::without_ioctl(uapi::GPIOHANDLE_SET_CONFIG, Errno::EINVAL);
        let client = &mut program.connect();
        // An input that becomes an output, an output that becomes an input, and an output that stays an output.
        let high = |oid, pin| format!("config_digital_out oid={oid} pin={pin} value=1 default_value=0 max_duration=0");
        configure(
            client,
            5,
            &[
                input(0, "lab/gpio0", 0),
                high(1, "lab/gpio0"),
                output(2, "lab/gpio1"),
                input(3, "lab/gpio1", 0),
                "set_digital_out pin=lab/gpio2 value=1".to_owned(),
                high(4, "lab/gpio2"),
            ],
        );
        assert!(sim.level(0) && sim.level(2));
        for up in [true, false, true] {
            sim.pull(1, up);
            assert_eq!(sees_high(client, 3), up);
        }
        run(client, "update_digital_out oid=4 value=0");
        run(client, "update_digital_out oid=4 value=1");
        assert!(sim.level(2));
        // The guardian has the present outputs.
        let guardian = program.guardian();
        program.kill();
        sysfs::wait_until("the guardian ends", || !exists(guardian));
        program.wait_for_line(&["guardian: ", "all 2 outputs are driven"]);
        assert!(!sim.level(0) && !sim.level(2));
    }
}
