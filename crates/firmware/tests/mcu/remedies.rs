// SPDX-License-Identifier: GPL-3.0-or-later
//! The log's line about a shutdown names the thing that it is about, and the remedy.

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::Rig;

const STEPPER: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100";
const OUTPUT: &str = "config_digital_out oid=3 pin=20 value=0 default_value=0 max_duration=50000";
const PWM: &str = "config_pwm_out oid=6 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=50000";

/// Runs the commands. Returns the log's line about the shutdown that they end in.
fn log_of(objects: &[&str], commands: &[&str]) -> String {
    let mut rig = Rig::new();
    rig.send("allocate_oids count=10");
    rig.send_all(objects);
    rig.send("finalize_config crc=1");
    rig.bench.script_adc(ANALOG, &[9]);
    rig.send_all(commands);
    rig.run_until(1_000_000);
    let notes = rig.notes();
    let mut shutdowns = notes.iter().filter_map(|note| note.strip_prefix("shutdown: "));
    let shutdown = shutdowns.next().unwrap_or_else(|| panic!("no shutdown in {notes:?}")).to_owned();
    assert_eq!(shutdowns.next(), None);
    shutdown
}

#[test]
fn the_log_names_the_thing_and_the_remedy() {
    // The commands, the thing that the line names, and a word of its remedy.
    for (objects, commands, thing, remedy) in [
        // Pins.
        (
            &["config_digital_out oid=3 pin=399 value=0 default_value=0 max_duration=0"][..],
            &[][..],
            "pin 399",
            "choose",
        ),
        (&["config_endstop oid=3 pin=400 pull_up=0"], &[], "pin 400", "choose"),
        (&["config_analog_in oid=3 pin=7"], &[], "pin 7", "choose"),
        // Objects.
        (&["config_trsync oid=10"], &[], "oid 10", "FIRMWARE_RESTART"),
        (&["config_trsync oid=9", "config_trsync oid=9"], &[], "oid 9", "FIRMWARE_RESTART"),
        (&[], &["config_trsync oid=9"], "oid 9", "FIRMWARE_RESTART"),
        (&[STEPPER], &["trsync_trigger oid=0 reason=0"], "oid 0", "FIRMWARE_RESTART"),
        (&[STEPPER], &["trsync_trigger oid=77 reason=0"], "oid 77", "FIRMWARE_RESTART"),
        (&["allocate_oids count=1"], &[], "left its configuration unfinished", "FIRMWARE_RESTART"),
        (&[], &["finalize_config crc=1"], "finalize_config", "FIRMWARE_RESTART"),
        (&[], &["config_reset"], "config_reset", "emergency_stop"),
        (&[], &["clear_shutdown"], "clear_shutdown", "not stopped"),
        (&[], &["emergency_stop"], "the host", "FIRMWARE_RESTART"),
        // Steppers.
        (&[STEPPER], &["queue_step oid=0 interval=1 count=0 add=0"], "oid 0", "host"),
        (
            &[STEPPER],
            &[
                "reset_step_clock oid=0 clock=@0",
                "queue_step oid=0 interval=9000 count=1 add=0",
                "reset_step_clock oid=0 clock=@0",
            ],
            "oid 0",
            "host",
        ),
        (
            &["config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=60000"],
            &[
                "reset_step_clock oid=0 clock=@0",
                "queue_step oid=0 interval=9000 count=1 add=0",
                "queue_step oid=0 interval=1 count=1 add=0",
            ],
            "stepper oid 0 (gpio1)",
            "step_pulse_duration",
        ),
        (
            &[STEPPER, "config_trsync oid=1"],
            &["stepper_stop_on_trigger oid=0 trsync_oid=1", "stepper_stop_on_trigger oid=0 trsync_oid=1"],
            "oid 0",
            "host",
        ),
        (
            &[STEPPER],
            &["reset_step_clock oid=0 clock=@-999", "queue_step oid=0 interval=1 count=1 add=0"],
            "oid 0",
            "overloaded",
        ),
        // Outputs.
        (&[OUTPUT], &["queue_digital_out oid=3 clock=@1000 on_ticks=1"], "oid 3", "max_duration"),
        (
            &[OUTPUT],
            &["queue_digital_out oid=3 clock=@1000 on_ticks=1", "queue_digital_out oid=3 clock=@90000 on_ticks=1"],
            "oid 3",
            "max_duration",
        ),
        (
            &[OUTPUT],
            &["queue_digital_out oid=3 clock=@1000 on_ticks=1", "update_digital_out oid=3 value=0"],
            "oid 3",
            "host",
        ),
        (
            &[OUTPUT],
            &["queue_digital_out oid=3 clock=@1000 on_ticks=1", "set_digital_out_pwm_cycle oid=3 cycle_ticks=1"],
            "oid 3",
            "host",
        ),
        // PWM outputs.
        (&[PWM], &["queue_pwm_out oid=6 clock=@1000 value=1"], "PWM output oid 6 (pwm0): it was not", "overloaded"),
        (
            &[PWM],
            &["queue_pwm_out oid=6 clock=@1000 value=1", "queue_pwm_out oid=6 clock=@90000 value=1"],
            "oid 6",
            "max_duration of 1 ms",
        ),
        (&[], &["set_pwm_out pin=501 cycle_ticks=1 value=1"], "pwm1", "FIRMWARE_RESTART"),
        (&[], &["set_digital_out pin=77 value=1"], "gpio77", "FIRMWARE_RESTART"),
        // Analog inputs.
        (
            &["config_analog_in oid=4 pin=400"],
            &[
                "query_analog_in oid=4 clock=@1000 sample_ticks=0 sample_count=1 rest_ticks=90000 bytes_per_report=2 min_value=10 max_value=20 range_check_count=1",
            ],
            "analog input oid 4 (analog0): it read 9",
            "sensor",
        ),
        (
            &["config_analog_in oid=4 pin=400"],
            &[
                "query_analog_in oid=4 clock=@1000 sample_ticks=0 sample_count=1 rest_ticks=90000 bytes_per_report=49 min_value=0 max_value=20 range_check_count=1",
            ],
            "oid 4",
            "48",
        ),
        // SPI.
        (&["config_spi_without_cs oid=5", "spi_set_bus oid=5 spi_bus=7 mode=0 rate=1"], &[], "SPI bus 7", "choose"),
        (&["config_spi_without_cs oid=5", "spi_set_bus oid=5 spi_bus=0 mode=4 rate=1"], &[], "oid 5", "0 to 3"),
        (
            &[
                "config_spi_without_cs oid=5",
                "spi_set_bus oid=5 spi_bus=0 mode=0 rate=1",
                "spi_set_bus oid=5 spi_bus=0 mode=0 rate=1",
            ],
            &[],
            "oid 5",
            "bus",
        ),
        // The host.
        (&[], &["debug_read order=0 addr=0"], "debug_read", "remove the command"),
    ] {
        let log = log_of(objects, commands);
        let detail = log.split_once(": ").map_or("", |(_, detail)| detail);
        assert!(
            detail.contains(thing) && detail.contains(remedy),
            "{commands:?} of {objects:?}: {log:?} does not say {thing:?} and {remedy:?}"
        );
    }
}

