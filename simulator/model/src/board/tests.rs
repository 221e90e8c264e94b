// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated board in virtual time: the effect of its pins on axes, heaters and fans.

use super::*;
use crate::config::SimConfig;
use crate::config::tests::example;
use crate::description::axes::End;
use crate::description::heater::HeaterConfig;
use crate::description::outputs::InputConfig;
use crate::printer_cfg::{Gains, printer_cfg};
use crate::view::AxisView;
use std::collections::HashSet;

mod boards;
mod buses;
mod examples;

use pinion_firmware::board::{Bias, ChipSelect, Line, ShutdownValue};
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks, VirtualClock};

/// A board in virtual time.
struct Bench {
    board: SimBoard,
    probe: SimProbe,
    clock: VirtualClock,
}

impl Bench {
    fn new(config: SimConfig) -> Bench {
        let clock = VirtualClock::at(Clock::from_ticks(0));
        let board = SimBoard::new(config, Arc::new(clock.clone())).unwrap();
        Bench { probe: board.probe(), board, clock }
    }

    fn advance(&self, seconds: f64) {
        let ticks = (seconds * f64::from(CLOCK_FREQ)).round() as u64;
        self.clock.set(Clock::from_ticks(self.clock.now().ticks() + ticks));
    }

    fn pin(&self, name: &str) -> Pin {
        let pins = self.board.pins();
        Pin(pins.iter().find(|range| range.name == name).unwrap().first)
    }

    fn output(&mut self, name: &str, value: bool) -> Arc<dyn Line> {
        let pin = self.pin(name);
        self.board.line(pin, Direction::at_rest(value)).unwrap().line
    }

    fn input(&mut self, name: &str) -> Arc<dyn Line> {
        let pin = self.pin(name);
        self.board.line(pin, Direction::Input(Bias::PullUp)).unwrap().line
    }

    fn adc(&mut self, name: &str) -> Box<dyn Adc> {
        let pin = self.pin(name);
        self.board.adc(pin).unwrap().device
    }

    fn axis(&self, name: &str) -> AxisView<'_> {
        self.probe.axis(name).unwrap()
    }
}

fn pulse(step: &dyn Line) {
    step.write(true).unwrap();
    step.write(false).unwrap();
}

/// klippy's conversion for the thermistor of a heater.
fn celsius_of(heater: &HeaterConfig, counts: f64) -> f64 {
    let thermistor = heater.thermistor().unwrap();
    let (mut low, mut high) = (-50.0, 500.0);
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        if thermistor.fraction(middle) * 4095.0 > counts {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[test]
fn homing_closes_the_endstop_at_the_exact_step() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let step = bench.output("x_step", false);
    let dir = bench.output("x_dir", false);
    let enable = bench.output("x_enable", true);
    let endstop = bench.input("x_endstop");
    dir.write(false).unwrap();
    enable.write(false).unwrap();
    let start = 60 * 80;
    for i in 1..=start {
        assert!(!endstop.read().unwrap(), "closed after {} steps", i - 1);
        pulse(&*step);
    }
    assert!(endstop.read().unwrap());
    assert_eq!(bench.axis("x").position_mm, 0.0);
    assert_eq!(bench.axis("x").endstop, Some(true));
    // Moving back: open at the first step.
    dir.write(true).unwrap();
    pulse(&*step);
    assert!(!endstop.read().unwrap());
    assert_eq!(bench.axis("x").lost_steps, 0);
}

#[test]
fn an_endstop_at_the_maximum_closes_there_and_may_be_inverted() {
    let mut config = SimConfig::default_printer();
    config.axes[0].endstop_at = End::Max;
    config.axes[0].travel_mm = Some(61.0);
    config.axes[0].endstop_pin = PinName::try_from("!x_endstop".to_owned()).ok();
    let mut bench = Bench::new(config);
    let step = bench.output("x_step", false);
    let _dir = bench.output("x_dir", true);
    let _enable = bench.output("x_enable", false);
    let endstop = bench.input("x_endstop");
    for _ in 0..80 {
        assert!(endstop.read().unwrap());
        pulse(&*step);
    }
    assert!(!endstop.read().unwrap());
    assert_eq!(bench.axis("x").position_mm, 61.0);
}

#[test]
fn an_axis_stays_at_its_hard_limit_and_counts_lost_steps() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let step = bench.output("z_step", false);
    let dir = bench.output("z_dir", false);
    let _enable = bench.output("z_enable", false);
    // From 12 mm to the end at 2 mm below zero, and 7 steps more.
    for _ in 0..14 * 400 + 7 {
        pulse(&*step);
    }
    assert_eq!(bench.axis("z").position_mm, -2.0);
    assert_eq!(bench.axis("z").lost_steps, 7);
    dir.write(true).unwrap();
    pulse(&*step);
    assert_eq!(bench.axis("z").position_mm, -2.0 + 1.0 / 400.0);
}

