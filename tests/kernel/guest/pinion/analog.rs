// SPDX-License-Identifier: GPL-3.0-or-later
//! Analog inputs on IIO devices.

use std::time::{Duration, Instant};

use nix::errno::Errno;
use pinion_client::Client;
use pinion_client::config::Config;
use pinion_client::motion::{MoveQueue, Profile, Stepper};

use crate::gpio_sim::GpioSim;
use crate::mock::adc;
use crate::program::{Program, configure, refusal, run, shutdown_of};
use crate::sysfs;
use crate::trace::Trace;

fn input(oid: usize, pin: &str) -> String {
    format!("config_analog_in oid={oid} pin={pin}")
}

/// Reads once every 5 ms from now on.
fn query(client: &mut Client, oid: usize) {
    let at = client.clock_in(0.05).expect("the clock").wire();
    run(
        client,
        &format!(
            "query_analog_in oid={oid} clock={at} sample_ticks=5000 sample_count=1 rest_ticks=250000 min_value=0 max_value=4095 range_check_count=0"
        ),
    );
}

fn reading(client: &mut Client, oid: u8) -> u16 {
    let until = Instant::now() + Duration::from_secs(5);
    let state = client.wait("analog_in_state", Some(oid), until).expect("a session").expect("a reading");
    state.int("value").expect("a reading") as u16
}

#[test]
fn channels_are_found_by_name_and_scaled_to_twelve_bits() {
    let _adcs = adc::Adcs::new();
    // Raw readings, and the values that the host gets for them.
    let channels: [(&str, [(i32, u16); 3]); 7] = [
        ("mock-adc12", [(0, 0), (2048, 2048), (4095, 4095)]),
        ("mock-adc8", [(1, 16), (128, 2056), (255, 4095)]),
        ("mock-adc10", [(1, 4), (512, 2050), (1023, 4095)]),
        ("mock-adc16", [(8, 0), (32768, 2048), (65535, 4095)]),
        ("mock-adc-s12", [(-5, 0), (1024, 2049), (2047, 4095)]),
        ("mock-adc-s16", [(-32768, 0), (16384, 2048), (32767, 4095)]),
        ("mock-adc-plain", [(0, 0), (100, 100), (4095, 4095)]),
    ];
    let program = Program::start();
    let client = &mut program.connect();
    let mut config: Vec<String> =
        channels.iter().enumerate().map(|(oid, (name, _))| input(oid, &format!("{name}/voltage5"))).collect();
    // The first device's channels also have the C program's names.
    config.push(input(7, "analog6"));
    configure(client, 8, &config);
    program.wait_for_line(&["does not report its resolution: 12 bits are assumed"]);
    for round in 0..3 {
        for (name, readings) in &channels {
            sysfs::write(adc::raw(name, 5), readings[round].0.to_string());
        }
        sysfs::write(adc::raw("mock-adc12", 6), (round * 1000).to_string());
        for (oid, (name, readings)) in (0..).zip(&channels) {
            query(client, oid);
            assert_eq!(reading(client, oid as u8), readings[round].1, "{name} at {}", readings[round].0);
            run(
                client,
                &format!(
                    "query_analog_in oid={oid} clock=0 sample_ticks=0 sample_count=0 rest_ticks=0 min_value=0 max_value=0 range_check_count=0"
                ),
            );
            client.drain();
        }
        query(client, 7);
        assert_eq!(usize::from(reading(client, 7)), round * 1000);
        run(
            client,
            "query_analog_in oid=7 clock=0 sample_ticks=0 sample_count=0 rest_ticks=0 min_value=0 max_value=0 range_check_count=0",
        );
        client.drain();
    }
}

#[test]
fn a_device_that_fails_or_disappears_stops_the_mcu_by_name() {
    let _adcs = adc::Adcs::new();
    let device = |name| adc::device(name).file_name().and_then(|name| name.to_str()).expect("a name").to_owned();
    let (first, second) = (device("mock-adc12"), device("mock-adc8"));
    let program = Program::start();
    let client = &mut program.connect();

    configure(client, 1, &[input(0, "mock-adc12/voltage3")]);
    query(client, 0);
    reading(client, 0);
    let failing = sysfs::set("/sys/devices/platform/mock-adc.0/fail", (Errno::EIO as i32).to_string(), "0");
    assert_eq!(shutdown_of(client), "Error on analog read");
    drop(failing);
    program.wait_for_line(&["shutdown: Error on analog read", &first, "mock-adc12", "voltage3", "EIO"]);

    let config = [input(0, "mock-adc8/voltage2")];
    configure(client, 1, &config);
    query(client, 0);
    reading(client, 0);
    let gone = adc::Gone::new("mock-adc.1");
    assert_eq!(shutdown_of(client), "Error on analog read");
    program.wait_for_line(&["shutdown: Error on analog read", &second, "mock-adc8", "voltage2"]);
    assert!(program.log().matches("shutdown: ").count() == 2, "the first reason is the last");
    configure(client, 1, &config);
    query(client, 0);
    assert_eq!(shutdown_of(client), "Error on analog read", "it is still gone");
    drop(gone);
    configure(client, 1, &config);
    query(client, 0);
    reading(client, 0);
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn channels_that_can_not_be_are_refused_and_the_log_says_why() {
        let _adcs = adc::Adcs::new();
        let program = Program::start();
        let client = &mut program.connect();
        assert_eq!(refusal(client, 1, &[input(0, "gpio3")]), "Unable to open adc device");
        program.wait_for_line(&["gpiochip0 line 3 is not an ADC channel"]);
        assert_eq!(refusal(client, 1, &[input(0, "33619967")]), "Unable to open adc device");
        program.wait_for_line(&["there is no channel 255 on iio:device255", "mock-adc12: voltage0 voltage1"]);
    }

    #[test]
    fn steps_do_not_wait_for_a_slow_reading() {
        let _adcs = adc::Adcs::new();
        const STEPS: u32 = 600;
        let sim = GpioSim::new("lab", 8);
        let program = Program::start();
        let client = &mut program.connect();
        let mut config = Config::default();
        let stepper = Stepper::configure(&mut config, "lab/gpio0", 0, "lab/gpio1", false, 100).expect("few objects");
        let oid = config.oid().expect("few objects");
        config.add(input(oid.into(), "mock-adc12/voltage0"));
        let status = config.apply(client).expect("a configuration that it takes");
        let delay = sysfs::set("/sys/devices/platform/mock-adc.0/delay_ms", "100", "0");
        query(client, oid.into());
        let trace = Trace::start();
        let even = Profile::trapezoid(STEPS, 1000.0, f64::INFINITY, 50e6).expect("a profile");
        MoveQueue::new(status.move_count).run(client, stepper, true, &even, None).expect("a move");
        drop(delay);
        let readings = client.drain().iter().filter(|response| response.name == "analog_in_state").count();
        assert!((4..=9).contains(&readings), "{readings} readings of 100 ms each in a second");
        let writes = trace.writes_to(sim.kernel_number(0));
        let rising: Vec<u64> = writes.iter().filter(|write| write.level).map(|write| write.at_ns).collect();
        assert_eq!(rising.len(), STEPS as usize);
        let longest = rising.windows(2).map(|pair| pair[1] - pair[0]).max().expect("steps");
        println!("{readings} readings, and at most {longest} ns between two steps");
        assert!(longest < 1_200_000, "{longest} ns between two steps of 1 ms");
    }
}