#[test]
fn bytes_that_are_no_command_are_named() {
    let mut rig = Rig::new();
    rig.execute(&[0x9f, 0x7f]);
    assert_eq!(
        rig.notes(),
        [
            "shutdown: Invalid command: the host sent command 4095, which the dictionary does not have: restart the host, and it reads the dictionary again"
        ]
    );
    let mut rig = Rig::new();
    let payload = rig.encode("allocate_oids count=1000000");
    rig.execute(&payload[..2]);
    let notes = rig.notes();
    assert!(notes[0].contains("allocate_oids") && notes[0].contains("restart the host"), "{notes:?}");
}

#[test]
fn a_full_move_queue_is_named() {
    let mut rig = Rig::configured(&[STEPPER]);
    rig.send("reset_step_clock oid=0 clock=@0");
    for _ in 0..1026 {
        rig.send("queue_step oid=0 interval=9000 count=1 add=0");
    }
    let notes = rig.notes();
    assert!(notes.last().unwrap().contains("1024 moves") && notes.last().unwrap().contains("host"), "{notes:?}");
}

#[test]
fn an_mcu_that_is_late_says_how_late_and_why() {
    let mut rig = Rig::configured(&[OUTPUT, "set_digital_out_pwm_cycle oid=3 cycle_ticks=100"]);
    rig.send("queue_digital_out oid=3 clock=@1000 on_ticks=50");
    rig.run_until(2000);
    rig.stall_until(10_000_000);
    rig.run_until(10_000_001);
    let notes = rig.notes();
    assert!(
        notes.iter().any(|note| note.starts_with("shutdown: Missed") || note.contains("events are 19")),
        "{notes:?}"
    );
}