#[test]
fn an_axis_moves_only_while_its_motor_is_enabled() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let step = bench.output("x_step", false);
    let enable = bench.output("x_enable", true);
    assert!(!bench.axis("x").enabled);
    pulse(&*step);
    assert_eq!(bench.axis("x").position_mm, 60.0);
    enable.write(false).unwrap();
    assert!(bench.axis("x").enabled);
    pulse(&*step);
    assert_eq!(bench.axis("x").position_mm, 60.0 - 1.0 / 80.0);
    assert_eq!(bench.axis("x").lost_steps, 0);
}

#[test]
fn both_edges_step_if_the_description_says_so() {
    let mut config = SimConfig::default_printer();
    config.axes[0].step_both_edges = true;
    config.axes[1].dir_pin.inverted = true;
    let mut bench = Bench::new(config);
    // The claim of a line is not an edge, whatever the level of the line.
    let x_step = bench.output("x_step", true);
    let y_step = bench.output("y_step", false);
    let _enable = [bench.output("x_enable", false), bench.output("y_enable", false)];
    let _dir = [bench.output("x_dir", true), bench.output("y_dir", false)];
    for value in [true, false, false, true] {
        x_step.write(value).unwrap();
        y_step.write(value).unwrap();
    }
    assert_eq!(bench.axis("x").position_mm, 60.0 + 2.0 / 80.0);
    assert_eq!(bench.axis("y").position_mm, 45.0 + 2.0 / 80.0);
}

#[test]
fn a_heater_follows_the_analytic_curve() {
    let config = SimConfig::default_printer();
    let bed = config.heaters[1].clone();
    let mut bench = Bench::new(config);
    let power = bench.output("bed_heater", false);
    bench.advance(10.0);
    power.write(true).unwrap();
    let (p, l, c) = (bed.heater_watts, bed.loss_w_per_k, bed.heat_capacity_j_per_k);
    let ambient = bed.ambient_celsius;
    let warm = |t: f64| ambient + p / l * (1.0 - (-l * t / c).exp());
    for t in 1..=90 {
        bench.advance(1.0);
        // Reading, or writing the same value, changes nothing.
        power.write(true).unwrap();
        let celsius = bench.probe.heater("heater_bed").unwrap().celsius;
        assert!((celsius - warm(f64::from(t))).abs() < 1e-9, "{t} s: {celsius}");
    }
    power.write(false).unwrap();
    bench.advance(100.0);
    let celsius = bench.probe.heater("heater_bed").unwrap().celsius;
    let cooled = ambient + (warm(90.0) - ambient) * (-l * 100.0 / c).exp();
    assert!((celsius - cooled).abs() < 1e-9);
}

