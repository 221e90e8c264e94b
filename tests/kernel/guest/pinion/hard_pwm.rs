// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM. (`safe_state` and `guardian` test its shutdown.)

use std::os::unix::process::ExitStatusExt;
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::sys::signal::Signal;
use pinion_client::Client;

use crate::mock::pwm;
use crate::program::{Program, configure, exists, refusal, run, shutdown_of};
use crate::sysfs;

const CHIP: &str = "/sys/class/pwm/pwmchip0";
const ON: &str = "6 1000000 500000 1";
const OFF: &str = "6 1000000 500000 0";

fn config(pin: &str, cycle_ticks: u32) -> String {
    format!("config_pwm_out oid=0 pin={pin} cycle_ticks={cycle_ticks} value=8192 default_value=0 max_duration=10000000")
}

#[test]
fn a_channel_is_exported_and_driven() {
    let program = Program::start();
    let client = &mut program.connect();
    assert!(!std::path::Path::new(CHIP).join("pwm6").exists());
    configure(client, 1, &[config("pwmchip0/pwm6", 50_000)]);
    assert_eq!(pwm::output(6), "6 1000000 250000 1");
    for (value, state) in [(32768, "6 1000000 1000000 1"), (16384, "6 1000000 500000 1"), (0, "6 1000000 500000 0")] {
        let at = client.clock_in(0.05).expect("the clock").wire();
        run(client, &format!("queue_pwm_out oid=0 clock={at} value={value}"));
        sysfs::wait_until(state, || pwm::output(6) == state);
    }
    // Once more, at another rate, while it is exported.
    configure(client, 1, &[config("pwmchip0/pwm6", 5_000)]);
    assert_eq!(pwm::output(6), "6 100000 25000 1");
    let at = client.clock_in(0.05).expect("the clock").wire();
    run(client, &format!("queue_pwm_out oid=0 clock={at} value=16384"));
    assert_eq!(shutdown_of(client), "Missed scheduling of next hard pwm event");
    sysfs::wait_until("it is switched off", || pwm::output(6) == "6 100000 50000 0");
    drop(program);
    sysfs::write(format!("{CHIP}/unexport"), "6");
}

/// From now on the chip's driver fails.
fn fail() -> sysfs::Setting {
    sysfs::set("/sys/devices/platform/mock-pwm/fail", (Errno::EIO as i32).to_string(), "0")
}

fn switch_on(client: &mut Client) {
    configure(
        client,
        1,
        &["config_pwm_out oid=0 pin=pwmchip0/pwm6 cycle_ticks=50000 value=16384 default_value=0 max_duration=0"],
    );
    assert_eq!(pwm::output(6), ON);
}

