// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM outputs, checked tick by tick.

use pinion_testbench::board::PWM;
use pinion_testbench::rig::Rig;

/// A heater on hardware PWM. It is off by default and needs a refresh every 100000 ticks.
const HEATER: &str = "config_pwm_out oid=0 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=100000";

fn values(rig: &Rig) -> Vec<(u64, u16)> {
    std::mem::take(&mut rig.bench.state().pwm_values).into_iter().map(|(_, at, value)| (at, value)).collect()
}

#[test]
fn values_come_on_their_ticks() {
    let mut rig = Rig::configured(&[HEATER]);
    assert_eq!(values(&rig).len(), 1, "the first value");
    rig.send_all(&[
        "queue_pwm_out oid=0 clock=@1000 value=16384",
        "queue_pwm_out oid=0 clock=@1001 value=32768",
        "queue_pwm_out oid=0 clock=@90000 value=0",
    ]);
    rig.run_until(1_000_000);
    assert_eq!(values(&rig), [(1000, 16384), (1001, 32768), (90_000, 0)]);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_host_that_falls_silent_is_noticed_after_max_duration_and_the_output_goes_off() {
    let mut rig = Rig::configured(&[HEATER]);
    values(&rig);
    rig.send("queue_pwm_out oid=0 clock=@1000 value=16384");
    rig.run_until(100_999);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(200_000, "Missed scheduling of next hard pwm event");
    assert_eq!(values(&rig), [(1000, 16384), (101_000, 0)]);
}

#[test]
fn a_change_beyond_max_duration_is_refused() {
    let text = "Scheduled pwm event will exceed max_duration";
    let mut rig = Rig::configured(&[HEATER]);
    rig.send_all(&["queue_pwm_out oid=0 clock=@1000 value=1", "queue_pwm_out oid=0 clock=@101001 value=1"]);
    rig.stops_by(2_000, text);

    let mut rig = Rig::configured(&[HEATER]);
    rig.send("queue_pwm_out oid=0 clock=@1000 value=1");
    rig.run_until(2_000);
    rig.stops_on("queue_pwm_out oid=0 clock=@101001 value=1", text);
}

#[test]
fn a_channel_that_fails_stops_the_mcu() {
    let mut rig = Rig::configured(&[HEATER]);
    rig.bench.state().broken.insert(PWM);
    rig.send("queue_pwm_out oid=0 clock=@1000 value=1");
    rig.stops_by(2_000, "PWM write failed");
    let notes = rig.notes();
    let logged = notes.iter().any(|note| note.starts_with("trouble: PWM write failed: PWM output oid 0 (pwm0)"));
    assert!(logged, "it is still on: {notes:?}");
}

const SECOND: &str = "config_pwm_out oid=1 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=0";
const SET: &str = "set_pwm_out pin=500 cycle_ticks=50000 value=100";

/// Klipper allows this with `[duplicate_pin_override]`. Klipper's C then opens the channel again.
#[test]
fn two_objects_may_have_one_channel() {
    let mut rig = Rig::configured(&[HEATER, SECOND]);
    values(&rig);
    rig.send_all(&["queue_pwm_out oid=0 clock=@1000 value=5", "queue_pwm_out oid=1 clock=@2000 value=7"]);
    rig.run_until(3000);
    assert_eq!(values(&rig), [(1000, 5), (2000, 7)]);
    rig.send("emergency_stop");
    rig.run_until(4000);
    assert_eq!(values(&rig), [(3000, 0), (3000, 0)]);
}

#[test]
fn values_that_come_faster_than_the_driver_writes_are_out_of_date_and_left_out() {
    let mut rig = Rig::with_workers(5000, &[HEATER]);
    values(&rig);
    for n in 1..=9 {
        rig.send(&format!("queue_pwm_out oid=0 clock=@{} value={n}", 1000 * n));
    }
    rig.run_until(50_000);
    assert_eq!(values(&rig), [(6000, 1), (11_000, 6), (16_000, 9)]);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_channel_that_is_set_once_stays_and_may_be_set_again() {
    let mut rig = Rig::new();
    rig.bench.state().answer_ticks = 2000;
    rig.configure(&[SET, "set_pwm_out pin=500 cycle_ticks=50000 value=200"]);
    rig.run_until(10_000);
    rig.send("set_pwm_out pin=500 cycle_ticks=20000 value=300");
    rig.run_until(20_000);
    rig.send("emergency_stop");
    rig.stops_by(30_000, "Command request");
    // Before finalize_config the channel is set up again. Afterwards a worker sets it.
    assert_eq!(values(&rig), [(0, 100), (0, 200), (12_000, 300)]);
    assert_eq!(rig.bench.state().pwm_cycles[&PWM], 20_000);
}

#[test]
fn a_channel_that_was_set_and_fails_stops_the_mcu() {
    let mut rig = Rig::with_workers(2000, &[SET]);
    rig.bench.state().broken.insert(PWM);
    rig.send(SET);
    rig.stops_by(10_000, "PWM write failed");
}