#[test]
fn a_sensor_lags_as_the_differential_equation_says() {
    let config = SimConfig::default_printer();
    let hot_end = config.heaters[0].clone();
    let mut bench = Bench::new(config);
    let power = bench.output("hotend_heater", true);
    let (mut mass, mut sensor) = (hot_end.ambient_celsius, hot_end.ambient_celsius);
    for i in 0..6 {
        let on = i % 2 == 0;
        power.write(on).unwrap();
        let watts = if on { hot_end.heater_watts } else { 0.0 };
        // Euler's method in small steps.
        let dt = 1e-5;
        for _ in 0..200_000 {
            let loss = hot_end.loss_w_per_k * (mass - hot_end.ambient_celsius);
            sensor += (mass - sensor) / hot_end.sensor_lag_s * dt;
            mass += (watts - loss) / hot_end.heat_capacity_j_per_k * dt;
        }
        bench.advance(2.0);
        let view = bench.probe.heater("extruder").unwrap();
        assert!((view.celsius - mass).abs() < 1e-3, "{view:?} {mass}");
        assert!((view.sensor_celsius - sensor).abs() < 1e-3, "{view:?} {sensor}");
    }
}

#[test]
fn half_a_duty_cycle_is_half_the_power() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let power = bench.output("bed_heater", false);
    for _ in 0..20_000 {
        power.write(true).unwrap();
        bench.advance(0.05);
        power.write(false).unwrap();
        bench.advance(0.05);
    }
    // 2000 s are eight time constants.
    let celsius = bench.probe.heater("heater_bed").unwrap().celsius;
    let end = 25.0 + 220.0 / 1.6 / 2.0;
    assert!((celsius - end).abs() < 0.05, "{celsius} {end}");
}

#[test]
fn a_reading_is_the_temperature_with_seeded_noise() {
    let config = SimConfig::default_printer();
    let heater = config.heaters[0].clone();
    let mut readings = Vec::new();
    for _ in 0..2 {
        let mut bench = Bench::new(config.clone());
        let mut adc = bench.adc("hotend_sensor");
        let power = bench.output("hotend_heater", true);
        bench.advance(45.0);
        power.write(false).unwrap();
        let counts: Vec<u16> = (0..1000).map(|_| adc.read().unwrap()).collect();
        let mean = counts.iter().map(|&count| f64::from(count)).sum::<f64>() / 1000.0;
        let truth = bench.probe.heater("extruder").unwrap().sensor_celsius;
        assert!((celsius_of(&heater, mean) - truth).abs() < 0.1);
        assert!(counts.iter().any(|count| *count != counts[0]), "no noise");
        readings.push(counts);
    }
    assert_eq!(readings[0], readings[1]);
}

#[test]
fn reset_frees_the_pins_and_the_physics_goes_on() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let power = bench.output("bed_heater", true);
    let step = bench.output("x_step", false);
    let enable = bench.output("x_enable", false);
    bench.advance(60.0);
    pulse(&*step);
    power.write(false).unwrap();
    let before = bench.probe.heater("heater_bed").unwrap();
    let (celsius, position_mm) = (before.celsius, bench.axis("x").position_mm);
    assert!(celsius > 40.0);
    drop((power, step, enable));
    bench.board.reset();
    assert_eq!(bench.probe.heater("heater_bed").unwrap().celsius, celsius);
    assert_eq!(bench.axis("x").position_mm, position_mm);
    bench.output("bed_heater", false);
    bench.advance(60.0);
    let cooled = bench.probe.heater("heater_bed").unwrap().celsius;
    assert!(cooled < celsius && cooled > 25.0);
}

