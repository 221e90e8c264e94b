// SPDX-License-Identifier: GPL-3.0-or-later
//! Analog inputs, with an ADC that answers at once and with a slow ADC.

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::Rig;

const SENSOR: &str = "config_analog_in oid=0 pin=400";

/// Requests sums of four samples 1000 ticks apart, every 100000 ticks from tick 5000 on.
fn query(bytes_per_report: u8, min_value: u16, max_value: u16, range_check_count: u8) -> String {
    format!(
        "query_analog_in oid=0 clock=@5000 sample_ticks=1000 sample_count=4 rest_ticks=100000 \
         bytes_per_report={bytes_per_report} min_value={min_value} max_value={max_value} \
         range_check_count={range_check_count}"
    )
}

#[test]
fn a_report_is_the_sum_of_its_samples() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.bench.script_adc(ANALOG, &[4095, 4095, 4095, 4094, 1, 2, 3, 4, 0]);
    rig.send(&query(1, 0, 65535, 1));
    rig.sends_until(7999, &[]);
    rig.sends_until(8000, &["analog_in_state oid=0 next_clock=@105000 values=fb3f"]);
    rig.sends_until(108_000, &["analog_in_state oid=0 next_clock=@205000 values=0a00"]);
}

#[test]
fn readings_are_packed_until_the_next_does_not_fit() {
    for (bytes_per_report, per_report) in [(0, 1), (1, 1), (2, 1), (3, 1), (4, 2), (5, 2), (48, 24)] {
        let mut rig = Rig::configured(&[SENSOR]);
        rig.bench.script_adc(ANALOG, &[100]);
        rig.send(&query(bytes_per_report, 0, 65535, 1));
        rig.run_until(5000 + 100_000 * 48 - 1);
        let reports = rig.responses();
        assert_eq!(reports.len(), 48 / per_report, "{bytes_per_report} bytes");
        let values = "9001".repeat(per_report);
        assert!(reports.iter().all(|report| report.ends_with(&format!("values={values}"))), "{reports:?}");
    }
}

#[test]
fn more_bytes_than_a_report_has_are_refused() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.stops_on(&query(49, 0, 65535, 1), "Invalid analog_in bytes_per_report");
}

#[test]
fn what_was_refused_is_not_kept() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.bench.script_adc(ANALOG, &[100]);
    rig.send(&query(4, 0, 65535, 1));
    rig.stops_on(&query(255, 0, 65535, 1), "Invalid analog_in bytes_per_report");
    // The stopped MCU goes on sampling with the earlier settings, the same as a running one.
    rig.run_until(10_000_000);
    let reports = rig.responses();
    assert!(reports.len() > 30, "{reports:?}");
    assert!(reports.iter().all(|report| report.ends_with("values=90019001")), "{reports:?}");
}

#[test]
fn so_many_readings_in_a_row_may_be_out_of_range() {
    let mut rig = Rig::configured(&[SENSOR]);
    // The sums are 0, 0, 400, 0, 0, 0.
    rig.bench.script_adc(ANALOG, &[0, 0, 0, 0, 0, 0, 0, 0, 100, 100, 100, 100, 0]);
    rig.send(&query(1, 100, 1000, 3));
    rig.run_until(500_000);
    assert_eq!(rig.shutdown(), None);
    rig.run_until(507_999);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(508_000, "ADC out of range");
}

#[test]
fn the_limits_of_the_range_are_in_it() {
    for (value, ends) in [(99, true), (100, false), (200, false), (201, true)] {
        let mut rig = Rig::configured(&[SENSOR]);
        rig.bench.script_adc(ANALOG, &[value, 0, 0, 0, value]);
        rig.send(&query(1, 100, 200, 1));
        rig.run_until(10_000);
        assert_eq!(rig.shutdown().is_some(), ends, "{value}");
    }
}

#[test]
fn temperatures_are_reported_after_a_shutdown_too_and_the_reason_stays() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.bench.script_adc(ANALOG, &[50]);
    rig.send(&query(1, 300, 65535, 1));
    rig.stops_by(10_000, "ADC out of range");
    rig.run_until(310_000);
    let reports = rig.responses();
    assert_eq!(reports.len(), 3, "{reports:?}");
    assert!(reports[0].starts_with("analog_in_state oid=0 next_clock=@"));
    assert!(reports.iter().all(|report| report.ends_with("values=c800")));
}

