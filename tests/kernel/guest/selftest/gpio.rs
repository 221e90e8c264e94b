// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO chips, simulated by the kernel.

use std::io::Read;
use std::thread;
use std::time::Duration;

use gpio_cdev::{Chip, LineHandle, LineRequestFlags};
use nix::errno::Errno;
use nix::time::{ClockId, clock_gettime};

use crate::gpio_sim::GpioSim;
use crate::trace::Trace;
use crate::uapi::{self, BIAS_DISABLE, BIAS_PULL_DOWN, BIAS_PULL_UP};

fn request(sim: &GpioSim, offset: u32, flags: LineRequestFlags) -> Result<LineHandle, gpio_cdev::Error> {
    let line = Chip::new(sim.path())?.get_line(offset)?;
    line.request(flags, 0, "lab test")
}

fn output(sim: &GpioSim, offset: u32) -> LineHandle {
    request(sim, offset, LineRequestFlags::OUTPUT).expect("a free line")
}

fn input(sim: &GpioSim, offset: u32, bias: u32) -> LineHandle {
    let flags = LineRequestFlags::INPUT | LineRequestFlags::from_bits_retain(bias);
    request(sim, offset, flags).expect("a free line")
}

#[test]
fn a_chip_of_64_lines_has_their_names() {
    let sim = GpioSim::builder("pinctrl-lab", 64).name(0, "FIRST").name(17, "GPIO17").name(63, "LAST").build();
    let mut chip = Chip::new(sim.path()).expect("the chip");
    assert_eq!(chip.num_lines(), 64);
    assert_eq!(chip.label(), "pinctrl-lab");
    let mut name = |offset| {
        let info = chip.get_line(offset).and_then(|line| line.info()).expect("the line");
        info.name().map(str::to_owned)
    };
    assert_eq!(name(0).as_deref(), Some("FIRST"));
    assert_eq!(name(17).as_deref(), Some("GPIO17"));
    assert_eq!(name(18), None);
    assert_eq!(name(63).as_deref(), Some("LAST"));
}

#[test]
fn several_chips_keep_their_lines_apart() {
    let sims = ["first", "second", "third"].map(|label| GpioSim::new(label, 8));
    let handles = [0, 1, 2].map(|index| output(&sims[index], 3));
    handles[1].set_value(1).expect("a held line");
    assert_eq!([0, 1, 2].map(|index| sims[index].level(3)), [false, true, false]);
    for sim in &sims {
        let chip = Chip::new(sim.path()).expect("the chip");
        assert_eq!((chip.name(), chip.label()), (sim.chip_name(), sim.label()));
    }
}

#[test]
fn an_output_is_seen_from_outside() {
    let sim = GpioSim::new("lab", 8);
    let handle = output(&sim, 5);
    for level in [true, false, true] {
        handle.set_value(level.into()).expect("a held line");
        assert_eq!(sim.level(5), level);
    }
}

#[test]
fn an_input_follows_what_pulls_it() {
    let sim = GpioSim::new("lab", 8);
    let handle = input(&sim, 2, 0);
    for level in [true, false, true] {
        sim.pull(2, level);
        assert_eq!(handle.get_value().expect("a held line"), u8::from(level));
    }
}

#[test]
fn a_bias_is_seen_in_the_line_and_in_its_information() {
    let sim = GpioSim::new("lab", 8);
    for (bias, up) in [(BIAS_PULL_UP, true), (BIAS_PULL_DOWN, false)] {
        let handle = input(&sim, 1, bias);
        assert_eq!(handle.get_value().expect("a held line"), u8::from(up));
        assert_eq!(sim.is_pulled_up(1), up);
        let all = BIAS_PULL_UP | BIAS_PULL_DOWN | BIAS_DISABLE;
        assert_eq!(uapi::line_info(&sim.path(), 1).flags & all, bias);
    }
}

#[test]
fn a_held_line_names_its_consumer() {
    let sim = GpioSim::builder("lab", 8).name(4, "HEATER").build();
    assert_eq!(uapi::line_info(&sim.path(), 4).consumer, "");
    let handle = output(&sim, 4);
    let info = uapi::line_info(&sim.path(), 4);
    assert_eq!((info.name.as_str(), info.consumer.as_str()), ("HEATER", "lab test"));
    assert!(request(&sim, 4, LineRequestFlags::OUTPUT).is_err(), "held twice");
    drop(handle);
    output(&sim, 4);
}

#[test]
fn a_line_that_the_kernel_holds_is_refused() {
    let sim = GpioSim::builder("lab", 8).hog(6, "spi0 CS1").build();
    assert_eq!(uapi::line_info(&sim.path(), 6).consumer, "spi0 CS1");
    assert!(request(&sim, 6, LineRequestFlags::OUTPUT).is_err(), "held twice");
}

#[test]
fn a_chip_that_goes_away_fails_its_held_lines() {
    let sim = GpioSim::new("lab", 8);
    let handle = output(&sim, 0);
    sim.unplug();
    assert!(!sim.path().exists());
    let error = handle.set_value(1).expect_err("no such line any more");
    assert!(format!("{error:?}").contains(&format!("{:?}", Errno::ENODEV)), "{error:?}");
}

#[test]
fn every_write_is_traced_with_its_time() {
    let sim = GpioSim::new("lab", 8);
    let handle = output(&sim, 7);
    let now_ns = || {
        let now = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("the clock");
        u64::try_from(now.tv_sec() * 1_000_000_000 + now.tv_nsec()).expect("after boot")
    };
    let trace = Trace::start();
    let before_ns = now_ns();
    for step in 0..100_u8 {
        handle.set_value(step % 2).expect("a held line");
    }
    let after_ns = now_ns();
    let writes = trace.writes();
    let levels: Vec<bool> = writes.iter().map(|write| write.level).collect();
    assert_eq!(levels, (0..100).map(|step| step % 2 == 1).collect::<Vec<_>>());
    assert!(writes.iter().all(|write| write.line == sim.kernel_number(7)));
    assert!(writes.is_sorted_by_key(|write| write.at_ns));
    assert!(before_ns <= writes[0].at_ns && writes[99].at_ns <= after_ns);
}

/// The reason why Pinion itself filters glitches. If the chip cannot debounce, the kernel debounces with a timer in
/// jiffies. A fan at 10,000 rpm with two pulses per turn then appears to stand still.
#[test]
fn the_kernel_s_debouncing_loses_the_pulses_of_a_fan() {
    let sim = GpioSim::new("lab", 8);
    let mut events = uapi::debounced_input(&sim.path(), 3, 375);
    for edge in 0..200 {
        sim.pull(3, edge % 2 == 0);
        thread::sleep(Duration::from_micros(1500));
    }
    thread::sleep(Duration::from_millis(50));
    sim.pull(3, true);
    thread::sleep(Duration::from_millis(50));
    let mut bytes = vec![0; 300 * 48];
    let seen = events.read(&mut bytes).expect("the last edge at least") / 48;
    println!("{seen} of 201 edges");
    assert!((1..150).contains(&seen), "{seen} of 201 edges");
}