#[test]
fn a_wrong_pin_says_which_and_what_to_do() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let board = &mut bench.board;
    let pin = |name: &str, board: &SimBoard| {
        let pins = board.pins();
        Pin(pins.iter().find(|range| range.name == name).unwrap().first)
    };
    let (step, endstop) = (pin("x_step", board), pin("x_endstop", board));
    let sensor = pin("bed_sensor", board);
    let nowhere = Pin(u32::MAX);
    let output = Direction::at_rest(false);
    let input = Direction::Input(Bias::None);
    let errors = [
        (board.line(nowhere, output).err(), reason::NOT_OUTPUT, "no pin 4294967295"),
        (board.line(endstop, output).err(), reason::NOT_OUTPUT, "x_endstop"),
        (board.line(sensor, output).err(), reason::NOT_OUTPUT, "bed_sensor"),
        (board.line(nowhere, input).err(), reason::NOT_INPUT, "no pin 4294967295"),
        (board.line(step, input).err(), reason::NOT_INPUT, "x_step"),
        (board.adc(nowhere).err(), reason::ADC_OPEN, "no pin 4294967295"),
        (board.adc(endstop).err(), reason::ADC_OPEN, "x_endstop"),
    ];
    for (error, reason, subject) in errors {
        let error = error.unwrap();
        assert_eq!(error.reason, reason);
        assert!(error.trouble.cause.contains(subject) && error.trouble.remedy.is_some(), "{error:?}");
    }
}

#[test]
fn a_fan_spins_up_and_its_tachometer_counts_the_turns() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let tachometer = bench.input("fan_tachometer");
    let fan = bench.output("fan", true);
    bench.advance(0.4);
    let rpm = bench.probe.fan("fan").unwrap().rpm;
    assert!((rpm - 4500.0 * (1.0 - (-1f64).exp())).abs() < 1e-6);
    bench.advance(10.0);
    // 4500 rpm are 75 turns, 150 pulses and 300 edges a second. klippy polls every 1.5 ms.
    let mut edges = 0;
    let mut last = tachometer.read().unwrap();
    for _ in 0..20_000 {
        bench.advance(0.0015);
        let level = tachometer.read().unwrap();
        edges += u32::from(level != last);
        last = level;
    }
    assert!(edges.abs_diff(300 * 30) <= 1, "{edges}");
    // Avoid a time at which a whole number of turns ends on an edge.
    bench.advance(0.001);
    fan.write(false).unwrap();
    bench.advance(10.0);
    assert!(bench.probe.fan("fan").unwrap().rpm < 1e-6);
    let stopped = tachometer.read().unwrap();
    for _ in 0..100 {
        bench.advance(0.1);
        assert_eq!(tachometer.read().unwrap(), stopped);
    }
}

#[test]
fn a_fan_with_an_enable_pin_needs_both() {
    let mut config = SimConfig::default_printer();
    config.fans[0].enable_pin = PinName::try_from("!fan_enable".to_owned()).ok();
    let mut bench = Bench::new(config);
    let _fan = bench.output("fan", true);
    bench.advance(5.0);
    assert_eq!(bench.probe.fan("fan").unwrap().rpm, 0.0);
    let enable = bench.output("fan_enable", true);
    enable.write(false).unwrap();
    bench.advance(5.0);
    assert!(bench.probe.fan("fan").unwrap().rpm > 4490.0);
}

#[test]
fn lights_and_fixed_inputs() {
    let mut config = SimConfig::default_printer();
    let pin = PinName { name: "door".into(), inverted: false };
    config.inputs.push(InputConfig { name: "door".into(), pin, level: true });
    let mut bench = Bench::new(config);
    let led = bench.output("led", false);
    assert!(!bench.probe.output("light").unwrap().on);
    led.write(true).unwrap();
    assert!(bench.probe.output("light").unwrap().on);
    assert!(bench.input("door").read().unwrap());
}

#[test]
fn every_pin_has_its_own_name_and_number_and_stands_in_printer_cfg() {
    let config = SimConfig::default_printer();
    let cfg = printer_cfg(&config, "/tmp/klipper_host_mcu");
    assert!(cfg.contains("serial: /tmp/klipper_host_mcu\n"));
    // The data output of a bus is also a pin.
    let buses: Vec<String> = config.spi_buses.iter().map(|bus| bus.name.clone()).collect();
    let bench = Bench::new(config);
    let pins = bench.board.pins();
    for (number, range) in (0..).zip(&pins) {
        assert_eq!((range.first, range.count), (number, 1));
        let named = cfg.split([' ', '!', '\n']).any(|word| word == range.name);
        assert!(named || buses.contains(&range.name), "{} is not in\n{cfg}", range.name);
    }
    let names: HashSet<&String> = pins.iter().map(|range| &range.name).collect();
    assert_eq!(names.len(), pins.len());
}

