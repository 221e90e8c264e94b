// SPDX-License-Identifier: GPL-3.0-or-later
//! A shutdown value that cannot be written is pending. It is retried, and nothing is forgotten before it is written.

use pinion_testbench::board::{PWM, SPI_CHIPS};
use pinion_testbench::rig::Rig;

const HEATER: &str = "config_digital_out oid=0 pin=20 value=1 default_value=0 max_duration=0";
const BED: &str = "config_pwm_out oid=1 pin=500 cycle_ticks=50000 value=100 default_value=0 max_duration=0";

/// A third of a second is six attempts.
const SOME_ATTEMPTS: u64 = 16_000_000;

#[test]
fn what_can_not_be_written_is_tried_again_until_it_is() {
    for (objects, broken, name) in [
        (&[HEATER][..], 20, "digital output oid 0 (gpio20)"),
        (&[BED], PWM, "PWM output oid 1 (pwm0)"),
        (
            &[
                "config_spi_without_cs oid=0",
                "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1",
                "config_spi_shutdown oid=1 spi_oid=0 shutdown_msg=01",
            ],
            SPI_CHIPS,
            "SPI shutdown message oid 1",
        ),
    ] {
        let mut rig = Rig::with_workers(1000, objects);
        rig.bench.state().broken.insert(broken);
        rig.send("emergency_stop");
        rig.run_until(SOME_ATTEMPTS);
        assert_eq!(rig.mcu.pending_value(), Some(name));
        rig.bench.state().broken.clear();
        rig.run_until(2 * SOME_ATTEMPTS);
        assert!(!rig.mcu.has_pending_values(), "{name}");
        let notes = rig.notes();
        let troubles: Vec<_> = notes.iter().filter(|note| note.starts_with("trouble: ")).collect();
        assert!(troubles.len() == 1 && troubles[0].contains(name), "{notes:?}");
        assert_eq!(*notes.last().unwrap(), format!("safe: {name}"));
        assert_eq!(rig.responses(), ["shutdown clock=@0 static_string_id=Command request"], "the host gets it once");
    }
}

#[test]
fn an_output_that_fails_keeps_no_other_one() {
    let mut rig = Rig::with_workers(
        1000,
        &[HEATER, BED, "config_digital_out oid=2 pin=21 value=1 default_value=0 max_duration=0"],
    );
    rig.bench.state().broken.insert(20);
    rig.send("emergency_stop");
    assert!(!rig.bench.level(21));
    rig.run_until(2000);
    assert_eq!(rig.bench.state().pwm_values.last(), Some(&(PWM, 1000, 0)));
}

#[test]
fn a_configuration_is_dropped_when_its_outputs_are_safe() {
    let mut rig = Rig::with_workers(1000, &[HEATER, BED]);
    rig.bench.state().broken.insert(20);
    rig.send("emergency_stop");
    rig.begin("config_reset");
    rig.run_until(SOME_ATTEMPTS);
    assert!(rig.mcu.is_held(), "the host waits");
    assert!(rig.mcu.is_shutdown());
    rig.bench.state().broken.clear();
    rig.run_until(2 * SOME_ATTEMPTS);
    assert!(!rig.mcu.is_held() && !rig.mcu.is_shutdown());
    assert!(!rig.bench.level(20));
    assert_eq!(rig.notes().last().unwrap(), "reset");
    rig.forget_responses();
    rig.configure(&[HEATER, BED]);
}

#[test]
fn a_reset_waits_for_no_more_than_the_last_writes() {
    let mut rig = Rig::with_workers(20_000, &[HEATER, BED]);
    rig.send_all(&["emergency_stop", "config_reset"]);
    assert_eq!(rig.now(), 20_000);
    rig.forget_responses();
    rig.configure(&[HEATER]);
}

/// After 20 timers in a row, then after every 100, Klipper's C checks if the next one is over 100 ms late.
#[test]
fn a_timer_that_repeats_in_the_past_stops_the_mcu_where_the_firmware_stops() {
    let pulses = |late_ticks: u64| {
        let mut rig = Rig::new();
        rig.configure(&[
            "config_digital_out oid=0 pin=20 value=0 default_value=0 max_duration=0",
            "set_digital_out_pwm_cycle oid=0 cycle_ticks=1000000",
        ]);
        let at = 100_000_000;
        rig.run_until(at - 1000);
        rig.send(&format!("queue_digital_out oid=0 clock=@{at} on_ticks=500000"));
        rig.stall_until(at + late_ticks);
        rig.run_turns(3);
        rig.shutdown()
    };
    // A cycle of 20 ms has two events. The twentieth event is 190 ms after the first.
    assert_eq!(pulses(28_000_000).as_deref(), Some("Rescheduled timer in the past"));
    assert_eq!(pulses(14_000_000), None);
}

/// The state after a host whose wire is cut at tick 0: a heater and a fan that are on, a motor that moves, and a motor
/// that homes with an endstop of another MCU.
#[test]
fn without_its_host_an_mcu_ends_what_was_begun() {
    const HEATER_PIN: u32 = 20;
    const FAN_PIN: u32 = 21;
    for heater_ticks in [90_000_u64, 0] {
        let mut rig = Rig::configured(&[
            &format!("config_digital_out oid=0 pin={HEATER_PIN} value=0 default_value=0 max_duration={heater_ticks}"),
            &format!("config_digital_out oid=1 pin={FAN_PIN} value=0 default_value=0 max_duration=0"),
            "config_stepper oid=2 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100",
            "config_stepper oid=3 step_pin=3 dir_pin=4 invert_step=0 step_pulse_ticks=100",
            "config_trsync oid=4",
        ]);
        rig.send_all(&[
            "update_digital_out oid=0 value=1",
            "update_digital_out oid=1 value=1",
            "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=4",
            "trsync_set_timeout oid=4 clock=@20500",
            "stepper_stop_on_trigger oid=3 trsync_oid=4",
            "reset_step_clock oid=2 clock=@0",
            "reset_step_clock oid=3 clock=@0",
            "queue_step oid=2 interval=1000 count=60 add=0",
            "queue_step oid=3 interval=1000 count=60 add=0",
        ]);
        rig.run_until(89_000);
        assert_eq!((rig.bench.level(HEATER_PIN), rig.bench.level(FAN_PIN)), (true, true));
        assert_eq!(rig.responses(), ["trsync_state oid=4 can_trigger=0 trigger_reason=4 clock=@20500"]);
        let stands = |rig: &mut Rig, oid| rig.ask(&format!("stepper_get_position oid={oid}"));
        assert_eq!(stands(&mut rig, 2), "stepper_position oid=2 pos=-60", "its queue is empty");
        assert_eq!(stands(&mut rig, 3), "stepper_position oid=3 pos=-20", "the other MCU is not heard any more");
        rig.run_until(10_000_000);
        let is_on = heater_ticks == 0;
        assert_eq!((rig.bench.level(HEATER_PIN), rig.bench.level(FAN_PIN)), (is_on, is_on));
        let text = (!is_on).then(|| "Missed scheduling of next digital out event".to_owned());
        assert_eq!(rig.shutdown(), text);
    }
}
