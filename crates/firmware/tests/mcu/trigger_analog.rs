// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing with the values of a sensor: an analog input, sampled every 10000 ticks from tick 100000 on. A stepper stops
//! on the trigger.

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::Rig;

const OBJECTS: &[&str] = &[
    "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0",
    "config_trsync oid=1",
    "config_analog_in oid=2 pin=400",
    "config_sos_filter oid=3 max_sections=1",
    "config_trigger_analog oid=4 sos_filter_oid=3",
];

const ABS_GE: u8 = 0;
const GT: u8 = 1;
const DIFF_PEAK_GT: u8 = 2;

/// Every 10000 ticks from 100000 on.
fn read(rig: &mut Rig, values: &[u16]) {
    rig.bench.script_adc(ANALOG, values);
    rig.send("query_analog_in oid=2 clock=@100000 sample_ticks=0 sample_count=1 rest_ticks=10000 bytes_per_report=2 min_value=0 max_value=65535 range_check_count=0");
}

/// Homes from `clock` on. The reason is 1 for a trigger, and 40 or more for errors.
fn home(rig: &mut Rig, clock: u64) {
    rig.send_all(&[
        "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=2",
        "stepper_stop_on_trigger oid=0 trsync_oid=1",
        "reset_step_clock oid=0 clock=@0",
        "queue_step oid=0 interval=1000 count=60000 add=0",
    ]);
    let clock = format!("clock=@{clock} monitor_ticks=10000 monitor_max=3");
    rig.send(&format!("trigger_analog_home oid=4 trsync_oid=1 trigger_reason=1 error_reason=40 {clock}"));
}

/// An MCU that homes while values come in: the values of the ADC minus `offset`.
fn homing(offset: i32, trigger_type: u8, trigger_value: i32, values: &[u16]) -> Rig {
    let mut rig = Rig::configured(OBJECTS);
    rig.send_all(&[
        "analog_in_attach_trigger_analog oid=2 trigger_analog_oid=4",
        &format!("sos_filter_set_offset_scale oid=3 offset={} scale=1 scale_frac_bits=0 auto_offset=0", -offset),
        "trigger_analog_set_raw_range oid=4 raw_min=10 raw_max=4000",
        &format!("trigger_analog_set_trigger oid=4 trigger_analog_type={trigger_type} trigger_value={trigger_value}"),
    ]);
    read(&mut rig, values);
    home(&mut rig, 95_000);
    rig
}

/// Runs for twenty samples. Returns the reason and the time of the trigger, if it came.
fn triggered(rig: &mut Rig) -> Option<(u8, u64)> {
    rig.edges(1);
    rig.run_until(300_000);
    let reports = rig.responses();
    let report = reports.iter().find(|report| report.starts_with("trsync_state"))?;
    let field = |name: &str| report.split_once(name).unwrap().1.split(' ').next().unwrap();
    let at = field(" clock=@").parse().unwrap();
    let last_step = rig.edges(1).last().map_or(0, |(last, _)| *last);
    assert!((at - 1000..=at).contains(&last_step), "the stepper stops: last step at {last_step}, trigger at {at}");
    Some((field("trigger_reason=").parse().unwrap(), at))
}