#[test]
fn printer_cfg_moves_as_far_as_the_board() {
    let mut config = SimConfig::default_printer();
    config.axes[1].step_both_edges = true;
    let cfg = printer_cfg(&config, "/tmp/pty");
    // 200 full steps of 16 microsteps per turn, 80 or 400 steps per millimeter.
    for (section, expected) in [("x", "40"), ("y", "80"), ("z", "8")] {
        let section = cfg.split(&format!("[stepper_{section}]\n")).nth(1).unwrap();
        let section = section.split("\n\n").next().unwrap();
        assert!(section.contains(&format!("rotation_distance: {expected}\n")), "{section}");
        assert!(section.contains("microsteps: 16\n"));
    }
}

/// klippy's heater loop (`klippy/extras/heaters.py`: `ControlPID`, the soft PWM, its delays) around the board, with the
/// parameters in printer.cfg.
#[test]
fn klippy_holds_the_targets_and_finds_no_fault_with_the_heaters() {
    for (index, pin, sensor, target, seconds) in
        [(0, "hotend_heater", "hotend_sensor", 200.0, 45.0..75.0), (1, "bed_heater", "bed_sensor", 60.0, 60.0..90.0)]
    {
        let config = SimConfig::default_printer();
        let heater = config.heaters[index].clone();
        let gains = Gains::of(&heater);
        let [kp, ki, kd] = [gains.kp, gains.ki, gains.kd].map(|gain| gain / 255.0);
        let mut bench = Bench::new(config);
        let power = bench.output(pin, false);
        let mut adc = bench.adc(sensor);
        let (mut last, mut slope, mut integral) = (25.0, 0.0, 0.0);
        let (mut duty, mut reached, mut hottest, mut coldest) = (0.0, None, 0f64, f64::MAX);
        for report in 0..1000 {
            let now = 0.3 * f64::from(report);
            let samples: u16 = (0..8).map(|_| adc.read().unwrap()).sum();
            let celsius = celsius_of(&heater, f64::from(samples) / 8.0);
            slope = slope * 0.7 + (celsius - last);
            last = celsius;
            let error = target - celsius;
            let next_integral = (integral + error * 0.3).clamp(0.0, 1.0 / ki);
            let output: f64 = kp * error + ki * next_integral - kd * slope;
            if (0.0..=1.0).contains(&output) {
                integral = next_integral;
            }
            // klippy's decision takes effect 0.3 s later.
            let in_force = std::mem::replace(&mut duty, output.clamp(0.0, 1.0));
            for _ in 0..3 {
                power.write(in_force > 0.0).unwrap();
                bench.advance(0.1 * in_force);
                power.write(in_force >= 1.0).unwrap();
                bench.advance(0.1 * (1.0 - in_force));
            }
            let truth = bench.probe.heaters().nth(index).unwrap().celsius;
            hottest = hottest.max(truth);
            if error.abs() <= 1.0 && slope.abs() <= 0.1 && reached.is_none() {
                reached = Some(now);
            }
            if reached.is_some_and(|reached| now > reached + 5.0) {
                coldest = coldest.min(truth);
            }
        }
        let name = &heater.name;
        assert!(reached.is_some_and(|s| seconds.contains(&s)), "{name}: {reached:?} s");
        assert!(hottest < target + 2.0, "{name}: {hottest}");
        assert!(coldest > target - 2.0, "{name}: {coldest}");
    }
}