#[test]
fn a_channel_that_is_set_anew_is_left_at_its_last_value_by_the_guardian() {
    let mut program = Program::start();
    let client = &mut program.connect();
    configure(client, 0, &["set_pwm_out pin=pwmchip0/pwm6 cycle_ticks=50000 value=8192"]);
    assert_eq!(pwm::output(6), "6 1000000 250000 1");
    run(client, "set_pwm_out pin=pwmchip0/pwm6 cycle_ticks=100000 value=16384");
    sysfs::wait_until("it is set anew", || pwm::output(6) == "6 2000000 1000000 1");
    let guardian = program.guardian();
    program.kill();
    sysfs::wait_until("the guardian ends", || !exists(guardian));
    program.wait_for_line(&["guardian: ", "all 1 outputs are driven"]);
    assert_eq!(pwm::output(6), "6 2000000 1000000 1");
    sysfs::write(format!("{CHIP}/unexport"), "6");
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn a_channel_that_goes_on_failing_is_left_to_the_guardian() {
        let mut program = Program::start();
        let client = &mut program.connect();
        switch_on(client);
        let guardian = program.guardian();
        let failing = fail();
        client.send_line("emergency_stop").expect("a session");
        assert_eq!(shutdown_of(client), "Command request");
        assert_eq!(program.wait().signal(), Some(Signal::SIGKILL as i32));
        program.wait_for_line(&[
            "guardian: ",
            "not yet at its shutdown value, trying for 2 s: pwmchip0/pwm6: Input/output error",
        ]);
        drop(failing);
        sysfs::wait_until("the guardian ends", || !exists(guardian));
        program.wait_for_line(&["is not at its shutdown value within 1000 ms", "all 1 outputs are driven"]);
        assert_eq!(pwm::output(6), OFF);
        switch_on(&mut Program::start().connect());
        sysfs::write(format!("{CHIP}/unexport"), "6");
    }

    /// A running fan or heater is neither switched off nor driven harder, not even for a moment.
    #[test]
    fn a_channel_that_runs_is_configured_anew_without_a_moment_off() {
        let part = |(period, duty, enabled): (u64, u64, bool)| if enabled { duty as f64 / period as f64 } else { 0.0 };
        for (before, after) in [(50_000, 50_000), (50_000, 5_000), (5_000, 50_000), (50_000, 40_000), (40_000, 50_000)]
        {
            // As a former program left it, such as before an upgrade.
            sysfs::write(format!("{CHIP}/export"), "6");
            for (file, value) in [("period", before * 20), ("duty_cycle", before * 5), ("enable", 1)] {
                sysfs::write(format!("{CHIP}/pwm6/{file}"), value.to_string());
            }
            pwm::forget();
            let program = Program::start();
            configure(&mut program.connect(), 1, &[config("pwmchip0/pwm6", after)]);
            let history = pwm::history(6);
            assert_eq!(pwm::output(6), format!("6 {} {} 1", after * 20, after * 5));
            assert_eq!(history.is_empty(), before == after, "{history:?}");
            assert!(history.iter().map(|state| part(*state)).all(|part| part > 0.0 && part <= 0.25), "{history:?}");
            drop(program);
            sysfs::write(format!("{CHIP}/unexport"), "6");
        }
    }

    #[test]
    fn channels_that_can_not_be_are_refused_and_the_log_says_why() {
        let program = Program::start();
        let client = &mut program.connect();
        for pin in ["pwmchip0/pwm8", "pwmchip5/pwm0"] {
            assert_eq!(refusal(client, 1, &[config(pin, 50_000)]), "Unable to config pwm device", "{pin}");
            program.wait_for_line(&["Unable to config pwm device", pin]);
        }
        assert_eq!(refusal(client, 1, &[config("gpio0", 50_000)]), "Unable to config pwm device");
        program.wait_for_line(&["gpiochip0 line 0 has no hardware PWM"]);
        assert_eq!(refusal(client, 1, &[config("pwmchip0/pwm6", 0)]), "Unable to config pwm device");
        program.wait_for_line(&["pwmchip0/pwm6", "a period of 0 ns", "choose another cycle_time"]);
        drop(program);
        sysfs::write(format!("{CHIP}/unexport"), "6");
    }

    #[test]
    fn a_channel_that_fails_stops_the_mcu_and_is_tried_again() {
        let mut program = Program::start();
        let client = &mut program.connect();
        switch_on(client);
        let failing = fail();
        let at = client.clock_in(0.05).expect("the clock").wire();
        client.send_line(&format!("queue_pwm_out oid=0 clock={at} value=8192")).expect("a session");
        let text = shutdown_of(client);
        program.wait_for_line(&[&text, "PWM output oid 0", "pwmchip0/pwm6: Input/output error"]);
        thread::sleep(Duration::from_millis(300));
        drop(failing);
        program.wait_for_line(&["PWM output oid 0", "has now reached its shutdown value"]);
        assert_eq!(pwm::output(6), OFF);
        thread::sleep(Duration::from_secs(2));
        assert!(program.is_running());
        assert!(!program.log().contains("guardian"), "{}", program.log());
        client.reset().expect("a reset");
        switch_on(client);
        drop(program);
        sysfs::write(format!("{CHIP}/unexport"), "6");
    }
}