#[test]
fn a_query_without_samples_ends_the_reports() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.send(&query(1, 0, 65535, 1));
    rig.run_until(6500);
    rig.send("query_analog_in oid=0 clock=@0 sample_ticks=0 sample_count=0 rest_ticks=0 bytes_per_report=0 min_value=0 max_value=0 range_check_count=0");
    rig.sends_until(500_000, &[]);
    rig.stops_on("emergency_stop", "Command request");
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn a_query_without_rest_reads_as_fast_as_the_adc_does_until_the_mcu_stops() {
    let mut rig = Rig::with_workers(3000, &[SENSOR]);
    rig.bench.script_adc(ANALOG, &[10]);
    rig.send("query_analog_in oid=0 clock=@5000 sample_ticks=0 sample_count=1 rest_ticks=0 bytes_per_report=1 min_value=0 max_value=65535 range_check_count=1");
    rig.run_until(65_100);
    assert!((18..=20).contains(&rig.responses().len()));
    rig.stall_until(6_000_000);
    rig.run_until(6_100_000);
    assert_eq!(rig.shutdown(), None, "it lags behind nothing");
    rig.send("emergency_stop");
    rig.sends_until(6_200_000, &["shutdown clock=@6100000 static_string_id=Command request"]);
    assert_eq!(rig.turn(), rig.mcu.next_timer(), "nothing is under way any more");
}

#[test]
fn reads_that_fail_for_100_ms_stop_the_mcu_and_reports_come_once_it_works_again() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.bench.script_adc(ANALOG, &[1]);
    rig.send(&query(1, 0, 65535, 1));
    rig.bench.state().broken.insert(ANALOG);
    // Sums without any reading are due every 100000 ticks from 5000 on.
    rig.sends_until(5_004_999, &[]);
    rig.stops_by(5_005_000, "Error on analog read");
    rig.sends_until(5_500_000, &[]);
    rig.bench.state().broken.clear();
    rig.run_until(5_800_000);
    assert_eq!(rig.responses().len(), 3);
}

#[test]
fn a_read_that_fails_is_tried_again_and_then_its_sum_is_left_out() {
    let mut rig = Rig::configured(&[SENSOR]);
    rig.bench.script_adc(ANALOG, &[1]);
    rig.send(&query(1, 0, 65535, 1));
    rig.bench.state().nacks.insert(ANALOG, 2);
    rig.sends_until(50_000, &["analog_in_state oid=0 next_clock=@105000 values=0400"]);
    rig.bench.state().nacks.insert(ANALOG, 3);
    rig.sends_until(250_000, &["analog_in_state oid=0 next_clock=@305000 values=0400"]);
    // One more failure, long after: it is the first of a new row.
    rig.run_until(6_000_000);
    rig.bench.state().nacks.insert(ANALOG, 3);
    rig.run_until(12_000_000);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn an_adc_that_takes_its_time_delays_samples_and_nothing_else() {
    // A reading takes 3000 ticks. So the four samples take 12000 ticks instead of 3000.
    let mut rig = Rig::with_workers(
        3000,
        &[SENSOR, "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0"],
    );
    rig.bench.script_adc(ANALOG, &[10]);
    rig.send(&query(1, 0, 65535, 1));
    rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=100 count=5000 add=0"]);
    rig.run_until(500_000);
    let reports = rig.responses();
    let expected: Vec<String> =
        (1..6).map(|n| format!("analog_in_state oid=0 next_clock=@{} values=2800", 5000 + 100_000 * n)).collect();
    assert_eq!(reports, expected);
    let edges = rig.edges(1);
    assert_eq!(edges.len(), 5000);
    assert!(edges.iter().zip(1..).all(|((at, _), n)| *at == 100 * n));
}

#[test]
fn an_adc_that_is_slower_than_the_reports_loses_some_and_no_step() {
    // A reading takes 60000 ticks. A report takes 240000 and is requested every 100000.
    let mut rig = Rig::with_workers(
        60_000,
        &[SENSOR, "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0"],
    );
    rig.bench.script_adc(ANALOG, &[10]);
    rig.send(&query(1, 0, 65535, 1));
    rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=1000 count=5000 add=0"]);
    rig.run_until(5_000_000);
    let reports = rig.responses();
    // Every third time slot is used: 5000, 305000, ...
    let expected: Vec<String> = (0..reports.len() as u64)
        .map(|n| format!("analog_in_state oid=0 next_clock=@{} values=2800", 305_000 + 300_000 * n))
        .collect();
    assert_eq!(reports, expected);
    assert_eq!(reports.len(), 16);
    assert!(rig.edges(1).iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
}

#[test]
fn an_answer_to_an_earlier_query_is_not_counted() {
    let mut rig = Rig::with_workers(3000, &[SENSOR]);
    rig.bench.script_adc(ANALOG, &[4000, 10]);
    rig.send(&query(1, 0, 65535, 1));
    rig.run_until(6000);
    rig.send(&query(1, 0, 65535, 1).replace("@5000", "@7000"));
    rig.sends_until(50_000, &["analog_in_state oid=0 next_clock=@107000 values=2800"]);
}
