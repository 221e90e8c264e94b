// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM. (What becomes of it at a shutdown is in `safe_state` and `guardian`.)

use crate::program::{Program, configure, refusal, run, shutdown_of};
use crate::{pwm, sysfs};

const CHIP: &str = "/sys/class/pwm/pwmchip0";

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
    sysfs::write(format!("{CHIP}/unexport"), "6");
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
    sysfs::write(format!("{CHIP}/unexport"), "6");
}