#[test]
fn the_enumerations_are_klippers() {
    let rig = Rig::new();
    let numbers = |name: &str| rig.dictionary().enumerations[name].to_string();
    assert_eq!(numbers("trigger_analog_type"), r#"{"abs_ge":0,"gt":1,"diff_peak_gt":2}"#);
    assert_eq!(numbers("trigger_analog_error:"), r#"{"RAW_RANGE":0,"OVERFLOW":1,"MONITOR":2,"SENSOR_SPECIFIC":3}"#);
}

#[test]
fn each_type_triggers_at_its_value() {
    // Values minus 1000, and the index of the sample that triggers.
    let cases: &[(u8, i32, &[u16], Option<u64>)] = &[
        (ABS_GE, 100, &[1000, 1099, 901, 1100, 1000], Some(3)),
        (ABS_GE, 100, &[1000, 1099, 901, 900, 1000], Some(3)),
        (ABS_GE, 0, &[1000], Some(0)),
        // A negative trigger value is beyond all numbers.
        (ABS_GE, -1, &[1000, 3000, 10], None),
        (GT, 100, &[1000, 900, 1100, 1101], Some(3)),
        (GT, -100, &[900, 899, 901], Some(2)),
        (DIFF_PEAK_GT, 100, &[1000, 1200, 1100, 1150, 1100, 1099], Some(5)),
        (DIFF_PEAK_GT, 0, &[1000, 1000, 1001, 1000], Some(3)),
        (DIFF_PEAK_GT, -1, &[1000, 3000, 10], None),
    ];
    for (trigger_type, trigger_value, values, expected) in cases {
        let mut rig = homing(1000, *trigger_type, *trigger_value, values);
        let expected = expected.map(|index| 100_000 + 10_000 * index);
        assert_eq!(triggered(&mut rig), expected.map(|at| (1, at)), "type {trigger_type}, {trigger_value}: {values:?}");
        let (homing, clock) = (u8::from(expected.is_none()), expected.unwrap_or(95_000));
        let state = rig.ask("trigger_analog_query_state oid=4");
        assert_eq!(state, format!("trigger_analog_state oid=4 homing={homing} homing_clock=@{clock}"));
    }
}

/// A type that never triggers would let a probe run into the bed.
#[test]
fn a_type_that_the_dictionary_does_not_have_is_refused() {
    let mut rig = homing(1000, GT, 100, &[1000]);
    rig.stops_on(
        "trigger_analog_set_trigger oid=4 trigger_analog_type=3 trigger_value=0",
        "Invalid trigger_analog_type",
    );
}

#[test]
fn samples_before_the_homing_clock_count_for_nothing() {
    let mut rig = Rig::configured(OBJECTS);
    rig.send_all(&[
        "analog_in_attach_trigger_analog oid=2 trigger_analog_oid=4",
        "sos_filter_set_offset_scale oid=3 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
        "trigger_analog_set_raw_range oid=4 raw_min=0 raw_max=4000",
        "trigger_analog_set_trigger oid=4 trigger_analog_type=1 trigger_value=500",
    ]);
    // One sample is out of range, two are above the trigger. Then homing begins with the sample of exactly this time.
    read(&mut rig, &[4001, 600, 600, 400, 600]);
    home(&mut rig, 130_000);
    assert_eq!(triggered(&mut rig), Some((1, 140_000)));
}

#[test]
fn a_trigger_is_of_the_instant_when_the_sample_was_read() {
    let mut rig = Rig::with_workers(3000, OBJECTS);
    rig.send_all(&[
        "analog_in_attach_trigger_analog oid=2 trigger_analog_oid=4",
        "sos_filter_set_offset_scale oid=3 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
        "trigger_analog_set_raw_range oid=4 raw_min=0 raw_max=4000",
        "trigger_analog_set_trigger oid=4 trigger_analog_type=1 trigger_value=500",
    ]);
    read(&mut rig, &[0, 600]);
    home(&mut rig, 95_000);
    assert_eq!(triggered(&mut rig), Some((1, 113_000)));
    assert_eq!(rig.ask("trigger_analog_query_state oid=4"), "trigger_analog_state oid=4 homing=0 homing_clock=@113000");
}

#[test]
fn a_sample_out_of_range_ends_homing_with_its_error() {
    for value in [9, 4001] {
        let mut rig = homing(0, GT, 3999, &[10, 3999, value, 4000]);
        assert_eq!(triggered(&mut rig), Some((40, 120_000)), "{value}");
        // The time of homing stays, because nothing was hit.
        let state = rig.ask("trigger_analog_query_state oid=4");
        assert_eq!(state, "trigger_analog_state oid=4 homing=0 homing_clock=@95000");
    }
}

#[test]
fn a_filter_that_overflows_ends_homing_with_its_error() {
    let mut rig = homing(0, GT, i32::MAX, &[1000]);
    rig.send("sos_filter_set_offset_scale oid=3 offset=2147482646 scale=1 scale_frac_bits=0 auto_offset=0");
    rig.bench.script_adc(ANALOG, &[1001, 1002]);
    assert_eq!(triggered(&mut rig), Some((41, 110_000)));
}

#[test]
fn a_sensor_that_falls_silent_ends_homing_with_its_error() {
    let mut rig = homing(0, GT, 4000, &[1000]);
    rig.run_until(151_000);
    rig.send("query_analog_in oid=2 clock=@0 sample_ticks=0 sample_count=0 rest_ticks=0 bytes_per_report=0 min_value=0 max_value=0 range_check_count=0");
    // The last sample was at 150000. The monitor checks at 155000. Its fourth check after that is one too many.
    assert_eq!(triggered(&mut rig), Some((42, 195_000)));
}

#[test]
fn a_sensor_that_is_not_there_ends_homing_too() {
    let mut rig = homing(0, GT, 4000, &[1000]);
    rig.send("query_analog_in oid=2 clock=@0 sample_ticks=0 sample_count=0 rest_ticks=0 bytes_per_report=0 min_value=0 max_value=0 range_check_count=0");
    assert_eq!(triggered(&mut rig), Some((42, 135_000)));
}

#[test]
fn values_go_through_the_active_sections_and_a_section_that_is_set_anew_through_none() {
    // The difference of two samples: klippy's derivative filter.
    let derivative = [
        "sos_filter_set_section oid=3 section_idx=0 sos0=1 sos1=-1 sos2=0 sos3=0 sos4=0",
        "sos_filter_set_state oid=3 section_idx=0 state0=0 state1=0",
        "sos_filter_set_offset_scale oid=3 offset=0 scale=1 scale_frac_bits=0 auto_offset=1",
        "sos_filter_set_active oid=3 n_sections=1 coeff_frac_bits=0",
    ];
    let values = [2000, 2040, 2080, 2131, 2131];
    let mut rig = homing(0, GT, 50, &values);
    rig.send_all(&derivative);
    assert_eq!(triggered(&mut rig), Some((1, 130_000)));
    let mut rig = homing(0, GT, 50, &values);
    rig.send_all(&derivative);
    rig.send(derivative[1]);
    // Without the section, only the offset of the first sample is left.
    assert_eq!(triggered(&mut rig), Some((1, 120_000)));
}

#[test]
fn an_end_of_homing_by_the_host_keeps_the_clock_and_ends_the_monitor() {
    let mut rig = homing(0, GT, 2000, &[1000, 3000]);
    rig.run_until(101_000);
    rig.send(
        "trigger_analog_home oid=4 trsync_oid=0 trigger_reason=0 error_reason=0 clock=0 monitor_ticks=0 monitor_max=0",
    );
    assert_eq!(triggered(&mut rig), None);
    assert_eq!(rig.ask("trigger_analog_query_state oid=4"), "trigger_analog_state oid=4 homing=0 homing_clock=@95000");
}

#[test]
fn homing_can_begin_anew_with_another_peak() {
    let mut rig = homing(0, DIFF_PEAK_GT, 100, &[1000, 2000, 1899, 1000, 1050, 949]);
    rig.run_until(125_000);
    assert!(rig.responses().iter().any(|report| report.contains("trigger_reason=1 clock=@120000")));
    rig.send_all(&[
        "reset_step_clock oid=0 clock=@126000",
        "trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=2",
        "trigger_analog_home oid=4 trsync_oid=1 trigger_reason=1 error_reason=40 clock=@126000 monitor_ticks=10000 monitor_max=3",
    ]);
    rig.run_until(149_000);
    assert!(!rig.responses().iter().any(|report| report.starts_with("trsync_state")));
    rig.run_until(150_000);
    assert!(rig.responses().iter().any(|report| report.contains("trigger_reason=1 clock=@150000")));
}

#[test]
fn a_shutdown_ends_homing_and_detaches_the_input() {
    let mut rig = homing(0, GT, 2000, &[1000, 1000, 3000]);
    rig.run_until(105_000);
    rig.send("emergency_stop");
    rig.run_until(400_000);
    let responses = rig.responses();
    assert!(!responses.iter().any(|report| report.starts_with("trsync_state")), "{responses:?}");
    assert!(responses.last().unwrap().starts_with("analog_in_state"), "temperatures go on");
    rig.send("config_reset");
    rig.configure(OBJECTS);
}

#[test]
fn what_is_named_must_be_of_its_kind() {
    for (configuration, commands) in [
        (&["config_trsync oid=0", "config_trigger_analog oid=1 sos_filter_oid=0"][..], &[][..]),
        (OBJECTS, &["analog_in_attach_trigger_analog oid=2 trigger_analog_oid=3"]),
        (
            OBJECTS,
            &[
                "trigger_analog_home oid=4 trsync_oid=3 trigger_reason=1 error_reason=2 clock=@5000 monitor_ticks=1 monitor_max=1",
            ],
        ),
    ] {
        let mut rig = Rig::new();
        rig.send("allocate_oids count=5");
        rig.send_all(configuration);
        rig.send_all(commands);
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid oid type"), "{configuration:?} {commands:?}");
    }
}

#[test]
fn homing_that_begins_in_the_past_is_too_close() {
    let mut rig = Rig::configured(OBJECTS);
    rig.run_until(50_000);
    rig.stops_on("trigger_analog_home oid=4 trsync_oid=1 trigger_reason=1 error_reason=2 clock=@49999 monitor_ticks=1 monitor_max=1", "Timer too close");
}