/// Uses everything in a printer, also with bytes that no host would send.
fn use_all(config: SimConfig) {
    let _ = printer_cfg(&config, "/tmp/pty");
    let mut bench = Bench::new(config);
    let mut lines: Vec<Arc<dyn Line>> = Vec::new();
    for number in 0..bench.board.pins.len() {
        let pin = Pin(number as u32);
        let output = Direction::at_rest(true);
        lines.extend(bench.board.line(pin, output).map(|claimed| claimed.line));
        lines.extend(bench.board.line(pin, Direction::Input(Bias::None)).map(|claimed| claimed.line));
        if let Ok(OnWorker { mut device, .. }) = bench.board.adc(pin) {
            device.read().unwrap();
        }
        let cycle = Ticks::from_ms(1);
        let _ = bench.board.pwm(PwmConfig { pin, cycle, value: 12_345, shutdown_value: ShutdownValue::default() });
    }
    let mut noise = Noise::of("bytes", 1);
    for seconds in [0.0, 0.002, 1e5] {
        bench.advance(seconds);
        for line in &lines {
            for level in [true, false] {
                line.write(level).unwrap();
                line.read().unwrap();
            }
        }
        // Every chip with a low select line is selected.
        for (bus, mode) in (0..bench.board.spi_buses.len()).flat_map(|bus| [(bus, 0), (bus, 1), (bus, 3)]) {
            let config = SpiConfig { bus: bus as u32, mode, rate_hz: 1_000_000, chip_select: None };
            let OnWorker { mut device, .. } = bench.board.spi(config).unwrap();
            for length in [0, 1, 2, 3, 5, 9, 40] {
                let mut bytes: Vec<u8> = (0..length).map(|_| (noise.draw() * 100.0) as i32 as u8).collect();
                device.exchange(&mut bytes).unwrap();
            }
        }
        let addresses: &[u8] = if bench.board.i2c_buses.is_empty() { &[] } else { &[42, 60] };
        for address in addresses.iter().copied() {
            let OnWorker { mut device, .. } = bench.board.i2c(I2cConfig { bus: 0, address, rate_hz: 400_000 }).unwrap();
            // The measurement of the coil's chip since its wake-up, with a given drive current; then anything.
            for message in [&[0x00][..], &[0x1e, 0x80, 0x00], &[0x1a, 0x16, 0x01], &[0x7f, 0xff, 0xff, 0xff], &[]] {
                // If the changed number is the address, no chip answers.
                let _ = device.write_read(message, &mut [0; 3]);
                let _ = device.write_read(message, &mut []);
            }
        }
        bench.probe.heaters().for_each(drop);
        bench.probe.fans().for_each(drop);
    }
    // Once: displays have thousands of pixels.
    bench.probe.sights().for_each(drop);
}

#[test]
fn no_number_of_a_description_makes_it_panic() {
    let used = use_with_each_number(SimConfig::default_toml(), "");
    assert!(used > 300, "{used}");
    let used = use_with_each_number(&example("A delta printer"), "");
    assert!(used > 30, "{used}");
    let used = use_with_each_number(&example("A chamber with a fan"), "name = \"chamber\"");
    assert!(used > 30, "{used}");
}

/// Uses a printer with other values for each number after this text. Returns the number of printers.
fn use_with_each_number(toml: &str, behind: &str) -> u32 {
    let lines: Vec<&str> = toml.lines().collect();
    let first = lines.iter().position(|line| line.contains(behind)).unwrap();
    let mut used = 0;
    for (place, line) in lines.iter().enumerate().skip(first) {
        let Some((key, _)) = line.split_once(" = ").filter(|(_, value)| value.parse::<f64>().is_ok()) else { continue };
        for value in ["0", "1", "-1", "31", "255", "65535", "1000000000", "-1e9", "1e-9", "1e9", "nan"] {
            let changed = format!("{key} = {value}");
            let text = [&lines[..place], &[&changed], &lines[place + 1..]].concat().join("\n");
            if let Ok(config) = SimConfig::parse(&text, "test") {
                used += 1;
                use_all(config);
            }
        }
    }
    used
}
