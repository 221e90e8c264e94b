// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs and inputs of pinctrl-bcm2835, seen and driven from outside.

use std::env;
use std::thread;
use std::time::{Duration, Instant};

use gpio_cdev::{Chip, LineRequestFlags};
use nix::sys::signal::Signal;
use pinion_client::Client;
use pinion_client::config::Config;
use pinion_client::motion::Endstop;

use super::outside::Outside;
use super::program::{Pinion, Way, both_ways};

const OUTPUT: u32 = 22;
const INPUT: u32 = 24;
/// The emulator reports an edge only if it differs from the last one, also of an earlier test.
const TOGGLED: u32 = 23;

both_ways!(
    an_output_is_seen_from_outside,
    a_stop_drives_an_output_to_its_shutdown_value,
    the_guardian_drives_an_output_when_pinion_is_killed,
    an_endstop_is_driven_from_outside,
    the_last_setup_of_a_shared_line_counts,
    a_stopped_program_is_killed_before_its_lines_are_free,
);

/// Waits for the result of another process.
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(10);
    while !condition() {
        assert!(Instant::now() < end, "waited in vain: {what}");
        thread::sleep(Duration::from_millis(20));
    }
}

/// One output with these initial and shutdown levels.
fn configure(client: &mut Client, value: u8, default_value: u8) -> u8 {
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!(
        "config_digital_out oid={oid} pin=gpio{OUTPUT} value={value} default_value={default_value} max_duration=0"
    ));
    config.apply(client).expect("a configuration");
    oid
}

fn update(client: &mut Client, oid: u8, value: u8) {
    client.send("update_digital_out", &[("oid", oid.into()), ("value", value.into())]).unwrap();
}

/// The board's features, from the kernel's command line.
fn expected(variable: &str) -> String {
    env::var(variable).unwrap_or_else(|_| panic!("{variable} is not on the kernel's command line"))
}

#[test]
fn the_chip_is_the_real_driver() {
    let mut chip = Chip::new("/dev/gpiochip0").expect("the chip");
    assert_eq!((chip.label(), chip.num_lines().to_string()), (&*expected("GPIO_CHIP"), expected("GPIO_LINES")));
    let line = chip.get_line(17).and_then(|line| line.info()).expect("the line");
    assert_eq!(line.name(), Some("GPIO17"));
}

#[test]
fn lines_go_by_number_by_name_and_by_chip() {
    let pinion = Pinion::start(Way::Kernel);
    let client = pinion.client();
    let command = |pin: &str| {
        let line = format!("config_digital_out oid=0 pin={pin} value=0 default_value=0 max_duration=0");
        client.messages().encode_line(&line).expect("a pin")
    };
    let by_label = format!("{}/gpio17", expected("GPIO_CHIP"));
    for name in ["gpiochip0/gpio17", "GPIO17", &by_label] {
        assert_eq!(command(name), command("gpio17"), "{name}");
    }
}

fn an_output_is_seen_from_outside(way: Way) {
    let mut outside = Outside::new();
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let oid = configure(&mut client, 1, 0);
    assert!(outside.level(OUTPUT), "its first level is the configured one");
    for value in [0, 1, 0, 1] {
        update(&mut client, oid, value);
        until("the output follows", || outside.level(OUTPUT) == (value == 1));
    }
    assert_eq!(outside.edges(OUTPUT), "0101");
}

fn a_stop_drives_an_output_to_its_shutdown_value(way: Way) {
    let mut outside = Outside::new();
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let oid = configure(&mut client, 0, 1);
    // A low that the emulator reports, whatever an earlier test left: see TOGGLED.
    for value in [1, 0] {
        update(&mut client, oid, value);
    }
    until("the output falls", || outside.edges(OUTPUT).ends_with('0'));
    client.emergency_stop().expect("a shutdown");
    until("the output rises", || outside.level(OUTPUT));
    assert!(outside.edges(OUTPUT).ends_with("01"));
}

fn the_guardian_drives_an_output_when_pinion_is_killed(way: Way) {
    let mut outside = Outside::new();
    let mut pinion = Pinion::start(way);
    let mut client = pinion.client();
    configure(&mut client, 1, 0);
    assert!(outside.level(OUTPUT));
    pinion.kill();
    until("the output falls", || !outside.level(OUTPUT));
}

fn an_endstop_is_driven_from_outside(way: Way) {
    let mut outside = Outside::new();
    outside.drive(INPUT, false);
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    for pull in [0, 1, -1] {
        let mut config = Config::default();
        let endstop = Endstop::configure(&mut config, &format!("gpio{INPUT}"), pull, false).unwrap();
        config.apply(&mut client).expect("a configuration");
        for level in [false, true, false] {
            outside.drive(INPUT, level);
            assert_eq!(endstop.triggered(&mut client).unwrap(), level, "pull {pull}");
        }
    }
}

fn the_last_setup_of_a_shared_line_counts(way: Way) {
    let mut outside = Outside::new();
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!("config_digital_out oid={oid} pin=gpio{OUTPUT} value=1 default_value=1 max_duration=0"));
    let endstop = Endstop::configure(&mut config, &format!("gpio{OUTPUT}"), 0, false).unwrap();
    config.apply(&mut client).expect("a configuration");
    for level in [false, true, false] {
        outside.drive(OUTPUT, level);
        // The line is an input now, so this drives nothing.
        update(&mut client, oid, u8::from(!level));
        assert_eq!(endstop.triggered(&mut client).unwrap(), level);
        assert_eq!(outside.level(OUTPUT), level);
    }
}

/// While the program stands still it does not beat, so the guardian drives its outputs. When another program can have
/// the lines, nobody writes them any more.
fn a_stopped_program_is_killed_before_its_lines_are_free(way: Way) {
    let mut outside = Outside::new();
    let mut pinion = Pinion::start(way);
    let mut client = pinion.client();
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!("config_digital_out oid={oid} pin=gpio{TOGGLED} value=0 default_value=0 max_duration=0"));
    config.add(format!("set_digital_out_pwm_cycle oid={oid} cycle_ticks={}", client.ticks(0.001)));
    config.apply(&mut client).expect("a configuration");
    let (at, on) = (client.clock_in(0.2).unwrap().wire(), client.ticks(0.0005));
    client.send("queue_digital_out", &[("oid", oid.into()), ("clock", at.into()), ("on_ticks", on.into())]).unwrap();
    until("it toggles", || outside.edges(TOGGLED).len() > 20);
    pinion.signal(Signal::SIGSTOP);
    let line = Chip::new("/dev/gpiochip0").and_then(|mut chip| chip.get_line(TOGGLED)).expect("the line");
    until("the line is free", || line.request(LineRequestFlags::INPUT, 0, "test").is_ok());
    assert!(pinion.has_ended());
    let edges = outside.edges(TOGGLED);
    assert!(edges.ends_with('0'), "its shutdown value");
    thread::sleep(Duration::from_millis(100));
    assert_eq!(outside.edges(TOGGLED), edges);
}
