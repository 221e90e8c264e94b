// SPDX-License-Identifier: GPL-3.0-or-later
//! DS18B20 thermometers on the stock w1_therm.

use std::time::{Duration, Instant};

use pinion_client::Client;

use crate::program::{Program, configure, refusal, run, shutdown_of};
use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-w1";

/// klippy's request: the name in hexadecimal.
fn config(oid: usize, name: &str) -> String {
    let serial: String = name.bytes().map(|byte| format!("{byte:02x}")).collect();
    format!("config_ds18b20 oid={oid} serial={serial} max_error_count=1")
}

fn sensor(number: usize) -> String {
    format!("28-00000000100{number}")
}

/// A reading every two seconds.
fn query(client: &mut Client, oid: usize, min_value: i32) {
    let at = client.clock_in(0.1).expect("the clock").wire();
    run(
        client,
        &format!("query_ds18b20 oid={oid} clock={at} rest_ticks=100000000 min_value={min_value} max_value=125000"),
    );
}

fn reading(client: &mut Client, oid: u8) -> (i64, i64) {
    let until = Instant::now() + Duration::from_secs(20);
    let result = client.wait("ds18b20_result", Some(oid), until).expect("a session").expect("a result");
    (result.int("value").expect("a number"), result.int("fault").expect("a number"))
}

#[test]
fn sensors_are_read_by_name_and_one_that_is_taken_away_stops_the_mcu() {
    for number in [1, 2] {
        let folder = format!("/sys/bus/w1/devices/{}", sensor(number));
        sysfs::wait_until("the bus was searched", || std::fs::exists(format!("{folder}/w1_slave")).unwrap_or(false));
    }
    sysfs::write(format!("{MOCK}/temperature"), "0 85500");
    sysfs::write(format!("{MOCK}/temperature"), "1 -10250");
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 2, &[config(0, &sensor(1)), config(1, &sensor(2))]);
    query(client, 0, -55_000);
    query(client, 1, -55_000);
    assert_eq!(reading(client, 0), (85_500, 0));
    assert_eq!(reading(client, 1), (-10_250, 0));
    sysfs::write(format!("{MOCK}/present"), "1 0");
    // One failure is allowed.
    let failed = reading(client, 1);
    let text = shutdown_of(client);
    sysfs::write(format!("{MOCK}/present"), "1 1");
    assert_eq!(failed, (-10_250, 1));
    assert_eq!(text, "Error reading DS18B20 sensor");
    program.wait_for_line(&["Error reading DS18B20 sensor", &sensor(2), "2 readings in a row"]);

    let refused = refusal(client, 1, &[config(0, "28-00000000ffff")]);
    assert_eq!(refused, "Invalid DS18B20 serial id, could not open for reading");
    program.wait_for_line(&["28-00000000ffff", &sensor(1), "correct serial_no"]);
    configure(client, 1, &[config(0, &sensor(1))]);
    query(client, 0, 90_000);
    assert_eq!(reading(client, 0), (85_500, 0));
    assert_eq!(shutdown_of(client), "DS18B20 out of range");
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_sensor_that_is_being_read_keeps_no_restart_waiting() {
        sysfs::wait_until("the bus was searched", || {
            std::fs::exists(format!("/sys/bus/w1/devices/{}/w1_slave", sensor(1))).unwrap_or(false)
        });
        sysfs::write(format!("{MOCK}/temperature"), "0 20000");
        let program = Program::start();
        let client = &mut program.connect();
        configure(client, 1, &[config(0, &sensor(1))]);
        query(client, 0, -55_000);
        // It measures from 100 to 850 ms.
        std::thread::sleep(Duration::from_millis(200));
        let began = Instant::now();
        client.reset().expect("a reset");
        configure(client, 1, &[config(0, &sensor(1))]);
        let took = began.elapsed();
        println!("restarted within {took:?}");
        assert!(took < Duration::from_millis(400), "{took:?}");
        query(client, 0, -55_000);
        assert_eq!(reading(client, 0), (20_000, 0));
        assert!(!program.log().contains("does not answer"), "{}", program.log());
    }
}
