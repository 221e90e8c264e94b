// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian has the value that a stop of the MCU writes, for each kind of output.

use pinion_testbench::board::PWM;
use pinion_testbench::rig::Rig;

const HEATER: u32 = 20;
const INVERTED: u32 = 21;
const PULSED: u32 = 22;
const STEP: u32 = 1;
const INVERTED_STEP: u32 = 3;
const ENABLE: u32 = 5;
const SELECT: u32 = 6;
const ON_EXPANDER: u32 = 27;

#[test]
fn the_guardian_has_the_value_that_a_stop_writes() {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(ON_EXPANDER);
    rig.configure(&[
        &format!("config_digital_out oid=0 pin={HEATER} value=0 default_value=0 max_duration=0"),
        &format!("config_digital_out oid=1 pin={INVERTED} value=1 default_value=1 max_duration=0"),
        &format!("config_digital_out oid=2 pin={PULSED} value=0 default_value=0 max_duration=0"),
        "set_digital_out_pwm_cycle oid=2 cycle_ticks=100000",
        &format!("config_stepper oid=3 step_pin={STEP} dir_pin=2 invert_step=0 step_pulse_ticks=100"),
        &format!("config_stepper oid=4 step_pin={INVERTED_STEP} dir_pin=4 invert_step=1 step_pulse_ticks=100"),
        // klippy's stepper_enable: high is off.
        &format!("config_digital_out oid=5 pin={ENABLE} value=1 default_value=1 max_duration=0"),
        &format!("config_spi oid=6 pin={SELECT} cs_active_high=0"),
        &format!("config_digital_out oid=7 pin={ON_EXPANDER} value=0 default_value=0 max_duration=0"),
        "config_pwm_out oid=8 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=0",
        "config_pwm_out oid=9 pin=501 cycle_ticks=50000 value=0 default_value=32768 max_duration=0",
    ]);
    let outputs = [HEATER, INVERTED, PULSED, STEP, INVERTED_STEP, ENABLE, SELECT, ON_EXPANDER];
    rig.send_all(&[
        "update_digital_out oid=0 value=1",
        "update_digital_out oid=1 value=0",
        "queue_digital_out oid=2 clock=@20000 on_ticks=50000",
        "reset_step_clock oid=3 clock=@0",
        "queue_step oid=3 interval=30000 count=1 add=0",
        "update_digital_out oid=5 value=0",
        "update_digital_out oid=7 value=1",
        "queue_pwm_out oid=8 clock=@20000 value=100",
        "queue_pwm_out oid=9 clock=@20000 value=100",
    ]);
    rig.run_until(30_050);
    let guarded = outputs.map(|pin| rig.bench.shutdown_value(pin));
    assert_eq!(guarded, [false, true, false, false, true, true, true, false]);
    let now = outputs.map(|pin| rig.bench.level(pin));
    assert_eq!(now, [true, false, true, true, true, false, true, true], "the host has switched them on");
    let last = |rig: &Rig, pin| rig.bench.state().pwm_values.iter().rev().find(|(of, ..)| *of == pin).unwrap().2;
    assert_eq!([PWM, PWM + 1].map(|pin| last(&rig, pin)), [100, 100]);

    rig.send("emergency_stop");
    rig.run_until(100_000);
    assert_eq!(outputs.map(|pin| rig.bench.level(pin)), guarded);
    let channels = [PWM, PWM + 1].map(|pin| rig.bench.state().pwm_shutdown_values[&pin]);
    assert_eq!(channels, [0, 32768]);
    assert_eq!([PWM, PWM + 1].map(|pin| last(&rig, pin)), channels);
}

/// `set_digital_out` and `set_pwm_out` set outputs that a stop leaves as they are: so does the guardian.
#[test]
fn an_output_that_a_stop_leaves_is_left_by_the_guardian() {
    let mut rig = Rig::new();
    rig.configure(&[
        &format!("set_digital_out pin={HEATER} value=0"),
        &format!("set_digital_out pin={HEATER} value=1"),
        "set_pwm_out pin=500 cycle_ticks=50000 value=77",
    ]);
    rig.send("emergency_stop");
    rig.run_until(10_000);
    assert!(rig.bench.level(HEATER) && rig.bench.shutdown_value(HEATER));
    assert_eq!(rig.bench.state().pwm_values.last().unwrap().2, 77);
    assert_eq!(rig.bench.state().pwm_shutdown_values[&PWM], 77);
}
