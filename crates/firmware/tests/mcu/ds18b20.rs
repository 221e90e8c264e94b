// SPDX-License-Identifier: GPL-3.0-or-later
//! DS18B20 thermometers, with readings of 750 ms.

use pinion_testbench::rig::{Rig, hex};

const SERIAL: &str = "28-00000000100f";
const MS: u64 = 50_000;

/// A sensor with these readings. It ignores four failures in a row, as klippy configures it.
fn rig(answer_ms: u64, values: &[Option<i32>]) -> Rig {
    let mut rig = Rig::new();
    rig.bench.script_ds18b20(SERIAL, values);
    rig.bench.state().answer_ticks = (answer_ms * MS) as u32;
    rig.configure(&[&config(SERIAL)]);
    rig
}

fn config(serial: &str) -> String {
    format!("config_ds18b20 oid=0 serial={} max_error_count=4", hex(serial.as_bytes()))
}

/// Queries from 100 ms on, every three seconds.
fn query(min_value: i32, max_value: i32) -> String {
    format!(
        "query_ds18b20 oid=0 clock=@{} rest_ticks={} min_value={min_value} max_value={max_value}",
        100 * MS,
        3000 * MS
    )
}

fn reading(next_ms: u64, value: i32, fault: u8) -> String {
    format!("ds18b20_result oid=0 next_clock=@{} value={value} fault={fault}", next_ms * MS)
}

#[test]
fn a_temperature_is_reported_when_it_is_there_with_the_time_it_was_asked_for() {
    let mut rig = rig(750, &[Some(85_500), Some(-10_250)]);
    rig.send(&query(-55_000, 125_000));
    rig.sends_until(850 * MS - 1, &[]);
    rig.run_until(850 * MS);
    assert_eq!(rig.responses(), [reading(3100, 85_500, 0)]);
    rig.run_until(4000 * MS);
    assert_eq!(rig.responses(), [reading(6100, -10_250, 0)]);
}

#[test]
fn failures_are_reported_with_the_last_temperature_until_there_are_too_many() {
    let values = [Some(20_000), None, None, Some(21_000), None, None, None, None, None];
    let mut rig = rig(750, &values);
    rig.send(&query(0, 100_000));
    rig.run_until(22_000 * MS);
    let expected: Vec<String> = [(20, 0), (20, 1), (20, 2), (21, 0), (21, 1), (21, 2), (21, 3), (21, 4)]
        .iter()
        .zip(1..)
        .map(|((value, fault), n)| reading(100 + 3000 * n, value * 1000, *fault))
        .collect();
    assert_eq!(rig.responses(), expected);
    rig.stops_by(25_000 * MS, "Error reading DS18B20 sensor");
    let note = rig.notes().pop().unwrap();
    assert!(note.contains("wrong CRC") && note.contains("5 readings in a row"), "{note}");
}

#[test]
fn a_temperature_out_of_its_range_is_reported_and_stops_the_mcu() {
    for (value, ends) in [(4999, true), (5000, false), (30_000, false), (30_001, true)] {
        let mut rig = rig(750, &[Some(value)]);
        rig.send(&query(5000, 30_000));
        rig.run_until(850 * MS);
        let responses = rig.responses();
        assert_eq!(responses[0], reading(3100, value, 0));
        assert_eq!(responses.len() == 2, ends, "{value}");
        if ends {
            assert!(responses[1].ends_with("static_string_id=DS18B20 out of range"), "{responses:?}");
            let note = rig.notes().pop().unwrap();
            let celsius = f64::from(value) / 1000.;
            assert!(note.contains(&format!("it read {celsius} C where 5 C to 30 C is allowed")), "{note}");
        }
    }
}

#[test]
fn a_sensor_that_does_not_answer_stops_the_mcu() {
    let mut rig = rig(7000, &[Some(20_000)]);
    rig.send(&query(0, 100_000));
    // Queries at 100, 3100 and 6100 ms.
    rig.run_until(6099 * MS);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(6100 * MS, "DS18B20 sensor didn't respond in time");
    rig.sends_until(60_000 * MS, &[]);
}

#[test]
fn a_slow_reading_leaves_out_a_turn() {
    let mut rig = rig(4000, &[Some(20_000), Some(21_000)]);
    rig.send(&query(0, 100_000));
    rig.run_until(12_000 * MS);
    assert_eq!(rig.responses(), [reading(3100, 20_000, 0), reading(9100, 21_000, 0)]);
}

#[test]
fn a_reading_of_an_earlier_query_is_not_reported_and_steps_are_in_time() {
    let mut rig = Rig::new();
    rig.bench.script_ds18b20(SERIAL, &[Some(20_000)]);
    rig.bench.state().answer_ticks = 750 * MS as u32;
    rig.configure(&[&config(SERIAL), "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0"]);
    rig.send(&query(0, 100_000));
    rig.run_until(200 * MS);
    rig.send(&query(0, 100_000).replace(&format!("@{}", 100 * MS), &format!("@{}", 900 * MS)));
    rig.send_all(&["reset_step_clock oid=1 clock=@45000000", "queue_step oid=1 interval=100000 count=300 add=0"]);
    rig.run_until(2000 * MS);
    assert_eq!(rig.responses(), [reading(3900, 20_000, 0)]);
    assert!(rig.edges(1).iter().zip(1..).all(|((at, _), n)| *at == 45_000_000 + 100_000 * n));
    rig.send("query_ds18b20 oid=0 clock=@0 rest_ticks=0 min_value=0 max_value=0");
    rig.sends_until(60_000 * MS, &[]);
}

#[test]
fn what_can_not_be_configured() {
    for (serial, text) in [
        ("../28-00000000100f", "Invalid DS18B20 serial id, must not contain '/'"),
        ("28-1", "Invalid DS18B20 serial id, could not open for reading"),
        ("", "Invalid DS18B20 serial id, could not open for reading"),
    ] {
        let mut rig = Rig::new();
        rig.bench.script_ds18b20(SERIAL, &[Some(0)]);
        rig.refuses(&[&config(serial)], text);
    }
}
